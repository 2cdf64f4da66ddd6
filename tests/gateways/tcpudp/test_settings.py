"""Settings blocks against the protocol page; all bytes by hand. Recorded ones are read in test_captures."""

import pytest

from gateways.tcpudp.settings import (
    HQ_BLOCKS,
    ROBOT_BLOCKS,
    Feature,
    RobotSettings13,
    Settings,
    Settings12,
    Settings13,
    read_settings,
)
from zbridge.errors import ProtocolError


def test_each_flag_has_its_own_place_and_any_byte_but_zero_sets_it() -> None:
    for position, name in enumerate(("udp", "cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map")):
        flags = bytes((number == position) * 0x80 for number in range(7))
        robot = read_settings("1.1,1.2,1.3", flags + bytes.fromhex("1400000005000000"), ROBOT_BLOCKS)
        hq = read_settings("1.1,1.2,1.3", flags, HQ_BLOCKS)
        assert robot.features == hq.features == (Feature(name),)
        assert isinstance(robot, RobotSettings13)
        assert (robot.slam_map_size, robot.slam_map_interval) == (20, 5)


@pytest.mark.parametrize(
    ("versions", "blocks", "kind", "block"),
    [
        ("1.1", HQ_BLOCKS, Settings, "0001000100"),
        ("1.2", HQ_BLOCKS, Settings12, "000100010001"),
        ("1.1,1.2,1.3", HQ_BLOCKS, Settings13, "00010001000101"),
        ("1.3,1.1", HQ_BLOCKS, Settings13, "00010001000101"),
        ("1.3", ROBOT_BLOCKS, RobotSettings13, "010000010000010008000001000000"),
        ("1.1,1.2,1.3,1.4", ROBOT_BLOCKS, RobotSettings13, "010000010000010008000001000000"),
    ],
)
def test_a_block_follows_the_newest_version_listed_and_its_tail_is_ignored(versions, blocks, kind, block) -> None:
    settings = read_settings(versions, bytes.fromhex(block), blocks)
    assert type(settings) is kind
    assert settings.encode().hex() == block
    assert read_settings(versions, bytes.fromhex(block + "01ff"), blocks) == settings
    size = len(block) // 2
    for short in range(size):
        with pytest.raises(ProtocolError, match=f"{short} bytes, expected {size}"):
            read_settings(versions, bytes(short), blocks)


def test_versions_nobody_knows_have_no_features() -> None:
    for versions in ("", "0.9", "x", "1.,1.1.", "-1.3"):
        assert read_settings(versions, b"\x01" * 20, ROBOT_BLOCKS).features == ()
