"""Settings blocks against the protocol page and the recorded sessions; all bytes by hand."""

import pytest

from gateways.tcpudp.messages import ClientSettings, ServerSettings, decode_packet
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


@pytest.mark.parametrize(
    ("position", "name"), [*enumerate(["udp", "cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map"])]
)
def test_each_flag_has_its_own_place_in_the_order_of_the_document(position: int, name: str) -> None:
    flags = bytes(number == position for number in range(7))
    robot = read_settings("1.1,1.2,1.3", flags + bytes.fromhex("1400000005000000"), ROBOT_BLOCKS)
    hq = read_settings("1.1,1.2,1.3", flags, HQ_BLOCKS)
    assert robot.features == hq.features == (Feature(name),)
    assert isinstance(robot, RobotSettings13)
    assert (robot.slam_map_size, robot.slam_map_interval) == (20, 5)


@pytest.mark.parametrize(
    ("versions", "kind", "block"),
    [
        ("1.1", Settings, "0001000100"),
        ("1.2", Settings12, "000100010001"),
        ("1.1,1.2", Settings12, "000100010001"),
        ("1.1,1.2,1.3", Settings13, "00010001000101"),
        ("1.3,1.1", Settings13, "00010001000101"),
    ],
)
def test_an_hq_block_follows_the_newest_version_listed(versions: str, kind: type[Settings], block: str) -> None:
    settings = read_settings(versions, bytes.fromhex(block), HQ_BLOCKS)
    assert type(settings) is kind
    assert settings.encode().hex() == block


def test_a_robot_that_lists_1_4_sends_the_block_of_1_3() -> None:
    block = bytes.fromhex("010000010000010008000001000000")
    settings = read_settings("1.1,1.2,1.3,1.4", block, ROBOT_BLOCKS)
    assert settings == RobotSettings13(udp=True, chat=True, slam_map=True, slam_map_size=2048, slam_map_interval=1)


@pytest.mark.parametrize("tail", ["01", "0101010101", "ffffffff00"])
def test_older_readers_ignore_the_tail(tail: str) -> None:
    assert read_settings("1.1", bytes.fromhex("0100010001" + tail), ROBOT_BLOCKS) == Settings(
        udp=True, joystick=True, lidar=True
    )


def test_any_byte_but_zero_is_true() -> None:
    assert read_settings("1.1", bytes([2, 0, 255, 128, 0]), HQ_BLOCKS).features == (
        Feature.UDP,
        Feature.JOYSTICK,
        Feature.CHAT,
    )


@pytest.mark.parametrize(("versions", "size"), [("1.1", 5), ("1.2", 6), ("1.3", 15), ("1.4", 15)])
def test_a_block_that_is_too_short_is_refused(versions: str, size: int) -> None:
    for short in range(size):
        with pytest.raises(ProtocolError, match=f"{short} bytes, expected {size}"):
            read_settings(versions, bytes(short), ROBOT_BLOCKS)
    read_settings(versions, bytes(size), ROBOT_BLOCKS)


@pytest.mark.parametrize("versions", ["", "0.9", "x", "1.,1.1.", "-1.3"])
def test_versions_nobody_knows_have_no_features(versions: str) -> None:
    assert read_settings(versions, b"\x01" * 20, ROBOT_BLOCKS).features == ()


def test_recorded_settings_are_read() -> None:
    robot = decode_packet(bytes.fromhex("210000000102010b000000312e312c312e322c312e33010000000001010008000001000000"))
    hq = decode_packet(bytes.fromhex("1800000001030b000000312e312c312e322c312e3301000000000100"))
    assert isinstance(robot, ServerSettings)
    assert isinstance(hq, ClientSettings)
    assert robot.client_id == 1
    assert read_settings(robot.versions, robot.block, ROBOT_BLOCKS) == RobotSettings13(
        udp=True, lidar_sim=True, slam_map=True, slam_map_size=2048, slam_map_interval=1
    )
    assert read_settings(hq.versions, hq.block, HQ_BLOCKS) == Settings13(udp=True, lidar_sim=True)
