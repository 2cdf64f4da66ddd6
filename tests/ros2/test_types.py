"""Type hashes are pinned; messages are CDR and back; garbage is a ProtocolError."""

from __future__ import annotations

import random
import struct

import numpy as np
import pytest
from rosbags.typesys import Stores

from zbridge.errors import ConfigError, EncodeError, ProtocolError
from zbridge.ros2.types import DISTROS, NO_HASH, types_of

HASHES = {  # of running ROS 2 systems: `ros2 topic info -v`, the design page of rmw_zenoh, REP 2011's example
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "example_interfaces/srv/AddTwoInts": "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a",
    "std_srvs/srv/Trigger": "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
}
PINNED = {
    "sensor_msgs/msg/LaserScan": "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828",
    "nav_msgs/msg/Odometry": "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "geometry_msgs/msg/PoseStamped": "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "nav_msgs/msg/OccupancyGrid": "RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7",
    "tf2_msgs/msg/TFMessage": "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "sensor_msgs/msg/Imu": "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    "sensor_msgs/msg/BatteryState": "RIHS01_4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741",
    "sensor_msgs/msg/JointState": "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "sensor_msgs/msg/CompressedImage": "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    "diagnostic_msgs/msg/DiagnosticArray": "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "geometry_msgs/msg/Twist": "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "geometry_msgs/msg/TwistStamped": "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    "std_srvs/srv/Trigger": "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    "std_srvs/srv/SetBool": "RIHS01_abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
}
NEWER = {  # humble's Range has no variance, and humble's keys have no hashes
    "sensor_msgs/msg/Range": "RIHS01_b42b62562e93cbfe9d42b82fe5994dfa3d63d7d5c90a317981703f7388adff3a",
}


def test_every_distro_of_ros_2_that_rosbags_knows_and_rmw_zenoh_exists_for_is_known() -> None:
    known = {store.value.removeprefix("ros2_") for store in Stores if store.value.startswith("ros2_")}
    assert known - {"dashing", "eloquent", "foxy", "galactic"} == set(DISTROS)


@pytest.mark.parametrize("distro", DISTROS)
def test_hashes_are_those_of_running_systems(distro: str) -> None:
    types = types_of(distro)
    assert {name: types.computed_hash(name) for name in HASHES} == HASHES


@pytest.mark.parametrize("distro", DISTROS)
def test_hashes_are_pinned(distro: str) -> None:
    types = types_of(distro)
    expected = PINNED if distro == "humble" else PINNED | NEWER
    assert {name: types.computed_hash(name) for name in expected} == expected


@pytest.mark.parametrize("distro", DISTROS)
def test_humble_alone_has_no_hashes_in_its_keys(distro: str) -> None:
    types = types_of(distro)
    shown = types.hash("geometry_msgs/msg/Twist")
    assert shown == (NO_HASH if distro == "humble" else PINNED["geometry_msgs/msg/Twist"])
    assert NO_HASH == "TypeHashNotSupported"


def test_an_unknown_distro_is_said() -> None:
    with pytest.raises(ConfigError, match="distro = 'foxy': expected one of humble"):
        types_of("foxy")


def test_a_twist_is_six_little_endian_doubles_behind_the_header() -> None:
    types = types_of("jazzy")
    payload = b"\x00\x01\x00\x00" + struct.pack("<6d", 0.5, 0, 0, 0, 0, -1.5)
    twist = types.decode("geometry_msgs/msg/Twist", payload)
    assert (twist.linear.x, twist.angular.z) == (0.5, -1.5)
    assert types.encode(twist) == payload


def test_what_is_left_out_is_zero_and_what_a_distro_lacks_is_left_out() -> None:
    for distro in DISTROS:
        types = types_of(distro)
        message = types.message("sensor_msgs/msg/Range", range=2.5, variance=0.1)
        assert message.range == 2.5
        assert hasattr(message, "variance") is (distro != "humble")
        assert types.decode("sensor_msgs/msg/Range", types.encode(message)).range == 2.5
    imu = types.message("sensor_msgs/msg/Imu")
    assert imu.orientation_covariance.tolist() == [0.0] * 9
    assert types.encode(types.message("std_srvs/srv/Trigger_Request")) == b"\x00\x01\x00\x00\x00"


def test_a_value_that_does_not_fit_is_an_error_of_ours() -> None:
    types = types_of("jazzy")
    with pytest.raises(EncodeError, match="sensor_msgs/msg/JointState"):
        types.encode(types.message("sensor_msgs/msg/JointState", name=[3]))


def test_random_bytes_give_a_message_or_a_protocol_error() -> None:
    types, dice = types_of("jazzy"), random.Random(18)
    for name in (*PINNED, "std_srvs/srv/SetBool_Request"):
        try:
            good = types.encode(types.message(name))
        except KeyError:  # a service
            continue
        for _ in range(150):
            payload = bytearray(dice.choice((good, b"\x00\x01\x00\x00" + dice.randbytes(dice.randrange(200)))))
            for _ in range(dice.randrange(4)):
                if payload:
                    payload[dice.randrange(len(payload))] = dice.randrange(256)
            payload = payload[: dice.randrange(len(payload) + 1)]
            try:
                types.decode(name, bytes(payload))
            except ProtocolError:
                continue


def test_a_sequence_that_is_said_to_be_endless_takes_no_memory() -> None:
    types = types_of("jazzy")
    scan = types.encode(types.message("sensor_msgs/msg/LaserScan", ranges=np.zeros(1, np.float32)))
    at = scan.index(b"\x01\x00\x00\x00", 4)
    with pytest.raises(ProtocolError):
        types.decode("sensor_msgs/msg/LaserScan", scan[:at] + b"\xff\xff\xff\xff" + scan[at + 4 :])
    with pytest.raises(ProtocolError):
        types.decode("tf2_msgs/msg/TFMessage", b"\x00\x01\x00\x00\xff\xff\xff\xff" + bytes(64))
