"""Amounts that people write."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from zbridge.errors import ConfigError
from zbridge.views.recording.selection import read_moment, read_split

SPLITS = {
    "1GB": (10**9, None),
    "1.5 MiB": (1_572_864, None),
    "10min": (None, 600.0),
    "90s": (None, 90.0),
    "1h": (None, 3600.0),
}
MOMENTS = {"12.5": 12.5, "90s": 90.0, "1:30": 90.0, "1:02:03.5": 3723.5, "2min": 120.0}


@pytest.mark.parametrize("text", SPLITS)
def test_a_split_is_a_size_or_a_time(text: str) -> None:
    assert read_split(text) == SPLITS[text]


@pytest.mark.parametrize("text", ["", "1", "1 parsec", "10kB", "0.5s", "-1GB", "1e9B"])
def test_a_split_that_is_neither_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"split = .*1GB, 10min"):
        read_split(text)


@pytest.mark.parametrize("text", MOMENTS)
def test_a_moment_counts_from_the_begin(text: str) -> None:
    assert read_moment("from", text, 10**18) == 10**18 + int(MOMENTS[text] * 1e9)


def test_a_moment_may_be_a_time_of_day() -> None:
    expected = datetime(2026, 11, 22, 4, 0, tzinfo=UTC).timestamp() * 1e9
    assert read_moment("from", "2026-11-22T05:00:00+01:00", 0) == expected


@pytest.mark.parametrize("text", ["yesterday", "1:2:3:4", "2026-13-01T00:00:00", "T"])
def test_a_moment_that_is_none_is_refused_with_the_option(text: str) -> None:
    with pytest.raises(ConfigError, match=r"to = .*: expected 12\.5, 1:30 or 2026"):
        read_moment("to", text, 0)
