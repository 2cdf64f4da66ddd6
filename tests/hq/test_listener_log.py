"""What a listener logs of its connections."""

from __future__ import annotations

import logging

import pytest

from zbridge.hq.listener_log import OTHERS, ConnectionLog


def flushed(folding: ConnectionLog, caplog: pytest.LogCaptureFixture, now: float) -> list[str]:
    caplog.clear()
    with caplog.at_level(logging.INFO, "zbridge.hq"):
        folding.flush(now)
    return [record.getMessage() for record in caplog.records]


def test_the_first_of_a_kind_is_told_at_once_and_the_others_after_a_second(caplog: pytest.LogCaptureFixture) -> None:
    folding = ConnectionLog("toy")
    told = [(number, kind) for number in range(400) for kind in ("came", "went") if folding.first("a", kind, 5.0)]
    assert told == [(0, "came"), (0, "went")]
    assert flushed(folding, caplog, 5.9) == []
    assert flushed(folding, caplog, 6.0) == ["toy: a: 399 more came, 399 more went"]
    assert folding.first("a", "came", 7.0)
    assert flushed(folding, caplog, 8.0) == [], "what came once is not told again"


@pytest.mark.parametrize("addresses", [1, 64])
def test_many_addresses_share_a_line(addresses: int, caplog: pytest.LogCaptureFixture) -> None:
    folding = ConnectionLog("toy", addresses)
    assert sum(folding.first(f"a{number}", "came", 0.0) for number in range(1000)) == addresses + 1
    assert flushed(folding, caplog, 1.0) == [f"toy: {OTHERS}: {1000 - addresses - 1} more came"]
