"""The queue between the event loop and the disk: its bounds, what is told of the disk, log lines, the end.

Most tests do the rounds of the disk's thread themselves: a disk that hangs is one without rounds.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import logging
import os
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.blackbox.scene import EPOCH_NS, S_NS, Disk, disk
from zbridge.blackbox import box as boxes
from zbridge.blackbox.box import LINE_CHARACTERS, LINES, ORDERS, QUEUE_BYTES, RECORD_BYTES, STATES, BlackBox
from zbridge.blackbox.disk_thread import DiskThread, Job
from zbridge.blackbox.reading import Findings, KeptRecord, read_records
from zbridge.blackbox.segments import LogLine
from zbridge.blackbox.settings import BlackBoxSettings
from zbridge.blackbox.spool import Spool
from zbridge.fleet import payload as payloads
from zbridge.fleet.topics import KeySpace
from zbridge.log import current_robot

__all__ = ["disk"]
pytestmark = pytest.mark.jumping
JOIN_S = 10.0
"""Longest time a thread of a test may take; no test waits that long."""


class Rounds:
    """In place of the disk's thread: does its rounds when it is told."""

    def __init__(self) -> None:
        self.jobs: list[Job] = []
        self.woken = 0
        self.ending = False
        """Whether a round follows at once when it is woken."""

    def add(self, job: Job) -> None:
        self.jobs.append(job)

    def remove(self, job: Job) -> None:
        with contextlib.suppress(ValueError):
            self.jobs.remove(job)

    def wake(self) -> None:
        self.woken += 1
        if self.ending:
            self.round()

    def round(self) -> None:
        for job in tuple(self.jobs):
            job()


class Scene:
    """A black box on a loop whose clock jumps."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.path = path
        self.rounds = Rounds()
        self.told: list[str | None] = []
        self.died: list[str] = []
        self.loop = asyncio.get_running_loop()
        self.boxes: list[BlackBox] = []
        monkeypatch.setattr(boxes, "time", SimpleNamespace(monotonic=self.now, monotonic_ns=self.ns, time_ns=self.wall))
        monkeypatch.setattr(boxes, "CLOSE_S", 0.02)
        self.box = self.made()

    def now(self) -> float:
        return self.loop.time()

    def ns(self) -> int:
        return int(self.loop.time() * S_NS)

    def wall(self) -> int:
        return EPOCH_NS + self.ns()

    def made(self, *, alone: bool = True, disk: Any = None, robot: str = "r1", **settings: Any) -> BlackBox:
        box = BlackBox(
            KeySpace("fleet", robot),
            self.path,
            BlackBoxSettings(**{"minutes": 1.0, **settings}),
            {"versions": {"zbridge": "9"}},
            tell=self.told.append,
            died=self.died.append,
            alone=alone,
            disk=disk or self.rounds,
        )
        self.boxes.append(box)
        return box

    async def after(self, seconds: int, *, hangs: bool = False) -> None:
        for _ in range(seconds):
            await asyncio.sleep(1.0)
            if not hangs:
                self.rounds.round()
        await asyncio.sleep(0)

    def close(self, error: Exception | None = None) -> None:
        self.rounds.ending = True
        self.box.close(error)

    def read(self, box: BlackBox | None = None) -> list[KeptRecord]:
        folder = (box or self.box).folder
        segments = sorted(folder.path.rglob("*.zbb"), key=lambda path: path.name)
        return list(read_records(segments, Findings()))

    def keys(self) -> list[str]:
        return [record.key.removeprefix("fleet/r1/") for record in self.read() if not record.key.endswith("/@log")]

    def lines(self) -> list[LogLine]:
        return [payloads.decode(LogLine, record.payload) for record in self.read() if record.key == "fleet/r1/@log"]


@pytest.fixture
async def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scene = Scene(tmp_path, monkeypatch)
    yield scene
    scene.rounds.ending = True
    for box in scene.boxes:
        box.close()


# Messages and states


async def test_messages_are_written_in_order_with_the_times_they_came(scene: Scene) -> None:
    scene.box.begin()
    scene.box.put("fleet/r1/@cmd/drive", b"\x80", b"lease")
    await asyncio.sleep(0.5)
    scene.box.put("fleet/r1/pose", b"\x81\xa1x\x01")
    scene.rounds.round()
    first, second = scene.read()
    assert (first.key, first.payload, first.attachment) == ("fleet/r1/@cmd/drive", b"\x80", b"lease")
    assert (second.key, second.payload, second.attachment) == ("fleet/r1/pose", b"\x81\xa1x\x01", None)
    assert second.at_ns - first.at_ns == pytest.approx(0.5e9, abs=1e6)


async def test_nothing_is_written_before_the_begin_and_a_second_begin_is_none(scene: Scene) -> None:
    scene.box.keep("deadman", "no command")
    scene.rounds.round()
    assert list(scene.path.iterdir()) == []
    handlers = len(logging.getLogger().handlers)
    for _ in range(2):
        scene.box.begin()
    assert len(scene.rounds.jobs) == 1
    assert len(logging.getLogger().handlers) == handlers + 1
    scene.rounds.round()
    assert scene.box.folder.infos() == []


async def test_each_segment_begins_with_all_states_and_every_tenth_with_large_ones(scene: Scene) -> None:
    small, large = ("fleet/r1/status", b"\x80"), ("fleet/r1/map", bytes(5000))
    scene.box.snapshot = lambda: [small, large]
    scene.box.begin()
    await scene.after(205)
    kept = list(read_records(sorted(scene.box.folder.ring.iterdir()), Findings()))
    assert len(kept) == 7 + 1
    assert [record.key for record in kept].count("fleet/r1/map") == 1, "in number 21, and 11 is gone"


async def test_a_cause_keeps_the_states_of_its_moment_and_the_minutes_before(scene: Scene) -> None:
    scene.box.snapshot = lambda: [("fleet/r1/status", b"\x81\xa5state\xa7offline"), ("fleet/r1/map", bytes(9000))]
    scene.box.begin()
    await scene.after(65)
    scene.box.keep("robot_lost", "closed")
    scene.rounds.round()
    (info,) = scene.box.folder.infos()
    assert (info.causes[0].code, info.causes[0].text) == ("robot_lost", "closed")
    assert info.frame["status"] == {"state": "offline"}
    assert info.frame["versions"] == {"zbridge": "9"}
    assert scene.keys()[-2:] == ["status", "map"], "also large ones"
    assert len(scene.box.folder.parts(info.name)) == 1 + 7 + 1


async def test_causes_of_one_code_are_noted_once_a_second_and_states_every_five(scene: Scene) -> None:
    frames = []
    scene.box.begin()
    scene.box.snapshot = lambda: frames.append(scene.now()) or [("fleet/r1/status", b"\x80")]
    for _ in range(40):
        scene.box.keep("deadman", "no command")
        scene.box.keep("latched", "wet floor")
        await asyncio.sleep(0.2)
        scene.rounds.round()
    (info,) = scene.box.folder.infos()
    codes = [cause.code for cause in info.causes]
    assert 7 <= codes.count("deadman") == codes.count("latched") <= 8
    assert len(frames) == 2


async def test_incidents_and_lost_messages_are_counted(scene: Scene, disk: Disk) -> None:
    scene.box.begin()
    scene.box.put("fleet/r1/pose", b"\x80")
    scene.box.keep("deadman", "no command")
    scene.rounds.round()
    disk.fault = errno.EROFS
    await scene.after(10)
    scene.box.put("fleet/r1/pose", b"\x80")
    scene.rounds.round()
    await scene.after(1)
    for _ in range(QUEUE_BYTES // (RECORD_BYTES + 1) + 10):
        scene.box.put("fleet/r1/pose", b"\x80")
    readings = {(name, *labels.values()): value for name, labels, value in scene.box.readings()}
    assert readings["blackbox_incidents", "deadman"] == 1
    assert 1 <= readings["blackbox_lost", "queue"] < 10
    assert readings["blackbox_lost", "disk"] >= 1
    assert readings["blackbox_bytes",] == sum(path.stat().st_size for path in scene.path.rglob("*.zbb"))
    assert scene.box.lost == readings["blackbox_lost", "queue"] + readings["blackbox_lost", "disk"]


# A disk that is slow, hangs or fails


async def test_what_does_not_fit_is_dropped_and_counted_until_the_disk_took_some(scene: Scene) -> None:
    scene.box.begin()
    for _ in range(20_000):
        scene.box.put("fleet/r1/scan", bytes(100))
    fits = 20_000 - scene.box.lost
    assert QUEUE_BYTES <= fits * (100 + RECORD_BYTES) <= QUEUE_BYTES + 1000
    scene.rounds.round()
    assert scene.keys().count("scan") == fits
    scene.box.put("fleet/r1/pose", b"\x80")
    assert scene.box.lost == 20_000 - fits
    scene.rounds.round()
    assert scene.keys()[-1] == "pose"


async def test_a_message_larger_than_the_queue_passes_where_nothing_else_waits(scene: Scene) -> None:
    scene.box.begin()
    scene.rounds.round()
    scene.box.put("fleet/r1/map", bytes(2 * QUEUE_BYTES))
    scene.box.put("fleet/r1/map", bytes(2 * QUEUE_BYTES))
    assert scene.box.lost == 1
    scene.rounds.round()
    assert scene.keys() == ["map"]


async def test_the_disk_is_woken_once_when_much_waits(scene: Scene) -> None:
    scene.box.begin()
    woken = []
    for _ in range(10):
        scene.box.put("fleet/r1/scan", bytes(90_000))
        woken.append(scene.rounds.woken)
    assert woken == [1, 1, 1, 2, 2, 2, 2, 2, 2, 2], "the first time: to begin"
    scene.rounds.round()
    for _ in range(4):
        scene.box.put("fleet/r1/scan", bytes(90_000))
    assert scene.rounds.woken == 3


async def test_memory_is_bounded_however_long_the_disk_hangs(scene: Scene) -> None:
    scene.box.begin()
    taken = []
    scene.box.snapshot = lambda: taken.append(scene.now()) or [("fleet/r1/map", bytes(10_000))]
    for minute in range(600):
        for code in ("deadman", "robot_lost", "latched", "mark"):
            scene.box.keep(code, f"minute {minute}")
        await scene.after(60, hangs=True) if minute < 20 else await asyncio.sleep(60)
        scene.box.put("fleet/r1/scan", bytes(100))
    assert len(taken) <= STATES
    assert scene.box.lost >= 4 * 600 - ORDERS
    scene.rounds.round()
    (info,) = scene.box.folder.infos()
    assert info.causes[0].text == "minute 0"
    assert 4 < len(info.causes) <= ORDERS
    await scene.after(70)
    assert scene.told[-1] is None
    assert len(scene.box.folder.infos()) == 1


async def test_states_that_wait_for_a_disk_that_hangs_are_bounded(scene: Scene) -> None:
    scene.box.begin()
    taken = []
    scene.box.snapshot = lambda: taken.append(scene.now()) or [("fleet/r1/status", b"\x80")]
    await asyncio.sleep(3600)
    assert len(taken) == STATES - 1, "and one at the begin"
    await scene.after(70)
    assert scene.keys().count("status") >= 7, "and afterwards all is as before"


async def test_a_disk_that_hangs_is_told_and_so_is_its_end(scene: Scene, caplog: pytest.LogCaptureFixture) -> None:
    scene.box.begin()
    await scene.after(24)
    assert scene.told == []
    await scene.after(25, hangs=True)
    assert scene.told[0] == "the black box is not written: the disk does not answer"
    assert all(text and "does not answer" in text for text in scene.told)
    await scene.after(1)
    assert scene.told[-1] is None
    told = len(scene.told)
    await scene.after(30)
    assert len(scene.told) == told
    events = [record.event for record in caplog.records if record.name == "zbridge.blackbox"]
    assert events == ["blackbox_not_written", "blackbox_written_again"]


async def test_a_disk_that_fails_is_told_once_and_so_is_its_end(scene: Scene, disk: Disk) -> None:
    scene.box.snapshot = lambda: [("fleet/r1/status", b"\x80")]
    scene.box.begin()
    await scene.after(5)
    disk.fault = errno.EROFS
    await scene.after(30)
    text = f"the black box is not written: {scene.box.folder.path}: Read-only file system"
    assert scene.told == [text]
    disk.fault = None
    await scene.after(11)
    assert scene.told == [text, None]


async def test_a_folder_that_cannot_be_made_at_the_begin_is_tried_again(scene: Scene, disk: Disk) -> None:
    disk.fault = errno.EACCES
    scene.box.begin()
    await scene.after(3)
    assert [bool(text and text.endswith("Permission denied")) for text in scene.told] == [True]
    disk.fault = None
    scene.box.put("fleet/r1/pose", b"\x80")
    await scene.after(3)
    assert scene.told[-1] is None
    assert scene.keys() == ["pose"]


async def test_an_error_of_the_box_itself_ends_it_and_nothing_else(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("a bug")

    scene.box.begin()
    monkeypatch.setattr(Spool, "write", fail)
    scene.rounds.round()
    assert scene.rounds.jobs == []
    assert [record.event for record in caplog.records] == ["blackbox_failed"]
    for _ in range(20_000):
        scene.box.put("fleet/r1/scan", bytes(100))
    assert scene.box.lost > 10_000, "the queue is bounded"


# The process before


async def test_a_process_that_died_is_told_once(scene: Scene) -> None:
    scene.box.folder.make()
    for pid in (4711, 4712):
        (scene.box.folder.live / str(pid)).write_text("")
    scene.box.begin()
    await scene.after(5)
    text = "process 4711, 4712 did not shut down cleanly: it crashed, was killed, or lost power"
    assert scene.died == [text]


async def test_a_process_that_ended_in_order_is_not_told(scene: Scene) -> None:
    first, second = scene.box, scene.made()
    first.begin()
    scene.rounds.round()
    assert (first.folder.live / str(os.getpid())).exists()
    scene.close()
    second.begin()
    await scene.after(2)
    assert scene.died == []


# The end


async def test_the_end_writes_what_waits(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boxes, "CLOSE_S", JOIN_S)
    box = scene.made(disk=DiskThread(period_s=3600.0), robot="r2")
    box.begin()
    for number in range(100):
        box.put("fleet/r2/text", b"%d" % number)
    box.close()
    assert [int(record.payload) for record in scene.read(box)] == list(range(100))
    assert list(box.folder.live.iterdir()) == []
    box.close()


async def test_the_end_does_not_wait_for_a_disk_that_hangs(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    moves, held, write = threading.Event(), threading.Event(), os.write

    def stand_still(descriptor: int, data: bytes) -> int:
        if threading.current_thread().name == "zbridge-blackbox":
            held.set()
            assert moves.wait(JOIN_S)
        return write(descriptor, data)

    monkeypatch.setattr(os, "write", stand_still)
    box = scene.made(disk=DiskThread(period_s=0.001), robot="r2")
    box.begin()
    box.put("fleet/r2/pose", b"\x80")
    assert held.wait(JOIN_S)
    box.put("fleet/r2/pose", b"\x81")
    before = time.monotonic()
    box.close()
    assert time.monotonic() - before < JOIN_S / 2
    assert os.listdir(box.folder.live) == [str(os.getpid())], "it has not ended"
    moves.set()
    for thread in threading.enumerate():
        if thread.name == "zbridge-blackbox":
            thread.join(JOIN_S)
    assert os.listdir(box.folder.live) == [], "but it does when the disk answers"
    assert [record.payload for record in scene.read(box)] == [b"\x80", b"\x81"]


async def test_an_error_by_which_the_gateway_ends_is_an_incident(scene: Scene) -> None:
    scene.box.begin()
    scene.box.keep("gateway_died", "the one before")
    scene.close(ValueError("a bug"))
    (info,) = scene.box.folder.infos()
    assert [cause.text for cause in info.causes][-1].startswith("the gateway failed: ")
    assert "a bug" in info.causes[-1].text


async def test_an_incident_that_is_open_is_left_to_the_next_process(scene: Scene) -> None:
    scene.box.begin()
    scene.box.keep("deadman", "no command")
    scene.rounds.round()
    scene.close()
    assert [info.ended_ns for info in scene.box.folder.infos()] == [None]
    assert scene.rounds.jobs == []


async def test_the_end_of_a_box_that_never_began_makes_nothing(scene: Scene) -> None:
    scene.box.close(ValueError("a bug"))
    assert list(scene.path.iterdir()) == []


# Log lines


@pytest.fixture
def logger(caplog: pytest.LogCaptureFixture) -> logging.Logger:
    caplog.set_level(logging.DEBUG)
    return logging.getLogger("zbridge.tests")


async def test_lines_of_the_log_are_recorded_from_info_on_from_any_thread(scene: Scene, logger: logging.Logger) -> None:
    logger.info("too early")
    handlers = list(logging.getLogger().handlers)
    scene.box.begin()
    logger.debug("too much")
    logger.info("here %d", 1, extra={"event": "here"})
    thread = threading.Thread(target=logger.warning, args=("there",))
    thread.start()
    thread.join()
    try:
        raise ValueError("a reason")
    except ValueError:
        logger.exception("it failed")
    scene.close()
    logger.info("too late")
    assert logging.getLogger().handlers == handlers
    lines = scene.lines()
    assert [(line.level, line.message, line.event) for line in lines[:2]] == [
        ("info", "here 1", "here"),
        ("warning", "there", None),
    ]
    assert lines[2].message.startswith("it failed (")
    assert "a reason" in lines[2].message
    assert {line.logger for line in lines} == {"zbridge.tests"}
    assert all(line.stamp_ns for line in lines)


async def test_lines_are_bounded_in_length_and_in_number_and_the_newest_are_kept(
    scene: Scene, logger: logging.Logger
) -> None:
    scene.box.begin()
    for number in range(LINES + 100):
        logger.info("%d %s", number, "x" * 2 * LINE_CHARACTERS)
    scene.rounds.round()
    lines = scene.lines()
    assert [int(line.message.split()[0]) for line in lines] == list(range(100, LINES + 100))
    assert {len(line.message) for line in lines} == {LINE_CHARACTERS}


async def test_in_a_process_of_several_robots_only_the_lines_of_this_one_are_recorded(
    scene: Scene, logger: logging.Logger
) -> None:
    scene.boxes.clear()
    scene.box = scene.made(alone=False)
    scene.box.begin()
    for robot in ("", "r1", "r2"):
        token = current_robot.set(robot)
        logger.info("of %s", robot or "nobody")
        current_robot.reset(token)
    scene.rounds.round()
    assert [line.message for line in scene.lines()] == ["of r1"]


async def test_a_cause_may_have_any_name_in_it(scene: Scene) -> None:
    scene.box.begin()
    assert scene.box.keep("mark", "by \udcff")
    scene.rounds.round()
    (info,) = scene.box.folder.infos()
    assert info.causes[0].text == "by ?"
