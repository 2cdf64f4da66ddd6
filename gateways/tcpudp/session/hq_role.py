"""The gateway plays HQ towards one robot: which packets may be sent, and when they are repeated. Sans-IO.

Source: "The gateway as HQ" and "Translation" of the protocol page. The handshake is :mod:`.hq_handshake`.

An unregistered packet id crashes a robot: :meth:`HqRole.may_send` checks each kind of packet against the settings that
the robot announced. Robots of 1.1 and 1.2 misread a tenth of the packets: a packet that is sent once and matters (mode,
lidar) is sent to them again after :data:`AGAIN_S`. A stop cancels these repetitions, and withdraws every packet that
might move the robot after it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Any, ClassVar

from gateways.tcpudp import messages as packets
from gateways.tcpudp.session.hq_handshake import HqHandshake
from gateways.tcpudp.settings import ANNOUNCED, Feature
from zbridge.protocol import FRAME, FRAMES, LIMIT, EncodeError, Frame, Limits, Malformed, Spare, Unsupported

MAX_WRITE = 4096
"""Bytes of the longest packet a legacy robot reads whole."""
AGAIN_S = 0.3
"""Seconds after which a mode or a lidar mode is sent again to robots that misread a tenth of what they get."""
_AUTONOMOUS = 3
_MODE_AGAIN, _LIDAR_AGAIN = "mode again", "lidar again"
_MISREADING = frozenset({"1.1", "1.2"})
_ANSWERED = (packets.ClientGetSLAMMap, packets.ClientGetPosition)


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

    def may_send(self, message: packets.Packet) -> None:
        """Raise Unsupported for a packet that this robot may not know: an unregistered id crashes it."""
        if isinstance(message, packets.OpaquePacket):
            if message.id not in self._force:
                raise Unsupported(f"packet {message.id} may crash the robot; list it in options.force if it knows it")
            return
        spec = message.spec
        if spec.id not in self._force and spec.features and self._force.isdisjoint(spec.features):
            # Of several features the first one that the robot's version has a flag for decides.
            feature = next((feature for feature in spec.features if hasattr(self.settings, feature.value)), None)
            if feature is None:
                names = " or ".join(feature.value for feature in spec.features)
                raise Unsupported(f"{spec.name}: version {self._agreed} has no {names}")
            if not getattr(self.settings, feature.value):
                raise Unsupported(f"{spec.name}: the robot does not announce {feature.value}")
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
