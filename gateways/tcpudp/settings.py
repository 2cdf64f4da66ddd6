"""The settings blocks of each version, declared flag by flag, and the version table: what peers send and know. Sans-IO.

Source: "Versions and dialects" of the protocol page, "What crashes a peer" in ``fragile-robots.md``. A block is that
of the newest version its sender lists; older readers ignore the tail.
"""

from __future__ import annotations

from collections.abc import Collection
from enum import Enum
from typing import Any

import msgspec

from zbridge.protocol import Form, ProtocolError, newest, parse_versions
from zbridge.wire import I32, BinaryCodec, Bool, Message


class Feature(Enum):
    """The flags of a settings block, in their order on the wire."""

    UDP = "udp"
    CAM = "cam"
    JOYSTICK = "joystick"
    CHAT = "chat"
    LIDAR = "lidar"
    LIDAR_SIM = "lidar_sim"
    SLAM_MAP = "slam_map"


class Settings(Message, frozen=True):
    """Version 1.1."""

    udp: Bool = False
    cam: Bool = False
    joystick: Bool = False
    chat: Bool = False
    lidar: Bool = False

    @property
    def features(self) -> tuple[Feature, ...]:
        """The flags that are set."""
        return tuple(feature for feature in Feature if getattr(self, feature.value, False))

    def encode(self) -> bytes:
        """Write the block."""
        return _CODECS[type(self)].encode(self)


class Settings12(Settings, frozen=True):
    """Version 1.2."""

    lidar_sim: Bool = False


class Settings13(Settings12, frozen=True):
    """Version 1.3, from an HQ."""

    slam_map: Bool = False


class RobotSettings13(Settings13, frozen=True):
    """Version 1.3, from a robot; size and interval of the map in the robot's unit of length."""

    slam_map_size: I32 = 0
    slam_map_interval: I32 = 0


_CODECS = {block: BinaryCodec(block) for block in (Settings, Settings12, Settings13, RobotSettings13)}


def _write_settings(block: Settings | None) -> list[Any] | None:
    return None if block is None else [type(block).__name__, block.encode()]


def _read_snapshot(raw: list[Any] | None) -> Settings | None:
    if raw is None:
        return None
    name, block = raw
    return next(codec for kind, codec in _CODECS.items() if kind.__name__ == name).decode(block, 0)


SETTINGS = Form(_write_settings, _read_snapshot)
"""A settings block of any version, or None, as it is handed on."""
HQ_BLOCKS: dict[str, type[Settings]] = {"1.1": Settings, "1.2": Settings12, "1.3": Settings13}
"""The settings block an HQ sends, by the newest version it lists."""
ROBOT_BLOCKS: dict[str, type[Settings]] = {"1.1": Settings, "1.2": Settings12, "1.3": RobotSettings13}
"""The settings block a robot sends, by the newest version it lists; "1.4" is sent with the block of 1.3."""


def read_settings(versions: str, block: bytes, blocks: dict[str, type[Settings]]) -> Settings:
    """Read a settings block by the versions its sender lists; raise ProtocolError if it is too short.

    If the newest listed version is unknown, read the newest known block and ignore the tail.
    """
    version = newest(parse_versions(versions), known=blocks)
    if version is None:
        return Settings()
    codec = _CODECS[blocks[version]]
    size = len(codec.encode(blocks[version]()))
    if len(block) < size:
        raise ProtocolError(f"settings of version {version} with {len(block)} bytes, expected {size}")
    return codec.decode(block[:size], 0)


LISTED = ("1.1", "1.2", "1.3")
"""What peers of version 1.3 list; with other lists legacy robots of 1.3 and "1.4" may crash."""
_LISTED = ",".join(LISTED)


class Version(msgspec.Struct, frozen=True):
    """One row. ``listed``: what a robot of this version sends.

    ``answer``: the list that such a robot understands from an HQ; None: its own, verbatim. ``known_to_hq``: the packet
    ids that an HQ of this version knows; an unknown one cripples it.
    """

    listed: str
    answer: str | None
    known_to_hq: frozenset[int]


_HQ_11 = frozenset({1, 2, 4, 6, 51, 53, 55})
_HQ_12 = _HQ_11 | {60}
VERSIONS = {
    "1.1": Version("1.1", None, _HQ_11),
    "1.2": Version("1.2", None, _HQ_12),
    "1.3": Version(_LISTED, _LISTED, _HQ_12),
    "1.4": Version(f"{_LISTED},1.4", _LISTED, _HQ_12 | {56}),  # exists on robots only
}


ANNOUNCED = (Feature.UDP, Feature.LIDAR_SIM)
"""What legacy HQ programs announce."""


def announced(listed: str, features: Collection[Feature]) -> bytes:
    """Write the settings block of an HQ that lists these versions, as far as the block has flags for the features."""
    block = HQ_BLOCKS[newest(parse_versions(listed), known=HQ_BLOCKS) or "1.1"]
    return block(**{feature.value: True for feature in features if hasattr(block, feature.value)}).encode()
