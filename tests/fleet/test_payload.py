"""Fleet messages as MessagePack: what other programs see on the bus, and what garbage does to us (nothing)."""

import contextlib
import math
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import UNSET

from zbridge.errors import PayloadError
from zbridge.fleet import lease_messages as lm
from zbridge.fleet import messages as m
from zbridge.fleet import processes as p
from zbridge.fleet.payload import decode, encode, pack, schema, unpack

KINDS = {
    kind
    for kind in (vars(m) | vars(lm) | vars(p)).values()
    if isinstance(kind, type) and issubclass(kind, m.FleetMessage)
}
KINDS.remove(m.FleetMessage)


def none(names: str) -> dict[str, None]:
    return dict.fromkeys(names.split())


STOP, OTHER_STOP = b"\x04" * 16, b"\x05" * 16
LATCH = {"id": STOP, "who": "ann", "reason": None, "fleet": True}
LEASE, TOKEN, PROOF = b"\x01" * 8, b"\x02" * 32, b"\x03" * 16
OFFLINE = m.Refusal(who=None, command="drive", code="not_ready", reason="offline", count=2)
OFFLINE_SENT = {"who": None, "command": "drive", "code": "not_ready", "reason": "offline", "count": 2, "by": None}
LINK = {"name": "robot", "state": "established", "peer": "tcp://a:1"}
SESSION = {"name": "ground.2", "peer": "tcp://10.0.0.7:50000", "role": "robot", "state": "established"}
SESSION |= {"version": "1.1", "counters": {"frames_in": 3}, "left_out": {"servertSLAMMapPart (56)": 7}}
PROCESS = {"host": "hub", "pid": 7, "version": "0.1.0", "robots": 2, "uptime_s": 3.5, "cpu": 0.25, "late_s": 0.001}
PROCESS |= {"resident_bytes": 70_000_000, "proportional_bytes": None, "files": 31, "most_files": 1024}
DESK = {"name": "desk", "protocol": "tcpudp", "address": "tcp://0.0.0.0:11002", "clients": 1, "listening": True}
DISK = {"use": "audit", "path": "/var/log/r1", "free_bytes": 5}
SCANNER = {"angle_min": 0.0, "angle_max": 1.0, "angle_increment": 0.5, "time_increment_s": 0.1}
SCANNER |= {"range_min": 0.2, "range_max": 9.0, "points": 3}
ACQUIRE = {"who": "hq 1", "priority": 3, "lease_s": 2.0, "deadman_s": 0.5, "alive": "operator.1"}
GRANTED = {"ok": True, "lease": LEASE, "token": TOKEN, "expires_in_s": 3.0, "holder": "hq 1"}
HELD = {"ok": False, "expires_in_s": 1.5, "holder": "hq 1", "reason": "held by hq 1", "code": "held"}
DRIVE = {"seq": 7, "device_ms": 9, "forward": 0.5, "left": -1.0}

PAYLOADS: list[tuple[m.FleetMessage, dict[str, Any]]] = [
    (m.Pose(1.0, 2.0, 3.0, stamp_ns=5), {"stamp_ns": 5, "x": 1.0, "y": 2.0, "heading": 3.0}),
    (
        m.Motion(speed=0.5, gyro=(1.0, 2.0, 3.0)),
        {"speed": 0.5, "gyro": [1.0, 2.0, 3.0]} | none("acceleration temperature"),
    ),
    (m.Scanner(**SCANNER), SCANNER),
    (m.Reading(1.5), {"value": 1.5, "fault": False} | none("kind device")),
    (m.Image("jpeg", b"\xff\xd8"), {"format": "jpeg", "data": b"\xff\xd8"} | none("width height")),
    (m.Battery(level=0.5, voltage=12.0), {"level": 0.5, "voltage": 12.0} | none("current charging")),
    (m.Devices((m.Device("left", 1, "motor"),)), {"devices": [{"name": "left", "number": 1, "kind": "motor"}]}),
    (m.Switch(on=True), {"on": True}),
    (m.Switch(on=True, stamp_ns=0, seq=0, device_ms=0), {"on": True, "stamp_ns": 0, "seq": 0, "device_ms": 0}),
    (m.Text("hi"), {"text": "hi", "kind": "debug", "sender": None}),
    (
        m.Image(format="jpeg", data=b"\xff\xd8\xff", width=640, stamp_ns=5),
        {"stamp_ns": 5, "format": "jpeg", "data": b"\xff\xd8\xff", "width": 640, "height": None},
    ),
    (m.Raw(40, b"\x01"), {"id": 40, "body": b"\x01"}),
    (
        m.Status("established", links=(m.LinkStatus(**LINK),)),
        {"state": "established", "features": [], "commands": [], "faults": [], "links": [LINK | none("reason")]}
        | none("reason protocol dialect version host"),
    ),
    (
        m.Control("stopped", refusals=(OFFLINE,)),
        {"state": "stopped", "refusals": [OFFLINE_SENT], "latches": [], "stops": []}
        | none("holder lease priority expires_in_s"),
    ),
    (lm.Unlatch(STOP), {"id": STOP}),
    (
        lm.FleetLatches((m.Latch(STOP, "ann", fleet=True),), (OTHER_STOP,)),
        {"latches": [LATCH], "released": [OTHER_STOP]},
    ),
    (m.Drive(**DRIVE), {**DRIVE, "turn": 0.0, "light": None}),
    (m.Motor(2.0), {"value": 2.0}),
    (m.Mode("manual"), {"mode": "manual"}),
    (m.Stop(), {}),
    (m.Query(), {}),
    (
        m.SensorSetting(index=1, value=2.0, values=(1.0, 2.0)),
        {"enable": None, "index": 1, "value": 2.0, "values": [1.0, 2.0]},
    ),
    (lm.Acquire(**ACQUIRE), ACQUIRE),
    (lm.Authorization(lease=LEASE, seq=7, proof=PROOF), {"seq": 7, "lease": LEASE, "proof": PROOF}),
    (lm.Lease(**GRANTED), GRANTED | none("reason code")),
    (lm.Lease(**HELD), HELD | none("lease token")),
    (m.Refusals((OFFLINE,)), {"refusals": [OFFLINE_SENT]}),
    (
        p.Membership(name="g1", role="gateway", robots=("r1",)),
        {"name": "g1", "role": "gateway", "robots": ["r1"]},
    ),
    (lm.Denied("closing", "gateway stopped"), {"code": "closing", "reason": "gateway stopped"}),
    (
        p.Sessions((p.SessionEntry(**SESSION, features=("udp",)),)),
        {"sessions": [{**SESSION, "reason": None, "features": ["udp"], "transport": "tcp"}], "listeners": []},
    ),
    (
        p.Stats(p.ProcessStats(**PROCESS), {"pose": 20.5}, 1, 2, 3, (p.ListenerStats(**DESK),), (p.DiskSpace(**DISK),)),
        {"process": PROCESS, "rates": {"pose": 20.5}, "gaps": 1, "refused": 2, "dropped": 3}
        | {"listeners": [DESK], "disks": [DISK]},
    ),
]


@pytest.mark.parametrize(("message", "fields"), PAYLOADS, ids=lambda value: type(value).__name__)
def test_a_message_is_a_map_of_its_fields(message: m.FleetMessage, fields: dict[str, Any]) -> None:
    assert msgpack.unpackb(encode(message)) == fields
    assert decode(type(message), msgpack.packb(fields)) == message


def test_every_message_but_the_two_with_arrays_is_shown_above_and_a_schema_names_message_and_version() -> None:
    assert {type(message) for message, _ in PAYLOADS} == KINDS - {m.Scan, m.Map}
    assert schema(m.Scan) == "zbridge.Scan.v1"


@pytest.mark.parametrize(
    ("kind", "payload", "message"),
    [
        (m.Drive, msgpack.packb({"forward": 1, "left": -1, "turn": 0}), m.Drive(1.0, -1.0)),
        (m.Drive, msgpack.packb({"left": -1.0, "forward": 1.0}, use_single_float=True), m.Drive(1.0, -1.0)),
        (m.Drive, b"", m.Drive()),
        (m.Stop, b"", m.Stop()),
        (lm.Acquire, msgpack.packb({"who": "hq"}), lm.Acquire("hq", 0, None, None, None)),
        (m.Switch, bytes.fromhex("82 a3 726564 00 a2 6f6e c3"), m.Switch(on=True)),  # {"red": 0, "on": true}
    ],
)
def test_numbers_may_be_whole_or_short_fields_in_any_order_missing_or_unknown(kind, payload: bytes, message) -> None:
    assert decode(kind, payload) == message
    assert decode(kind, payload).stamp_ns is UNSET


# Arrays

SCAN = {"angle_min": 0.0, "angle_increment": 0.1, "range_min": 0.2, "range_max": 5.0, "ranges": bytes(8)}
MAP = {"rows": 2, "columns": 3, "cell": 0.1, "origin": [0.0, 0.0], "cells": bytes(6)}


@pytest.mark.parametrize(
    ("ranges", "sent"),
    [
        (np.array([1.5, -2.25]), "0000c03f 000010c0"),
        (np.array([1.5, -2.25], np.float32), "0000c03f 000010c0"),
        (np.array([1.5, 0.0, -2.25, 0.0], ">f8")[::2], "0000c03f 000010c0"),
        (np.array([math.nan], np.float32), "0000c07f"),
        (np.zeros(0, np.float32), ""),
    ],
)
def test_ranges_travel_as_little_endian_floats(ranges: Any, sent: str) -> None:
    fields = {**SCAN, "ranges": bytes.fromhex(sent)}
    assert msgpack.unpackb(encode(m.Scan(**{**SCAN, "ranges": ranges}))) == fields
    again = decode(m.Scan, msgpack.packb(fields)).ranges
    np.testing.assert_array_equal(again, ranges)
    assert decode(m.Scan, msgpack.packb(fields), arrays=False).ranges == fields["ranges"]
    assert (again.dtype, again.flags.writeable) == (np.float32, False)


@pytest.mark.parametrize(
    ("cells", "sent"),
    [
        (np.array([[0, 1], [2, 0], [1, 2]], np.uint8).T, bytes([0, 2, 1, 1, 0, 2])),
        (np.zeros((0, 0), np.uint8), b""),
        (np.tile(np.array([[1, 2, 0, 1]], np.uint8), (1024, 512)), bytes([1, 2, 0, 1]) * 1024 * 512),
    ],
    ids=["transposed", "empty", "large"],
)
def test_cells_travel_row_by_row(cells: Any, sent: bytes) -> None:
    fields = {**MAP, "rows": cells.shape[0], "columns": cells.shape[1], "cells": sent}
    assert msgpack.unpackb(encode(m.Map(**{**fields, "cells": cells}))) == fields
    again = decode(m.Map, msgpack.packb(fields)).cells
    np.testing.assert_array_equal(again, cells)
    assert not again.flags.writeable


# What is none


@pytest.mark.parametrize(
    ("kind", "fields", "named"),
    [
        (m.Switch, {}, "on"),
        (m.Pose, {"x": 1.0, "y": 1.0}, "heading"),
        (m.Drive, {"forward": 1.0001}, "forward"),
        (m.Drive, {"left": -1.0001}, "left"),
        (m.Drive, {"turn": math.nan}, "turn"),
        (m.Drive, {"turn": math.inf}, "turn"),
        (m.Motor, {"value": math.nan}, "value"),
        (m.Mode, {"mode": "sport"}, "mode"),
        (m.Switch, {"on": True, "stamp_ns": "now"}, "stamp_ns"),
        (lm.Authorization, {"seq": 1, "proof": PROOF}, "lease"),
        (lm.Authorization, {"lease": LEASE[1:], "seq": 1, "proof": PROOF}, "lease"),
        (lm.Authorization, {"lease": LEASE, "seq": -1, "proof": PROOF}, "seq"),
        (lm.Authorization, {"lease": LEASE, "proof": PROOF}, "seq"),
        (m.Refusals, {"refusals": 17 * [{"who": None, "command": "drive", "reason": "", "count": 1}]}, "refusals"),
        (lm.Lease, {"ok": True, "lease": LEASE, "token": TOKEN[:16]}, "token"),
        (m.Scan, {name: value for name, value in SCAN.items() if name != "ranges"}, "`ranges`"),
        (m.Scan, {}, "required field `angle_min`"),
        (m.Scan, {**SCAN, "ranges": bytes(7)}, "ranges: a bin of float32"),
        *((m.Scan, {**SCAN, "ranges": ranges}, r"Expected `bytes`.*ranges") for ranges in ([1.0], None)),
        *((m.Map, {**MAP, "rows": rows, "columns": at}, "do not fill") for rows, at in ((3, 3), (-2, -3), (0, 3))),
        (m.Map, {**MAP, "rows": 0, "columns": 2**64 - 1, "cells": b""}, ""),
        *((m.Map, {**MAP, "cells": cells}, "") for cells in ("text", [0] * 6, None, bytes(5))),
        (m.Map, {**MAP, "origin": [0.0]}, "origin"),
    ],
)
def test_a_wrong_field_is_a_payload_error_that_names_it(kind, fields: dict[str, Any], named: str) -> None:
    with pytest.raises(PayloadError, match=f"{kind.__name__}: .*{named}"):
        decode(kind, msgpack.packb(fields))


NO_MAPS = [
    *(b"\xc1", b"\x81", b"\x80\x80", b"\x01", b"\x90", b"\xc0", b"\xa1a", b"\x81\x01\x02", b"\xdf\xff\xff\xff\xff"),
    *(b"hello", b"\x81\xa1x" + b"\x91" * 100_000 + b"\xc0"),
]


@pytest.mark.parametrize("payload", [*NO_MAPS, b"\x81\xa1\xff\x01", b"\x91" * 100_000], ids=lambda some: repr(some[:9]))
def test_what_is_no_map_or_nested_too_deeply_is_no_message(payload: bytes) -> None:
    with pytest.raises(PayloadError):
        unpack(payload)
    for kind in KINDS if payload in NO_MAPS else ():
        with pytest.raises(PayloadError, match=f"^{kind.__name__}: ."):
            decode(kind, payload)


def test_plain_maps_are_packed_and_unpacked_and_an_empty_payload_is_an_empty_one() -> None:
    assert unpack(b"") == {}
    assert unpack(pack({"zid": "1", "held": True})) == {"zid": "1", "held": True}


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from(sorted(KINDS, key=repr)), st.data())
def test_random_bytes_and_fields_give_a_message_or_a_payload_error(kind: type[m.FleetMessage], data) -> None:
    fields = data.draw(st.dictionaries(st.sampled_from(kind.__struct_fields__), JSON, max_size=4))
    for payload in (msgpack.packb(fields), data.draw(st.binary(max_size=40))):
        with contextlib.suppress(PayloadError):
            assert isinstance(decode(kind, payload), kind)


@pytest.mark.parametrize(
    ("message", "moving"),
    [
        *((m.Drive(light=True), False), (m.Drive(forward=-0.0), False), (m.Drive(forward=0.01), True)),
        *((m.Drive(left=-0.01), True), (m.Drive(turn=0.01), True)),
        *((m.Motor(0.0), False), (m.Motor(-0.1), True)),
    ],
)
def test_motion_is_told_from_neutral(message: m.Drive | m.Motor, moving: bool) -> None:
    assert message.moving is moving
