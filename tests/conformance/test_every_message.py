"""Every message of every protocol: golden bytes both ways, in any cut, joined, truncated, prolonged, random."""

import contextlib
import warnings
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.conformance.side import Side, plain
from tests.gateways.alf import golden as alf
from tests.gateways.tcpudp import golden as tcpudp
from tests.gateways.wc2ec import golden as wc2ec
from zbridge.errors import EncodeError, ProtocolError

SIDES: list[Side] = [*alf.SIDES, *tcpudp.SIDES, *wc2ec.SIDES]
MESSAGES = [
    pytest.param(side, message, frame, id=f"{side}-{type(message).__name__}-{number}")
    for side in SIDES
    for number, (message, frame) in enumerate(side.golden)
]

each_side = pytest.mark.parametrize("side", SIDES, ids=repr)
each_message = pytest.mark.parametrize(("side", "message", "frame"), MESSAGES)


@each_side
def test_the_golden_table_has_every_message_that_is_declared(side: Side) -> None:
    assert {type(message) for message, _ in side.golden} >= side.declared


@each_message
def test_a_message_and_its_bytes_are_made_from_each_other(side: Side, message: Any, frame: bytes) -> None:
    assert bytes(side.write(message)) == frame
    assert plain(side.read(frame)) == plain(message)
    assert list(map(plain, side.receiver()(frame))) == side.delivered(message)


@each_message
def test_a_truncated_message_is_none_and_is_completed_by_its_rest(side: Side, message: Any, frame: bytes) -> None:
    for size in range(1, len(frame)):
        receive = side.receiver()
        assert receive(frame[:size]) == []
        assert list(map(plain, receive(frame[size:]))) == side.delivered(message)
        if not side.bends(message, frame[:size]):
            with pytest.raises(ProtocolError):
                side.read(frame[:size])


@each_message
def test_a_message_with_a_byte_too_many_is_a_protocol_error(side: Side, message: Any, frame: bytes) -> None:
    for extra in (b"\x00", b"\x01", b"\xff\x00"):
        if not side.bends(message, frame + extra):
            with pytest.raises(ProtocolError):
                side.read(frame + extra)


@each_side
def test_messages_may_come_byte_by_byte_each_with_its_last_byte_and_hundreds_in_one_read(side: Side) -> None:
    receive, messages = side.receiver(), [plain(message) for message, _ in side.stream]
    for (_, frame), message in zip(side.stream, messages, strict=True):
        *before, last = (receive(frame[at : at + 1]) for at in range(len(frame)))
        assert not any(before)
        assert list(map(plain, last)) == [message]
    joined = b"".join(frame for _, frame in side.stream)
    assert list(map(plain, side.receiver()(joined * 200))) == messages * 200


def received(side: Side, reads: list[bytes]) -> tuple[list[str], bool]:
    """What a receiver makes of reads, NaN equal to NaN; and whether the stream broke."""
    receive, messages = side.receiver(), []
    broke = False
    try:
        for read in reads:
            messages += receive(read)
    except ProtocolError:
        broke = True
    return [repr(plain(message)) for message in messages], broke


@each_side
@given(data=st.data())
def test_the_cut_of_a_random_stream_changes_none_of_its_messages(side: Side, data: st.DataObject) -> None:
    frames = st.sampled_from([frame for _, frame in side.stream])
    pieces = st.one_of(frames, frames.map(lambda frame: frame[: len(frame) // 2]), st.binary(max_size=30))
    stream = b"".join(data.draw(st.lists(pieces, max_size=8)))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    # a receiver gives the messages of one read together: one broken read gives none of them
    single, broke = received(side, [stream[at : at + 1] for at in range(len(stream))])
    parts, broke_too = received(side, [stream[start:end] for start, end in pairwise([0, *cuts, len(stream)])])
    assert broke == broke_too
    assert parts == single or (broke and parts == single[: len(parts)])


@each_side
@given(data=st.data())
def test_random_bytes_give_a_message_that_survives_the_wire_or_a_protocol_error(side, data) -> None:
    frame = data.draw(st.sampled_from([frame for _, frame in side.golden]))
    kept = data.draw(st.integers(0, len(frame)))
    bent = frame[:kept] + data.draw(st.binary(min_size=len(frame) - kept, max_size=len(frame) - kept))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for random in filter(None, (bent, data.draw(st.binary(max_size=60)))):
            try:
                message = side.read(random)
            except ProtocolError:
                continue
            with contextlib.suppress(EncodeError):
                written = bytes(side.write(message))
                assert repr(plain(side.read(written))) == repr(plain(message))
