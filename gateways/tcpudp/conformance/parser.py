"""The packets of both judges, sans-IO: reads cut into packets, packets judged and written, settings."""

from __future__ import annotations

import enum
import math
import struct
from collections.abc import Callable, Collection
from typing import Literal

import msgspec

from zbridge.simulation.judge import show

Channel = Literal["tcp", "udp"]

DATAGRAM_BYTES = 65536
READ_BYTES = 4096
"""Most bytes of one read, and so of one packet ("Limits": nothing over 4096 bytes)."""
SERVER_ID = 1
DEBUG, SERVER_SETTINGS, CLIENT_SETTINGS = 1, 2, 3
START_UDP, UDP_PROBE, UDP_ANSWER, UDP_STATUS = 4, 5, 6, 7
MODE, MOVE, ROTATE, STOP, MOVE_AI = 10, 11, 12, 13, 21
CAMERA, CHAT = 31, 40
LIDAR_MODE, LIDAR_STATUS, GET_MAP, MAP, GET_POSITION, POSITION, MAP_PART = 50, 51, 52, 53, 54, 55, 56
GET_SCAN, SCAN = 60, 61
BY_UDP = frozenset({MOVE, ROTATE, SCAN, MAP, POSITION, MAP_PART})
"""The packets marked UDP* ("Versions and dialects")."""
SIDE, CELL_CM = 100, 10
"""Cells along a side of the simulated map, and SLAMMapIntervall; the largest maps of the field have 2048."""
_TAIL_BYTES = 1 << 20


class FeatureFlag(enum.IntEnum):
    """A feature flag; the value is its place in the settings ("Versions and dialects")."""

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
"""The version string a robot accepts without harm."""
DEADLY_ENTRIES = frozenset({1, 2, 4, 8})
"""Lengths of a version list that crash robots 1.3 and "1.4"."""
HQ_LOSES_BYTES = 2200
"""An HQ loses TCP packets of so many bytes and more ("Towards HQ programs")."""
HQ_SENT = {"1.1": "1.1", "1.2": "1.2", "1.3": "1.1,1.2,1.3"}
"""The version string an HQ sends."""
ANSWERS = {MAP: GET_MAP, POSITION: GET_POSITION}
"""What an HQ asks for, and how."""
_TO_ALL = frozenset({DEBUG, SERVER_SETTINGS, START_UDP, UDP_ANSWER, LIDAR_STATUS, MAP, POSITION})
KNOWN_TO_HQ = {"1.1": _TO_ALL, "1.2": _TO_ALL | {GET_SCAN}, "1.3": _TO_ALL | {GET_SCAN}}
"""The packet ids that do not cripple an HQ of a version."""
IGNORE_ONE = frozenset({"1.1", "1.2"})
"""Robots that ignore the first packet read alone after a stall ("Stops are repeated" in ``fragile-robots.md``)."""


class RobotTimes(msgspec.Struct, frozen=True, kw_only=True):
    """The robot's times in seconds; the defaults are those of the legacy robots."""

    read_s: float = 0.005
    """Longest sleep between two reads."""
    gap_s: float = 0.01
    """Least time between two packets of the HQ."""
    probe_s: float = 2.0
    """Sleep after packet 4, and the time a probe 5 may take."""
    silence_s: float = 2.5
    """Time after packet 4 in which nothing but the 7 may come by TCP: a loaded robot sleeps longer than it wants."""
    part_s: float = 1.0
    """Time from one map part to the next."""
    unasked_s: float = 0.4
    """Mean time between packets sent unasked; 0: nothing unasked."""
    flight_s: float = 0.1
    """How long what the HQ sent before it could know better may still arrive."""
    send_s: float = 5.0
    """Longest wait for its own send."""


class ParsedPacket(msgspec.Struct, frozen=True):
    """One packet as it was read."""

    sender: int
    kind: int
    body: bytes


class HqAnnouncement(msgspec.Struct, frozen=True):
    """What an HQ announces in packet 3."""

    versions: str
    features: frozenset[FeatureFlag]
    problem: str = ""
    readable: bool = True


class RobotAnnouncement(msgspec.Struct, frozen=True):
    """What a robot announces in packet 2, as one HQ reads it."""

    client: int
    versions: str
    block: bytes
    understood: str = ""
    """The version whose block the HQ read; empty: it keeps its old flags."""
    features: frozenset[FeatureFlag] = frozenset()
    map_size: int = 0
    map_interval: int = 0

    @property
    def udp(self) -> bool:
        """Whether the robot set the UDP flag, read or not."""
        return any(self.block[:1])

    @property
    def meant(self) -> tuple[int, int]:
        """Size and interval of the map as a 1.3 HQ should have read them, zeros for others."""
        size, interval = struct.unpack("<ii", self.block[-8:]) if self.understood == "1.3" else (0, 0)
        return size, interval

    @property
    def side(self) -> int:
        """Cells along a side of the map as announced to a 1.3 HQ, 0 if not."""
        size, interval = self.meant
        return max(size // interval, 0) if interval else 0


def cut(data: bytes) -> tuple[list[ParsedPacket], bytes, bool]:
    """Cut packets off the front ("Versions and dialects"); give them, what is left, and whether that is hopeless."""
    packets: list[ParsedPacket] = []
    while len(data) >= 4:
        (length,) = struct.unpack_from("<i", data)
        if not 2 <= length <= _TAIL_BYTES:
            return packets, data, True
        if len(data) < 4 + length:
            break
        packets.append(ParsedPacket(data[4], data[5], data[6 : 4 + length]))
        data = data[4 + length :]
    return packets, data, False


class ReadChecker:
    """Checks reads of TCP: each must be exactly one packet ("One packet per read" in ``fragile-robots.md``)."""

    def __init__(self, most: int = READ_BYTES) -> None:
        self.joined: list[ParsedPacket] = []
        """The packets of the last read if they were several and whole."""
        self.hopeless = False
        """The last read had a wrong length field."""
        self._tail = b""
        self._most = most

    def check(self, data: bytes) -> tuple[ParsedPacket | None, str]:
        """Return the packet of one read, or what is wrong with the read; neither for the rest of a split packet."""
        late = bool(self._tail)
        packets, self._tail, self.hopeless = cut(self._tail + data)
        self.joined = packets if len(packets) > 1 and not self._tail else []
        if self.hopeless:
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
        return (packets[0], "") if len(data) <= self._most else (None, self._large(len(data), data))

    def _incomplete(self, data: bytes) -> str:
        size = 4 + int(struct.unpack_from("<i", data)[0]) if len(data) >= 4 else 0
        if size > self._most:
            return self._large(size, data)
        return f"a split packet, {len(data)}{f' of {size}' * bool(size)} bytes in one read: {show(data)}"

    def _large(self, size: int, data: bytes) -> str:
        return f"a packet of {size} bytes, over {self._most}: {show(data)}"


def due_channel(kind: int, body: bytes, *, offered: bool, works: bool | None) -> Channel | None:
    """Return what must carry a packet of the robot ("Versions and dialects"); None: either, as nothing was agreed.

    ``offered``: the robot sent 4; ``works``: whether UDP was agreed, None until a 6 came.
    """
    if kind == UDP_ANSWER:
        return "udp" if any(body) else "tcp"  # 6(false) is a violation by itself
    if kind in BY_UDP and offered:
        return None if works is None else "udp" if works else "tcp"
    return "tcp"


def datagram(data: bytes) -> ParsedPacket | None:
    """Read a datagram as exactly one packet; none where its length field is wrong ("Versions and dialects")."""
    packets, rest, _ = cut(data)
    return packets[0] if len(packets) == 1 and not rest else None


def packet(kind: int, body: bytes = b"", sender: int = SERVER_ID) -> bytes:
    """Write a packet, of the robot by default ("Versions and dialects")."""
    return struct.pack("<iBB", 2 + len(body), sender, kind) + body


def string(text: str) -> bytes:
    """Write a string: the number of its bytes, then ASCII."""
    return struct.pack("<i", len(text)) + text.encode("ascii")


def server_settings(version: str, client: int, features: Collection[FeatureFlag], side: int = SIDE) -> bytes:
    """Write the body of packet 2 as a robot of ``version`` does ("Versions and dialects")."""
    flags = bytes(flag in features for flag in list(FeatureFlag)[: FLAGS[version]])
    sizes = struct.pack("<ii", side * CELL_CM, CELL_CM) if FLAGS[version] == 7 else b""
    return bytes([client]) + string(SENT[version]) + flags + sizes


def announcement(version: str, features: Collection[FeatureFlag] | None, *, udp: bool) -> frozenset[FeatureFlag]:
    """Return the flags that a robot announces, all of its version by default; raise ValueError for others."""
    known = frozenset(list(FeatureFlag)[: FLAGS[version]])
    others = known if features is None else frozenset(features)
    if not others <= known:
        raise ValueError(f"a robot of version {version} has no {sorted(flag.name for flag in others - known)}")
    return (others - {FeatureFlag.UDP}) | ({FeatureFlag.UDP} if udp else frozenset())


def client_settings(body: bytes) -> HqAnnouncement:
    """Read the body of packet 3 ("Versions and dialects")."""
    nothing: frozenset[FeatureFlag] = frozenset()
    count = struct.unpack_from("<i", body)[0] if len(body) >= 4 else -1
    if not 0 <= count <= len(body) - 4 or not body[4 : 4 + count].isascii():
        return HqAnnouncement("", nothing, "no version string", readable=False)
    versions, flags = body[4 : 4 + count].decode("ascii"), body[4 + count :]
    expected = FLAGS.get(max(versions.split(",")), 0)
    problem = (
        "" if len(flags) == expected else f"{len(flags)} flags for the versions {versions!r} instead of {expected}"
    )
    return HqAnnouncement(versions, frozenset(flag for flag in FeatureFlag if any(flags[flag : flag + 1])), problem)


def announced(body: bytes, version: str, *, skips_map_flag: bool = False) -> RobotAnnouncement:
    """Read the body of packet 2 as an HQ of ``version`` does; ValueError for what cripples it.

    ``skips_map_flag``: it finds the map's size where the SLAMMap flag is ("Protocol tcpudp" in ``configuration.md``).
    """
    count = struct.unpack_from("<i", body, 1)[0] if len(body) >= 5 else -1
    if not 0 <= count <= len(body) - 5 or not body[5 : 5 + count].isascii():
        raise ValueError("no version string")
    settings = RobotAnnouncement(body[0], body[5 : 5 + count].decode("ascii"), body[5 + count :])
    understood = _understood(version, settings.versions)
    if not understood:
        return settings
    sized = understood == "1.3"
    flags = FLAGS[understood] - (sized and skips_map_flag)
    size = flags + 8 * sized
    if len(settings.block) < size:
        count = len(settings.block)
        raise ValueError(f"{count} bytes of settings for the versions {settings.versions!r} instead of {size}")
    features = frozenset(flag for flag in list(FeatureFlag)[:flags] if settings.block[flag])
    length, interval = struct.unpack_from("<ii", settings.block, flags) if sized else (0, 0)
    if sized and not interval:
        raise ValueError("SLAMMapIntervall 0, a division by zero")
    return RobotAnnouncement(settings.client, settings.versions, settings.block, understood, features, length, interval)


def _understood(version: str, versions: str) -> str:
    """Return as which version's an HQ reads settings, empty if as none ("Versions and dialects")."""
    if version != "1.3":
        return version if versions == version else ""
    return next((known for known in ("1.3", "1.2", "1.1") if known in versions.split(",")), "")


def announced_problem(settings: RobotAnnouncement, *, skips_map_flag: bool = False) -> str:
    """Return what is wrong with packet 2 without crippling an HQ ("Versions and dialects")."""
    newest = max((known for known in settings.versions.split(",") if known in FLAGS), default="")
    size = FLAGS[newest] + 8 * (FLAGS[newest] == 7) if newest else len(settings.block)
    if len(settings.block) != size and not (skips_map_flag and len(settings.block) == size - 1 == 14):
        return f"{len(settings.block)} bytes of settings for the versions {settings.versions!r} instead of {size}"
    return f"client id {settings.client}" if settings.client < 2 else ""


def deadly(version: str, settings: HqAnnouncement) -> bool:
    """Return whether a version list crashes a robot ("What crashes a peer" in ``fragile-robots.md``)."""
    return "," in SENT[version] and settings.readable and len(settings.versions.split(",")) in DEADLY_ENTRIES


def registered(version: str, features: Collection[FeatureFlag]) -> frozenset[int]:
    """Return which packet ids from the HQ do not crash a robot.

    Source: "Versions and dialects" of the protocol page, "What crashes a peer" in ``fragile-robots.md``.
    """
    ids = {DEBUG, CLIENT_SETTINGS}.union(*(_REGISTERED.get(feature, ()) for feature in features))
    if maps(version, features):
        ids |= {GET_MAP, GET_POSITION}
    if FeatureFlag.LIDAR_SIM in features and FLAGS[version] > FeatureFlag.LIDAR_SIM:
        ids |= {SCAN}
    return frozenset(ids)


def maps(version: str, features: Collection[FeatureFlag]) -> bool:
    """Return whether a robot knows map and position: SLAMMap where the version has that flag, else Lidar."""
    return (FeatureFlag.SLAM_MAP if FLAGS[version] > FeatureFlag.SLAM_MAP else FeatureFlag.LIDAR) in features


def body_problem(kind: int, body: bytes) -> str:
    """Return what is wrong with a body, empty if nothing: a robot survives it, but for an empty text; an HQ does not.

    Source: "Versions and dialects" of the protocol page, "What crashes a peer" in ``fragile-robots.md``.
    """
    size = _SIZES.get(kind, len(body))
    if len(body) != size:
        return f"a body of {len(body)} bytes instead of {size}"
    check = _CHECKS.get(kind)
    return check(body) if check else ""


def value_problem(kind: int, body: bytes, side: int) -> str:
    """Return what values the page does not know; ``side``: announced cells or 0 ("Versions and dialects")."""
    if kind == LIDAR_STATUS:
        return _one_of("lidar status", (1, 2))(body)
    if kind == POSITION and not all(map(math.isfinite, struct.unpack("<3f", body))):
        return "numbers that are not finite"
    if kind == MAP and len(body) > 4:
        count = len(body) - 4
        if side not in (0, math.isqrt(count)):
            return f"{count} cells of a map announced with {side} x {side}"
        return "a cell that is neither 0, 1 nor 2" if body[4:].translate(None, b"\0\1\2") else ""
    return ""


def _text(body: bytes) -> str:
    if len(body) < 4 or struct.unpack_from("<i", body)[0] != len(body) - 4:
        return "a wrong byte count of the string"
    if body == bytes(4):
        return "an empty text"
    return "" if body.isascii() else "a text that is not ASCII"


def _one_of(name: str, values: tuple[int, ...]) -> Callable[[bytes], str]:
    def check(body: bytes) -> str:
        (value,) = struct.unpack("<i", body)
        return "" if value in values else f"{name} {value}"

    return check


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


def _map(body: bytes) -> str:
    if not body:
        return "a 53 without its int, on which it throws for good"
    count = struct.unpack_from("<i", body)[0] if len(body) >= 4 else -1
    if count != len(body) - 4:
        return f"n = {count} and {max(len(body) - 4, 0)} bytes of a map"
    return "" if math.isqrt(count) ** 2 == count else f"a map of {count} cells, no square"


_REGISTERED = {
    FeatureFlag.UDP: (UDP_PROBE, UDP_STATUS),
    FeatureFlag.JOYSTICK: (MODE, MOVE, ROTATE, STOP, MOVE_AI),
    FeatureFlag.CHAT: (CHAT,),
    FeatureFlag.LIDAR: (LIDAR_MODE,),
}
_SIZES = {
    **dict.fromkeys((START_UDP, UDP_PROBE, STOP, GET_MAP, GET_POSITION, GET_SCAN), 0),
    **dict.fromkeys((UDP_ANSWER, UDP_STATUS), 1),
    **dict.fromkeys((MODE, ROTATE, LIDAR_MODE, LIDAR_STATUS), 4),
    **dict.fromkeys((MOVE, POSITION), 12),
}
_CHECKS: dict[int, Callable[[bytes], str]] = {
    DEBUG: _text,
    MODE: _one_of("control mode", (1, 2, 3)),
    MOVE: _move,
    ROTATE: _rotate,
    LIDAR_MODE: _one_of("lidar mode", (1, 2)),
    SCAN: _scan,
    MAP: _map,
}
