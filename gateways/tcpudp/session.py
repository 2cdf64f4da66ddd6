"""Sessions of the TCP/UDP package protocol in both roles: handshake, identities, what may be sent. Sans-IO.

Source: "Handshake", "Settings and version negotiation" and "The gateway as HQ" of the protocol page.
Spoken here: version 1.3 over TCP.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from gateways.tcpudp.messages import (
    HEADER,
    MAX_FRAME,
    PACKETS,
    SERVER_ID,
    ClientSettings,
    DebugMessage,
    OpaquePacket,
    Packet,
    Sender,
    ServerSettings,
    decoder,
    encode_packet,
    frame_end,
)
from gateways.tcpudp.settings import HQ_BLOCKS, ROBOT_BLOCKS, Feature, Settings, Settings13, read_settings
from zbridge.errors import EncodeError, ProtocolError, Refused
from zbridge.session.negotiation import agree, parse_versions
from zbridge.session.session import Limits, Role, Session

VERSIONS = ("1.3",)
"""The versions that are spoken."""
LISTED = "1.1,1.2,1.3"
"""What peers of version 1.3 send, and the only list deployed 1.3 robots take safely."""
_QUOTED = 80
MAX_WRITE = 4096
"""Bytes of the longest packet a deployed robot reads whole."""
HANDSHAKE_S = 5.0
ANNOUNCED = Settings13(lidar_sim=True)
"""What deployed HQ programs of version 1.3 announce (UDP aside): robots are known to take it."""


def limits(gap_s: float) -> Limits:
    """Give the bounds of a session that leaves ``gap_s`` seconds between two packets."""
    return Limits(frame_bytes=MAX_FRAME, handshake_s=HANDSHAKE_S, gap_s=gap_s)


Decode = Callable[[bytes, int], Packet]


def decoders(own: Sender, peer_ids: Iterable[int]) -> dict[bytes, Decode]:
    """Tabulate, by ``id`` byte and packet id, how to read what a peer may send to the side ``own``."""
    packet_ids = [number for number in range(256) if number not in PACKETS or PACKETS[number].sender is not own]
    return {bytes((peer_id, number)): decoder(number) for peer_id in peer_ids for number in packet_ids}


class _TcpUdpSession(Session[Packet]):
    """What both roles share: framing, and the ``id`` byte of what they send."""

    frame_end = staticmethod(frame_end)
    sender_id: int
    """The ``id`` byte of what we send."""
    _decoders: dict[bytes, Decode]

    def encode(self, message: Packet) -> bytes:
        return encode_packet(message, self.sender_id)

    def decode(self, frame: bytes) -> Packet:
        """Read a packet of the stream; ``frame_end`` has checked its length."""
        decode = self._decoders.get(frame[4:6])
        if decode is None:
            raise ProtocolError(self._odd(frame[4], frame[5]))
        return decode(frame, HEADER.size)

    def _odd(self, sender_id: int, packet_id: int) -> str:
        """Say why the peer may not send a packet like this."""
        spec = PACKETS.get(packet_id)
        if spec is not None and spec.sender is _OWN[self.role]:
            return f"{spec.name} ({packet_id}) from the wrong side"
        return f"packet {packet_id} with id {sender_id}, which is not the peer's"

    def refuse_versions(self, listed: str, now: float) -> None:
        """Tell the peer and the operator that no version is common, and close."""
        reason = f"no common version: the peer speaks {listed[:_QUOTED]!r}, this gateway {', '.join(VERSIONS)}"
        self.send(DebugMessage(reason))
        self.close(reason, now)


_OWN = {Role.HQ: Sender.HQ, Role.ROBOT: Sender.ROBOT}


class HqSession(_TcpUdpSession):
    """We play HQ towards a robot. ``force``: features and packet ids to use although it does not announce them."""

    role = Role.HQ
    handled = frozenset({ServerSettings})
    _decoders = decoders(Sender.HQ, (SERVER_ID,))

    def __init__(self, limits: Limits, *, force: Iterable[Feature | int] = ()) -> None:
        super().__init__(limits)
        self.sender_id = 0
        self.settings: Settings | None = None
        self._force = frozenset(force)
        self._usable: frozenset[Feature | int] = self._force

    def overdue(self) -> str:
        return (
            f"connected, but no settings within {self.limits.handshake_s:g} s: "
            "its one connection may be used up, restart the robot program"
        )

    def accept(self, message: Packet, now: float) -> bool:
        if isinstance(message, ServerSettings):
            self._take_settings(message, now)
            return False
        if self.version is None:
            raise ProtocolError(f"{type(message).__name__} before serverSettings")
        return True

    def may_send(self, message: Packet) -> None:
        """Raise Refused for a packet that this robot may not know: an unregistered id crashes it."""
        packet_id = message.id if isinstance(message, OpaquePacket) else message.spec.id
        if packet_id in self._force:
            return
        if isinstance(message, OpaquePacket):
            raise Refused(f"packet {packet_id} may crash the robot; list it in options.force if it knows it")
        needed = message.spec.features
        if needed and self._usable.isdisjoint(needed):
            names = " or ".join(feature.value for feature in needed)
            raise Refused(f"{message.spec.name}: the robot does not announce {names}")

    def encode(self, message: Packet) -> bytes:
        """Write a packet the robot can take whole; raise Refused for one it may not know."""
        self.may_send(message)
        if isinstance(message, DebugMessage) and not message.text:
            raise Refused("an empty text crashes the robot")
        frame = super().encode(message)
        if len(frame) > MAX_WRITE:
            raise EncodeError(f"packet of {len(frame)} bytes, the robot reads {MAX_WRITE} at most")
        return frame

    def _take_settings(self, message: ServerSettings, now: float) -> None:
        if self.settings is not None:
            raise ProtocolError("serverSettings a second time")
        self.sender_id = message.client_id
        version = agree(VERSIONS, parse_versions(message.versions))
        if version is None:
            self.refuse_versions(message.versions, now)
            return
        self.settings = read_settings(message.versions, message.block, ROBOT_BLOCKS)
        self._usable = self._force.union(self.settings.features)
        self.send(ClientSettings(LISTED, ANNOUNCED.encode()))
        self.establish(version, tuple(feature.value for feature in self.settings.features))


class RobotSession(_TcpUdpSession):
    """We play the robot towards an HQ: what we announce, and the id we give it."""

    role = Role.ROBOT
    handled = frozenset({ClientSettings})
    sender_id = SERVER_ID

    def __init__(self, limits: Limits, settings: Settings, client_id: int) -> None:
        super().__init__(limits)
        self.settings = settings
        self.client_id = client_id
        self._decoders = decoders(Sender.ROBOT, (0, client_id))
        self.client: Settings | None = None

    def opened(self, now: float) -> None:
        self.send(ServerSettings(self.client_id, LISTED, self.settings.encode()))

    def accept(self, message: Packet, now: float) -> bool:
        if isinstance(message, ClientSettings):
            self._take_settings(message, now)
            return False
        if self.version is None:
            raise ProtocolError(f"{type(message).__name__} before clientSettings")
        return True

    def _take_settings(self, message: ClientSettings, now: float) -> None:
        if self.client is not None:
            raise ProtocolError("clientSettings a second time")
        version = agree(VERSIONS, parse_versions(message.versions))
        if version is None:
            self.refuse_versions(message.versions, now)
        else:
            self.client = read_settings(message.versions, message.block, HQ_BLOCKS)
            self.establish(version, tuple(feature.value for feature in self.client.features))
