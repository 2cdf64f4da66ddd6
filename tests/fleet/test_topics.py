"""Keys, names in keys, and how each class of message is delivered: the design's two tables."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.fleet import messages, topics
from zbridge.fleet.topics import (
    Congestion,
    Delivery,
    KeySpace,
    Priority,
    Topic,
    escape,
    find,
    is_name,
    split_key,
    unescape,
)

TABLE = [
    ("scan", messages.Scan, Delivery.STREAM),
    ("motion", messages.Motion, Delivery.STREAM),
    ("pose", messages.Pose, Delivery.STREAM),
    ("text", messages.Text, Delivery.STREAM),
    ("sensor/front", messages.Reading, Delivery.STREAM),
    ("raw/tcpudp", messages.Raw, Delivery.STREAM),
    ("status", messages.Status, Delivery.STATE),
    ("control", messages.Control, Delivery.STATE),
    ("scanner", messages.Scanner, Delivery.STATE),
    ("map", messages.Map, Delivery.STATE),
    ("lidar", messages.Switch, Delivery.STATE),
    ("camera", messages.Switch, Delivery.STATE),
    ("devices", messages.Devices, Delivery.STATE),
    ("@cmd/drive", messages.Drive, Delivery.COMMAND),
    ("@cmd/stop", messages.Stop, Delivery.COMMAND),
    ("@cmd/mode", messages.Mode, Delivery.COMMAND),
    ("@cmd/light", messages.Switch, Delivery.COMMAND),
    ("@cmd/lidar", messages.Switch, Delivery.COMMAND),
    ("@cmd/camera", messages.Switch, Delivery.COMMAND),
    ("@cmd/text", messages.Text, Delivery.COMMAND),
    ("@cmd/scan", messages.Scan, Delivery.COMMAND),
    ("@cmd/motor/left", messages.Motor, Delivery.COMMAND),
    ("@cmd/sensor/front", messages.SensorSetting, Delivery.COMMAND),
    ("@cmd/raw/tcpudp", messages.Raw, Delivery.COMMAND),
    ("@rpc/map", messages.Query, Delivery.QUERY),
    ("@rpc/pose", messages.Query, Delivery.QUERY),
    ("@rpc/control/acquire/op1", messages.Acquire, Delivery.QUERY),
    ("@rpc/control/takeover/user%40host", messages.Acquire, Delivery.QUERY),
    ("@rpc/control/refused/hq.desk", messages.Refusals, Delivery.QUERY),
    ("@rpc/control/renew", messages.Authorization, Delivery.QUERY),
    ("@rpc/control/release", messages.Authorization, Delivery.QUERY),
]


@pytest.mark.parametrize(("path", "message", "delivery"), TABLE)
def test_every_key_of_the_design_is_known(path: str, message: type[messages.FleetMessage], delivery: Delivery) -> None:
    found = find(path)
    assert found is not None
    assert (found.path, found.message, found.delivery) == (path, message, delivery)
    assert (found.most_bytes is not None) is (delivery in (Delivery.COMMAND, Delivery.QUERY)), "what anybody may send"


@pytest.mark.parametrize(
    "path",
    ["", "/", "scans", "Scan", "scan/", "sensor", "sensor/", "sensor/a/b", "@cmd", "@cmd/", "@cmd/fly", "cmd/drive"]
    + ["@rpc/control", "@rpc/control/", "@rpc/control/steal", "@rpc/acquire", "control/acquire"]
    + ["@rpc/control/acquire", "@rpc/control/takeover", "@rpc/control/renew/op1"],
)
def test_other_paths_are_not(path: str) -> None:
    assert find(path) is None


def test_a_stream_may_be_dropped_and_keeps_nothing() -> None:
    qos = topics.SCAN.qos
    assert (qos.priority, qos.congestion, qos.express, qos.keeps_last) == (Priority.DATA, Congestion.DROP, False, False)


def test_a_state_blocks_and_keeps_its_last_value() -> None:
    qos = topics.STATUS.qos
    assert (qos.priority, qos.congestion, qos.express, qos.keeps_last) == (
        Priority.DATA_HIGH,
        Congestion.BLOCK,
        False,
        True,
    )


@pytest.mark.parametrize("topic", [topics.CMD_STOP, topics.CMD_MODE, topics.CMD_RAW("x"), topics.CMD_MOTOR("y")])
def test_a_command_goes_first_and_blocks(topic: Topic) -> None:
    qos = topic.qos
    assert (qos.priority, qos.congestion, qos.express, qos.keeps_last) == (
        Priority.REAL_TIME,
        Congestion.BLOCK,
        True,
        False,
    )


def test_a_drive_goes_first_and_may_be_dropped() -> None:
    qos = topics.CMD_DRIVE.qos
    assert (qos.priority, qos.congestion, qos.express) == (Priority.REAL_TIME, Congestion.DROP, True)


@pytest.mark.parametrize(
    ("name", "chunk"),
    [
        ("front-left_2.0", "front-left_2.0"), ("", "%"), ("front left", "front%20left"), ("a/b", "a%2Fb"),
        ("*", "%2A"), ("$", "%24"), ("@cmd", "%40cmd"), ("?", "%3F"), ("#", "%23"), ("%", "%25"),
        ("é", "%C3%A9"), ("\udcff", "%FF"),
    ],
)  # fmt: skip
def test_a_name_is_written_as_one_chunk_and_read_back(name: str, chunk: str) -> None:
    assert escape(name) == chunk
    assert unescape(chunk) == name


@given(st.text() | st.binary().map(lambda raw: raw.decode("utf-8", "surrogateescape")))
def test_any_name_becomes_one_chunk_and_is_read_back(name: str) -> None:
    chunk = escape(name)
    assert unescape(chunk) == name
    assert chunk
    assert not set(chunk) & set("/*$?#@ ")


def test_a_family_escapes_its_names() -> None:
    assert topics.SENSOR("front left").path == "sensor/front%20left"
    assert find("sensor/front%20left") == topics.SENSOR("front left")
    assert topics.SENSOR("").path == "sensor/%"
    assert find("sensor/%") == topics.SENSOR("")


@pytest.mark.parametrize(
    ("who", "chunk", "may"),
    [
        ("op1", "op1", True),
        ("op1.laptop", "op1", True),
        ("op1.laptop.2", "op1", True),
        ("op1.laptop.2", "op1.laptop", True),
        ("hq.desk.3", "hq.desk", True),
        ("user@host", "user%40host", True),
        ("user@host.example.org", "user%40host", True),
        ("op12", "op1", False),
        ("op1", "op1.laptop", False),
        ("op2.op1", "op1", False),
        ("", "op1", False),
        ("op1", "%", False),
        (".x", "%", False),
        ("op1", "*", False),
        ("op1", "$*", False),
        ("op1", "%6Fp1", False),  # there is one way to write a name: rules need not know of others
        ("user@host", "user@host", False),
        ("OP1", "op1", False),
    ],
)
def test_a_program_speaks_in_the_name_that_it_asks_at(who: str, chunk: str, may: bool) -> None:
    assert topics.speaks_for(who, chunk) is may


@pytest.mark.parametrize(
    ("key", "concrete"), [("fleet/r1/@cmd/stop", True), ("fleet/*/@cmd/stop", False), ("**", False), ("a$*b", False)]
)
def test_a_key_is_told_from_an_expression(key: str, concrete: bool) -> None:
    assert topics.is_concrete(key) is concrete


@pytest.mark.parametrize(
    ("name", "stands"),
    [("r1", True), ("R_1.a-b", True), ("", False), ("a b", False), ("a/b", False), ("é", False), ("a\n", False)],
)
def test_a_plain_name_can_stand_in_a_key_as_it_is(name: str, stands: bool) -> None:
    assert is_name(name) is stands


def test_keys_are_written_and_read_back() -> None:
    keys = KeySpace("fleet", "r1")
    assert keys.key("@cmd/drive") == "fleet/r1/@cmd/drive"
    assert keys.path("fleet/r1/@cmd/drive") == "@cmd/drive"
    assert keys.alive("gateway") == "fleet/r1/@alive/gateway"


@pytest.mark.parametrize(
    ("key", "parts"),
    [
        ("fleet/r1/pose", ("fleet", "r1", "pose")),
        ("fleet/r1/@cmd/raw/x", ("fleet", "r1", "@cmd/raw/x")),
        ("fleet/r1", None),
        ("fleet", None),
        ("", None),
        ("fleet/r1/", None),
    ],
)
def test_a_full_key_is_split(key: str, parts: tuple[str, str, str] | None) -> None:
    assert split_key(key) == parts
