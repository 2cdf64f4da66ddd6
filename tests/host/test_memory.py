"""The memory that a gateway process shares with its supervisor, wherever the process dies."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from zbridge.host.memory import DEPOSIT_BYTES, PARTIAL_BYTES, SLOTS, MemoryReader, MemoryWriter
from zbridge.wire.frames import Partial


@pytest.fixture
def sides() -> Iterator[tuple[MemoryWriter, MemoryReader]]:
    writer = MemoryWriter()
    reader = MemoryReader(os.dup(writer.descriptor))
    writer.close_descriptor()
    yield writer, reader
    writer.close()
    reader.close()


def test_a_stream_of_which_nothing_was_read_begins_with_a_frame(sides: tuple[MemoryWriter, MemoryReader]) -> None:
    writer, reader = sides
    writer.begin(3)
    assert not reader.is_touched(3)
    assert reader.partial(3) == Partial()


@pytest.mark.parametrize("partial", [Partial(), Partial(b"1|10|"), Partial(bytes(PARTIAL_BYTES)), Partial(skip=2**22)])
def test_an_incomplete_frame_is_known_between_two_reads_and_not_within_one(
    sides: tuple[MemoryWriter, MemoryReader], partial: Partial
) -> None:
    writer, reader = sides
    writer.reading(3)
    assert reader.is_touched(3)
    assert reader.partial(3) is None
    writer.cut(3, partial)
    assert reader.partial(3) == partial
    writer.reading(3)
    assert reader.partial(3) is None, "bytes were taken from the kernel that nobody knows"


def test_what_nobody_could_resume_is_not_resumed(sides: tuple[MemoryWriter, MemoryReader]) -> None:
    writer, reader = sides
    for partial in (None, Partial(bytes(PARTIAL_BYTES + 1))):
        writer.cut(3, partial)
        assert reader.partial(3) is None


def test_links_have_slots_of_their_own_and_a_new_link_finds_its_slot_untouched(
    sides: tuple[MemoryWriter, MemoryReader],
) -> None:
    writer, reader = sides
    for link in range(SLOTS):
        writer.cut(link, Partial(bytes([link]) * PARTIAL_BYTES))
    assert [reader.partial(link) for link in range(SLOTS)] == [
        Partial(bytes([link]) * PARTIAL_BYTES) for link in range(SLOTS)
    ]
    writer.begin(SLOTS + 1)
    assert not reader.is_touched(SLOTS + 1)


def test_a_deposit_counts_when_it_was_told_and_the_one_before_it_stays_until_then(
    sides: tuple[MemoryWriter, MemoryReader],
) -> None:
    writer, reader = sides
    first = writer.deposit(b"first")
    writer.commit(first)
    second = writer.deposit(DEPOSIT_BYTES * b"2")
    assert reader.deposit(first, 5) == b"first", "the process may die before it tells the second one"
    assert writer.deposit(b"third") == second, "the second one was never told"
    assert reader.deposit(first, 5) == b"first"
    writer.commit(second)
    assert writer.deposit(b"fourth") == first
    assert reader.deposit(second, 5) == b"third"


@pytest.mark.parametrize(("area", "size"), [(-1, 0), (2, 5), (0, -1), (0, DEPOSIT_BYTES + 1)])
def test_a_deposit_that_cannot_be_there_is_empty(
    sides: tuple[MemoryWriter, MemoryReader], area: int, size: int
) -> None:
    assert sides[1].deposit(area, size) == b""


def test_memory_of_another_version_is_refused() -> None:
    descriptor = os.memfd_create("page")
    os.ftruncate(descriptor, 256)
    with pytest.raises(ValueError, match="another version"):
        MemoryReader(descriptor)
    os.close(descriptor)
