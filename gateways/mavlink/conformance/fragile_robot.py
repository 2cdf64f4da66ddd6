"""A simulated ArduRover as fragile as deployed ones: the judge of a gateway that plays the ground station."""

from __future__ import annotations

import enum
import socket
import time
from collections import Counter
from collections.abc import Iterable, Mapping

from gateways.mavlink.conformance.machine import GatewayAsStation, StationRules
from gateways.mavlink.conformance.parser import MavlinkReader, ParsedMavlinkFrame, write_frame
from gateways.mavlink.conformance.rover import JudgedRover, RoverQuirks, SentMessage
from zbridge.simulation.fragile import FragileServer, Work
from zbridge.simulation.judge import Chances, show
from zbridge.simulation.sockets import drain, reset_on_close
from zbridge.simulation.timing import Ticker

_CYCLE_S, _SEND_S = 0.02, 5.0
_GARBAGE_S = 0.5


class _RoverPhase(enum.Enum):
    LISTENING = enum.auto()
    CONNECTED = enum.auto()
    LEFT = enum.auto()


class FragileRover(FragileServer):
    """One vehicle behind a TCP listener, for one connection after the other; it records every violation.

    ``expected``: what the gateway is configured to be; ``params``: of the vehicle, where others than the deployed ones.
    A row of ``received``: monotonic seconds, name, fields, source. Its position and motion are those of ``machine``.
    """

    KEEP = 100_000
    _phase: _RoverPhase
    _reader: MavlinkReader

    def __init__(
        self,
        *,
        expected: GatewayAsStation | None = None,
        quirks: RoverQuirks | None = None,
        params: Mapping[str, float] | None = None,
        seed: int = 1,
    ) -> None:
        super().__init__()
        expected = expected or GatewayAsStation()
        self.quirks = quirks or RoverQuirks()
        self.rules = StationRules(expected, self._violate)
        self.machine = JudgedRover(self.rules, quirks=self.quirks, system_id=expected.vehicle_id, params=params)
        self._phase, self._numbered = _RoverPhase.LISTENING, expected.numbered
        self._reader = MavlinkReader(numbered=self._numbered)
        self._chance = Chances(seed)
        self._seqs: Counter[tuple[int, int]] = Counter()
        self._stalled_until = self._garbage_due = 0.0
        self._held = b""

    @property
    def moving(self) -> bool:
        """Whether it moves or is commanded to."""
        return self.machine.moving

    def pilot_drives(self, mode: int) -> None:
        """Change the mode as an RC pilot, a mission or another GCS would; from now on only a stop may change it."""
        self.machine.choose(mode)
        self.rules.piloted()

    def pilot_leaves(self) -> None:
        """Let the gateway have the vehicle again; the mode stays."""
        self.rules.piloted(False)

    def expect_stop(self) -> None:
        """Note that somebody ordered a stop: it may act in any mode."""
        self.rules.expect_stop()

    def stall(self, seconds: float) -> None:
        """Read nothing for some time; it moves and sends all the same."""
        self._stalled_until = time.monotonic() + seconds

    def cut(self) -> None:
        """Reset the connection; the next one is served."""
        if self._conn is not None:
            reset_on_close(self._conn)
            if self._midway:  # the write that waits must end first
                self._shut()
            else:
                self._conn.close()
            self._leave("the vehicle cut the connection")

    # The connection

    def _free(self) -> bool:
        return self._conn is None

    def _begin(self, conn: socket.socket) -> None:
        self._phase, self._broken, self._held = _RoverPhase.CONNECTED, "", b""
        self._reader = MavlinkReader(numbered=self._numbered)
        self._seqs.clear()
        self.rules.connected()
        self.machine.connected(time.monotonic())

    def _work(self) -> Iterable[Work]:
        return (self._live(),)

    def _leave(self, why: str) -> None:
        self._event(f"{why}, {'moving' if self.machine.moving else 'at rest'}")
        self._phase, self._conn = _RoverPhase.LEFT, None

    async def _live(self) -> None:
        """Read, judge, move and measure in cycles. A late cycle counts as one of the right length."""
        ticker = Ticker(_CYCLE_S)
        while True:
            await ticker.tick()
            now = time.monotonic()
            if now >= self._stalled_until:
                self.rules.step(now, min(ticker.passed_s, _CYCLE_S) if self._conn is not None else 0.0)
                if self._conn is not None:
                    self._take(*drain(self._conn))
            self.machine.step(now)
            await self._send(now)

    def _receive(self, message: ParsedMavlinkFrame) -> None:
        source = message.sysid, message.compid
        self.received.append((time.monotonic(), message.name, message.fields, source))
        self._report(message.problem, show(message.raw))
        if message.fields:
            self.rules.receive(message)
            self.machine.receive(message)

    def _judge_end(self, end: str) -> None:
        if self._reader.rest:
            self._violate(f"the connection ended within a frame: {show(self._reader.rest)}")
        self._shut()
        self._leave(f"the gateway closed the connection: {end}")

    # Frames of the vehicle

    async def _send(self, now: float) -> None:
        """Write what is due, joined, or cut as the seed says; nothing without a connection."""
        data = self._held + b"".join(self._write_one(message) for message in self.machine.out)
        self.machine.out.clear()
        if self._conn is None or self._broken:
            return
        if self.quirks.garbage and now >= self._garbage_due:
            self._garbage_due = now + _GARBAGE_S
            data += self._garbage()
        self._held = b""
        if self.quirks.cuts and data:
            cut = self._chance["cuts"].randrange(len(data) + 1)
            data, self._held = data[:cut], data[cut:]
        if not data:
            return
        conn = self._conn
        try:
            await self._write(data, _SEND_S)
        except TimeoutError:
            if conn is self._conn:
                self._shut()
                self._leave(f"the gateway read nothing for {_SEND_S:g} s")

    def _write_one(self, message: SentMessage) -> bytes:
        seq = self._seqs[message.source]
        self._seqs[message.source] = (seq + 1) % 256
        return write_frame(message.name, message.fields, message.source, seq, v1=self.quirks.v1 and _has_v1(message))

    def _garbage(self) -> bytes:
        """Return noise, and a frame whose length byte says more than follows ("Frames": it swallows nothing)."""
        noise = self._chance["garbage"].randbytes(7)
        frame = bytearray(write_frame("ATTITUDE", {"yaw": 1.0}, (self.rules.vehicle_id, 1), 0))
        frame[1] = 255
        return noise + bytes(frame)


def _has_v1(message: SentMessage) -> bool:
    return message.name != "OBSTACLE_DISTANCE"  # its id is above 255
