"""The audit log: what a line says, what is counted instead of repeated, and what becomes of it on the disk."""

import contextlib
import errno
import json
import logging
import os
import select
import stat
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.control.audit_log import COUNTS, COUNTS_HZ, KINDS, MOST, WAITING, Audit, AuditFile
from zbridge.control.authority import Authority
from zbridge.control.events import Event, EventKind
from zbridge.errors import ConfigError
from zbridge.fleet.messages import Acquire
from zbridge.metrics import Metrics

EPOCH_NS = 1_767_225_600_000_000_000
"""The first second of 2026, UTC."""
JOIN_S = 30.0
"""Longest time a thread of a test may take; no test waits that long."""
QUIET_S = 2.0
"""How long nothing may come from a file that is open; no test waits that long either, unless it fails."""


class Log:
    """An audit log whose lines and whose clock are the test's."""

    def __init__(self) -> None:
        self.raw: list[str] = []
        self.now_ns = EPOCH_NS
        self.audit = Audit("r1", self.raw.append, lambda: self.now_ns)

    def lines(self) -> list[dict[str, Any]]:
        """Give what was written since the last call."""
        taken, self.raw[:] = list(self.raw), []
        return [json.loads(line) for line in taken]


@pytest.fixture
def log() -> Log:
    return Log()


def refused(who: str | None = "ann", command: str = "drive", reason: str = "offline") -> Event:
    return Event(EventKind.REFUSED, who, reason, command=command)


# Lines

WRITTEN = [
    (Event(EventKind.ACQUIRED, "ann", priority=0), {"event": "acquired", "who": "ann", "priority": 0}),
    (Event(EventKind.TAKEN_OVER, "bob", priority=-3), {"event": "taken over", "who": "bob", "priority": -3}),
    (
        Event(EventKind.ENDED, "ann", "taken over by bob", stops=True),
        {"event": "ended", "who": "ann", "reason": "taken over by bob", "stops": True},
    ),
    (Event(EventKind.RELEASED, "ann", "released"), {"event": "released", "who": "ann", "reason": "released"}),
    (
        Event(EventKind.STOPPED, "ann", "deadman", stops=True),
        {"event": "stopped", "who": "ann", "reason": "deadman", "stops": True},
    ),
    (Event(EventKind.STOPPED, None, "stop", stops=True), {"event": "stopped", "reason": "stop", "stops": True}),
    (refused(), {"event": "refused", "who": "ann", "command": "drive", "reason": "offline"}),
    (refused(None), {"event": "refused", "command": "drive", "reason": "offline"}),
]


@pytest.mark.parametrize(("event", "fields"), WRITTEN, ids=[str(event) for event, _ in WRITTEN])
def test_every_event_is_a_line_that_says_what_is_known(log: Log, event: Event, fields: dict[str, Any]) -> None:
    log.audit.write(event)
    assert log.lines() == [{"time": "2026-01-01T00:00:00.000+00:00", "robot": "r1", **fields}]


def test_the_time_is_utc_to_the_millisecond(log: Log) -> None:
    log.now_ns = EPOCH_NS + 61_234_567_890
    log.audit.write(Event(EventKind.ACQUIRED, "ann"))
    assert log.lines()[0]["time"] == "2026-01-01T00:01:01.234+00:00"


@pytest.mark.parametrize("name", ["two\nlines", 'a "quoted" name', "\x00\x1b[2J", "Jürgen", "\u2028", "%s %d {}"])
def test_whatever_a_name_is_it_stays_on_one_plain_line(log: Log, name: str) -> None:
    log.audit.write(refused(name, name, name))
    (raw,) = log.raw
    assert raw.isascii()
    assert raw.isprintable()
    (line,) = log.lines()
    assert (line["who"], line["command"], line["reason"]) == (name, name, name)


def test_an_audit_log_prints_whose_it_is(log: Log) -> None:
    assert repr(log.audit) == "<Audit r1>"


# Repetitions


def test_a_first_refusal_is_written_at_once_and_the_others_are_counted(log: Log) -> None:
    log.audit.write(refused())
    assert [line.get("count") for line in log.lines()] == [None]
    for _ in range(1000):
        log.audit.write(refused())
    assert log.raw == []
    log.now_ns += 1_000_000_000
    log.audit.flush()
    (line,) = log.lines()
    assert line["count"] == 1000
    assert (line["event"], line["who"], line["command"], line["reason"]) == ("refused", "ann", "drive", "offline")
    assert line["time"] == "2026-01-01T00:00:01.000+00:00"


def test_a_refusal_that_goes_on_is_a_line_and_then_one_a_second(log: Log) -> None:
    for _ in range(5):
        for _ in range(100):
            log.audit.write(refused())
        log.audit.flush()
    counts = [line.get("count", 1) for line in log.lines()]
    assert sum(counts) == 500
    assert len(counts) == 1 + 5


def test_a_refusal_that_did_not_repeat_itself_is_written_once(log: Log) -> None:
    log.audit.write(refused())
    log.audit.flush()
    log.audit.flush()
    assert len(log.lines()) == 1


def test_after_a_quiet_second_a_refusal_is_written_at_once_again(log: Log) -> None:
    for _ in range(3):
        log.audit.write(refused())
    log.audit.flush()
    log.audit.flush()
    log.lines()
    log.audit.write(refused())
    assert len(log.lines()) == 1


def test_refusals_of_long_ago_leave_room_for_others(log: Log) -> None:
    for number in range(3 * KINDS):
        for _ in range(2):
            log.audit.write(refused(reason=f"reason {number}"))
        log.audit.flush()
        log.audit.flush()
    assert len({line["reason"] for line in log.lines()}) == 3 * KINDS


def test_one_repetition_is_a_line_like_the_first(log: Log) -> None:
    log.audit.write(refused())
    log.audit.write(refused())
    log.audit.flush()
    first, second = log.lines()
    assert first == second
    assert "count" not in first


def test_nothing_is_written_when_nothing_happened(log: Log) -> None:
    log.audit.flush()
    assert log.raw == []


def test_what_was_flushed_is_not_counted_again(log: Log) -> None:
    for _ in range(3):
        log.audit.write(refused())
    log.audit.flush()
    log.lines()
    log.audit.flush()
    assert log.lines() == []
    log.audit.write(refused())
    log.audit.flush()
    assert [line.get("count", 1) for line in log.lines()] == [1]


@pytest.mark.parametrize("other", [refused("bob"), refused(None), refused(command="raw"), refused(reason="busy")])
def test_different_refusals_are_counted_apart(log: Log, other: Event) -> None:
    for event in (refused(), other, refused(), other, other):
        log.audit.write(event)
    assert len(log.lines()) == 2
    log.audit.flush()
    assert [line.get("count", 1) for line in log.lines()] == [1, 2]


@pytest.mark.parametrize("event", [event for event, _ in WRITTEN if event.who and event.what is not EventKind.REFUSED])
def test_what_happens_to_a_holder_again_and_again_is_counted_too(log: Log, event: Event) -> None:
    for _ in range(3):
        log.audit.write(event)
    assert [(line["event"], line.get("count")) for line in log.lines()] == [(event.what.value, None)]
    log.audit.flush()
    assert [(line["event"], line.get("count")) for line in log.lines()] == [(event.what.value, 2)]
    log.audit.write(event)
    log.audit.flush()
    log.audit.flush()
    log.lines()
    log.audit.write(event)
    assert len(log.lines()) == 1, "a second later it is news again"


def test_stops_of_a_robot_that_nobody_holds_are_counted_too(log: Log) -> None:
    for _ in range(5):
        log.audit.write(Event(EventKind.STOPPED, None, "stop", stops=True))
    log.audit.flush()
    assert [(line["event"], line["stops"], line.get("count")) for line in log.lines()] == [
        ("stopped", True, None),
        ("stopped", True, 4),
    ]


def test_a_flood_of_different_refusals_is_bounded_and_still_counted(log: Log) -> None:
    for number in range(10 * KINDS):
        log.audit.write(refused(reason=f"reason {number}"))
    log.audit.flush()
    lines = log.lines()
    assert len(lines) <= KINDS + 2
    assert sum(line.get("count", 1) for line in lines) == 10 * KINDS
    assert lines[-1]["reason"] == "others"
    assert lines[-1]["event"] == "refused"


def test_a_flood_of_refusals_hides_no_stop(log: Log) -> None:
    for number in range(KINDS + 1):
        log.audit.write(refused(None, f"no such command {number}"))
    log.lines()
    log.audit.write(Event(EventKind.STOPPED, None, "stop", stops=True))
    log.audit.flush()
    stops = [(line["reason"], line["stops"]) for line in log.lines() if line["event"] == "stopped"]
    assert stops == [("stop", True)]


# Floods


ANN = [
    Event(EventKind.ACQUIRED, "ann", priority=0),
    Event(EventKind.STOPPED, "ann", "stop", stops=True),
    Event(EventKind.TAKEN_OVER, "ann", priority=0),
]
"""What another actor did, and must still be found."""
PER_S = 3000


def takeovers(names: Iterable[str]) -> list[Event]:
    """What a robot's authority tells when one after the other takes the robot from the one before."""
    authority = Authority(3.0, 2.0, os.urandom)
    for name in names:
        authority.takeover(Acquire(name), 0.0)
    return authority.events()


def one_name() -> list[Event]:
    return takeovers(["mallory"] * PER_S)


def random_names() -> list[Event]:
    return takeovers([os.urandom(8).hex() for _ in range(PER_S)])


def stops() -> list[Event]:
    authority = Authority(3.0, 2.0, os.urandom)
    for _ in range(PER_S):
        authority.stop("stop")
    return authority.events()


def varied_refusals() -> list[Event]:
    return [refused("mallory", f"command {number}", os.urandom(8).hex()) for number in range(PER_S)]


def comings_and_goings() -> list[Event]:
    names = [os.urandom(8).hex() for _ in range(PER_S // 2)]
    return [
        event for who in names for event in (Event(EventKind.ACQUIRED, who), Event(EventKind.RELEASED, who, "released"))
    ]


FLOODS = [one_name, random_names, stops, varied_refusals, comings_and_goings]


@pytest.mark.parametrize("flood", FLOODS)
def test_a_flood_pushes_nothing_out_that_was_there_before(tmp_path, metrics, flood, caplog) -> None:
    caplog.set_level(logging.INFO)
    file = opened(tmp_path / "audit.jsonl", metrics, file_bytes=100_000, files=1)
    audit = Audit("r1", file.write)
    for event in ANN:
        audit.write(event)
    for _ in range(7):
        for event in flood():
            audit.write(event)
        audit.flush()
    audit.close()
    file.close()
    written = "".join(each.read_text() for each in tmp_path.iterdir()).splitlines()
    lines = [json.loads(line) for line in written]
    assert {line["event"] for line in lines if line.get("who") == "ann"} >= {event.what.value for event in ANN}
    assert sum(line.get("count", 1) for line in lines) >= 7 * PER_S, "and the flood itself is counted"
    assert len(lines) < 400
    assert len(caplog.records) < 400
    assert metrics.count("audit_dropped").value == 0


@pytest.mark.parametrize("flood", [one_name, random_names, varied_refusals])
def test_what_another_does_amid_a_flood_has_lines_of_its_own(log: Log, flood: Callable[[], list[Event]]) -> None:
    for second in range(20):
        for event in flood():
            log.audit.write(event)
        if second == 10:
            log.lines()
            for event in ANN[:2]:
                log.audit.write(event)
            assert [(line["event"], line["who"]) for line in log.lines()] == [("acquired", "ann"), ("stopped", "ann")]
        log.audit.flush()


def test_an_actor_that_was_there_before_keeps_its_lines_when_strangers_do_the_same(log: Log) -> None:
    log.audit.write(ANN[2])
    for _ in range(20):
        for event in random_names():
            log.audit.write(event)
        log.audit.flush()
    log.lines()
    log.audit.write(Event(EventKind.TAKEN_OVER, "ann", "again", priority=0))
    assert [(line["event"], line["who"]) for line in log.lines()] == [("taken over", "ann")]


def test_a_day_of_a_flood_fills_no_disk(log: Log) -> None:
    size = 0
    for second in range(600):
        for event in takeovers(os.urandom(8).hex() for _ in range(100)):
            log.audit.write(event)
        log.audit.flush()
        if second >= 60:
            size += sum(len(line) + 1 for line in log.raw)
        log.raw.clear()
    assert size / 540 * 86_400 < 50e6


def test_what_has_to_wait_to_be_counted_is_written_in_turn_and_at_the_end(log: Log) -> None:
    for _ in range(1000):
        for number in range(10):
            for _ in range(2):
                log.audit.write(refused(reason=f"reason {number}"))
        log.audit.flush()
    log.audit.close()
    lines = log.lines()
    assert len(lines) < 10 + COUNTS + 1000 * COUNTS_HZ + 10
    assert sum(line.get("count", 1) for line in lines) == 1000 * 10 * 2
    per_reason = Counter(line["reason"] for line in lines)
    assert max(per_reason.values()) - min(per_reason.values()) <= 1


def test_what_is_left_to_count_is_written_at_the_end(log: Log) -> None:
    for event in (refused(), refused(), refused(), Event(EventKind.STOPPED, None, "stop", stops=True)):
        log.audit.write(event)
    log.lines()
    log.audit.close()
    assert [line["count"] for line in log.lines()] == [2]


def test_the_gateways_log_has_the_same_but_for_refusals(log: Log, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "zbridge.control")
    for event in (ANN[0], refused(), ANN[1], ANN[1], ANN[1]):
        log.audit.write(event)
    log.audit.flush()
    assert [record.getMessage() for record in caplog.records] == [
        "r1: acquired ann",
        "r1: stopped ann (stop)",
        "r1: stopped ann (stop), 2 times",
    ]


events = st.builds(
    Event,
    st.sampled_from(EventKind),
    st.sampled_from(["ann", "bob", None]),
    st.sampled_from(["offline", "stop"]),
    command=st.sampled_from([None, "drive", "raw"]),
)


@given(st.lists(events | st.none(), max_size=60))
def test_nothing_is_lost_or_counted_twice(course: list[Event | None]) -> None:
    log = Log()
    for event in course:
        if event is None:
            log.audit.flush()
        else:
            log.audit.write(event)
    log.audit.flush()
    happened = Counter((event.what.value, event.who, event.command, event.reason) for event in course if event)
    written: Counter[tuple[str, str | None, str | None, str | None]] = Counter()
    for line in log.lines():
        written[line["event"], line.get("who"), line.get("command"), line["reason"]] += line.get("count", 1)
    assert written == happened


# The file


class Disk:
    """A disk that stands still until the test reads: a pipe in the place of the file."""

    def __init__(self, path: Path, metrics: Metrics) -> None:
        os.mkfifo(path)
        self._outlet = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        os.set_blocking(self._outlet, True)
        self._data = b""
        self.file = opened(path, metrics, file_bytes=0)

    def stand_still(self) -> None:
        """Let the writing thread begin a line that is too long for the pipe, and so take no other."""
        self.file.write("x" * 2**20)
        self._data += os.read(self._outlet, 1)

    def read(self, lines: int) -> list[bytes]:
        """Take what is written until there are that many lines."""
        while self._data.count(b"\n") < lines:
            chunk = os.read(self._outlet, 65536)
            assert chunk, "the file was closed before all was written"
            self._data += chunk
        return self._data.splitlines()

    def read_all(self) -> list[bytes]:
        """Take what is written until the file is closed, or, where it is never closed, until nothing more comes."""
        while select.select([self._outlet], [], [], QUIET_S)[0] and (chunk := os.read(self._outlet, 65536)):
            self._data += chunk
        return self._data.splitlines()

    def close(self) -> None:
        os.close(self._outlet)


@pytest.fixture
def metrics() -> Metrics:
    return Metrics()


@pytest.fixture
def disk(tmp_path: Path, metrics: Metrics) -> Iterator[Disk]:
    with contextlib.closing(Disk(tmp_path / "audit.jsonl", metrics)) as disk:
        yield disk


def opened(
    path: Path, metrics: Metrics | None = None, *, file_bytes: int = 1_000_000, files: int = 2, **more: Any
) -> AuditFile:
    return AuditFile(path, metrics or Metrics(), file_bytes=file_bytes, files=files, **more)


def fill(file: AuditFile) -> list[bytes]:
    """Write as many lines as may wait."""
    lines = [f"line {number}" for number in range(WAITING)]
    for line in lines:
        file.write(line)
    return [line.encode() for line in lines]


def test_closing_writes_what_waits(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    file = opened(path)
    lines = [f'{{"line": {number}}}' for number in range(1000)]
    for line in lines:
        file.write(line)
    file.close()
    assert path.read_text().splitlines() == lines


def test_lines_are_written_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    file = opened(path)
    lines = ["100 % %s %(name)s", "{}", "Jürgen", ""]
    for line in lines:
        file.write(line)
    file.close()
    assert path.read_text(encoding="utf-8") == "".join(f"{line}\n" for line in lines)


def test_a_file_that_is_there_is_continued(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    path.write_text("before\n")
    file = opened(path)
    file.write("after")
    file.close()
    assert path.read_text() == "before\nafter\n"


def test_the_folder_is_made(tmp_path: Path) -> None:
    path = tmp_path / "log" / "r1" / "audit.jsonl"
    opened(path).close()
    assert stat.S_ISREG(path.stat().st_mode)


def test_files_are_rotated_and_the_oldest_are_dropped(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    file = opened(path, file_bytes=1000, files=2)
    lines = [f"line {number:04}" for number in range(1000)]
    for line in lines:
        file.write(line)
    file.close()
    kept = [path.with_name("audit.jsonl.2"), path.with_name("audit.jsonl.1"), path]
    assert sorted(tmp_path.iterdir()) == sorted(kept)
    assert all(0 < each.stat().st_size <= 1000 for each in kept)
    written = "".join(each.read_text() for each in kept).splitlines()
    assert written == lines[-len(written) :]
    assert len(written) > 200


def rotated(path: Path, lines: int, **more: Any) -> list[str]:
    """Write lines of which one fills a file; name the files there are then."""
    file = opened(path, file_bytes=1000, **more)
    for number in range(lines):
        file.write(f"{number:0999}")
    file.close()
    return sorted(each.name for each in path.parent.iterdir())


def test_a_file_that_is_young_is_kept_though_there_are_many(tmp_path: Path) -> None:
    path = tmp_path / "audit"
    assert rotated(path, 6, files=2, days=1.0) == ["audit", *(f"audit.{number}" for number in range(1, 6))]
    assert path.with_name("audit.5").read_text() == f"{0:0999}\n", "nothing was lost"
    long_ago = time.time() - 2 * 86_400
    for number in (3, 4, 5):
        os.utime(path.with_name(f"audit.{number}"), (long_ago, long_ago))
    assert rotated(path, 1, files=2, days=1.0) == ["audit", "audit.1", "audit.2", "audit.3"]
    assert path.with_name("audit.3").read_text() == f"{3:0999}\n"


def test_an_old_file_is_kept_where_there_are_few(tmp_path: Path) -> None:
    path = tmp_path / "audit"
    rotated(path, 3, files=2, days=1.0)
    os.utime(path.with_name("audit.2"), (0, 0))
    os.utime(path.with_name("audit.1"), (0, 0))
    assert rotated(path, 1, files=3, days=1.0) == ["audit", "audit.1", "audit.2", "audit.3"]


def test_there_is_a_limit_to_how_many_young_files_there_are(tmp_path: Path) -> None:
    names = rotated(tmp_path / "audit", MOST + 5, files=1, days=365.0)
    assert len(names) == 1 + MOST


class Told(list[str | None]):
    """What people are told of the audit log, and a way to wait for it."""

    def __init__(self) -> None:
        super().__init__()
        self._changed = threading.Condition()

    def tell(self, text: str | None) -> None:
        with self._changed:
            self.append(text)
            self._changed.notify_all()

    def until(self, count: int) -> list[str | None]:
        with self._changed:
            assert self._changed.wait_for(lambda: len(self) >= count, JOIN_S)
            return list(self)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Told:
    monkeypatch.setattr("zbridge.control.audit_log.RETRY_S", 0.01)
    return Told()


def test_a_full_disk_is_said_once_and_what_waits_is_written_when_it_has_room_again(
    tmp_path: Path, metrics: Metrics, told: Told, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "audit.jsonl"
    path.symlink_to("/dev/full")
    file = opened(path, metrics, tell=told.tell)
    lines = [f"line {number}" for number in range(100)]
    for line in lines:
        file.write(line)
    assert told.until(1) == ["the audit log is not written: No space left on device"]
    failed = metrics.count("audit_failed")
    seen = failed.value
    assert seen >= 1
    room = tmp_path / "room"
    (tmp_path / "link").symlink_to(room)
    os.replace(tmp_path / "link", path)
    assert told.until(2)[1:] == [None]
    file.close()
    assert room.read_text().splitlines() == lines
    assert metrics.count("audit_dropped").value == 0
    errors = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert errors == [f"the audit log is not written: No space left on device ({path})"]


def test_a_disk_that_stays_full_keeps_nobody_from_ending_and_what_is_lost_is_counted(tmp_path, metrics, capfd) -> None:
    path = tmp_path / "audit.jsonl"
    path.symlink_to("/dev/full")
    file = opened(path, metrics)
    for number in range(100):
        file.write(f"line {number}")
    file.close()
    assert not file._writer.is_alive()
    assert metrics.count("audit_dropped").value == 100
    assert "Traceback" not in capfd.readouterr().err


def test_a_line_that_was_half_written_is_finished(tmp_path: Path, told: Told, monkeypatch: pytest.MonkeyPatch) -> None:
    path, write, full = tmp_path / "audit.jsonl", os.write, threading.Event()
    file = opened(path, tell=told.tell)

    def short_of_room(descriptor: int, data: bytes) -> int:
        if descriptor != file._file._descriptor:
            return write(descriptor, data)
        if full.is_set():
            raise OSError(errno.ENOSPC, "No space left on device")
        full.set()
        return write(descriptor, data[:4])

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", short_of_room)
        file.write("a whole line")
        told.until(1)
    file.write("and another")
    told.until(2)
    file.close()
    assert path.read_text() == "a whole line\nand another\n"


def test_a_pipe_that_nobody_reads_is_waited_for_by_nobody(tmp_path, metrics, told, caplog) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    file = opened(path, metrics, tell=told.tell)
    file.write("line")
    assert told.until(1) == ["the audit log is not written: No such device or address"]
    file.close()
    assert not file._writer.is_alive()
    assert metrics.count("audit_dropped").value == 1
    assert [record.levelname for record in caplog.records] == ["ERROR"]


def test_a_pipe_is_written_when_somebody_reads_it_and_again_when_somebody_else_does(tmp_path, metrics, told) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    file = opened(path, metrics, tell=told.tell)
    file.write("one")
    told.until(1)
    with path.open() as reader:
        assert reader.readline() == "one\n"
    assert told.until(2)[1:] == [None]
    file.write("two")
    assert told.until(3)[2:] == ["the audit log is not written: Broken pipe"]
    with path.open() as reader:
        assert reader.readline() == "two\n"
        file.close()
    assert metrics.count("audit_dropped").value == 0


def test_what_finds_no_room_is_dropped_and_counted_and_all_else_is_written(disk: Disk, metrics: Metrics) -> None:
    dropped = metrics.count("audit_dropped")
    disk.stand_still()
    lines = fill(disk.file)
    assert dropped.value == 0
    for _ in range(10):
        disk.file.write("no room for this one")  # and it returns, although nobody reads
    assert dropped.value == 10
    assert disk.read(1 + WAITING)[1:] == lines
    disk.file.write("and there is room again")
    disk.file.close()
    assert disk.read_all()[1:] == [*lines, b"and there is room again"]
    assert dropped.value == 10


def test_closing_writes_what_waits_although_the_queue_is_full(disk: Disk) -> None:
    disk.stand_still()
    lines = fill(disk.file)
    with closing(disk) as failed:
        assert failed == []
        assert disk.read_all()[1:] == lines
    assert failed == []


def test_what_is_given_up_at_the_end_is_counted(disk: Disk, metrics: Metrics, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zbridge.control.audit_log.CLOSE_S", 0.001)
    disk.stand_still()
    lines = fill(disk.file)
    with closing(disk) as failed:
        written = disk.read_all()[1:]
    assert failed == []
    assert len(written) + metrics.count("audit_dropped").value >= len(lines)


def test_a_disk_that_never_moves_again_does_not_keep_the_gateway_from_ending(disk, monkeypatch) -> None:
    monkeypatch.setattr("zbridge.control.audit_log.CLOSE_S", 0.001)
    disk.stand_still()
    with closing(disk, within_s=2.0) as failed:
        closed = not any(thread.name == "closing" for thread in threading.enumerate())
        disk.read(1)
    assert failed == []
    assert closed, "close() waits for the disk without an end"


@contextlib.contextmanager
def closing(disk: Disk, within_s: float = 0.05) -> Iterator[list[BaseException]]:
    """Close the file in a thread, and go on when that is done or waits for the disk; give the errors it had."""
    failed: list[BaseException] = []

    def close() -> None:
        try:
            disk.file.close()
        except BaseException as error:
            failed.append(error)

    thread = threading.Thread(target=close, name="closing", daemon=True)
    thread.start()
    thread.join(within_s)
    yield failed
    thread.join(JOIN_S)


def test_closing_twice_does_no_harm(tmp_path: Path) -> None:
    path = tmp_path / "audit.jsonl"
    file = opened(path)
    file.write("line")
    file.close()
    file.close()
    assert path.read_text() == "line\n"


@pytest.mark.parametrize("name", ["file/audit.jsonl", "folder", "file/deep/audit.jsonl"])
def test_a_path_that_cannot_be_written_is_an_error_of_the_configuration(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    path = tmp_path / name
    threads = threading.active_count()
    with pytest.raises(ConfigError) as error:
        opened(path)
    assert str(error.value).startswith(f"control.audit = '{path}': ")
    assert threading.active_count() == threads
