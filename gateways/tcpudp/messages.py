"""The packets of the TCP/UDP package protocol, each declared once, and how they are framed.

Source: "Versions and dialects" of the protocol page. Names are the protocol's own, spelling included. Sans-IO.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import Enum
from functools import partial
from typing import ClassVar, TypeVar

import msgspec

from gateways.tcpudp.settings import Feature, Settings
from zbridge.protocol import Codec, Datagram, EncodeError, ProtocolError, Role
from zbridge.wire import F32, I32, U8, BinaryCodec, Blob, Bool, F32Array, Message, Rest, Text

MAX_FRAME = 4 * 2**20 + 64
"""Bytes of the longest packet that is accepted: a map of 2048 x 2048 with its header."""
HEADER = struct.Struct("<iBB")
_HEADER_SIZE = HEADER.size
_LENGTH = struct.Struct("<i").unpack_from
SERVER_ID = 1
"""The ``id`` byte of every packet from the robot."""


class Carrier(Enum):
    """What carries a packet; ``UDP_IF_AGREED`` is the table's ``UDP*``."""

    TCP = "tcp"
    UDP = "udp"
    UDP_IF_AGREED = "udp*"


class Packet(Message, frozen=True):
    """A message of this protocol."""

    spec: ClassVar[PacketSpec]

    def raw(self) -> tuple[int, bytes]:
        """Return the packet id and the body; raise EncodeError for values that do not fit."""
        return self.spec.id, self.spec.codec.encode(self)


P = TypeVar("P", bound=Packet)


class PacketSpec(msgspec.Struct, frozen=True, eq=False):
    """A row of the packet table. sender: None if both send it.

    features: a robot that announces any of these has registered the packet; none means always.
    """

    id: int
    name: str
    sender: Role | None
    carrier: Carrier
    features: tuple[Feature, ...]
    packet: type[Packet]
    codec: BinaryCodec[Packet]

    def lacking(self, settings: Settings | None, version: str | None) -> str:
        """Return why a robot of these settings may not know the packet, "" if it does.

        Of several features the first one that the robot's version has a flag for decides.
        """
        feature = next((feature for feature in self.features if hasattr(settings, feature.value)), None)
        if feature is None:
            names = " or ".join(feature.value for feature in self.features)
            return f"{self.name}: version {version} has no {names}" if names else ""
        return "" if getattr(settings, feature.value) else f"{self.name}: the robot does not announce {feature.value}"


PACKETS: dict[int, PacketSpec] = {}
"""The packet table, by packet id."""


def packet(
    packet_id: int, name: str, sender: Role | None, carrier: Carrier = Carrier.TCP, needs: tuple[Feature, ...] = ()
) -> Callable[[type[P]], type[P]]:
    """Enter a declaration into the packet table."""

    def enter(declared: type[P]) -> type[P]:
        spec = PacketSpec(packet_id, name, sender, carrier, needs, declared, BinaryCodec(declared))
        declared.spec = PACKETS[packet_id] = spec
        return declared

    return enter


_JOYSTICK = (Feature.JOYSTICK,)
_MAPPING = (Feature.SLAM_MAP, Feature.LIDAR)


@packet(1, "debugMessage", None)
class DebugMessage(Packet, frozen=True):
    """A text for people; an empty one crashes legacy robots."""

    text: Text


@packet(2, "serverSettings", Role.ROBOT)
class ServerSettings(Packet, frozen=True):
    """The robot speaks first. ``block`` is the settings block of the newest version listed."""

    client_id: U8
    versions: Text
    block: Rest


@packet(3, "clientSettings", Role.HQ)
class ClientSettings(Packet, frozen=True):
    """The HQ's answer. ``block`` is the settings block of the newest version listed."""

    versions: Text
    block: Rest


@packet(4, "serverStartUDP", Role.ROBOT)
class ServerStartUDP(Packet, frozen=True):
    """The robot waits for the HQ's datagram."""


@packet(5, "clientUDPConnection", Role.HQ, Carrier.UDP)
class ClientUDPConnection(Packet, frozen=True):
    """The datagram that shows the robot the address of the HQ's socket."""


@packet(6, "serverUDPConnection", Role.ROBOT, Carrier.UDP)
class ServerUDPConnection(Packet, frozen=True):
    """Whether that datagram arrived; comes by UDP if it did, by TCP if not."""

    received: Bool


@packet(7, "clientUDPConnectionStatus", Role.HQ)
class ClientUDPConnectionStatus(Packet, frozen=True):
    """Whether the robot's datagram arrived."""

    connected: Bool


@packet(10, "clientControllMode", Role.HQ, needs=_JOYSTICK)
class ClientControllMode(Packet, frozen=True):
    """1 none, 2 joystick, 3 AI."""

    mode: I32


@packet(11, "clientJoystickMove", Role.HQ, Carrier.UDP_IF_AGREED, needs=_JOYSTICK)
class ClientJoystickMove(Packet, frozen=True):
    """Move along (x right, y forward), a vector of length 1 at most."""

    x: F32
    y: F32
    speed: F32


@packet(12, "clientJoystickRotate", Role.HQ, Carrier.UDP_IF_AGREED, needs=_JOYSTICK)
class ClientJoystickRotate(Packet, frozen=True):
    """Turn on the spot, positive to the right."""

    speed: F32


@packet(13, "clientJoystickStop", Role.HQ, needs=_JOYSTICK)
class ClientJoystickStop(Packet, frozen=True):
    """Stand still."""


@packet(21, "clientMoveAI", Role.HQ, needs=_JOYSTICK)
class ClientMoveAI(Packet, frozen=True):
    """Not defined by the document: opaque."""

    body: Rest = b""


@packet(31, "serverCamMode", Role.ROBOT)
class ServerCamMode(Packet, frozen=True):
    """1 on, 2 off."""

    mode: I32


@packet(40, "chatMessage", None, needs=(Feature.CHAT,))
class ChatMessage(Packet, frozen=True):
    """Not defined by the document: opaque."""

    body: Rest = b""


@packet(50, "clientLidarMode", Role.HQ, needs=(Feature.LIDAR,))
class ClientLidarMode(Packet, frozen=True):
    """1 on, 2 off."""

    mode: I32


@packet(51, "serverLidarStatus", Role.ROBOT)
class ServerLidarStatus(Packet, frozen=True):
    """1 on, 2 off."""

    mode: I32


@packet(52, "clientGetSLAMMap", Role.HQ, needs=_MAPPING)
class ClientGetSLAMMap(Packet, frozen=True):
    """Ask for the map."""


@packet(53, "servertSLAMMap", Role.ROBOT, Carrier.UDP_IF_AGREED)
class ServerSLAMMap(Packet, frozen=True):
    """The map: 0 unknown, 1 free, 2 obstacle, index = x * side + y. Empty: no map yet.

    The count is always written: an HQ program that gets a 53 without it throws for good
    ("What crashes a peer" in ``fragile-robots.md``). Robots may leave it out.
    """

    cells: Blob = b""


@packet(54, "clientGetPosition", Role.HQ, needs=_MAPPING)
class ClientGetPosition(Packet, frozen=True):
    """Ask for the position."""


@packet(55, "serverPosition", Role.ROBOT, Carrier.UDP_IF_AGREED)
class ServerPosition(Packet, frozen=True):
    """Position in the robot's length unit, heading in degrees."""

    x: F32
    y: F32
    heading_deg: F32


@packet(56, "servertSLAMMapPart", Role.ROBOT, Carrier.UDP_IF_AGREED)
class ServerSLAMMapPart(Packet, frozen=True):
    """Cells ``start`` to ``end`` (exclusive) of the map; sent by robots that list "1.4", one a second."""

    start: I32
    end: I32
    cells: Rest

    def check(self) -> None:
        if self.start < 0 or self.end - self.start != len(self.cells):
            raise ProtocolError(f"map part {self.start} to {self.end} with {len(self.cells)} cells")


@packet(60, "serverGetSimulatedLidarData", Role.ROBOT)
class ServerGetSimulatedLidarData(Packet, frozen=True):
    """The robot asks for simulated lidar data."""


@packet(61, "clientSimulatedLidarData", Role.HQ, Carrier.UDP_IF_AGREED, needs=(Feature.LIDAR_SIM,))
class ClientSimulatedLidarData(Packet, frozen=True, eq=False):
    """float32[360] ranges in the robot's length unit, index = degree."""

    ranges: F32Array


_MAP_OF_12_BYTES = 8
"""The only count with which twelve bytes of body are a map."""


class OpaquePacket(Packet, frozen=True):
    """A packet the table reserves (70-79, the LED stripe) or does not know; its body is passed on as it is."""

    id: int
    body: bytes = b""

    def raw(self) -> tuple[int, bytes]:
        return self.id, self.body


def frame_end(data: bytes, start: int) -> int:
    """Find where a packet ends ("Versions and dialects"): ``int32 length | u8 id | u8 packet id | body``."""
    if len(data) - start < _HEADER_SIZE:
        return start + _HEADER_SIZE
    length: int = _LENGTH(data, start)[0]
    if length < 2:
        raise ProtocolError(f"length {length}, expected at least 2")
    return start + 4 + length


def encode_packet(message: Packet, sender_id: int, transport: str = "tcp") -> bytes:
    """Write a packet with its header, a Datagram if ``transport`` is ``udp`` and the table says UDP*.

    Raise EncodeError for values that do not fit.
    """
    packet_id, body = message.raw()
    carrier = Carrier.TCP if isinstance(message, OpaquePacket) else message.spec.carrier
    try:
        frame = HEADER.pack(2 + len(body), sender_id, packet_id) + body
        return Datagram(frame) if transport == "udp" and carrier is Carrier.UDP_IF_AGREED else frame
    except struct.error as error:
        raise EncodeError(f"packet {packet_id} from {sender_id}: {error}") from error


def read_header(frame: bytes) -> tuple[int, int]:
    """Read the ``id`` byte and the packet id of one whole packet; raise ProtocolError if its length is wrong."""
    if len(frame) < HEADER.size:
        raise ProtocolError(f"packet of {len(frame)} bytes, expected at least {HEADER.size}")
    length, sender_id, packet_id = HEADER.unpack_from(frame)
    if length + 4 != len(frame):
        raise ProtocolError(f"length {length} in a packet of {len(frame)} bytes")
    return sender_id, packet_id


def decode_packet(frame: bytes) -> Packet:
    """Read one whole packet; raise ProtocolError for a wrong length or a malformed body."""
    return decoder(read_header(frame)[1])(frame, HEADER.size)


def decoder(packet_id: int) -> Callable[[bytes, int], Packet]:
    """Return the function that reads the body of a packet, ``decode(frame, start of the body)``."""
    spec = PACKETS.get(packet_id)
    if spec is None:
        return lambda frame, start: OpaquePacket(packet_id, frame[start:])
    return _DECODERS.get(spec.packet, spec.codec.decode)


def _decode_text(frame: bytes, start: int) -> Packet:
    """Read packet 1; a broadcast one carries a second header first ("Decisions where the document is silent")."""
    while _is_whole_text(frame, start):
        start += HEADER.size
    return DebugMessage.spec.codec.decode(frame, start)


def _is_whole_text(frame: bytes, start: int) -> bool:
    """Return whether a body is itself a packet 1 from the robot, down to its last byte."""
    size = len(frame) - start
    if size < HEADER.size + 4:
        return False
    length, sender_id, packet_id = HEADER.unpack_from(frame, start)
    (inner,) = _LENGTH(frame, start + HEADER.size)  # the count of the text, or the length of yet another header
    whole = length + 4 == size and inner + 4 == size - HEADER.size
    return bool(whole and sender_id == SERVER_ID and packet_id == DebugMessage.spec.id)


def _decode_map(frame: bytes, start: int) -> Packet:
    """Read packet 53; some robots answer 54 with it and three floats: a position ("Translation from the robot").

    One without a body is a map of no cells ("Decisions where the document is silent").
    """
    if start == len(frame):
        return ServerSLAMMap()
    three_floats = len(frame) - start == 12 and int.from_bytes(frame[start : start + 4], "little") != _MAP_OF_12_BYTES
    return (ServerPosition if three_floats else ServerSLAMMap).spec.codec.decode(frame, start)


_DECODERS: dict[type[Packet], Callable[[bytes, int], Packet]] = {
    DebugMessage: _decode_text,
    ServerSLAMMap: _decode_map,
}


def codecs() -> tuple[Codec, ...]:
    """List the packets for the conformance kit."""
    declared = (spec.packet for spec in PACKETS.values() if spec.packet is not ServerSLAMMapPart)
    messages = (*declared, ServerSLAMMapPart(1, 3, b"ab"), OpaquePacket(70, b"led"))
    return (Codec("packets", partial(encode_packet, sender_id=SERVER_ID), decode_packet, frame_end, messages),)
