"""The blocks of a segment, and what damage costs."""

from __future__ import annotations

import struct
import zlib

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tests.blackbox.scene import segment
from zbridge.blackbox.segments import (
    BLOCK_BYTES,
    Damage,
    Record,
    SegmentHead,
    head_block,
    read_head,
    read_segment,
    record_blocks,
)

HEAD = SegmentHead("fleet", "r1", "boot", 100, 5, 6, 7, {"versions": {"zbridge": "1"}})
RECORDS: list[Record] = [
    (1, "fleet/r1/pose", b"\x80", None),
    (2, "fleet/*/@cmd/stop", b"", b"attached"),
    (3, "fleet/r1/@wire/robot/in", b"ZB\xb1R" + bytes(40), None),
]
"""The last has what looks like the begin of a block."""
DATA = segment(*RECORDS, head=HEAD)
BLOCKS = [head_block(HEAD), *(block for record in RECORDS for _, block in record_blocks([record]))]


def records_of(data: bytes) -> list[Record]:
    return [record for content in read_segment(data) if isinstance(content, list) for record in content]


def damage_of(data: bytes) -> int:
    return sum(content.size for content in read_segment(data) if isinstance(content, Damage))


def block_at(position: int) -> int:
    """Return the number of the block that has this byte."""
    ends = [sum(map(len, BLOCKS[: number + 1])) for number in range(len(BLOCKS))]
    return next(number for number, end in enumerate(ends) if position < end)


def test_a_segment_is_read_as_it_was_written() -> None:
    assert list(read_segment(DATA)) == [HEAD, *([record] for record in RECORDS)]
    assert read_head(DATA) == HEAD
    assert list(read_segment(b"")) == []


def test_records_are_written_in_blocks_of_bounded_size_and_none_is_lost() -> None:
    records: list[Record] = [(number, "fleet/r1/scan", bytes(60_000), None) for number in range(23)]
    blocks = list(record_blocks(records))
    assert [count for count, _ in blocks] == [5, 5, 5, 5, 3]
    assert all(len(block) < BLOCK_BYTES + 62_000 for _, block in blocks)
    assert records_of(b"".join(block for _, block in blocks)) == records


def test_a_record_larger_than_a_block_has_one_of_its_own() -> None:
    large: Record = (1, "fleet/r1/map", bytes(3 * BLOCK_BYTES), None)
    ((count, block),) = record_blocks([large])
    assert (count, records_of(block)) == (1, [large])


def test_a_segment_that_was_cut_off_keeps_all_whole_blocks() -> None:
    for size in range(len(DATA)):
        whole = block_at(size)
        assert records_of(DATA[:size]) == RECORDS[: max(0, whole - 1)], size
        assert damage_of(DATA[:size]) == size - sum(map(len, BLOCKS[:whole])), size


@pytest.mark.parametrize("flipped", [0x01, 0x80, 0xFF])
def test_a_damaged_byte_costs_its_own_block_only(flipped: int) -> None:
    for position in range(len(DATA)):
        data = bytearray(DATA)
        data[position] ^= flipped
        hit = block_at(position)
        if data[position - 3 : position] == b"ZB\xb1" and hit:  # the kind of a block, which its content shows as well
            assert records_of(bytes(data)) in (RECORDS, without(hit)), position
            continue
        assert records_of(bytes(data)) == without(hit), position
        assert damage_of(bytes(data)) == len(BLOCKS[hit]), position
        assert (read_head(bytes(data)) is None) == (hit == 0), position


def without(hit: int) -> list[Record]:
    return [record for number, record in enumerate(RECORDS, 1) if number != hit]


def test_bytes_that_were_lost_or_came_between_cost_no_whole_block() -> None:
    whole = len(BLOCKS[0]) + len(BLOCKS[1])
    assert records_of(DATA[:whole] + b"ZB\xb1RZB" + DATA[whole:]) == RECORDS
    for position in range(whole, whole + len(BLOCKS[2])):
        data = DATA[:position] + DATA[position + 1 :]
        assert records_of(data) == [RECORDS[0], RECORDS[2]], position


def test_several_segments_one_after_the_other_are_read() -> None:
    assert records_of(DATA[:-1] + DATA) == [*RECORDS[:-1], *RECORDS]


@given(st.binary(max_size=300), st.sampled_from([b"", b"ZB\xb1H", b"ZB\xb1R", b"ZB\xb1R\x04\x00\x00\x00"]))
@example(b"\xff" * 50, b"ZB\xb1R")
def test_random_bytes_are_damage_and_never_an_error(data: bytes, begin: bytes) -> None:
    assert damage_of(begin + data) == len(begin + data)
    assert read_head(begin + data) is None
    assert records_of(begin + data + DATA) == RECORDS


@pytest.mark.parametrize("body", [b"", b"\x00", b"\x91" * 5000, b"\x91\x94\x01\xa2\xff\xfe\xc4\x00\xc0", b"\x91\x02"])
@pytest.mark.parametrize("kind", [b"H", b"R", b"?"])
def test_a_block_with_a_right_checksum_and_wrong_content_is_damage(kind: bytes, body: bytes) -> None:
    block = struct.pack("<3scII", b"ZB\xb1", kind, len(body), zlib.crc32(body)) + body
    assert next(read_segment(block + DATA)) == Damage(0, len(block))
    assert records_of(block + DATA) == RECORDS
