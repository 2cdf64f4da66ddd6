"""The audit log: what a line says, what is counted instead of repeated, and what becomes of it on the disk."""

import errno
import json
import logging
import os
import queue
import threading
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.control.audit_log import COUNTS, COUNTS_HZ, KINDS, MOST, WAITING, Audit, AuditFile
from zbridge.control.events import AuthorityEvent, EventKind
from zbridge.errors import ConfigError
from zbridge.metrics import Metrics

EPOCH_NS = 1_767_225_600_000_000_000
"""The first second of 2026, UTC."""
JOIN_S = 30.0
"""Longest time a thread of a test may take; no test waits that long."""


class Log(list[str]):
    """An audit log whose lines and whose clock are the test's."""

    def __init__(self) -> None:
        super().__init__()
        self.now_ns = EPOCH_NS
        self.audit = Audit("r1", self.append, lambda: self.now_ns)

    def write(self, events: Iterable[AuthorityEvent]) -> None:
        for event in events:
            self.audit.write(event)

    def lines(self) -> list[dict[str, Any]]:
        """Give what was written since the last call."""
        taken, self[:] = list(self), []
        return [json.loads(line) for line in taken]


@pytest.fixture
def log() -> Log:
    return Log()


def refused(who: str | None = "ann", command: str = "drive", reason: str = "offline") -> AuthorityEvent:
    return AuthorityEvent(EventKind.REFUSED, who, reason, command=command)


LINES: dict[str, dict[str, Any]] = {
    "A": {"event": "acquired", "who": "ann", "priority": 0},
    "T": {"event": "taken over", "who": "bob", "priority": -3},
    "E": {"event": "ended", "who": "ann", "reason": "taken over by bob", "stops": True},
    "R": {"event": "released", "who": "ann", "reason": "released"},
    "D": {"event": "stopped", "who": "ann", "reason": "deadman", "stops": True},
    "S": {"event": "stopped", "reason": "stop", "stops": True},
    "r": {"event": "refused", "who": "ann", "command": "drive", "reason": "offline"},
    "b": {"event": "refused", "who": "bob", "command": "drive", "reason": "offline"},
    "n": {"event": "refused", "command": "drive", "reason": "offline"},
    "c": {"event": "refused", "who": "ann", "command": "raw", "reason": "offline"},
    "w": {"event": "refused", "who": "ann", "command": "drive", "reason": "busy"},
}
"""What the line of an event says, by a letter."""


def event(letter: str) -> AuthorityEvent:
    fields = dict(LINES[letter])
    return AuthorityEvent(EventKind(fields.pop("event")), **fields)


COURSES = {
    "every event has a line": ("ATERDSrbncw", "A T E R D S r b n c w"),
    "the first is a line, the others one a second with their count": ("rrrr|", "r | r3"),
    "and so on while they come": ("rrr|rrr|rrr|", "r | r2 | r3 | r3"),
    "one repetition is a line like the first": ("rr|", "r | r"),
    "what did not repeat itself is written once": ("r||", "r | |"),
    "what was counted is not counted again": ("rrr||", "r | r2 |"),
    "after a quiet second it is news again": ("rrr||r", "r | r2 | r"),
    "what happens to a holder is counted too": ("AAATTTEEERRRDDD|", "A T E R D | A2 T2 E2 R2 D2"),
    "and so are stops of nobody": ("SSSSS|", "S | S4"),
    "different refusals are counted apart": ("rbnncwrbbnncww|", "r b n c w | r b2 n3 c w2"),
    "nothing is written when nothing happened": ("||", "| |"),
}
"""Events, and seconds (``|``) between them; lines with their counts, and the seconds again."""


@pytest.mark.parametrize(("course", "written"), COURSES.values(), ids=COURSES)
def test_what_repeats_itself_is_counted(log: Log, course: str, written: str) -> None:
    told: list[str] = []
    letters = {str(fields): letter for letter, fields in LINES.items()}
    for each in course:
        if each == "|":
            told.append(each)
            log.audit.flush()
        else:
            log.audit.write(event(each))
        for line in log.lines():
            assert (line.pop("time"), line.pop("robot")) == ("2026-01-01T00:00:00.000+00:00", "r1")
            count = line.pop("count", "")
            told.append(f"{letters[str(line)]}{count}")
    assert " ".join(told) == written


@pytest.mark.parametrize("name", ["two\nlines", 'a "quoted" name', "\x00\x1b[2J", "Jürgen", "\u2028", "%s %d {}"])
def test_whatever_a_name_is_it_stays_on_one_plain_line_with_the_time_to_the_millisecond(log: Log, name: str) -> None:
    log.now_ns += 61_234_567_890
    log.write([refused(name, name, name)])
    (raw,) = log
    assert raw.isascii()
    assert raw.isprintable()
    (line,) = log.lines()
    assert (line["who"], line["command"], line["reason"]) == (name, name, name)
    assert line["time"] == "2026-01-01T00:01:01.234+00:00"


def test_the_gateways_log_has_the_same_but_for_refusals(log: Log, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "zbridge.control")
    log.write(map(event, "ArDDD"))
    log.audit.flush()
    assert [record.getMessage() for record in caplog.records] == [
        "r1: acquired ann",
        "r1: stopped ann (deadman)",
        "r1: stopped ann (deadman), 2 times",
    ]


events = st.builds(
    AuthorityEvent,
    st.sampled_from(EventKind),
    st.sampled_from(["ann", "bob", None]),
    st.sampled_from(["offline", "stop"]),
    command=st.sampled_from([None, "drive", "raw"]),
)


@given(st.lists(events | st.none(), max_size=60))
def test_nothing_is_lost_or_counted_twice(course: list[AuthorityEvent | None]) -> None:
    log = Log()
    for event in course:
        if event is None:
            log.audit.flush()
        else:
            log.audit.write(event)
    log.audit.close()
    happened = Counter((event.what.value, event.who, event.command, event.reason) for event in course if event)
    written: Counter[tuple[str, str | None, str | None, str | None]] = Counter()
    for line in log.lines():
        written[line["event"], line.get("who"), line.get("command"), line["reason"]] += line.get("count", 1)
    assert written == happened


# Floods

ANN = [EventKind.ACQUIRED, EventKind.STOPPED, EventKind.TAKEN_OVER]
"""What another actor does, and must still be found."""
PER_S = 3000


def names(count: int = PER_S) -> list[str]:
    return [os.urandom(8).hex() for _ in range(count)]


def takeovers(names: Iterable[str]) -> list[AuthorityEvent]:
    """What is told when one after the other takes the robot from the one before."""
    return [msgspec.structs.replace(each, who=who) for who in names for each in map(event, "ET")]


FLOODS = {
    "one name": lambda: takeovers(["mallory"] * PER_S),
    "random names": lambda: takeovers(names()),
    "varied refusals": lambda: [refused("mallory", f"command {number}", name) for number, name in enumerate(names())],
}


@pytest.mark.parametrize("flood", FLOODS.values(), ids=FLOODS)
def test_a_flood_neither_pushes_out_what_was_there_before_nor_hides_what_happens_amid_it(
    tmp_path, metrics, flood, caplog
) -> None:
    caplog.set_level(logging.INFO)
    file = opened(tmp_path / "audit.jsonl", metrics, file_bytes=100_000, files=1)
    audit = Audit("r1", file.write)
    for second in range(12):
        if second in (0, 10):
            for what in ANN:
                audit.write(AuthorityEvent(what, "ann", f"second {second}"))
        for event in flood():
            audit.write(event)
        audit.flush()
    audit.close()
    file.close()
    lines = [json.loads(line) for each in tmp_path.iterdir() for line in each.read_text().splitlines()]
    found = {(line["event"], line["reason"]) for line in lines if line.get("who") == "ann"}
    assert found == {(what.value, f"second {second}") for what in ANN for second in (0, 10)}
    assert sum(line.get("count", 1) for line in lines) >= 12 * PER_S, "and the flood itself is counted"
    assert len(lines) < 400
    assert len(caplog.records) < 400
    assert metrics.total("audit_lines_dropped") == 0


def test_different_refusals_are_bounded_the_rest_is_counted_as_others_and_none_hides_a_stop(log: Log) -> None:
    log.write(refused(None, reason=f"reason {number}") for number in range(10 * KINDS))
    log.write([event("S")])
    log.audit.flush()
    lines = log.lines()
    assert [(line["reason"], line["stops"]) for line in lines if line["event"] == "stopped"] == [("stop", True)]
    assert len(lines) <= KINDS + 3
    assert sum(line.get("count", 1) for line in lines) == 10 * KINDS + 1
    assert (lines[-1]["event"], lines[-1]["reason"]) == ("refused", "others")


def test_a_day_of_a_flood_fills_no_disk(log: Log) -> None:
    size = 0
    for second in range(600):
        log.write(takeovers(names(100)))
        log.audit.flush()
        size += sum(len(line) + 1 for line in log) if second >= 60 else 0
        log.clear()
    assert size / 540 * 86_400 < 50e6


def test_what_has_to_wait_to_be_counted_is_written_in_turn_and_at_the_end(log: Log) -> None:
    for _ in range(1000):
        for number in range(10):
            log.write(2 * [refused(reason=f"reason {number}")])
        log.audit.flush()
    log.audit.close()
    lines = log.lines()
    assert len(lines) < 10 + COUNTS + 1000 * COUNTS_HZ + 10
    assert sum(line.get("count", 1) for line in lines) == 1000 * 10 * 2
    per_reason = Counter(line["reason"] for line in lines)
    assert max(per_reason.values()) - min(per_reason.values()) <= 1


# The file


@pytest.fixture
def metrics() -> Metrics:
    return Metrics()


def opened(path: Path, metrics: Metrics | None = None, *, file_bytes: int = 1000, files: int = 2, **more) -> AuditFile:
    return AuditFile(path, metrics or Metrics(), file_bytes=file_bytes, files=files, **more)


def test_lines_are_appended_as_they_are_and_closing_writes_what_waits(tmp_path: Path) -> None:
    path = tmp_path / "log" / "r1" / "audit.jsonl"
    rounds = [["100 % %s %(name)s", "{}", "Jürgen", ""], [f"line {number}" for number in range(1000)]]
    for lines in rounds:
        file = opened(path, file_bytes=1_000_000)
        for line in lines:
            file.write(line)
        file.close()
        file.close()
    assert path.read_text(encoding="utf-8") == "".join(f"{line}\n" for lines in rounds for line in lines)


def rotated(path: Path, lines: int, **more: Any) -> list[str]:
    """Write lines of which one fills a file; name the files there are then."""
    file = opened(path, **more)
    for number in range(lines):
        file.write(f"{number:0999}")
    file.close()
    return sorted(each.name for each in path.parent.iterdir())


def age(path: Path, *numbers: int) -> None:
    two_days_ago = time.time() - 2 * 86_400
    for number in numbers:
        os.utime(path.with_name(f"audit.{number}"), (two_days_ago, two_days_ago))


def test_the_oldest_files_are_dropped_where_there_are_many_and_they_are_old(tmp_path: Path) -> None:
    path = tmp_path / "audit"
    assert rotated(path, 6, files=2, days=1.0) == ["audit", *(f"audit.{number}" for number in range(1, 6))]
    assert path.with_name("audit.5").read_text() == f"{0:0999}\n", "young files are kept: nothing was lost"
    age(path, 3, 4, 5)
    assert rotated(path, 1, files=2, days=1.0) == ["audit", "audit.1", "audit.2", "audit.3"]
    assert path.with_name("audit.3").read_text() == f"{3:0999}\n"
    age(path, 1, 2, 3)
    assert len(rotated(path, 1, files=4, days=1.0)) == 5, "old files are kept where there are few"
    assert len(rotated(path, MOST + 5, files=1, days=365.0)) == 1 + MOST, "there is a limit to young ones"


def test_a_file_is_rotated_before_it_grows_too_large(tmp_path: Path) -> None:
    path = tmp_path / "audit"
    file = opened(path)
    for number in range(1000):
        file.write(f"line {number:04}")
    file.close()
    assert {each.name: each.stat().st_size for each in tmp_path.iterdir()} == dict.fromkeys(
        ("audit", "audit.1", "audit.2"), 1000
    )
    assert path.with_name("audit.2").read_text().startswith("line 0700\n")
    assert path.read_text().endswith("line 0999\n")


Told = queue.SimpleQueue[str | None]
"""What people are told of the audit log."""


def hear(told: Told, text: str | None) -> None:
    """Wait until people are told this."""
    assert told.get(timeout=JOIN_S) == (text and f"the audit log is not written: {text}")


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Told:
    monkeypatch.setattr("zbridge.control.audit_log.RETRY_S", 0.01)
    return queue.SimpleQueue()


FULL = "No space left on device"


def is_open_on(descriptor: int, file: os.stat_result) -> bool:
    """Tell whether a descriptor is of this file."""
    return os.path.samestat(os.fstat(descriptor), file)


@pytest.mark.parametrize(
    ("make", "why", "lines"),
    [(lambda path: path.symlink_to("/dev/full"), FULL, 100), (os.mkfifo, "No such device or address", 1)],
    ids=["full disk", "pipe that nobody reads"],
)
def test_what_cannot_be_written_until_the_end_keeps_nobody_from_ending_and_is_counted(
    tmp_path, metrics, told, capfd, make, why, lines
) -> None:
    path = tmp_path / "audit.jsonl"
    make(path)
    threads = threading.active_count()
    file = opened(path, metrics, tell=told.put)
    for number in range(lines):
        file.write(f"line {number}")
    hear(told, why)
    file.close()
    assert threading.active_count() == threads
    assert metrics.count("audit_lines_dropped").value == lines
    assert "Traceback" not in capfd.readouterr().err


def test_a_full_disk_is_said_once_and_what_waits_is_written_when_it_has_room_again(
    tmp_path: Path, metrics: Metrics, told: Told, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path, write, full = tmp_path / "audit.jsonl", os.write, threading.Event()
    file = opened(path, metrics, tell=told.put)
    there = path.stat()

    def short_of_room(descriptor: int, data: bytes) -> int:
        if not is_open_on(descriptor, there):
            return write(descriptor, data)
        if full.is_set():
            raise OSError(errno.ENOSPC, FULL)
        full.set()
        return write(descriptor, data[:4])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", short_of_room)
        file.write("a whole line")
        hear(told, FULL)
    file.write("and another")
    hear(told, None)
    file.close()
    assert path.read_text() == "a whole line\nand another\n", "a line that was half written is finished"
    assert (metrics.total("audit_write_failures") >= 1, metrics.total("audit_lines_dropped")) == (True, 0)
    errors = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert errors == [f"the audit log is not written: {FULL} ({path})"]


def test_a_pipe_is_written_when_somebody_reads_it_and_again_when_somebody_else_does(tmp_path, metrics, told) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    file = opened(path, metrics, tell=told.put)
    file.write("one")
    hear(told, "No such device or address")
    with path.open() as reader:
        assert reader.readline() == "one\n"
    hear(told, None)
    file.write("two")
    hear(told, "Broken pipe")
    with path.open() as reader:
        assert reader.readline() == "two\n"
        file.close()
    assert metrics.count("audit_lines_dropped").value == 0


@pytest.mark.parametrize("name", ["file/audit.jsonl", "folder", "file/deep/audit.jsonl"])
def test_a_path_that_cannot_be_written_is_an_error_of_the_configuration(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    path = tmp_path / name
    threads = threading.active_count()
    with pytest.raises(ConfigError, match=f"^control.audit = '{path}': "):
        opened(path)
    assert threading.active_count() == threads


# A disk that stands still


class Disk:
    """An audit file whose thread stands still in the midst of writing, and as many lines as may wait."""

    def __init__(self, path: Path, metrics: Metrics, monkeypatch: pytest.MonkeyPatch) -> None:
        before = set(threading.enumerate())
        self.file = opened(path, metrics, file_bytes=1_000_000)
        self.writers = lambda: set(threading.enumerate()) - before
        self.moves, held, write, there = threading.Event(), threading.Event(), os.write, path.stat()

        def stand_still(descriptor: int, data: bytes) -> int:
            if is_open_on(descriptor, there):
                held.set()
                self.moves.wait(JOIN_S)
            return write(descriptor, data)

        monkeypatch.setattr(os, "write", stand_still)
        self.lines = [f"line {number}" for number in range(1 + WAITING)]
        for line in self.lines:
            self.file.write(line)
            assert held.wait(JOIN_S)


@pytest.fixture
def disk(tmp_path: Path, metrics: Metrics, monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(tmp_path / "audit.jsonl", metrics, monkeypatch)


def test_what_finds_no_room_is_dropped_and_counted_and_all_else_is_written_at_the_end(disk, metrics, tmp_path) -> None:
    assert metrics.total("audit_lines_dropped") == 0
    for _ in range(10):
        disk.file.write("no room for this one")  # and it returns, although the disk stands still
    closing = threading.Thread(target=disk.file.close)
    closing.start()
    disk.moves.set()
    closing.join(JOIN_S)
    assert (tmp_path / "audit.jsonl").read_text().splitlines() == disk.lines
    assert metrics.total("audit_lines_dropped") == 10


def test_a_disk_that_never_moves_again_keeps_nobody_from_ending_and_what_is_given_up_is_counted(
    disk: Disk, metrics: Metrics, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("zbridge.control.audit_log.CLOSE_S", 0.001)
    disk.file.close()
    (writer,) = disk.writers()
    assert writer.is_alive(), "nobody waited for the disk"
    assert metrics.total("audit_lines_dropped") == WAITING
    disk.moves.set()
    writer.join(JOIN_S)
