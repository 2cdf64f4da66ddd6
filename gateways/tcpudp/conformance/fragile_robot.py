"""A simulated TCP/UDP robot as fragile as the legacy ones: the judge of a gateway that plays HQ."""

from __future__ import annotations

import asyncio
import contextlib
import enum
import math
import random
import socket
import time
from collections.abc import Collection, Iterable

from gateways.tcpudp.conformance import parser as wire
from gateways.tcpudp.conformance.machine import JudgedRobot, Loss, Quirks
from gateways.tcpudp.conformance.parser import Channel, FeatureFlag, ParsedPacket, RobotTimes
from zbridge.simulation.fragile import FragileServer, Work
from zbridge.simulation.judge import Chances, show
from zbridge.simulation.sockets import bind_tcp_and_udp, readable
from zbridge.simulation.timing import PollingReader, Ticker

_STEP_S, _MOST_MOVE_S = 0.02, 0.1
"""Seconds between two steps of the robot, and most seconds for which it moves in one."""
_POLL_S = 0.006
"""Seconds between two polls of a connection that brings nothing: less than the spacing that is demanded."""


class _RobotPhase(enum.Enum):
    LISTENING = enum.auto()
    GREETED = enum.auto()
    ASLEEP = enum.auto()
    WOKEN = enum.auto()
    ESTABLISHED = enum.auto()
    FROZEN = enum.auto()


_DEPLOYED, _NO_QUIRKS = RobotTimes(), Quirks()
_EXPECTED = {
    _RobotPhase.GREETED: {wire.DEBUG, wire.CLIENT_SETTINGS},
    _RobotPhase.ASLEEP: {wire.UDP_PROBE, wire.UDP_STATUS},
    _RobotPhase.WOKEN: {wire.UDP_PROBE, wire.UDP_STATUS},
}


class FragileRobot(FragileServer):
    """A robot of one version: serves one connection, records every violation and dies of the deadly ones.

    ``features``: flags announced besides UDP, default all of the version. A row of ``received`` and of the lists like
    it: monotonic seconds, channel, id, body.
    """

    _phase: _RobotPhase
    _polling: PollingReader

    def __init__(
        self,
        *,
        version: str,
        udp: bool,
        seed: int,
        features: Collection[FeatureFlag] | None = None,
        times: RobotTimes = _DEPLOYED,
        quirks: Quirks = _NO_QUIRKS,
    ) -> None:
        super().__init__()
        self.version = version
        self.features = wire.announcement(version, features, udp=udp)
        self.client_id = quirks.client_id or random.Random(seed).randint(1, 255)
        self.misread = self._rows()
        self.piled = self._rows()
        """What was lost in a read that this process itself joined, because it was late."""
        self.ignored = self._rows()
        """What robots of 1.1 and 1.2 ignored: the first packet read alone after they lost what had piled up."""
        self._registered = wire.registered(version, self.features | frozenset(quirks.obeys))
        self._times, self._quirks, self._chance = times, quirks, Chances(seed)
        self._poor = False
        """True for a connection after the first."""
        self.machine = JudgedRobot(self._chance["talk"], quirks.side)
        self._phase = _RobotPhase.LISTENING
        self._udp: socket.socket | None = None
        self._wake_at = self._closed_s = self._awake_s = 0.0
        """This process's own time, which stops while the process is late: it judges what was in flight."""
        self._forget()

    def _forget(self) -> None:
        self._reads = wire.ReadChecker()
        self._ignores_next = False
        self._awake = asyncio.Event()
        self._hq_features: frozenset[FeatureFlag] = frozenset()
        self._source: tuple[str, int] | None = None
        self._probes = 0
        self._offered = self._answered = self._asked_map = False
        self._quiet_until = -math.inf
        self._status: bool | None = None
        self._parts_since = math.inf

    def _bind(self, host: str, port: int, sockets: contextlib.ExitStack) -> socket.socket:
        """Bind TCP and UDP to the same number ("Links")."""
        tcp, self._udp = bind_tcp_and_udp(host, port)
        sockets.enter_context(self._udp)
        return sockets.enter_context(tcp)

    def _work(self) -> Iterable[Work]:
        assert self._udp is not None
        return self._read_datagrams(self._udp), self._move()

    # TCP

    def _free(self) -> bool:
        """With ``again``: whether the last connection is over ("One connection per start" in ``fragile-robots.md``)."""
        return self._quirks.again and self._conn is None

    def _begin(self, conn: socket.socket) -> None:
        """Begin with an HQ; a connection after the first is a poor one."""
        if self._phase is not _RobotPhase.LISTENING:
            self._poor, self.client_id, self._broken = True, max(2, self.client_id) % 255 + 1, ""
            self._forget()
        self._phase = _RobotPhase.GREETED
        self._start(self._converse(conn))

    def cut(self) -> None:
        self._shut()

    async def _converse(self, conn: socket.socket) -> None:
        """Speak first, then take one packet per read with a short sleep in between ("Handshake")."""
        try:
            settings = wire.server_settings(self.version, self.client_id, self.features, self._quirks.side)
            await self._send(wire.SERVER_SETTINGS, settings)
            self._polling = PollingReader(conn, wire.READ_BYTES)
            while data := await self._polling.read(_POLL_S):
                await self._read_packet(data)
                await asyncio.sleep(self._chance["sleep"].uniform(0, self._times.read_s))
            self._event(f"the connection broke: {self._broken}" if self._broken else "the HQ closed the connection")
        except OSError as error:
            self._event(f"the connection broke: {error!r}")
        finally:
            self._shut()
            self._phase, self._conn, self._closed_s = _RobotPhase.FROZEN, None, self._awake_s
            self._awake.set()

    async def _read_packet(self, data: bytes) -> None:
        """Take one read as one packet: what piled up while this process was stalled is lost.

        Joined packets are the HQ's fault if they came in less time, since a poll found nothing, than correctly spaced
        packets need; the text says how long this process did not read if it may be at fault itself.
        """
        received, problem = self._reads.check(data)
        joined, unread_s = self._reads.joined, self._polling.unread_s
        if joined and unread_s >= self._times.gap_s * (len(joined) - 1):
            problem += f" (this process read nothing for {unread_s * 1000:.0f} ms)"
            self.piled += [(time.monotonic(), "tcp", packet.kind, packet.body) for packet in joined]
        if problem:
            self._violate(problem)
        if joined:
            self._ignores_next = self.version in wire.IGNORE_ONE
        elif received is not None and self._ignores_next:
            self._ignores_next = False
            self.ignored.append((time.monotonic(), "tcp", received.kind, received.body))
        elif received is not None:
            await self._judge(received, "tcp")

    async def _send(self, kind: int, body: bytes = b"", *, by_udp: bool = False) -> None:
        """Send by UDP what the table marks UDP* when that was agreed, all else by TCP ("Versions and dialects")."""
        data = wire.packet(kind, body)
        if self._phase is _RobotPhase.ESTABLISHED and self._loses():
            return
        if by_udp or (kind in wire.BY_UDP and self._status):
            if self._udp is not None and self._source is not None:
                with contextlib.suppress(OSError):
                    self._udp.sendto(data, self._source)
        elif self._conn is not None:
            try:
                async with asyncio.timeout(self._times.send_s), self._sending:
                    await self._write(data)
            except TimeoutError:
                self._event(f"the HQ read nothing for {self._times.send_s:g} s")
                self._shut()

    # UDP

    async def _read_datagrams(self, udp: socket.socket) -> None:
        while True:
            await readable(udp)
            try:
                data, source = udp.recvfrom(wire.DATAGRAM_BYTES)
            except OSError:  # taken by another read, or the report that a datagram of ours was not delivered
                continue
            await self._datagram(data, source[:2])

    async def _datagram(self, data: bytes, source: tuple[str, int]) -> None:
        """Take one datagram ("What crashes a peer" in ``fragile-robots.md``: none may come before its packet 4)."""
        if self._loses():
            return
        if self._phase is _RobotPhase.FROZEN:
            if self._awake_s - self._closed_s > self._times.flight_s:
                self._violate(f"a datagram after the TCP connection ended: {show(data)}")
            return
        if not self._offered:
            before = "TCP" if self._phase is _RobotPhase.LISTENING else "the robot sent 4"
            self._die(f"a datagram before {before}: {show(data)}")
        received = wire.datagram(data)
        if received is None:
            self._die(f"a datagram whose length field is wrong: {show(data)}")
        if time.monotonic() >= self._wake_at:
            await self._awake.wait()  # the loop may run the two readers in either order
        if received.kind == wire.UDP_PROBE and self._source is None:
            self._source = source
        if self._source is None:
            self._violate(f"a datagram before the probe 5: {show(data)}")
        elif source != self._source:
            self._violate(f"a datagram from {source}, not from where 5 came from: {show(data)}")
        else:
            await self._judge(received, "udp")

    async def _probe(self) -> None:
        """Answer the first 5 with 6(true) from the TCP port's number, to where it came from ("Handshake")."""
        self._probes += 1
        if self._probes > 1:
            self._violate(f"{self._probes} probes 5 by UDP instead of one")
        elif self._phase is not _RobotPhase.ASLEEP:
            self._violate(f"the probe 5 came later than {self._times.probe_s:g} s after the 4")
        elif self._quirks.loss is Loss.NOTHING and not self._loses():
            self._answered = True
            await self._send(wire.UDP_ANSWER, b"\x01", by_udp=True)

    # Packets

    async def _judge(self, received: ParsedPacket, channel: Channel) -> None:
        kind, body = received.kind, received.body
        raw = f"{channel} packet {kind}, body {show(body)}"
        if self._phase is _RobotPhase.ESTABLISHED and self._chance[f"misread {kind}"].random() < self._quirks.misread:
            return self.misread.append((time.monotonic(), channel, kind, body))
        if self._phase is _RobotPhase.ESTABLISHED and channel == "tcp" and self._loses():
            return None
        self.received.append((time.monotonic(), channel, kind, body))
        if kind not in self._registered:
            self._die(f"unregistered packet id {kind} for a robot {self.version} with these flags: {raw}")
        senders = {0, self.client_id} if self._phase is _RobotPhase.GREETED else {self.client_id}
        if received.sender not in senders:
            self._violate(f"id byte {received.sender} instead of {self.client_id}: {raw}")
        if kind == wire.DEBUG and body == bytes(4):
            self._die(f"a debugMessage with an empty text: {raw}")
        if self._report(self._problem(kind, body, channel), raw):
            return None
        return await self._obey(kind, body)

    def _problem(self, kind: int, body: bytes, channel: Channel) -> str:
        by_udp = kind == wire.UDP_PROBE or (kind in wire.BY_UDP and bool(self._status))
        expected = _EXPECTED.get(self._phase)
        if expected is not None and kind not in expected:
            return f"packet {kind} while the robot waits for {' or '.join(map(str, sorted(expected)))}"
        if by_udp != (channel == "udp"):
            return f"packet {kind} by {channel.upper()} instead of {'UDP' if by_udp else 'TCP'}"
        if channel == "tcp" and kind != wire.UDP_STATUS and time.monotonic() < self._quiet_until:
            return f"packet {kind} by TCP within {self._times.silence_s:g} s of the 4"
        if kind == wire.GET_MAP and self._awake_s - self._parts_since > self._times.flight_s:
            return "packet 52 to a robot that sends its map in parts by itself"
        return wire.body_problem(kind, body)

    async def _obey(self, kind: int, body: bytes) -> None:
        if kind == wire.UDP_PROBE:
            await self._probe()
        elif kind == wire.CLIENT_SETTINGS:
            await self._settle(body)
        elif kind == wire.UDP_STATUS:
            self._conclude(any(body))
        elif kind in (wire.MOVE, wire.ROTATE, wire.STOP):
            self.machine.steer(body)
        elif kind == wire.MODE:
            self.machine.choose(body)
        elif kind == wire.LIDAR_MODE:
            self.machine.lidar_on = body[0] == 1
            await self._send(wire.LIDAR_STATUS, self.machine.body(wire.LIDAR_STATUS))
        elif kind == wire.GET_POSITION:
            misnamed = self._chance["answer"].random() < self._quirks.misnamed
            await self._send(wire.MAP if misnamed else wire.POSITION, self.machine.body(wire.POSITION))
        elif kind == wire.GET_MAP:  # the first answer of a 1.1 robot is no map yet, the handler of a "1.4" is empty
            first, self._asked_map = not self._asked_map, True
            if self.version != "1.4":
                none_yet = first and self.version == "1.1"
                await self._send(wire.MAP, b"" if none_yet else self.machine.body(wire.MAP))

    # Handshake

    async def _settle(self, body: bytes) -> None:
        """Take the HQ's settings; judge its version string ("Versions and dialects")."""
        if self._phase is not _RobotPhase.GREETED:
            return self._violate(f"a second clientSettings: {show(body)}")
        settings = wire.client_settings(body)
        if wire.deadly(self.version, settings):
            self._die(f"a version list of {settings.versions.count(',') + 1} entries to a {self.version}: {show(body)}")
        if settings.versions == (safe := wire.UNDERSTOOD[self.version]):
            self._hq_features = settings.features
        else:
            self._violate(f"versions {settings.versions!r} to a robot that understands {safe!r} only: {show(body)}")
        self._report(settings.problem, show(body))
        if FeatureFlag.UDP in self.features & self._hq_features:
            return await self._offer_udp()
        return self._establish()

    async def _offer_udp(self) -> None:
        """Send 4, sleep, then take in one read what came meanwhile: the single 7 ("Handshake")."""
        self._offered, self._phase = True, _RobotPhase.ASLEEP
        self._wake_at = time.monotonic() + self._times.probe_s
        self._quiet_until = time.monotonic() + self._times.silence_s
        await self._send(wire.START_UDP)
        self._start(self._miss_status())
        await asyncio.sleep(self._times.probe_s)
        late_s = time.monotonic() - self._wake_at
        self._phase = _RobotPhase.WOKEN
        self._awake.set()
        data = self._polling.poll()
        if data == b"":
            return
        if not self._answered and self._quirks.loss is not Loss.ANSWER:
            await self._send(wire.UDP_ANSWER, b"\x00")
        if not self._probes:
            self._violate(f"no 5 by UDP within {self._times.probe_s:g} s of the 4")
        if data is not None:
            packets, rest, _ = wire.cut(data)
            if rest or [packet.kind for packet in packets] != [wire.UDP_STATUS]:
                problem = f"TCP other than one 7 within {self._times.probe_s:g} s of the 4: {show(data)}"
                late = f" (this process slept {late_s:.2f} s too long)"
                self._violate(problem + late * (self._times.probe_s + late_s >= self._times.silence_s))
            await self._read_packet(data)

    async def _miss_status(self) -> None:
        await asyncio.sleep(2 * self._times.probe_s)
        if self._status is None and self._conn is not None:
            self._violate(f"no 7 within {2 * self._times.probe_s:g} s of the 4")

    def _conclude(self, connected: bool) -> None:
        if not self._offered or self._status is not None:
            return self._violate("a second 7" if self._offered else "a 7 though the robot sent no 4")
        if connected and not self._answered:
            self._violate("7(true) though no 6(true) was received")
        if not connected and self._answered:
            self._event("7(false) though 6(true) was sent by UDP")
        self._status = connected and self._answered
        return self._establish()

    def _establish(self) -> None:
        self._phase = _RobotPhase.ESTABLISHED
        if self._poor:
            return
        if self._times.unasked_s:
            self._start(self._chatter(self._conn))
        if self.version == "1.4" and FeatureFlag.LIDAR_SIM in self._hq_features:
            self._start(self._send_parts(self._conn))

    def _loses(self) -> bool:
        """Return whether the connection is a poor one and loses the packet."""
        return self._poor and self._chance["loss"].random() < 0.5

    # Motion, maps, talk

    async def _move(self) -> None:
        """Move as commanded, for ever: a legacy robot does not stop by itself."""
        ticker = Ticker(_STEP_S)
        while True:
            await ticker.tick()
            self._awake_s += min(ticker.passed_s, _STEP_S)
            self.machine.step(min(ticker.passed_s, _MOST_MOVE_S))

    async def _send_parts(self, conn: socket.socket | None) -> None:
        """Send the map in parts again and again; TCP is read meanwhile ("Limits")."""
        while True:
            for body in self.machine.parts(self._quirks.parts):
                if self._conn is not conn:
                    return
                await self._send(wire.MAP_PART, body)
                self._parts_since = min(self._parts_since, self._awake_s)
                await asyncio.sleep(self._times.part_s)

    async def _chatter(self, conn: socket.socket | None) -> None:
        mean = self._times.unasked_s
        for kind, body in self.machine.unasked(self.version, self.features, self._hq_features):
            await asyncio.sleep(self._chance["pause"].uniform(0.5 * mean, 1.5 * mean))
            if self._conn is not conn:
                return
            await self._send(kind, body or self.machine.body(kind))
