"""Keys, names in keys, and how each class of message is delivered: the design's two tables."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.fleet import lease_messages as lm
from zbridge.fleet import messages as m
from zbridge.fleet import topics
from zbridge.fleet.topics import Congestion, Delivery, KeySpace, Priority, Topic, escape, find, unescape

TABLE: dict[Delivery, dict[str, type[m.FleetMessage]]] = {
    Delivery.STREAM: {"scan": m.Scan, "motion": m.Motion, "pose": m.Pose, "text": m.Text}
    | {"image": m.Image, "battery": m.Battery}
    | {"sensor/front": m.Reading, "raw/tcpudp": m.Raw},
    Delivery.STATE: {"status": m.Status, "control": m.Control, "scanner": m.Scanner, "map": m.Map}
    | {"lidar": m.Switch, "camera": m.Switch, "devices": m.Devices},
    Delivery.COMMAND: {"@cmd/drive": m.Drive, "@cmd/stop": m.Stop, "@cmd/mode": m.Mode, "@cmd/light": m.Switch}
    | {"@cmd/lidar": m.Switch, "@cmd/camera": m.Switch, "@cmd/text": m.Text, "@cmd/scan": m.Scan}
    | {"@cmd/motor/left": m.Motor, "@cmd/raw/tcpudp": m.Raw, "@cmd/sensor/front": m.SensorSetting},
    Delivery.QUERY: {"@rpc/map": m.Query, "@rpc/pose": m.Query, "@rpc/sessions/r1": m.Query}
    | {"@rpc/control/renew": lm.Authorization, "@rpc/control/release": lm.Authorization}
    | {"@rpc/control/acquire/op1": lm.Acquire, "@rpc/control/takeover/user%40host": lm.Acquire}
    | {"@rpc/control/refused/hq.desk": m.Refusals},
}


@pytest.mark.parametrize("delivery", TABLE)
def test_every_key_of_the_design_is_known(delivery: Delivery) -> None:
    for path, message in TABLE[delivery].items():
        found = find(path)
        assert found is not None, path
        assert (found.path, found.message, found.delivery) == (path, message, delivery)
        anybody = delivery in (Delivery.COMMAND, Delivery.QUERY)
        assert (found.most_bytes is not None) is anybody, "what anybody may send is bounded"


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
        (topics.IMAGE, Priority.DATA, Congestion.DROP, False, False),
        (topics.STATUS, Priority.DATA_HIGH, Congestion.BLOCK, False, True),
        (topics.CMD_DRIVE, Priority.REAL_TIME, Congestion.DROP, True, False),
        *((topic, *FIRST) for topic in (topics.CMD_STOP, topics.CMD_MOTOR("y"), topics.RPC_RENEW)),
    ],
)
def test_a_topic_is_delivered_so(topic: Topic, priority, congestion, express: bool, keeps_last: bool) -> None:
    qos = topic.qos
    assert (qos.priority, qos.congestion, qos.express, qos.keeps_last) == (priority, congestion, express, keeps_last)


NAMES = {"front-left_2.0": "front-left_2.0", "": "%", "front left": "front%20left", "a/b": "a%2Fb", "*": "%2A"} | {
    "$": "%24", "@cmd": "%40cmd", "?": "%3F", "#": "%23", "%": "%25", "é": "%C3%A9", "\udcff": "%FF",
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_a_name_is_written_as_one_chunk_and_read_back_also_by_a_family(name: str) -> None:
    assert (escape(name), unescape(NAMES[name])) == (NAMES[name], name)
    assert topics.SENSOR(name).path == f"sensor/{NAMES[name]}"
    assert find(f"sensor/{NAMES[name]}") == topics.SENSOR(name)


@given(st.text() | st.binary().map(lambda raw: raw.decode("utf-8", "surrogateescape")))
def test_any_name_becomes_one_chunk_and_is_read_back(name: str) -> None:
    chunk = escape(name)
    assert unescape(chunk) == name
    assert chunk
    assert not set(chunk) & set("/*$?#@ ")


SPEAKERS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "op1": (("op1", "op1.laptop", "op1.laptop.2"), ("op12", "op2.op1", "", "OP1")),
    "op1.laptop": (("op1.laptop.2",), ("op1",)),
    "user%40host": (("user@host", "user@host.example.org"), ()),
    "user@host": ((), ("user@host",)),
    "%6Fp1": ((), ("op1",)),  # there is one way to write a name: rules need not know of others
    **dict.fromkeys(("%", "*", "$*"), ((), ("op1", ".x"))),
}
"""Of a key chunk, who may ask there and who may not."""


@pytest.mark.parametrize("chunk", SPEAKERS)
def test_a_program_speaks_in_the_name_that_it_asks_at(chunk: str) -> None:
    may, may_not = SPEAKERS[chunk]
    assert [who for who in (*may, *may_not) if topics.speaks_for(who, chunk)] == list(may)


@pytest.mark.parametrize(
    ("chunk", "may", "may_not"),
    [
        (
            "op1",
            ("operator.op1.a1.2", "hq.op1.7"),
            ("operator.op1", "operator.op12.7", "operator.op2.op1.7", "op1.7", ""),
        ),
        ("user%40host", ("operator.user%40host.a1",), ("operator.user@host.a1",)),
        ("hq.desk", ("hq.desk.7", "hq.desk.7.1"), ("hq.desk", "hq.desk2.7", "operator.desk.7", "operator.hq.desk.7")),
    ],
)
def test_a_program_names_a_token_of_the_name_that_it_asks_at(
    chunk: str, may: tuple[str, ...], may_not: tuple[str, ...]
) -> None:
    assert [alive for alive in (*may, *may_not) if topics.may_name_token(alive, chunk)] == list(may)


def test_a_key_is_told_from_an_expression_and_a_plain_name_can_stand_in_it_as_it_is() -> None:
    keys = ("fleet/r1/@cmd/stop", "fleet/*/@cmd/stop", "**", "a$*b")
    assert [key for key in keys if topics.is_concrete(key)] == ["fleet/r1/@cmd/stop"]
    names = ("r1", "R_1.a-b", "", "a b", "a/b", "é", "a\n")
    assert [name for name in names if topics.is_name(name)] == ["r1", "R_1.a-b"]


def test_keys_are_written_read_back_and_split() -> None:
    keys = KeySpace("fleet", "r1")
    assert (keys.key("@cmd/drive"), keys.alive("gateway")) == ("fleet/r1/@cmd/drive", "fleet/r1/@alive/gateway")
    assert keys.path("fleet/r1/@cmd/drive") == "@cmd/drive"
    assert topics.split_key("fleet/r1/@cmd/raw/x") == ("fleet", "r1", "@cmd/raw/x")
    assert [topics.split_key(key) for key in ("fleet/r1", "fleet", "", "fleet/r1/")] == [None] * 4
