"""What others wrote, made safe to show: expected texts written by hand."""

import json
import unicodedata
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.fleet.printable import as_json, shown

AS_IT_IS = ("", "plain text", "Jürgen 走れ café", "[/x] [bold]b[/bold] :warning: {0} %s")
WRITTEN: list[tuple[object, str]] = [
    *((text, text) for text in AS_IT_IS),
    ("\x1b[31m\x1b]0;title\x07", "\\x1b[31m\\x1b]0;title\\x07"),
    ("\x9b31m\x9d0;title\x9c", "\\x9b31m\\x9d0;title\\x9c"),
    ("one\ntwo\r\nthree\tfour\x0b\x0c", "one\\ntwo\\r\\nthree\\tfour\\x0b\\x0c"),
    ("\x00\x08\x7f\x80", "\\x00\\x08\\x7f\\x80"),
    ("\u202egnp.exe\u2066\u2069", "\\u202egnp.exe\\u2066\\u2069"),
    ("a\u200bb\ufeffc\u2028d\u2029e\u00a0f", "a\\u200bb\\ufeffc\\u2028d\\u2029e\\xa0f"),
    ("\U000e0041\U0010ffff\udc80", "\\U000e0041\\U0010ffff\\udc80"),
    *((None, "None"), (1.5, "1.5"), (ValueError("\x1b"), "\\x1b")),
]


@pytest.mark.parametrize(("text", "expected"), WRITTEN, ids=[ascii(text) for text, _ in WRITTEN])
def test_what_does_not_print_is_escaped_and_all_else_left_alone(text: object, expected: str) -> None:
    assert shown(text) == expected


def test_what_is_too_long_is_cut_and_says_so() -> None:
    assert shown("x" * 20, 20) == "x" * 20
    assert shown("x" * 21, 20) == "x" * 17 + "..."
    assert shown("\u202e" * 10**6, 20) == ("\\u202e" * 3)[:17] + "..."
    assert len(shown("x" * 10**7)) <= 2000


@given(st.text(), st.integers(3, 100))
def test_nothing_but_printable_characters_comes_out_and_never_too_many(text: str, most: int) -> None:
    safe = shown(text, most)
    assert len(safe) <= most
    assert not any(unicodedata.category(character) in ("Cc", "Cf", "Cs", "Zl", "Zp") for character in safe)
    safe.encode()


@given(st.recursive(st.text() | st.integers() | st.booleans() | st.none(), st.lists, max_leaves=10))
def test_json_is_plain_ascii_that_means_the_same(value: Any) -> None:
    line = as_json({"\x7f\x1b": value})
    assert line.isascii()
    assert line.isprintable()
    assert json.loads(line) == {"\x7f\x1b": value}
