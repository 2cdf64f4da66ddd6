"""STATUSTEXT: chunks of 50 bytes, both ways."""

from __future__ import annotations

import pytest

from gateways.mavlink.messages.telemetry import Statustext
from gateways.mavlink.texts import MOST_CHUNKS, MOST_TEXTS, TextJoiner, chunks_of, clip

LONG = "PreArm: compass not calibrated, and the throttle of the receiver is not neutral at all"


def join(chunks: tuple[Statustext, ...]) -> list[str]:
    joiner = TextJoiner()
    return [joined.text for chunk in chunks for joined in joiner.take(chunk)]


@pytest.mark.parametrize("text", ["", "short", "x" * 50, LONG, "y" * 100, "z" * 149])
def test_a_text_comes_back_whole(text: str) -> None:
    chunks = chunks_of(text, 4, 7)
    assert join(chunks) == [text]
    assert all(len(chunk.text) == 50 for chunk in chunks[:-1])
    assert [chunk.text_id for chunk in chunks] == [0] if len(text) <= 50 else [7] * len(chunks)


def test_no_chunk_has_half_a_character() -> None:
    text = "x" * 49 + "ü" * 40
    chunks = chunks_of(text, 6, 1)
    assert [chunk.text.decode().rstrip("\0 ") for chunk in chunks] == ["x" * 49, "ü" * 25, "ü" * 15]
    assert clip("x" * 49 + "ü") == b"x" * 49


def test_a_text_without_end_is_cut() -> None:
    for size in (800, 5000):
        chunks = chunks_of("x" * size, 6, 1)
        assert [len(chunk.text) for chunk in chunks] == [50] * (MOST_CHUNKS - 1) + [49]
        assert join(chunks) == ["x" * 799]
    assert join(chunks_of("x" * 750, 6, 1)) == ["x" * 750]


def test_chunks_that_never_end_are_shown_all_the_same() -> None:
    chunks = tuple(Statustext(6, b"x" * 50, 1, number) for number in range(MOST_CHUNKS))
    assert join(chunks) == ["x" * 800]


def test_chunks_of_several_texts_may_come_in_any_order() -> None:
    joiner, one, other = TextJoiner(), chunks_of(LONG, 4, 1), chunks_of(LONG.upper(), 6, 2)
    assert joiner.take(other[1]) == joiner.take(one[0]) == ()
    assert joiner.take(one[1]) == ((4, LONG),)
    assert joiner.take(other[0]) == ((6, LONG.upper()),)


def test_a_text_that_lacks_a_chunk_gives_way_to_newer_ones() -> None:
    joiner = TextJoiner()
    joiner.take(chunks_of("a" * 120, 4, 1)[0])
    joiner.take(chunks_of("a" * 120, 4, 1)[2])
    given = [joiner.take(chunks_of(LONG, 4, number)[0]) for number in range(2, 2 + MOST_TEXTS)]
    assert given == [(), (), (), ((4, "a" * 50 + "..." + "a" * 20),)]
