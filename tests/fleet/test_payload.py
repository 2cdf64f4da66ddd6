"""Fleet messages as MessagePack: what other programs see on the bus, and what garbage does to us (nothing)."""

import contextlib
import math
import struct
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET

from zbridge.errors import PayloadError
from zbridge.fleet import messages

# fmt: off
from zbridge.fleet.messages import (
    Acquire,
    Authorization,
    Control,
    Denied,
    Device,
    Devices,
    Drive,
    FleetMessage,
    Lease,
    LinkStatus,
    Map,
    Mode,
    Motion,
    Motor,
    Pose,
    Query,
    Raw,
    Reading,
    Refusal,
    Refusals,
    Scan,
    Scanner,
    SensorSetting,
    SessionEntry,
    Sessions,
    Status,
    Stop,
    Switch,
    Text,
)

# fmt: on
from zbridge.fleet.payload import decode, encode, pack, schema, unpack

KINDS = [
    kind
    for kind in vars(messages).values()
    if isinstance(kind, type) and issubclass(kind, FleetMessage) and kind is not FleetMessage
]

LEASE, TOKEN, PROOF = b"\x01" * 8, b"\x02" * 32, b"\x03" * 16

OFFLINE = Refusal(who=None, command="drive", code="not_ready", reason="offline", count=2)
OFFLINE_FIELDS = {"who": None, "command": "drive", "code": "not_ready", "reason": "offline", "count": 2, "by": None}
SCANNER = {
    "angle_min": 0.0,
    "angle_max": 1.0,
    "angle_increment": 0.5,
    "time_increment_s": 0.1,
    "range_min": 0.2,
    "range_max": 9.0,
    "points": 3,
}
ACQUIRE = {"who": "hq 1", "priority": 3, "lease_s": 2.0, "deadman_s": 0.5, "alive": "operator.1"}
HELD = {"ok": False, "expires_in_s": 1.5, "holder": "hq 1", "reason": "held by hq 1", "code": "held"}
SESSION = {
    "name": "ground.2",
    "peer": "tcp://10.0.0.7:50000",
    "role": "robot",
    "state": "established",
    "version": "1.1",
    "counters": {"frames_in": 3},
    "left_out": {"servertSLAMMapPart (56)": 7},
}

PAYLOADS: list[tuple[FleetMessage, dict[str, Any]]] = [
    (Pose(x=1.0, y=2.0, heading=3.0, stamp_ns=5), {"stamp_ns": 5, "x": 1.0, "y": 2.0, "heading": 3.0}),
    (
        Motion(speed=0.5, gyro=(1.0, 2.0, 3.0)),
        {"speed": 0.5, "acceleration": None, "gyro": [1.0, 2.0, 3.0], "temperature": None},
    ),
    (Scanner(**SCANNER), SCANNER),  # type: ignore[arg-type]
    (Reading(value=1.5), {"value": 1.5, "kind": None, "device": None, "fault": False}),
    (
        Devices(devices=(Device(name="left", number=1, kind="motor"),)),
        {"devices": [{"name": "left", "number": 1, "kind": "motor"}]},
    ),
    (Switch(on=True), {"on": True}),
    (Text(text="hi"), {"text": "hi", "kind": "debug", "sender": None}),
    (Raw(id=40, body=b"\x01"), {"id": 40, "body": b"\x01"}),
    (
        Status(state="established", links=(LinkStatus(name="robot", state="established", peer="tcp://a:1"),)),
        {
            "state": "established",
            "reason": None,
            "protocol": None,
            "dialect": None,
            "version": None,
            "features": [],
            "links": [{"name": "robot", "state": "established", "peer": "tcp://a:1", "reason": None}],
        },
    ),
    (
        Control(state="stopped", refusals=(OFFLINE,)),
        {
            "state": "stopped",
            "holder": None,
            "lease": None,
            "priority": None,
            "expires_in_s": None,
            "refusals": [OFFLINE_FIELDS],
        },
    ),
    (
        Drive(forward=0.5, left=-1.0, seq=7, device_ms=9),
        {"seq": 7, "device_ms": 9, "forward": 0.5, "left": -1.0, "turn": 0.0, "light": None},
    ),
    (Motor(value=2.0), {"value": 2.0}),
    (Mode(mode="manual"), {"mode": "manual"}),
    (Stop(), {}),
    (Query(), {}),
    (
        SensorSetting(index=1, value=2.0, values=(1.0, 2.0)),
        {"enable": None, "index": 1, "value": 2.0, "values": [1.0, 2.0]},
    ),
    (Acquire(**ACQUIRE), ACQUIRE),  # type: ignore[arg-type]
    (Authorization(lease=LEASE, seq=7, proof=PROOF), {"seq": 7, "lease": LEASE, "proof": PROOF}),
    (
        Lease(ok=True, lease=LEASE, token=TOKEN, expires_in_s=3.0, holder="hq 1"),
        {
            "ok": True,
            "lease": LEASE,
            "token": TOKEN,
            "expires_in_s": 3.0,
            "holder": "hq 1",
            "reason": None,
            "code": None,
        },
    ),
    (Lease(**HELD), {**HELD, "lease": None, "token": None}),  # type: ignore[arg-type]
    (Refusals(refusals=(OFFLINE,)), {"refusals": [OFFLINE_FIELDS]}),
    (Denied(code="closing", reason="gateway stopped"), {"code": "closing", "reason": "gateway stopped"}),
    (
        Sessions(sessions=(SessionEntry(**SESSION, features=("udp",)),)),  # type: ignore[arg-type]
        {"sessions": [{**SESSION, "reason": None, "features": ["udp"], "transport": "tcp"}]},
    ),
]


@pytest.mark.parametrize(("message", "fields"), PAYLOADS, ids=lambda value: type(value).__name__)
def test_a_message_is_a_map_of_its_fields(message: FleetMessage, fields: dict[str, Any]) -> None:
    assert msgpack.unpackb(encode(message)) == fields
    assert decode(type(message), msgpack.packb(fields)) == message


def test_every_message_but_the_two_with_arrays_is_shown_above() -> None:
    assert {type(message) for message, _ in PAYLOADS} == set(KINDS) - {Scan, Map}


SCAN_SENT = Scan(
    angle_min=0.0, angle_increment=0.5, range_min=0.25, range_max=5.0, ranges=np.array([1.5, -2.25], np.float32)
)
MAP_SENT = Map(rows=1, columns=2, cell=0.5, origin=(0.0, -1.0), cells=np.array([[1, 2]], np.uint8))
EVERY = [*(message for message, _ in PAYLOADS), SCAN_SENT, MAP_SENT]


@pytest.mark.parametrize("message", EVERY, ids=lambda message: type(message).__name__)
def test_plain_msgpack_finds_all_fields_and_what_it_packs_is_decoded_to_the_same_message(message: FleetMessage) -> None:
    read = msgpack.unpackb(encode(message))
    fields = {name for name in message.__struct_fields__ if getattr(message, name) is not UNSET}
    assert set(read) == fields
    assert set(message.__struct_fields__) - fields <= {"stamp_ns", "seq", "device_ms"}
    again = decode(type(message), msgpack.packb(read))
    assert encode(again) == encode(message)
    assert type(again) is type(message)


@pytest.mark.parametrize("name", ["stamp_ns", "seq", "device_ms"])
@pytest.mark.parametrize("value", [0, 1_700_000_000_000_000_000])
def test_a_field_the_device_may_lack_is_in_the_payload_only_where_it_has_it(name: str, value: int) -> None:
    assert name not in msgpack.unpackb(encode(Switch(on=True)))
    told = Switch(on=True, **{name: value})
    assert msgpack.unpackb(encode(told)) == {"on": True, name: value}
    assert decode(Switch, msgpack.packb({"on": True, name: value})) == told
    assert getattr(decode(Switch, msgpack.packb({"on": True})), name) is UNSET


def test_a_message_by_hand() -> None:
    payload = bytes.fromhex("81 a2 6f6e c3")  # {"on": true}
    assert encode(Switch(on=True)) == payload
    assert decode(Switch, payload) == Switch(on=True)


@pytest.mark.parametrize(
    "payload",
    [
        msgpack.packb({"forward": 1, "left": -1, "turn": 0}),
        msgpack.packb({"forward": 1.0, "left": -1.0}, use_single_float=True),
        msgpack.packb({"turn": 0.0, "left": -1.0, "forward": 1.0, "light": None}),
    ],
)
def test_numbers_may_be_packed_whole_or_short_and_fields_in_any_order(payload: bytes) -> None:
    assert decode(Drive, payload) == Drive(forward=1.0, left=-1.0)


def test_large_arrays_travel_whole() -> None:
    cells = np.arange(2048 * 1024, dtype=np.uint32).astype(np.uint8).reshape(1024, 2048) % 3
    read = msgpack.unpackb(encode(Map(rows=1024, columns=2048, cell=0.1, origin=(0.0, 0.0), cells=cells)))
    assert read["cells"] == cells.tobytes()
    assert np.array_equal(decode(Map, msgpack.packb(read)).cells, cells)


def test_ranges_travel_as_little_endian_floats() -> None:
    scan = Scan(angle_min=0.0, angle_increment=0.1, range_min=0.2, range_max=5.0, ranges=np.array([1.5, math.nan]))
    fields = msgpack.unpackb(encode(scan))
    assert fields["ranges"][:4] == bytes.fromhex("0000c03f")
    assert len(fields["ranges"]) == 8
    assert math.isnan(struct.unpack("<f", fields["ranges"][4:])[0])
    again = decode(Scan, msgpack.packb({**fields, "ranges": bytes.fromhex("0000c03f 000010c0")}))
    assert again.ranges.tolist() == [1.5, -2.25]
    assert again.ranges.dtype == np.float32
    assert not again.ranges.flags.writeable


def test_big_endian_and_strided_ranges_are_written_little_endian() -> None:
    ranges = np.array([1.5, 0.0, -2.25, 0.0], ">f8")[::2]
    scan = Scan(angle_min=0.0, angle_increment=0.1, range_min=0.2, range_max=5.0, ranges=ranges)  # type: ignore[arg-type]
    assert msgpack.unpackb(encode(scan))["ranges"] == bytes.fromhex("0000c03f 000010c0")


def test_cells_travel_row_by_row_even_of_a_transposed_array() -> None:
    cells = np.array([[0, 1], [2, 0], [1, 2]], np.uint8).T
    fields = msgpack.unpackb(encode(Map(rows=2, columns=3, cell=0.1, origin=(0.0, 1.0), cells=cells)))
    assert fields["cells"] == bytes([0, 2, 1, 1, 0, 2])
    again = decode(Map, msgpack.packb(fields))
    assert again.cells.tolist() == [[0, 2, 1], [1, 0, 2]]
    assert not again.cells.flags.writeable


def test_an_empty_map_and_an_empty_scan_travel() -> None:
    empty = Map(rows=0, columns=0, cell=0.1, origin=(0.0, 0.0), cells=np.zeros((0, 0), np.uint8))
    assert decode(Map, encode(empty)).cells.shape == (0, 0)
    assert len(decode(Scan, msgpack.packb({**SCAN, "ranges": b""})).ranges) == 0
    scan = Scan(angle_min=0.0, angle_increment=0.1, range_min=0.2, range_max=5.0, ranges=np.zeros(0, np.float32))
    assert msgpack.unpackb(encode(scan))["ranges"] == b""


MAP = {"rows": 2, "columns": 3, "cell": 0.1, "origin": [0.0, 0.0], "cells": bytes(6)}
SCAN = {"angle_min": 0.0, "angle_increment": 0.1, "range_min": 0.2, "range_max": 5.0, "ranges": bytes(8)}


WRONG: list[tuple[type[FleetMessage], dict[str, Any]]] = [
    *(
        (Map, {"rows": rows, "columns": columns})
        for rows, columns in [(3, 3), (-2, -3), (None, 3), ("2", 3), (2.0, 3), (0, 3)]
    ),
    (Map, {"rows": 0, "columns": 2**64 - 1, "cells": b""}),
    *((Map, {"cells": cells}) for cells in ("text", [0] * 6, None, bytes(5))),
    (Map, {"cell": "wide"}),
    (Map, {"origin": [0.0]}),
    *((Scan, {"ranges": ranges}) for ranges in (bytes(7), [1.0], None)),
    (Scan, {"angle_min": None}),
]


@pytest.mark.parametrize(("kind", "wrong"), WRONG)
def test_an_array_and_fields_that_do_not_go_with_it_are_a_payload_error(kind: type[FleetMessage], wrong) -> None:
    with pytest.raises(PayloadError, match=kind.__name__):
        decode(kind, msgpack.packb({**(MAP if kind is Map else SCAN), **wrong}))


def test_of_missing_fields_one_is_named_an_array_too() -> None:
    without = {name: value for name, value in SCAN.items() if name != "ranges"}
    with pytest.raises(PayloadError, match=r"Scan: .*`ranges`"):
        decode(Scan, msgpack.packb(without))
    with pytest.raises(PayloadError, match=r"Scan: .*required field `angle_min`"):
        decode(Scan, b"")


def test_missing_optional_fields_take_their_defaults_and_unknown_ones_are_ignored() -> None:
    assert decode(Drive, b"") == Drive()
    assert decode(Drive, msgpack.packb({"forward": 1})) == Drive(forward=1.0)
    assert decode(Acquire, msgpack.packb({"who": "hq"})) == Acquire("hq", 0, None, None, None)
    assert decode(Switch, msgpack.packb({"on": True, "colour": "red"})) == Switch(on=True)


@pytest.mark.parametrize(
    ("message", "moving"),
    [
        (Drive(), False), (Drive(light=True), False), (Drive(forward=-0.0), False),
        (Drive(forward=0.01), True), (Drive(left=-0.01), True), (Drive(turn=0.01), True),
        (Motor(value=0.0), False), (Motor(value=-0.1), True),
    ],
)  # fmt: skip
def test_motion_is_told_from_neutral(message: Drive | Motor, moving: bool) -> None:
    assert message.moving is moving


@pytest.mark.parametrize(
    ("kind", "fields", "named"),
    [
        (Switch, {}, "on"),
        (Switch, {"on": 1}, "on"),
        (Pose, {"x": 1.0, "y": 1.0}, "heading"),
        (Pose, {"x": "1", "y": 1.0, "heading": 0.0}, "x"),
        (Drive, {"forward": 1.0001}, "forward"),
        (Drive, {"left": -1.0001}, "left"),
        (Drive, {"turn": math.nan}, "turn"),
        (Drive, {"turn": math.inf}, "turn"),
        (Mode, {"mode": "sport"}, "mode"),
        (Text, {"text": b"bytes"}, "text"),
        (Raw, {"id": "x"}, "id"),
        (Raw, {"id": 1, "body": [1]}, "body"),
        (Switch, {"on": True, "stamp_ns": "now"}, "stamp_ns"),
        (Acquire, {}, "who"),
        (Acquire, {"who": 1}, "who"),
        (Acquire, {"who": "hq", "priority": 1.5}, "priority"),
        (Acquire, {"who": "hq", "lease_s": "long"}, "lease_s"),
        (Acquire, {"who": "hq", "alive": 7}, "alive"),
        (Authorization, {"seq": 1, "proof": PROOF}, "lease"),
        (Authorization, {"lease": LEASE[1:], "seq": 1, "proof": PROOF}, "lease"),
        (Authorization, {"lease": LEASE, "seq": -1, "proof": PROOF}, "seq"),
        (Authorization, {"lease": LEASE, "proof": PROOF}, "seq"),
        (Authorization, {"lease": LEASE, "seq": 1, "proof": "text"}, "proof"),
        (Refusals, {"refusals": 17 * [{"who": None, "command": "drive", "reason": "", "count": 1}]}, "refusals"),
        (Lease, {"ok": True, "lease": LEASE, "token": TOKEN[:16]}, "token"),
    ],
)
def test_a_wrong_field_is_a_payload_error_that_names_it(kind, fields, named) -> None:
    with pytest.raises(PayloadError, match=f"{kind.__name__}.*{named}"):
        decode(kind, msgpack.packb(fields))


NO_MAPS = [
    *(b"\xc1", b"\x81", b"\x80\x80", b"\x01", b"\x90", b"\xc0", b"\xa1a", b"\x81\x01\x02", b"\xdf\xff\xff\xff\xff"),
    b"hello",
]


@pytest.mark.parametrize("payload", [*NO_MAPS, b"\x81\xa1\xff\x01", b"\x91" * 100_000])
def test_what_is_no_map_is_a_payload_error(payload: bytes) -> None:
    with pytest.raises(PayloadError):
        unpack(payload)


@pytest.mark.parametrize("payload", NO_MAPS)
@pytest.mark.parametrize("kind", [Drive, Stop, Scan, Map])
def test_what_is_no_map_is_no_message_and_the_error_names_the_message(kind: type[FleetMessage], payload: bytes) -> None:
    with pytest.raises(PayloadError, match=f"^{kind.__name__}: ."):
        decode(kind, payload)


@pytest.mark.parametrize("kind", KINDS)
def test_a_payload_nested_too_deeply_is_a_payload_error(kind: type[FleetMessage]) -> None:
    with pytest.raises(PayloadError, match=f"^{kind.__name__}: ."):
        decode(kind, b"\x81\xa1x" + b"\x91" * 100_000 + b"\xc0")


def test_plain_maps_are_packed_and_unpacked_and_an_empty_payload_is_an_empty_one() -> None:
    assert unpack(b"") == {}
    assert decode(Stop, b"") == Stop()
    assert unpack(pack({"zid": "1", "held": True})) == {"zid": "1", "held": True}


def test_the_schema_names_message_and_version() -> None:
    assert schema(Scan) == "zbridge.Scan.v1"


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from(KINDS), st.binary(max_size=40))
def test_random_bytes_give_a_message_or_a_payload_error(kind: type[FleetMessage], payload: bytes) -> None:
    with contextlib.suppress(PayloadError):
        assert isinstance(decode(kind, payload), kind)


@given(st.sampled_from(KINDS), st.data())
def test_random_fields_give_a_message_or_a_payload_error(kind: type[FleetMessage], data: st.DataObject) -> None:
    fields = data.draw(st.dictionaries(st.sampled_from(kind.__struct_fields__), JSON, max_size=4))
    with contextlib.suppress(PayloadError):
        assert isinstance(decode(kind, msgpack.packb(fields)), kind)
