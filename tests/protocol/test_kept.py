"""What survives a restart: sessions of every protocol in the middle of their work, as MessagePack there and back."""

from __future__ import annotations

import struct
from typing import Any

import msgspec
import pytest

from zbridge.errors import ProtocolError
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive
from zbridge.fleet.view import RobotView
from zbridge.metrics import Metrics
from zbridge.protocol.kept import Budget, Kept, Spare
from zbridge.protocol.outbox import Outbox
from zbridge.protocol.plugin import Protocol, find_protocol
from zbridge.protocol.session import PARTIAL, SKIPPED, Limits, Session
from zbridge.protocol.traffic import Datagram

SETTINGS = bytes.fromhex("210000000102020b000000312e312c312e322c312e3300010101010101e803000064000000")
"""serverSettings of a robot of 1.3 without UDP, from the protocol page."""
POSITION = bytes.fromhex("0e0000000137") + bytes(12)
HEARTBEAT = bytes.fromhex("fd0900000001010000000f0000000a03c10403ac7c")
"""Of an armed rover in GUIDED, from the protocol page."""
STREAMS = {
    "tcpudp": SETTINGS + POSITION + POSITION,
    "alf": b"2|-95|95|0.25|100|20|5600;4|0|1|2|3|4|5|6|7;4|0|1|2|3|4|5|6|7;",
    "wc2ec": b"".join(bytes([0, 53, number, 5]) + b"motor" for number in (8, 9)),
    "mavlink": HEARTBEAT + HEARTBEAT + HEARTBEAT,
}
HQ_OPTIONS = {"mavlink": {"system_id": 1}}


def carried(state: Any) -> Any:
    """Carry a state as it is carried between two processes."""
    return msgspec.msgpack.decode(msgspec.msgpack.encode(state))


def robot(protocol: Protocol) -> tuple[Any, Session[Any]]:
    made = protocol.robot(msgspec.convert({}, protocol.options), 1, Metrics())
    return made, made.session(made.link_names[0], "tcp://robot.test:1")


@pytest.mark.parametrize("name", STREAMS)
def test_a_robots_session_goes_on_in_another_process_wherever_its_stream_is_cut(name: str) -> None:
    stream, protocol = STREAMS[name], find_protocol(name)
    _, whole = robot(protocol)
    whole.open(1.0)
    expected = whole.receive(stream, 2.0)
    for cut in range(len(stream) + 1):
        before_robot, before = robot(protocol)
        before.open(1.0)
        heard = before.receive(stream[:cut], 2.0)
        after_robot, after = robot(protocol)
        after.restore(carried(before.export()))
        after_robot.restore(carried(before_robot.export()))
        assert after.export() == before.export()
        assert len(heard + after.receive(stream[cut:], 2.0)) == len(expected)
        assert (after.state, after.version, after.features) == (whole.state, whole.version, whole.features)
        assert after.traffic == whole.traffic
    assert after_robot.hands_over


def test_what_a_robot_was_to_be_sent_is_sent_by_the_other_process_at_its_time_and_once() -> None:
    protocol = find_protocol("tcpudp")
    told, before = robot(protocol)
    before.open(1.0)
    before.receive(SETTINGS, 1.0)
    while before.outgoing(1.0):
        pass
    told.command(topics.CMD_DRIVE, Drive(forward=0.5), 2.0)
    told.stop(2.0, 3.0)
    other, after = robot(protocol)
    after.restore(carried(before.export()))
    other.restore(carried(told.export()))
    times = [2.0 + tick / 100 for tick in range(150)]
    sent = [(now, frame) for now in times if (frame := after.outgoing(now))]
    expected = [(now, frame) for now in times if (frame := before.outgoing(now))]
    assert sent == expected
    assert {frame[5] for _, frame in sent} == {13}, "the stop replaces the drive"


def test_a_frame_keeps_its_kind() -> None:
    before, after = Outbox(0.0), Outbox(0.0)
    before.put(Datagram(b"by udp"))
    before.put(b"by tcp")
    after.restore(carried(before.export()))
    assert [(type(frame), frame) for frame in (after.take(0.0), after.take(0.0))] == [
        (Datagram, b"by udp"),
        (bytes, b"by tcp"),
    ]


@pytest.mark.parametrize("name", STREAMS)
def test_a_listeners_client_goes_on_in_another_process(name: str) -> None:
    protocol = find_protocol(name)
    assert protocol.hq is not None
    sides = [protocol.hq(protocol.hq_options(**HQ_OPTIONS.get(name, {})), RobotView(), Metrics()) for _ in range(2)]
    before, after = (side.session(3, Limits(65_536, 5.0)) for side in sides)
    before.open(1.0)
    sides[1].restore(carried(sides[0].export()))
    after.restore(carried(before.export()))
    assert after.export() == before.export()
    assert sides[0].hands_over


class _Thing(Kept):
    kept = {"number": int, "step": str}  # noqa: RUF012 - as short as a protocol's

    def __init__(self) -> None:
        self.number, self.step = 1, "first"


@pytest.mark.parametrize(
    ("state", "said"),
    [({"number": 1}, "_Thing.step"), ({"number": "1", "step": ""}, "_Thing.number"), ({}, "_Thing.number")],
)
def test_a_state_of_another_form_is_refused_by_name(state: dict[str, Any], said: str) -> None:
    with pytest.raises(ProtocolError, match=said):
        _Thing().restore(state)


def test_a_step_or_a_kind_of_frame_that_this_version_lacks_is_refused() -> None:
    _, session = robot(find_protocol("tcpudp"))
    state = session.export()
    with pytest.raises(ProtocolError, match="no step 'LATER'"):
        session.restore({**state, "_handshake": {"deadline": 1.0, "step": "LATER"}})
    outbox = {**state["outbox"], "_queue": [["a.later.Kind", b""]]}
    with pytest.raises(ProtocolError, match=r"unknown kind 'a\.later\.Kind'"):
        session.restore({**state, "outbox": outbox})


# A deposit, for the case that the process dies


class _Thrifty(Kept):
    kept = {"name": str, "large": Spare(bytes | None), "rows": Spare(list[int]), "inner": _Thing}  # noqa: RUF012

    def __init__(self) -> None:
        self.name, self.large, self.rows, self.inner = "new", b"", [0], _Thing()


def test_a_deposit_lacks_what_is_spare_and_large_and_the_rest_is_restored() -> None:
    before, after, budget = _Thrifty(), _Thrifty(), Budget(100)
    before.name, before.large, before.rows, before.inner.number = 200 * "n", bytes(101), [7], 5
    after.restore(carried(before.export(budget)))
    assert (after.name, after.large, after.rows, after.inner.number) == (200 * "n", b"", [7], 5)
    assert budget.left_out == {"_Thrifty.large": 101}
    whole = _Thrifty()
    whole.restore(carried(before.export()))
    assert whole.large == bytes(101)


@pytest.mark.parametrize("name", STREAMS)
def test_a_robots_session_goes_on_from_a_deposit_wherever_its_stream_is_cut(name: str) -> None:
    stream, protocol = STREAMS[name], find_protocol(name)
    _, whole = robot(protocol)
    whole.open(1.0)
    expected = whole.receive(stream, 2.0)
    for cut in range(len(stream) + 1):
        _, before = robot(protocol)
        before.open(1.0)
        heard = before.receive(stream[:cut], 2.0)
        _, after = robot(protocol)
        after.restore(carried({**before.export(Budget(1000)), PARTIAL: before.partial(1000)}))
        assert len(heard + after.receive(stream[cut:], 2.0)) == len(expected)


def test_a_1_4_robot_leaves_its_map_of_4_mb_out_of_a_deposit_and_the_next_part_begins_it_anew() -> None:
    body = bytes([2]) + struct.pack("<i", 7) + b"1.3,1.4" + bytes(7) + struct.pack("<ii", 20480, 10)
    settings = struct.pack("<iBB", 2 + len(body), 1, 2) + body
    part = struct.pack("<iBBii", 2 + 8 + 1024, 1, 56, 0, 1024) + bytes(1023) + b"\2"
    made, session = robot(find_protocol("tcpudp"))
    session.open(1.0)
    session.receive(settings, 1.0)
    assert session.settings is not None
    for message in session.receive(part, 2.0):
        made.translator(type(message))(message, 1)
    assert made.known(topics.MAP) is not None
    budget = Budget(64 * 1024)
    state = carried(made.export(budget))
    assert budget.left_out == {"TelemetryTranslator._parts": 2048 * 2048}
    heir, other = robot(find_protocol("tcpudp"))
    other.restore(carried(session.export(budget)))
    heir.restore(state)
    assert heir.known(topics.MAP) is None
    for message in other.receive(part, 3.0):
        heir.translator(type(message))(message, 1)
    assert heir.known(topics.MAP).cells[0:1024, 0].tolist() == [0] * 1023 + [2]


def test_a_frame_of_4_mb_that_was_cut_off_is_counted_where_its_rest_is_skipped() -> None:
    _, before = robot(find_protocol("tcpudp"))
    before.open(1.0)
    before.receive(SETTINGS, 1.0)
    cells = 2048 * 2048
    grid = struct.pack("<iBBi", 2 + 4 + cells, 1, 53, cells) + bytes(cells)
    assert before.receive(grid[:3_000_000], 2.0) == []
    state = {**before.export(Budget(1000)), PARTIAL: before.partial(32_768)}
    assert len(msgspec.msgpack.encode(state)) < 3000
    _, after = robot(find_protocol("tcpudp"))
    after.restore(carried(state))
    assert after.snapshot().left_out == {SKIPPED: 1}
    assert len(after.receive(grid[3_000_000:] + POSITION, 3.0)) == 1


def test_a_robot_of_255_devices_fits_a_deposit_whatever_bytes_are_in_their_names() -> None:
    made, session = robot(find_protocol("wc2ec"))
    session.open(1.0)
    for number in range(255):
        name = b"sensor \xff %03d" % number + 243 * b"x"
        for message in session.receive(bytes([0, 37, number, len(name)]) + name, 1.0):
            made.translator(type(message))(message, 1)
    state = carried(made.export(Budget(64 * 1024)))
    assert len(msgspec.msgpack.encode(state)) < 256 * 1024
    heir, _ = robot(find_protocol("wc2ec"))
    heir.restore(state)
    assert heir.export() == made.export()
    assert len(state["_table"]["_by_number"]) == 255
