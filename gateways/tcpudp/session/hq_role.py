"""The gateway plays HQ towards one robot: the handshake, which packets may be sent, when they are repeated. Sans-IO.

Source: "Handshake", "Versions and dialects", "Translation of commands" and "Limits" of the protocol page.

Theory of operation. The handshake is the table at the foot of this file: :class:`HqStep` says what the session waits
for, :class:`HqEvent` what can happen, and every row names the action that is taken. The session is ``established`` from
the steps STREAM, GIVEN_UP and DONE on. A robot that sent 4 sleeps 2 s and then takes one read as one packet, so for
:data:`SILENCE_S` nothing leaves by TCP but one 7: before the handshake ends, and in the LATE steps, where commands are
refused with :data:`LATE_START`.

An unregistered packet id crashes a robot: :meth:`HqRole.may_send` checks each kind of packet against the settings that
the robot announced. Robots of 1.1 and 1.2 misread a tenth of the packets: a packet that is sent once and matters (mode,
lidar) is sent to them again after :data:`AGAIN_S`. A stop cancels these repetitions, and withdraws every packet that
might move the robot after it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from enum import Enum
from typing import Any, ClassVar

from gateways.tcpudp import messages as packets
from gateways.tcpudp.session import decoders
from gateways.tcpudp.session.signs import INSPECT_S, Signs, WatchedSession
from gateways.tcpudp.settings import (
    ANNOUNCED,
    ROBOT_BLOCKS,
    SETTINGS,
    VERSIONS,
    Feature,
    Settings,
    announced,
    read_settings,
)
from zbridge.protocol import (
    FRAME,
    FRAMES,
    LIMIT,
    Datagram,
    EncodeError,
    Frame,
    Handshake,
    Limits,
    Malformed,
    ProtocolError,
    Role,
    Spare,
    Unsupported,
    agree,
    parse_versions,
)

PROBE_S = 2.0
"""Seconds a robot has for packet 4, and then for packet 6."""
SILENCE_S = 2.5
"""Seconds after packet 4 in which only one packet 7 may be sent by TCP: the robot sleeps 2 s, and may be late."""
LATE_START = "handshaking"
UNREADABLE = "no settings that can be read"
USED_UP = "its one connection may be used up"
MAX_WRITE = 4096
"""Bytes of the longest packet a legacy robot reads whole."""
AGAIN_S = 0.3
"""Seconds after which a mode or a lidar mode is sent again to robots that misread a tenth of what they get."""
_AUTONOMOUS = 3
_MODE_AGAIN, _LIDAR_AGAIN = "mode again", "lidar again"
_MISREADING = frozenset({"1.1", "1.2"})
_ANSWERED = (packets.ClientGetSLAMMap, packets.ClientGetPosition)
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


class HqHandshake(WatchedSession):
    """The conversation with a robot up to ``established``, and its timers.

    ``udp``: offer datagrams. ``announce``: the features that we announce. ``signs``: of the connection before.
    """

    kept: ClassVar[dict[str, Any]] = {
        "settings": SETTINGS,
        "_agreed": str,
        "_handshake": Handshake,
        "_silent_until": float,
        "_answered": bool | None,
    }
    role = Role.HQ
    silent_s = math.inf  # a robot need not send anything by itself
    handled = frozenset(
        {packets.ServerSettings, packets.ServerStartUDP, packets.ServerUDPConnection, packets.DebugMessage}
    )

    def __init__(self, limits: Limits, *, udp: bool, announce: Iterable[Feature], signs: Signs | None) -> None:
        super().__init__(limits, signs)
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

    def decode(self, frame: bytes) -> packets.Packet:
        decode = _FROM_ROBOT.get(frame[4:6])
        if decode is None:
            raise self.misplaced(frame)
        return decode(frame, _HEADER_SIZE)

    def overdue(self) -> str:
        if self.last_malformed is not None:
            return f"{UNREADABLE} within {self.limits.handshake_s:g} s: {self.last_malformed}"
        return f"connected, but no settings within {self.limits.handshake_s:g} s: {USED_UP}, restart the robot program"

    # Messages of the handshake

    def accept_datagram(self, message: packets.Packet, now: float) -> bool:
        return self.accept(message, now, by_datagram=True)

    def accept(self, message: packets.Packet, now: float, *, by_datagram: bool = False) -> bool:
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
            self._inspect(now, unanswered=self._answered is False)


class _Chosen(Frame):
    """A packet 10 that was commanded, unlike the 1 of a stop."""

    @property
    def autonomous(self) -> bool:
        """True if it lets the robot's own program drive."""
        return self[packets.HEADER.size] == _AUTONOMOUS


class HqRole(HqHandshake):
    """One conversation with a robot.

    ``udp``: offer datagrams. ``force``: features and packet ids to use although the robot does not announce them.
    ``announce``: the features that we announce. ``predecessor``: the session of the connection before.
    """

    kept: ClassVar[dict[str, Any]] = {"sent_autonomous": bool, "_chosen": FRAME, "_raw": Spare(FRAMES)}

    def __init__(
        self,
        limits: Limits,
        *,
        udp: bool = True,
        force: Iterable[Feature | int] = (),
        announce: Iterable[Feature] = ANNOUNCED,
        predecessor: HqRole | None = None,
    ) -> None:
        signs = predecessor._signs if predecessor is not None else None
        super().__init__(limits, udp=udp, announce=announce, signs=signs)
        self.sent_autonomous: bool = predecessor is not None and predecessor.sent_autonomous
        """Whether the robot was ever sent mode 3; outlives connections. No packet shows that another mode ended it."""
        self._force = frozenset(force)
        self._registered: set[type[packets.Packet]] = set()
        """Classes of packets that the robot knows, as far as they were checked."""
        self._chosen: _Chosen | None = None
        """The mode that was commanded last."""
        self._raw: deque[bytes] = deque(maxlen=LIMIT)
        """The undefined packets that were queued; at most as many as the queue holds."""

    def encode(self, message: packets.Packet) -> bytes:
        """Write a packet; raise Refused for one the robot may not know, EncodeError for one it cannot take whole."""
        if type(message) not in self._registered:
            self.may_send(message)
        if isinstance(message, packets.DebugMessage) and not message.text:
            raise Malformed("an empty text crashes the robot")
        frame = packets.encode_packet(message, self.sender_id, self.transport)
        if len(frame) > MAX_WRITE:
            raise EncodeError(f"packet of {len(frame)} bytes, the robot reads {MAX_WRITE} at most")
        return frame

    def knows(self, spec: packets.PacketSpec) -> bool:
        """Return whether the robot may be sent a packet: because it announces it, or options.force lists it."""
        return not self._force.isdisjoint({spec.id, *spec.features}) or not spec.lacking(self.settings, self._agreed)

    def may_send(self, message: packets.Packet) -> None:
        """Raise Unsupported for a packet that this robot may not know: an unregistered id crashes it."""
        if isinstance(message, packets.OpaquePacket):
            if message.id not in self._force:
                raise Unsupported(f"packet {message.id} may crash the robot; list it in options.force if it knows it")
            return
        if not self.knows(message.spec):
            raise Unsupported(message.spec.lacking(self.settings, self._agreed))
        self._registered.add(type(message))

    @property
    def misreads(self) -> bool:
        """Whether the robot's version misreads some packets, and ignores one after it lost what piled up."""
        return self._agreed in _MISREADING

    # What is sent once and matters

    def choose_mode(self, mode: int, now: float) -> None:
        """Send a control mode that was commanded; raise Refused."""
        frame = _Chosen(self.encode(packets.ClientControllMode(mode)))
        self._send_reliably(frame, _MODE_AGAIN, now)
        self._chosen = frame

    def switch_lidar(self, mode: int, now: float) -> None:
        """Send a lidar mode; raise Refused."""
        self._send_reliably(self.encode(packets.ClientLidarMode(mode)), _LIDAR_AGAIN, now)
        self._signs.note_queries(self._telemetry_in, 1 + self.outbox.is_set(_LIDAR_AGAIN))

    def send_nothing_again(self) -> None:
        """Cancel all repetitions: the robot is stopped."""
        self.outbox.clear(_MODE_AGAIN)
        self.outbox.clear(_LIDAR_AGAIN)

    def send_raw(self, packet: packets.Packet) -> None:
        """Queue an undefined packet; raise Refused, EncodeError."""
        frame = self.encode(packet)
        self.outbox.put(frame)
        self._raw.append(frame)

    def withdraw_raw(self) -> None:
        """Drop the undefined packets that still wait: they might move a robot after its stop."""
        waiting = len(self.outbox)
        while self._raw:
            self.outbox.unqueue(self._raw.popleft())
        self.traffic.dropped += waiting - len(self.outbox)

    def withdraw_autonomous(self) -> None:
        """Drop a mode 3 that still waits, and its repetition."""
        if self._chosen is not None and self._chosen.autonomous:
            self.outbox.unqueue(self._chosen)
            self.outbox.clear(_MODE_AGAIN)

    def send(self, message: packets.Packet) -> None:
        super().send(message)
        if isinstance(message, _ANSWERED):
            self._signs.note_queries(self._telemetry_in)

    def outgoing(self, now: float) -> bytes | None:
        frame = super().outgoing(now)
        if type(frame) is _Chosen and frame.autonomous:
            self.sent_autonomous = True
        return frame

    def _send_reliably(self, frame: bytes, again: str, now: float) -> None:
        """Send a packet, to robots that misread some again; a newer one replaces the repetition of an older one."""
        self.outbox.put(frame)
        if self.misreads:
            self.outbox.set(again, (frame,), now + AGAIN_S)


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
