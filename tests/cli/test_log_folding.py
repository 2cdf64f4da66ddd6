"""Repeated warnings: the first at once, then a count, also at the end and without any further record."""

from __future__ import annotations

import copy
import io
import json
import logging
import re
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from zbridge.cli.log_folding import FOLD_S, KEYS, LogHandler, WarningFolds
from zbridge.cli.log_lines import JsonFormatter, LineFormatter
from zbridge.log import Log, current_robot

NAME = "test.folding"
log = Log(NAME)


class Unreadable:
    def __str__(self) -> str:
        raise ValueError("torn")


class Written:
    """A handler with a clock that stands still, and what it wrote."""

    def __init__(self) -> None:
        self.now = 100.0
        self.stream = io.StringIO()
        self.handler = LogHandler(self.stream, lambda: self.now)

    def take(self) -> list[str]:
        text = self.stream.getvalue()
        self.stream.seek(0)
        self.stream.truncate()
        return text.splitlines()


@pytest.fixture
def written() -> Iterator[Written]:
    made = Written()
    logger = logging.getLogger(NAME)
    logger.addHandler(made.handler)
    logger.propagate = False
    yield made
    logger.removeHandler(made.handler)
    made.handler.close()


def test_a_repeated_warning_is_written_once_and_then_with_its_count(written: Written) -> None:
    written.handler.setFormatter(logging.Formatter("%(message)s %(repeated)s", defaults={"repeated": ""}))
    for number in range(13):
        log.warning("slow", "slow {number}", number=number)
    assert written.take() == ["slow 0 "]
    written.now += FOLD_S
    log.warning("other", "other")
    assert written.take() == ["slow 12 12", "other "]
    log.warning("slow", "slow {number}", number=13)
    assert written.take() == [], "a flood has a line in each time"
    written.now += FOLD_S
    log.info("tick", "information folds nothing")
    log.warning("other", "other")
    assert written.take() == ["slow 13 1", "other "]
    written.now += 2 * FOLD_S
    log.warning("slow", "slow {number}", number=14)
    assert written.take() == ["slow 14 "], "a time without a count ends the folding"


def test_information_and_what_is_below_is_never_folded(written: Written, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, NAME)
    for _ in range(3):
        log.info("event", "information")
        log.debug("event", "detail")
    assert len(written.take()) == 6


def test_robots_sessions_peers_files_and_levels_are_told_apart_and_ports_are_not(written: Written) -> None:
    for host in ("10.0.0.7", "10.0.0.8"):
        for port in range(1000, 1010):
            log.warning("refused", "{peer} refused", peer=f"{host}:{port}")
    for robot in ("r1", "r2"):
        for _ in range(2):
            log.error("failed", "{robot} failed", robot=robot)
            log.warning("failed", "{robot} failed", robot=robot)
            log.error("faulty", "{file} is faulty", file=f"{robot}.toml")
            log.error("died", "{session}", session=robot)
            log.error("refused", "{reason}", reason=robot)
    token = current_robot.set("r3")
    log.error("failed", "in another robot's code")
    current_robot.reset(token)
    assert len(written.take()) == 2 + 2 * 5 + 1


def test_plain_records_fold_by_their_templates(written: Written) -> None:
    plain = logging.getLogger(NAME)
    for number in range(5):
        plain.warning("slow: %d", number)
        plain.warning("%s", f"text {number % 2}")
    assert written.take() == ["slow: 0", "text 0", "text 1"]


def test_different_exceptions_of_one_event_are_all_written(written: Written) -> None:
    for error in (KeyError("a"), KeyError("b"), ValueError("a"), KeyError("a")):
        try:
            raise error
        except (KeyError, ValueError):
            log.exception("failed", "a handler failed")
    lines = written.take()
    assert [line for line in lines if line.startswith(("KeyError", "ValueError"))] == [
        "KeyError: 'a'",
        "KeyError: 'b'",
        "ValueError: a",
    ]


def test_a_crowd_of_one_kind_hides_no_other_event(written: Written) -> None:
    for number in range(KEYS + 100):
        log.warning("refused", "{peer} refused", peer=f"host{number}:1")
    written.take()
    log.error("not_written", "the disk is full")
    log.warning("stalled", "{robot} is stalled", robot="r1")
    assert written.take() == ["the disk is full", "r1 is stalled"]


def test_kinds_without_end_share_one_count(written: Written) -> None:
    for number in range(KEYS + 500):
        log.warning("refused", "{peer} refused", peer=f"host{number}:1")
    assert len(written.take()) == KEYS + 1
    written.now += FOLD_S
    log.warning("slow", "slow")
    assert written.take() == [f"host{KEYS + 499}:1 refused", "slow"]


def test_a_traceback_is_written_whole_once(written: Written) -> None:
    for _ in range(3):
        log.error("failed", "it failed", exc_info=ValueError("torn"))
    assert written.take() == ["it failed", "ValueError: torn"]
    written.now += FOLD_S
    log.warning("slow", "slow")
    assert written.take() == ["it failed", "slow"]


def test_what_is_counted_is_written_at_the_end(written: Written) -> None:
    log.warning("slow", "slow")
    log.warning("slow", "slow")
    written.take()
    written.handler.close()
    assert written.take() == ["slow"]
    log.warning("slow", "slow")
    log.warning("slow", "slow")
    assert written.take() == ["slow", "slow"], "whatever follows is written"


def test_counts_are_written_without_a_further_record(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zbridge.cli.log_folding.FOLD_S", 0.05)
    stream = io.StringIO()
    handler, record = LogHandler(stream), log.record(logging.WARNING, "slow", "slow")
    handler.setFormatter(JsonFormatter())
    for _ in range(4):
        handler.handle(record)
    over = time.monotonic() + 5
    while stream.getvalue().count("\n") < 2 and time.monotonic() < over:
        time.sleep(0.01)
    assert [json.loads(line).get("repeated") for line in stream.getvalue().splitlines()] == [None, 3]
    while any(thread.name == "zbridge-log" for thread in threading.enumerate()) and time.monotonic() < over:
        time.sleep(0.01)
    assert not any(thread.name == "zbridge-log" for thread in threading.enumerate()), "it runs only while it counts"


def test_a_quiet_process_has_no_thread(written: Written) -> None:
    before = threading.active_count()
    log.warning("slow", "slow")
    assert threading.active_count() == before
    log.warning("slow", "slow")
    assert threading.active_count() == before + 1


def test_a_record_that_cannot_be_read_is_told_of(written: Written) -> None:
    for level in (logging.INFO, logging.WARNING, logging.WARNING):
        written.handler.handle(log.record(level, "torn", "{what}", what=Unreadable()))
    lines = written.take()
    assert len(lines) == 3
    assert all(line.startswith(f"a record of {NAME} cannot be written: ValueError: torn") for line in lines)


def test_both_forms_write_and_count_the_same_events() -> None:
    now = 0.0
    streams, forms = (io.StringIO(), io.StringIO()), (LineFormatter("r1: "), JsonFormatter())
    handlers = [LogHandler(stream, lambda: now) for stream in streams]
    for handler, form in zip(handlers, forms, strict=True):
        handler.setFormatter(form)
        handler.robot = "r1"
    for number in range(30):
        now += 1.0
        record = log.record(logging.WARNING, "slow", "slow \x1b {number}", number=number, peer=f"10.0.0.7:{number}")
        plain = logging.LogRecord("asyncio", logging.ERROR, "", 0, "Executing took %.3f s", (number,), None)
        for handler in handlers:
            handler.handle(copy.copy(record))
            handler.handle(copy.copy(plain))
            handler.handle(log.record(logging.INFO, "tick", "tick"))
    for handler in handlers:
        handler.close()
    people = [re.sub(r"in \d+ s\)$", "in N s)", line[24:]) for line in streams[0].getvalue().splitlines()]
    programs = [json.loads(line) for line in streams[1].getvalue().splitlines()]
    assert people == [as_people_read(line) for line in programs]
    assert 30 < len(people) < 45
    assert sum(line.get("repeated", 0) + ("repeated" not in line) for line in programs) == 90


def as_people_read(line: dict[str, Any]) -> str:
    count = line.get("repeated", 0)
    repeated = f" ({count} times more in N s)" if count else ""
    return f"{line['level'].upper():<7} r1: {line['logger']}: {line['message']}{repeated}"


def test_a_stream_that_takes_nothing_is_no_fault() -> None:
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    handler = LogHandler(Full())
    handler.handle(log.record(logging.ERROR, "event", "text"))
    handler.close()


def test_the_deadline_is_that_of_the_oldest_count() -> None:
    folds, first, second = WarningFolds(), *(log.record(logging.WARNING, event, "x") for event in ("a", "b"))
    assert folds.admit(first, 1.0)
    assert folds.deadline is None
    assert folds.admit(second, 2.0)
    assert not folds.admit(second, 3.0)
    assert not folds.admit(first, 4.0)
    assert folds.deadline == 1.0 + FOLD_S
    assert [each.__dict__["repeated_s"] for each in folds.due(11.0)] == [10.0]
    assert folds.deadline == 2.0 + FOLD_S
