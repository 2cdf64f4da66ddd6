"""Keys, tokens, QoS, gids and attachments are those of rmw_zenoh's design page and of captures of real nodes."""

from __future__ import annotations

import struct

import pytest

from zbridge.errors import ProtocolError
from zbridge.ros2.rmw_zenoh import (
    KEEP_LAST_10,
    LATCHED,
    SENSOR_DATA,
    Attachment,
    Endpoint,
    Kind,
    Node,
    RosQoS,
    dds_type,
    endpoints_of,
    gid_of,
    is_ros_name,
    read_attachment,
    read_qos,
    read_token,
    ros_name,
    ros_type,
    topic_key,
)

STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
ADD = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
LISTENER = "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MS/%/%/listener"
SERVER = "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server"

KEYS = {  # the design page of rmw_zenoh, "Topic and Service name mapping"
    ("/chatter", "std_msgs/msg/String", STRING, 0): f"0/chatter/std_msgs::msg::dds_::String_/{STRING}",
    ("/robot1/chatter", "std_msgs/msg/String", STRING, 0): f"0/robot1/chatter/std_msgs::msg::dds_::String_/{STRING}",
    ("/add_two_ints", "example_interfaces/srv/AddTwoInts", ADD, 2): (
        f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{ADD}"
    ),
}
TOKENS = {  # the same page, "Graph Cache"
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener": Node(
        2, "aac3178e146ba6f1fc6e6a4085e77f21", 0, "/", "listener"
    ),
    f"{LISTENER}/%chatter/std_msgs::msg::dds_::String_/{STRING}/::,10:,:,:,,": Endpoint(
        Node(2, "8b20917502ee955ac4476e0266340d5c", 0, "/", "listener"),
        10,
        Kind.SUBSCRIBER,
        "/chatter",
        "std_msgs/msg/String",
        STRING,
        KEEP_LAST_10,
    ),
    f"{SERVER}/%add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{ADD}/::,10:,:,:,,": Endpoint(
        Node(2, "f9980ee0495eaafb3e38f0d19e2eae12", 0, "/", "add_two_ints_server"),
        10,
        Kind.SERVER,
        "/add_two_ints",
        "example_interfaces/srv/AddTwoInts",
        ADD,
        KEEP_LAST_10,
    ),
}
NO_TOKENS = [
    "",
    "@ros2_lv",
    "@ros2_lv/2/aa/0/0/NN/%/%",
    "@ros2_lv/2/aa/0/0/NN/%/%/listener/more",
    "@ros2_lv/x/aa/0/0/NN/%/%/listener",
    "@ros2_lv/2/aa/0/0/XX/%/%/listener",
    "@ros2_lv/2//0/0/NN/%/%/listener",
    LISTENER,
    f"{LISTENER}/%chatter/String/{STRING}/::,10:,:,:,,",
    f"{LISTENER}/%chatter/std_msgs::msg::dds_::String_/{STRING}/::10",
    f"{LISTENER}/%chatter/std_msgs::msg::dds_::String_/{STRING}/9::,10:,:,:,,",
    f"{LISTENER}/%{'c' * 3000}/std_msgs::msg::dds_::String_/{STRING}/::,10:,:,:,,",
]
QOS = {
    "::,10:,:,:,,": KEEP_LAST_10,
    ":1:,1:,:,:,,": LATCHED,
    "2::,5:,:,:,,": SENSOR_DATA,
    "::,:,:,:,,": RosQoS(depth=42),
    "2:1:2,:,:,:,,": RosQoS(best_effort=True, transient_local=True, depth=0),
}
NAMES = {"r1": "r1", "front left": "front_left", "7": "_7", "": "_", "a-b.c": "a_b_c", "Ä": "_"}


@pytest.mark.parametrize(("parts", "key"), KEYS.items())
def test_keys_are_those_of_the_design_page(parts: tuple[str, str, str, int], key: str) -> None:
    *names, domain = parts
    assert topic_key(domain, *names) == key


@pytest.mark.parametrize(("token", "shown"), TOKENS.items())
def test_tokens_of_the_design_page_are_read_and_written(token: str, shown: Node | Endpoint) -> None:
    read = read_token(token)
    assert shown.token() == token
    if isinstance(read, Endpoint):
        assert read.token_read == token
        read = Endpoint(read.node, read.number, read.kind, read.name, read.type_name, read.type_hash, read.qos)
    assert read == shown


@pytest.mark.parametrize("token", NO_TOKENS)
def test_what_is_no_token_is_none(token: str) -> None:
    assert read_token(token) is None


def test_slashes_within_a_part_are_percent_signs() -> None:
    node = Node(0, "aa", 3, "/a/b", "n", "/e/f")
    assert node.token() == "@ros2_lv/0/aa/3/3/NN/%e%f/%a%b/n"
    assert node.full_name == "/a/b/n"
    assert read_token(node.token()) == node


def test_tokens_and_gids_of_dora_rs_are_read() -> None:
    token = (  # captured: dora-rs 1.1.0, a publisher of node /x/d; its samples had the gid below
        "@ros2_lv/0/163c68d81ed5621b39d8d88a707e10e4/d/2/MP/%/%x/d/%r1%cmd_vel/geometry_msgs::msg::dds_::Twist_/"
        "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a/::,10:,:,:,,"
    )
    read = read_token(token)
    assert isinstance(read, Endpoint)
    assert (read.node.full_name, read.node.number, read.number) == ("/x/d", "d", 2)
    assert bytes.fromhex("e4107e708ad8d8390200000000000000") in read.gids()
    assert read.gid() in read.gids()


def test_a_gid_is_the_xxh3_128_of_the_token_low_half_first() -> None:
    # XXH3-128 of the empty text is 99aa06d3014798d86001c324468d497f (the specification's own vector)
    assert gid_of("").hex() == "7f498d4624c30160" + "d8984701d306aa99"


@pytest.mark.parametrize(("text", "qos"), QOS.items())
def test_qos_is_read_and_written(text: str, qos: RosQoS) -> None:
    assert str(qos) == text
    assert read_qos(text) == qos


def test_an_attachment_is_number_time_length_and_gid() -> None:
    gid = bytes(range(16))
    data = struct.pack("<qq", 7, 1_700_000_000_000_000_000) + b"\x10" + gid
    assert Attachment(7, 1_700_000_000_000_000_000, gid).encode() == data
    assert read_attachment(data) == Attachment(7, 1_700_000_000_000_000_000, gid)


def test_an_attachment_of_an_rmw_zenoh_from_before_the_format_was_changed_is_named() -> None:
    parts = (b"\x0fsequence_number", bytes(8), b"\x10source_timestamp", bytes(8), b"\x0asource_gid", b"\x10", bytes(16))
    with pytest.raises(ProtocolError, match=r"old rmw_zenoh: expected 0.2.5 \(jazzy\)"):
        read_attachment(b"".join(parts))


@pytest.mark.parametrize(
    "data",
    [None, b"", bytes(32), bytes(33), bytes(16) + b"\x11" + bytes(16), struct.pack("<qq", -1, 0) + b"\x10" + bytes(16)],
)
def test_a_short_or_lying_attachment_is_a_protocol_error(data: bytes | None) -> None:
    with pytest.raises(ProtocolError, match="attachment"):
        read_attachment(data)


@pytest.mark.parametrize(("name", "part"), NAMES.items())
def test_any_name_is_a_part_of_a_ros_name(name: str, part: str) -> None:
    assert ros_name(name) == part
    assert is_ros_name(f"/{part}/scan")


def test_types_are_written_with_colons_and_read_back() -> None:
    assert dds_type("nav_msgs/msg/OccupancyGrid") == "nav_msgs::msg::dds_::OccupancyGrid_"
    assert ros_type("nav_msgs::msg::dds_::OccupancyGrid_") == "nav_msgs/msg/OccupancyGrid"
    assert ros_type("nav_msgs/msg/OccupancyGrid") is None
    with pytest.raises(ValueError, match="expected package/msg/Name"):
        dds_type("OccupancyGrid")


def test_tokens_of_a_topic_are_asked_for_by_its_name() -> None:
    assert endpoints_of(3, Kind.PUBLISHER, "/r1/scan") == "@ros2_lv/3/*/*/*/MP/*/*/*/%r1%scan/*/*/*"


FOREIGN_QOS = {  # other numbers of rmw's policies, as rmw_zenoh may write them
    "1:2:1,7:,:,:,,": RosQoS(depth=7),
    "0:0:0,:,:,:,,": RosQoS(depth=42),
    "3:3:3,1:,:,:,,": RosQoS(depth=1),
    "2:1:2,9:,:,:,,": RosQoS(best_effort=True, transient_local=True, depth=0),
    "::,10:,:,:,,:more": KEEP_LAST_10,
    "4::,10:,:,:,,": None,
    ":4:,10:,:,:,,": None,
    "::4,10:,:,:,,": None,
    "::10:,:,:,,": None,
    "::,x:,:,:,,": None,
    "::,-1:,:,:,,": None,
    "::,\u0663:,:,:,,": None,
    "::,1000000000000000000:,:,:,,": None,
}


@pytest.mark.parametrize("text", FOREIGN_QOS)
def test_qos_of_others_is_read_or_is_none(text: str) -> None:
    assert read_qos(text) == FOREIGN_QOS[text]


NUMBERS = {"7": 7, "0": 0, "007": "007", "d": "d", "\u0663": "\u0663", "9" * 18: 10**18 - 1, "9" * 19: "9" * 19}


@pytest.mark.parametrize("text", NUMBERS)
def test_a_number_of_a_token_is_text_where_it_would_be_written_otherwise(text: str) -> None:
    node = read_token(f"@ros2_lv/2/aa/{text}/0/NN/%/%/n")
    assert isinstance(node, Node)
    assert node.number == NUMBERS[text]


def test_a_token_may_be_long_and_say_more_than_is_known() -> None:
    token = f"{LISTENER}/%{'c' * 100}/std_msgs::msg::dds_::String_/{STRING}/::,10:,:,:,,"
    longest = token.replace("c" * 100, "c" * (100 + 2048 - len(token)))
    assert isinstance(read_token(longest), Endpoint)
    assert read_token(longest.replace("c", "cc", 1)) is None
    assert isinstance(read_token(f"{token}/more"), Endpoint)


def test_an_endpoint_of_a_session_without_a_number_has_the_gid_of_its_token_alone() -> None:
    endpoint = Endpoint(Node(0, "zz", 0, "/", "n"), 1, Kind.PUBLISHER, "/scan", "sensor_msgs/msg/Imu", STRING)
    assert endpoint.gids() == (endpoint.gid(),)
    assert endpoint.key == f"0/scan/sensor_msgs::msg::dds_::Imu_/{STRING}"
