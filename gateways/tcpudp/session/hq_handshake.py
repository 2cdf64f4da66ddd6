"""The handshake of the gateway as HQ with one robot, and the signs of a poor connection. Sans-IO.

Source: "Handshake", "Settings and version negotiation" and "The gateway as HQ" of the protocol page; for the signs "One
usable connection per start".

Theory of operation. The handshake is the table at the foot of this file: :class:`HqStep` says what the session waits
for, :class:`HqEvent` what can happen, and every row names the action that is taken. The session is ``established`` from
the steps STREAM, GIVEN_UP and DONE on. A robot that sent 4 sleeps 2 s and then takes one read as one packet, so for
:data:`SILENCE_S` nothing leaves by TCP but one 7: before the handshake ends, and in the LATE steps, where commands are
refused with :data:`LATE_START`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any, ClassVar

from gateways.tcpudp import messages as packets
from gateways.tcpudp.session import PacketSession, decoders
from gateways.tcpudp.settings import ROBOT_BLOCKS, SETTINGS, VERSIONS, Feature, Settings, announced, read_settings
from zbridge.protocol import Datagram, Handshake, Kept, Limits, ProtocolError, Role, Traffic, agree, parse_versions

FIRST_CLIENT = 2
"""The id that most robots give their first client; a legacy one gave 35."""
INSPECT_S = 5.0
"""Seconds after which a silent connection is a sign."""
INSPECT_AGAIN_S = 1.0
MALFORMED, MALFORMED_SHARE = 3, 0.05
"""Malformed packets are a sign from this number and from this share of all packets on."""
LATER_CLIENT = "another program is connected, or the one usable connection is used up"
GARBLED = "malformed packets"
UNANSWERED = f"no telemetry and no answer to the probe within {INSPECT_S:g} s"
MUTE = f"no telemetry within {INSPECT_S:g} s, unlike on the connection before"


class Signs(Kept):
    """The signs on one connection. ``before``: the signs on the connection before."""

    kept: ClassVar[dict[str, Any]] = {
        "talks": bool,
        "_expected": bool,
        "_talked": bool,
        "_inspected": bool,
        "_asked": int,
        "_silent": str | None,
    }

    def __init__(self, before: Signs | None = None) -> None:
        self.talks: bool = before is not None and before.talks
        """Whether the robot sent telemetry unasked within :data:`INSPECT_S`, on this connection or one before."""
        self._expected = self.talks
        self._talked = self._inspected = False
        self._asked = 0
        self._silent: str | None = None

    def __repr__(self) -> str:
        return f"<Signs talks={self.talks} {self._silent}>"

    def note_queries(self, received: int, questions: int = 1) -> None:
        """Count queries that were just sent: their answers are not telemetry."""
        self._note_telemetry(received)
        self._asked += questions

    def inspect(self, received: int, *, unanswered: bool) -> None:
        """Judge whether the robot is silent. Call first at :data:`INSPECT_S`; ``unanswered``: a probe got no answer.

        Some robots send nothing until they are asked: silence is a sign only if the robot sent telemetry on the
        connection before, or did not answer the probe.
        """
        self._note_telemetry(received)
        if not self._inspected:
            self._inspected, self.talks = True, self.talks or self._talked
        if self._expected and not self._talked:
            self._silent = MUTE
        else:
            self._silent = UNANSWERED if unanswered and not received else None

    def listing(self, client_id: int, traffic: Traffic) -> tuple[str, ...]:
        """List the present signs, for people.

        A client id above :data:`FIRST_CLIENT` is listed only with another sign: a second HQ program gets such an id
        too, and some robots begin with any number.
        """
        few = traffic.malformed < max(MALFORMED, MALFORMED_SHARE * traffic.frames_in)
        signs = tuple(filter(None, (None if few else GARBLED, self._silent)))
        return (f"client id {client_id}: {LATER_CLIENT}", *signs) if signs and client_id > FIRST_CLIENT else signs

    def _note_telemetry(self, received: int) -> None:
        self._talked = self._talked or received > self._asked


PROBE_S = 2.0
"""Seconds a robot has for packet 4, and then for packet 6."""
SILENCE_S = 2.5
"""Seconds after packet 4 in which only one packet 7 may be sent by TCP: the robot sleeps 2 s, and may be late."""
LATE_START = "handshaking"
_HEADER_SIZE = packets.HEADER.size
_FROM_ROBOT = {bytes((packets.SERVER_ID, packet_id)): decode for packet_id, decode in decoders(Role.HQ).items()}
"""How to read what a robot may send, by ``id`` byte and packet id."""


class HqStep(Enum):
    """What the handshake waits for."""

    GREETING = "waits for 2"
    OFFERED = "answered 3, waits for 4"
    PROBING = "got 4 and sent 5, waits for 6; silent"
    SILENT = "sent 7; silent"
    STREAM = "established; UDP was not agreed"
    GIVEN_UP = "established; no 4 came"
    LATE_PROBING = "established, got a late 4, waits for 6; silent"
    LATE_SILENT = "established, sent 7; silent"
    DONE = "established after a 4"


class HqEvent(Enum):
    """What can happen in a handshake."""

    SETTINGS_UDP = "2, and both set the UDP flag"
    SETTINGS_TCP = "2, and not both set the UDP flag"
    START = "4"
    WORKS = "6(true) by UDP"
    FAILS = "any other 6"
    TIMEOUT = "the step lasts longer than 2 s"
    SILENCE_OVER = "2.5 s after the 4"


class HqHandshake(PacketSession):
    """The conversation with a robot up to ``established``, and its timers.

    ``udp``: offer datagrams. ``announce``: the features that we announce. ``signs``: of the connection before.
    """

    kept: ClassVar[dict[str, Any]] = {
        "sender_id": int,
        "settings": SETTINGS,
        "_agreed": str,
        "_handshake": Handshake,
        "_silent_until": float,
        "_answered": bool | None,
        "_signs": Signs,
        "_inspect_at": float,
        "_others": int,
    }
    role = Role.HQ
    handled = frozenset(
        {packets.ServerSettings, packets.ServerStartUDP, packets.ServerUDPConnection, packets.DebugMessage}
    )

    def __init__(self, limits: Limits, *, udp: bool, announce: Iterable[Feature], signs: Signs | None) -> None:
        super().__init__(limits)
        self.sender_id = 0
        self.settings: Settings | None = None
        """What the robot announced."""
        self._announce = frozenset(announce)
        self._udp = udp and Feature.UDP in self._announce
        self._agreed = ""
        within_s = {HqStep.OFFERED: PROBE_S, HqStep.PROBING: PROBE_S, HqStep.LATE_PROBING: PROBE_S}
        self._handshake = Handshake(self, TABLE, HqStep.GREETING, timeout=HqEvent.TIMEOUT, within_s=within_s)
        self._silent_until = math.inf
        self._answered: bool | None = None
        """True if the robot got our 5 and we its 6; None if no 5 was sent."""
        self._signs: Signs = Signs(signs)
        self._inspect_at = math.inf
        self._others = 0
        """Packets received that are no telemetry."""

    def decode(self, frame: bytes) -> packets.Packet:
        decode = _FROM_ROBOT.get(frame[4:6])
        if decode is None:
            raise self.misplaced(frame)
        return decode(frame, _HEADER_SIZE)

    def overdue(self) -> str:
        if self.last_malformed is not None:
            return f"no settings that can be read within {self.limits.handshake_s:g} s: {self.last_malformed}"
        return (
            f"connected, but no settings within {self.limits.handshake_s:g} s: "
            "its one connection may be used up, restart the robot program"
        )

    # Messages of the handshake

    def accept(self, message: packets.Packet, now: float) -> bool:
        return self._accept(message, now, by_datagram=False)

    def accept_datagram(self, message: packets.Packet, now: float) -> bool:
        return self._accept(message, now, by_datagram=True)

    def _accept(self, message: packets.Packet, now: float, *, by_datagram: bool) -> bool:
        if isinstance(message, packets.ServerUDPConnection) and (by_datagram or self.settings is not None):
            self._take_answer(works=message.received and by_datagram, now=now)
        elif isinstance(message, packets.ServerSettings):
            self._take_settings(message, now)
        elif self.settings is None:
            raise ProtocolError(f"{type(message).__name__} before serverSettings")
        elif isinstance(message, packets.ServerStartUDP):
            if not self._handshake.fire(HqEvent.START, now):
                raise ProtocolError("serverStartUDP a second time")
        else:
            self._others += isinstance(message, packets.DebugMessage)
            return True
        self._others += 1
        return False

    def _take_settings(self, message: packets.ServerSettings, now: float) -> None:
        if self.settings is not None:
            raise ProtocolError("serverSettings a second time")
        self.sender_id = message.client_id
        self._update_doubts()
        listed = parse_versions(message.versions)
        agreed = agree(VERSIONS, listed)
        if agreed is None:
            self.refuse_versions(message.versions, VERSIONS, now)
            return
        self.settings = read_settings(message.versions, message.block, ROBOT_BLOCKS)
        self._agreed = agreed
        udp = self._udp and self.settings.udp
        answer = VERSIONS[agreed].answer or message.versions
        features = self._announce if udp else self._announce - {Feature.UDP}
        self.send_first(packets.ClientSettings(answer, announced(answer, features)))
        self._handshake.fire(HqEvent.SETTINGS_UDP if udp else HqEvent.SETTINGS_TCP, now)

    def _take_answer(self, *, works: bool, now: float) -> None:
        repeated = works and self._answered is True  # the network may deliver a datagram twice
        self._answered = self._answered or works
        if not repeated and not self._handshake.fire(HqEvent.WORKS if works else HqEvent.FAILS, now):
            raise ProtocolError("serverUDPConnection was not due")

    # Actions of the table

    def _await_start(self, now: float) -> None:
        """Wait for a 4, without the time limit of the settings."""
        self.lift_limit()

    def _probe(self, now: float) -> None:
        """Send 5 by UDP; begin the silence by TCP."""
        self._fall_silent(now)
        self._answered = False
        self.outbox.put_exempt(Datagram(self.encode(packets.ClientUDPConnection())))

    def _probe_late(self, now: float) -> None:
        """Refuse commands; send 5 by UDP; begin the silence by TCP."""
        self.busy = LATE_START
        self._probe(now)

    def _fall_silent_late(self, now: float) -> None:
        """Refuse commands; begin the silence by TCP: the robot sleeps, though nobody offered UDP."""
        self.busy = LATE_START
        self._fall_silent(now)

    def _fall_silent(self, now: float) -> None:
        self._silent_until = now + SILENCE_S
        self.outbox.quiet(self._silent_until)

    def _report_works(self, now: float) -> None:
        """Send 7(true), and use datagrams."""
        self.transport = "udp"
        self.send_first(packets.ClientUDPConnectionStatus(True))

    def _report_fails(self, now: float) -> None:
        """Send 7(false)."""
        self.send_first(packets.ClientUDPConnectionStatus(False))

    def _finish(self, now: float) -> None:
        """Establish the session."""
        assert self.settings is not None
        self.establish(self._agreed, tuple(feature.value for feature in self.settings.features))
        self._inspect_at = now + INSPECT_S

    def _take_commands(self, now: float) -> None:
        """Take commands again."""
        self.busy = None

    # Timers

    def timers(self) -> float:
        return min(self._handshake.deadline, self._silent_until, self._inspect_at)

    def on_timer(self, now: float) -> None:
        self._handshake.expire(now)
        if now >= self._silent_until:
            self._silent_until = math.inf
            self._handshake.fire(HqEvent.SILENCE_OVER, now)
        if now >= self._inspect_at:
            self._signs.inspect(self._telemetry_in, unanswered=self._answered is False)
            self._update_doubts()
            self._inspect_at = now + INSPECT_AGAIN_S

    # Signs of a connection that is not the robot's one usable connection

    def malformed(self, what: str) -> None:
        super().malformed(what)
        self._update_doubts()

    @property
    def _telemetry_in(self) -> int:
        return self.traffic.frames_in - self.traffic.malformed - self._others

    def _update_doubts(self) -> None:
        self.doubts = self._signs.listing(self.sender_id, self.traffic)


TABLE: dict[HqStep, dict[HqEvent, tuple[Callable[[HqHandshake, float], None], HqStep]]] = {
    HqStep.GREETING: {
        HqEvent.SETTINGS_UDP: (HqHandshake._await_start, HqStep.OFFERED),
        HqEvent.SETTINGS_TCP: (HqHandshake._finish, HqStep.STREAM),
    },
    HqStep.OFFERED: {
        HqEvent.START: (HqHandshake._probe, HqStep.PROBING),
        HqEvent.TIMEOUT: (HqHandshake._finish, HqStep.GIVEN_UP),
    },
    HqStep.PROBING: {
        HqEvent.WORKS: (HqHandshake._report_works, HqStep.SILENT),
        HqEvent.FAILS: (HqHandshake._report_fails, HqStep.SILENT),
        HqEvent.TIMEOUT: (HqHandshake._report_fails, HqStep.SILENT),
    },
    HqStep.SILENT: {HqEvent.SILENCE_OVER: (HqHandshake._finish, HqStep.DONE)},
    HqStep.STREAM: {HqEvent.START: (HqHandshake._fall_silent_late, HqStep.LATE_PROBING)},
    HqStep.GIVEN_UP: {HqEvent.START: (HqHandshake._probe_late, HqStep.LATE_PROBING)},
    HqStep.LATE_PROBING: {
        HqEvent.WORKS: (HqHandshake._report_works, HqStep.LATE_SILENT),
        HqEvent.FAILS: (HqHandshake._report_fails, HqStep.LATE_SILENT),
        HqEvent.TIMEOUT: (HqHandshake._report_fails, HqStep.LATE_SILENT),
    },
    HqStep.LATE_SILENT: {HqEvent.SILENCE_OVER: (HqHandshake._take_commands, HqStep.DONE)},
    HqStep.DONE: {},
}
