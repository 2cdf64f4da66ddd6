"""Keys, names in keys, and how each class of message is delivered: the design's two tables."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.fleet import messages, topics
from zbridge.fleet.messages import Acquire, Authorization, Query, Raw, Reading, Switch
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

TABLE: dict[Delivery, dict[str, type[messages.FleetMessage]]] = {
    Delivery.STREAM: {
        "scan": messages.Scan,
        "motion": messages.Motion,
        "pose": messages.Pose,
        "text": messages.Text,
        "sensor/front": Reading,
        "raw/tcpudp": Raw,
    },
    Delivery.STATE: {
        "status": messages.Status,
        "control": messages.Control,
        "scanner": messages.Scanner,
        "map": messages.Map,
        "lidar": Switch,
        "camera": Switch,
        "devices": messages.Devices,
    },
    Delivery.COMMAND: {
        "@cmd/drive": messages.Drive,
        "@cmd/stop": messages.Stop,
        "@cmd/mode": messages.Mode,
        "@cmd/light": Switch,
        "@cmd/lidar": Switch,
        "@cmd/camera": Switch,
        "@cmd/text": messages.Text,
        "@cmd/scan": messages.Scan,
        "@cmd/motor/left": messages.Motor,
        "@cmd/raw/tcpudp": Raw,
        "@cmd/sensor/front": messages.SensorSetting,
    },
    Delivery.QUERY: {
        "@rpc/map": Query,
        "@rpc/pose": Query,
        "@rpc/control/renew": Authorization,
        "@rpc/control/release": Authorization,
        "@rpc/control/acquire/op1": Acquire,
        "@rpc/control/takeover/user%40host": Acquire,
        "@rpc/control/refused/hq.desk": messages.Refusals,
    },
}


@pytest.mark.parametrize(
    ("path", "message", "delivery"), [(*entry, delivery) for delivery, keys in TABLE.items() for entry in keys.items()]
)
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


FIRST = (Priority.REAL_TIME, Congestion.BLOCK, True, False)
"""A command goes first and blocks."""


@pytest.mark.parametrize(
    ("topic", "priority", "congestion", "express", "keeps_last"),
    [
        (topics.SCAN, Priority.DATA, Congestion.DROP, False, False),
        (topics.STATUS, Priority.DATA_HIGH, Congestion.BLOCK, False, True),
        (topics.CMD_DRIVE, Priority.REAL_TIME, Congestion.DROP, True, False),
        *((command, *FIRST) for command in (topics.CMD_STOP, topics.CMD_MODE)),
        *((command, *FIRST) for command in (topics.CMD_RAW("x"), topics.CMD_MOTOR("y"))),
    ],
)
def test_a_topic_is_delivered_so(topic: Topic, priority, congestion, express: bool, keeps_last: bool) -> None:
    qos = topic.qos
    assert (qos.priority, qos.congestion, qos.express, qos.keeps_last) == (priority, congestion, express, keeps_last)


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
        *((who, "op1", True) for who in ("op1", "op1.laptop", "op1.laptop.2")),
        *(("op1.laptop.2", "op1.laptop", True), ("hq.desk.3", "hq.desk", True)),
        *((who, "user%40host", True) for who in ("user@host", "user@host.example.org")),
        *((who, "op1", False) for who in ("op12", "op2.op1", "", "OP1")),
        *(("op1", chunk, False) for chunk in ("op1.laptop", "%", "*", "$*")),
        (".x", "%", False),
        ("op1", "%6Fp1", False),  # there is one way to write a name: rules need not know of others
        ("user@host", "user@host", False),
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
