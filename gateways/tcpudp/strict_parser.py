"""What a deployed TCP/UDP robot makes of bytes: reads cut into packets, packets judged, packets written. Sans-IO.

The parser of the judge in :mod:`gateways.tcpudp.strict`; by intention it shares nothing with the gateway's messages.
Section names in the docstrings are those of the protocol page ``tcpudp.md``.
"""

from __future__ import annotations

import enum
import math
import struct
from collections.abc import Callable, Collection

import msgspec

READ_BYTES = 4096
"""Most bytes of one read, and so of one packet ("The gateway as HQ": nothing over 4096 bytes)."""
SERVER_ID = 1
DEBUG, SERVER_SETTINGS, CLIENT_SETTINGS = 1, 2, 3
START_UDP, UDP_PROBE, UDP_ANSWER, UDP_STATUS = 4, 5, 6, 7
MODE, MOVE, ROTATE, STOP, MOVE_AI = 10, 11, 12, 13, 21
CAMERA, CHAT = 31, 40
LIDAR_MODE, LIDAR_STATUS, GET_MAP, MAP, GET_POSITION, POSITION, MAP_PART = 50, 51, 52, 53, 54, 55, 56
GET_SCAN, SCAN = 60, 61
BY_UDP = frozenset({MOVE, ROTATE, SCAN, MAP, POSITION, MAP_PART})
"""The packets marked UDP* ("Packets")."""
_TAIL_BYTES = 1 << 20


class Feature(enum.IntEnum):
    """A feature flag; the value is its place in the settings ("Settings and version negotiation")."""

    UDP = 0
    CAM = 1
    JOYSTICK = 2
    CHAT = 3
    LIDAR = 4
    LIDAR_SIM = 5
    SLAM_MAP = 6


FLAGS = {"1.1": 5, "1.2": 6, "1.3": 7, "1.4": 7}
"""How many flags a settings body of a version has."""
SENT = {"1.1": "1.1", "1.2": "1.2", "1.3": "1.1,1.2,1.3", "1.4": "1.1,1.2,1.3,1.4"}
"""The version string a robot sends."""
UNDERSTOOD = {"1.1": "1.1", "1.2": "1.2", "1.3": "1.1,1.2,1.3", "1.4": "1.1,1.2,1.3"}
"""The version string a robot takes without harm."""
DEADLY_ENTRIES = frozenset({1, 2, 4, 8})
"""Lengths of a version list that crash robots 1.3 and "1.4"."""


class Packet(msgspec.Struct, frozen=True):
    """One packet as it was read."""

    sender: int
    kind: int
    body: bytes


class Settings(msgspec.Struct, frozen=True):
    """What an HQ says about itself in packet 3."""

    versions: str
    features: frozenset[Feature]
    problem: str


def show(data: bytes, limit: int = 40) -> str:
    """Write bytes in hex for a sentence, shortened."""
    rest = f"... ({len(data)} bytes)" if len(data) > limit else ""
    return (data[:limit].hex(" ") or "(no bytes)") + rest


def cut(data: bytes) -> tuple[list[Packet], bytes, bool]:
    """Cut packets off the front ("Framing"); give them, what is left, and whether that is hopeless."""
    packets: list[Packet] = []
    while len(data) >= 4:
        (length,) = struct.unpack_from("<i", data)
        if not 2 <= length <= _TAIL_BYTES:
            return packets, data, True
        if len(data) < 4 + length:
            break
        packets.append(Packet(data[4], data[5], data[6 : 4 + length]))
        data = data[4 + length :]
    return packets, data, False


class Reads:
    """The reads of one TCP connection: each must be exactly one packet ("The gateway as HQ")."""

    def __init__(self) -> None:
        self._tail = b""

    def take(self, data: bytes) -> tuple[Packet | None, str]:
        """Give the packet that one read is, or what is wrong with it; neither for the rest of a split packet."""
        late = bool(self._tail)
        packets, self._tail, hopeless = cut(self._tail + data)
        if hopeless:
            self._tail = b""
            return None, f"no packet in one read, its length field is wrong: {show(data)}"
        if late and len(packets) + bool(self._tail) == 1:
            return None, ""
        if len(packets) > 1 or (packets and self._tail):
            count = f"{len(packets)} packets" if len(packets) != 2 else "two packets"
            some = f"{count} and a part of one" if self._tail else count
            return None, f"{some} in one read: {show(data)}"
        if self._tail:
            return None, self._incomplete(data)
        if len(data) > READ_BYTES:
            return None, f"a packet of {len(data)} bytes, over {READ_BYTES}: {show(data)}"
        return packets[0], ""

    def _incomplete(self, data: bytes) -> str:
        if len(data) < 4:
            return f"a split packet, {len(data)} bytes in one read: {show(data)}"
        size = 4 + int(struct.unpack_from("<i", data)[0])
        if size > READ_BYTES:
            return f"a packet of {size} bytes, over {READ_BYTES}: {show(data)}"
        return f"a split packet, {len(data)} of {size} bytes in one read: {show(data)}"


def datagram(data: bytes) -> Packet | None:
    """Read a datagram as exactly one packet; none where its length field is wrong ("Framing")."""
    packets, rest, _ = cut(data)
    return packets[0] if len(packets) == 1 and not rest else None


def packet(kind: int, body: bytes = b"") -> bytes:
    """Write a packet of the robot ("Framing")."""
    return struct.pack("<iBB", 2 + len(body), SERVER_ID, kind) + body


def string(text: str) -> bytes:
    """Write a string ("Framing")."""
    return struct.pack("<i", len(text)) + text.encode("ascii")


def server_settings(version: str, client: int, features: Collection[Feature], size: int, interval: int) -> bytes:
    """Write the body of packet 2 as a robot of ``version`` does ("Settings and version negotiation")."""
    flags = bytes(flag in features for flag in list(Feature)[: FLAGS[version]])
    sizes = struct.pack("<ii", size, interval) if FLAGS[version] == 7 else b""
    return bytes([client]) + string(SENT[version]) + flags + sizes


def client_settings(body: bytes) -> Settings:
    """Read the body of packet 3 ("Settings and version negotiation")."""
    nothing: frozenset[Feature] = frozenset()
    count = struct.unpack_from("<i", body)[0] if len(body) >= 4 else -1
    if not 0 <= count <= len(body) - 4 or not body[4 : 4 + count].isascii():
        return Settings("", nothing, "no version string")
    versions, flags = body[4 : 4 + count].decode("ascii"), body[4 + count :]
    expected = FLAGS.get(max(versions.split(",")), 0)
    problem = "" if len(flags) == expected else f"{len(flags)} flags for the versions {versions!r} instead of {expected}"
    return Settings(versions, frozenset(flag for flag in Feature if any(flags[flag : flag + 1])), problem)


def registered(version: str, features: Collection[Feature]) -> frozenset[int]:
    """Tell which packet ids from the HQ do not crash a robot ("Packets", "The gateway as HQ")."""
    ids = {DEBUG, CLIENT_SETTINGS}
    if Feature.UDP in features:
        ids |= {UDP_PROBE, UDP_STATUS}
    if Feature.JOYSTICK in features:
        ids |= {MODE, MOVE, ROTATE, STOP, MOVE_AI}
    if Feature.CHAT in features:
        ids |= {CHAT}
    if Feature.LIDAR in features:
        ids |= {LIDAR_MODE}
    if maps(version, features):
        ids |= {GET_MAP, GET_POSITION}
    if Feature.LIDAR_SIM in features and FLAGS[version] > Feature.LIDAR_SIM:
        ids |= {SCAN}
    return frozenset(ids)


def maps(version: str, features: Collection[Feature]) -> bool:
    """Tell whether a robot knows map and position: SLAMMap where the version has that flag, else Lidar."""
    return (Feature.SLAM_MAP if FLAGS[version] > Feature.SLAM_MAP else Feature.LIDAR) in features


def body_problem(kind: int, body: bytes) -> str:
    """Tell what is wrong with a body from the HQ, empty if nothing ("Packets")."""
    size = _SIZES.get(kind, len(body))
    if len(body) != size:
        return f"a body of {len(body)} bytes instead of {size}"
    check = _CHECKS.get(kind)
    return check(body) if check else ""


def _text(body: bytes) -> str:
    if len(body) < 4 or struct.unpack_from("<i", body)[0] != len(body) - 4:
        return "a wrong byte count of the string"
    return "" if body.isascii() else "a text that is not ASCII"


def _mode(body: bytes) -> str:
    (value,) = struct.unpack("<i", body)
    return "" if value in (1, 2, 3) else f"control mode {value}"


def _lidar(body: bytes) -> str:
    (value,) = struct.unpack("<i", body)
    return "" if value in (1, 2) else f"lidar mode {value}"


def _move(body: bytes) -> str:
    x, y, speed = struct.unpack("<3f", body)
    if not all(map(math.isfinite, (x, y, speed))):
        return "numbers that are not finite"
    return "" if math.hypot(x, y) <= 1.001 else f"a direction of length {math.hypot(x, y):.3f}"


def _rotate(body: bytes) -> str:
    return "" if math.isfinite(struct.unpack("<f", body)[0]) else "a number that is not finite"


def _scan(body: bytes) -> str:
    count = struct.unpack_from("<i", body)[0] if len(body) >= 4 else -1
    if count != 360:
        return f"n = {count} instead of 360"
    return "" if len(body) == 4 + 4 * 360 else f"{len(body)} bytes for 360 floats"


_SIZES = {UDP_PROBE: 0, UDP_STATUS: 1, MODE: 4, MOVE: 12, ROTATE: 4, STOP: 0, LIDAR_MODE: 4, GET_MAP: 0, GET_POSITION: 0}
_CHECKS: dict[int, Callable[[bytes], str]] = {
    DEBUG: _text,
    MODE: _mode,
    MOVE: _move,
    ROTATE: _rotate,
    LIDAR_MODE: _lidar,
    SCAN: _scan,
}
