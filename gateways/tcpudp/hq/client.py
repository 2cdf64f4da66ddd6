"""The session of one TCP/UDP HQ program, and how frames are queued for it. Sans-IO.

Source: "The gateway as robot" of the protocol page.
"""

from __future__ import annotations

from typing import Any, ClassVar

from gateways.tcpudp.hq.options import HqOptions
from gateways.tcpudp.maps import TCP_BYTES, Geometry
from gateways.tcpudp.messages import PACKETS, Packet, ServerPosition, ServerSLAMMap, encode_packet
from gateways.tcpudp.session import RobotRole
from gateways.tcpudp.settings import Feature, RobotSettings13, Settings
from zbridge.protocol import Datagram, EncodeError, Limits, Send

_ASKING = ("1.1",)
"""Versions whose first programs have no handlers for packets that they did not ask for ("The gateway as robot")."""
_ON_REQUEST = frozenset({ServerSLAMMap.spec.id, ServerPosition.spec.id})


class HqClient(RobotRole):
    """One program: the geometry of the map that it was announced, and the packets that it knows."""

    kept: ClassVar[dict[str, Any]] = {"geometry": Geometry, "_asked": set[int]}

    def __init__(self, bounds: Limits, settings: Settings, number: int, options: HqOptions, geometry: Geometry) -> None:
        self.geometry = geometry
        super().__init__(
            bounds,
            settings,
            number,
            options.versions,
            block=_without_map_flag(settings) if options.skip_map_flag else None,
            known=options.known,
            client_port=options.client_port,
        )
        self._unasked = options.unasked
        self._asked: set[int] = set()

    def establish(self, version: str, features: tuple[str, ...]) -> None:
        super().establish(version, features)
        if version in _ASKING and not self._unasked:
            self.known -= _ON_REQUEST - self._asked

    def asks(self, packet_id: int) -> None:
        """Record that the client asked for a packet, so that it has a handler for it."""
        self._asked.add(packet_id)
        self.known |= {packet_id}

    @property
    def by_udp(self) -> bool:
        """Whether datagrams were agreed on and reach the client."""
        return self.transport == "udp"

    def show(self, slot: str, packet_id: int, frame: bytes, now: float) -> None:
        """Queue a frame as the newest of its slot, if the client knows the packet; count it otherwise."""
        if packet_id in self.known:
            self.outbox.set(slot, (frame,), now)
        else:
            self.leave_out(packet_id)

    def leave_out(self, packet_id: int) -> None:
        """Count a packet that the client does not know."""
        spec = PACKETS.get(packet_id)
        name = f"{spec.name} ({packet_id})" if spec is not None else f"packet {packet_id}"
        self.left_out[f"{name} unasked" if packet_id in _ON_REQUEST else name] += 1


def newest_of(slot: str, packet: Packet) -> Send:
    """Encode a packet once for all clients, to be queued as the newest of its slot, by datagram where it may be."""
    frame = encode_packet(packet, RobotRole.sender_id)
    datagram = Datagram(frame) if packet.spec.carrier.value == "udp*" else frame

    def send(session: HqClient, now: float) -> None:
        session.show(slot, packet.spec.id, datagram if session.by_udp else frame, now)

    return send


def each_once(packet: Packet) -> Send:
    """Encode a packet once for all clients, to be queued behind others; nothing replaces it.

    Raises EncodeError if it is longer than programs take by TCP.
    """
    frame = encode_packet(packet, RobotRole.sender_id)
    if len(frame) > TCP_BYTES:
        raise EncodeError(f"packet of {len(frame)} bytes, HQ programs take {TCP_BYTES} by TCP")
    packet_id = frame[5]

    def send(session: HqClient, now: float) -> None:
        if packet_id in session.known:
            session.outbox.put(frame)
        else:
            session.leave_out(packet_id)

    return send


def _without_map_flag(settings: Settings) -> bytes:
    """Leave out the byte that some HQ programs of version 1.3 skip when they read the settings."""
    block = settings.encode()
    place = list(Feature).index(Feature.SLAM_MAP)
    return block[:place] + block[place + 1 :] if isinstance(settings, RobotSettings13) else block
