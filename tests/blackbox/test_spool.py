"""What the spool keeps, deletes and counts, on a clock of the test's own and on disks that fail."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest

from tests.blackbox.scene import STATUS, Disk, Process, Scene, disk, messages, scene, texts
from zbridge.blackbox.incidents import INFO, head_of, number_of, segments_of
from zbridge.blackbox.reading import Findings, list_incidents
from zbridge.blackbox.settings import SEGMENT_S
from zbridge.blackbox.spool import AFTER_S, PENDING, SEGMENT_BYTES, NextSegment
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Status

__all__ = ["disk", "scene"]
MINUTE = 60.0
FULL = 7
"""Segments of one minute before a cause."""


@pytest.fixture
def process(scene: Scene) -> Process:
    """A process that keeps one minute."""
    made = scene.process(minutes=1.0, keep=3)
    made.begin()
    return made


def numbers(segments: list[Path]) -> list[int]:
    return [number_of(path) for path in segments]


# Segments


def test_a_segment_every_ten_seconds_and_the_oldest_are_deleted(scene: Scene, process: Process) -> None:
    process.run(50)
    assert numbers(scene.ring) == [1, 2, 3, 4, 5]
    process.run(50)
    assert numbers(scene.ring) == [4, 5, 6, 7, 8, 9, 10]
    assert texts(scene.ring) == [f"{seconds}" for seconds in range(1030, 1100, 10)]


@pytest.mark.parametrize(("minutes", "segments"), [(0.5, 4), (1.0, 7), (5.0, 31), (60.0, 361)])
def test_the_minutes_before_are_whole_while_the_last_segment_has_just_begun(
    scene: Scene, minutes: float, segments: int
) -> None:
    process = scene.process(minutes=minutes)
    process.begin()
    for _ in range(segments + 3):
        process.write(NextSegment([process.record("x")]))
    assert len(scene.ring) == segments == minutes * 6 + 1


def test_each_segment_begins_with_the_states_and_a_head_that_says_when(scene: Scene, process: Process) -> None:
    process.run(30)
    for number, path in enumerate(scene.ring):
        head = head_of(path)
        assert head is not None
        assert (head.realm, head.robot, head.pid, head.mono_ns) == ("fleet", "r1", 100, (1000 + 10 * number) * 10**9)
        assert path.read_bytes().count(STATUS) == 1


def test_a_segment_whose_loop_hangs_ends_by_itself(scene: Scene, process: Process) -> None:
    process.write(NextSegment(), process.record("first"))
    scene.now += 1.5 * SEGMENT_S - 0.1
    process.say("second")
    assert len(scene.ring) == 1
    scene.now += 0.1
    process.say("third")
    assert [texts([path]) for path in scene.ring] == [["first", "second"], ["third"]]


def test_a_large_segment_ends_by_itself(scene: Scene, process: Process) -> None:
    for _ in range(3):
        process.say(*(bytes(2**20) for _ in range(6)))
    sizes = [path.stat().st_size for path in scene.ring]
    assert len(sizes) == 3
    assert all(SEGMENT_BYTES <= size < SEGMENT_BYTES + 2**20 + 2**10 for size in sizes[:-1])
    assert len(messages(scene.ring)) == 18


def test_a_next_segment_without_states_makes_a_file_only_with_its_first_message(scene: Scene, process: Process) -> None:
    process.write(NextSegment(), NextSegment())
    assert scene.ring == []
    process.say("x")
    assert len(scene.ring) == 1


def test_messages_are_on_the_disk_at_once_and_counted(scene: Scene, process: Process) -> None:
    process.say("a", "b")
    assert texts(scene.ring) == ["a", "b"]
    assert process.spool.bytes == sum(path.stat().st_size for path in scene.ring)
    assert (process.spool.unwritten, process.spool.error) == (0, None)


def test_with_fsync_the_disk_is_waited_for(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[str] = []
    for name in ("fsync", "fdatasync"):
        monkeypatch.setattr(os, name, lambda descriptor: synced.append(os.readlink(f"/proc/self/fd/{descriptor}")))
    lazy, careful = scene.process(100), scene.process(101, fsync=True)
    lazy.begin()
    lazy.say("x")
    lazy.keep()
    assert synced == []
    lazy.end()
    scene.now += AFTER_S + 1
    careful.begin()
    synced.clear()
    careful.say("x")
    assert synced == [str(scene.folder.ring), str(scene.ring[-1])]
    careful.keep()
    assert str(scene.folder.incidents / scene.names[-1]) in synced


# Incidents


def test_an_incident_keeps_the_minutes_before_by_renaming_them_and_one_minute_after(
    scene: Scene, process: Process
) -> None:
    process.run(200)
    before = {path.stat().st_ino for path in scene.ring}
    process.keep()
    assert scene.ring == []
    info = scene.only_incident()
    assert {path.stat().st_ino for path in segments_of(scene.folder.incidents / info.name)} == before
    process.run(100)
    assert scene.kept(info.name) == [f"{seconds}" for seconds in range(1130, 1260, 10)]
    assert texts(scene.ring) == ["1260", "1270", "1280", "1290"]
    ended = scene.only_incident().ended_ns
    assert ended is not None
    assert AFTER_S <= (ended - info.began_ns) / 1e9 < AFTER_S + SEGMENT_S


def test_it_is_named_by_time_robot_and_first_cause_and_says_why(scene: Scene, process: Process) -> None:
    process.run(20)
    process.keep("robot_lost")
    info = scene.only_incident()
    assert info.name == "20260101T000020Z-r1-robot_lost"
    assert [(cause.code, cause.text, cause.at_ns) for cause in info.causes] == [
        ("robot_lost", "why robot_lost", scene.wall_ns)
    ]
    assert (info.realm, info.robot, info.ended_ns, info.more) == ("fleet", "r1", None, 0)
    assert process.counts == {"robot_lost": 1}


def test_the_freeze_frame_shows_the_state_of_the_moment(scene: Scene, process: Process) -> None:
    process.lost = 4
    frame = [
        process.record(STATUS, "status"),
        process.record(b"\x81\xa6holder\xa3ann", "control"),
        process.record(b"\x81\xa8sessions\x90", "@rpc/sessions/gateway"),
        process.record(b"\x80", "pose"),
    ]
    process.keep(frame=frame)
    shown = scene.only_incident().frame
    assert (shown["status"]["state"], shown["control"], shown["sessions"]) == (
        "established",
        {"holder": "ann"},
        {"sessions": []},
    )
    assert (shown["pid"], shown["lost"], shown["host"]) == (100, 4, os.uname().nodename)
    assert (shown["versions"], shown["configuration"]) == ({"zbridge": "of 100"}, {"robot": "r1"})
    assert "pose" not in shown


@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\xa2\xff\xfe", b"\x81"])
def test_a_state_that_cannot_be_read_is_missing_in_the_frame_and_costs_no_incident(
    scene: Scene, process: Process, payload: bytes
) -> None:
    process.keep(frame=[process.record(payload, "status"), (0, "odd", payload, None)])
    assert "status" not in scene.only_incident().frame


def test_causes_close_together_make_one_incident_that_lasts_a_minute_after_the_last(
    scene: Scene, process: Process
) -> None:
    process.run(100)
    process.keep("deadman")
    process.run(50)
    process.keep("robot_lost")
    info = scene.only_incident()
    assert [cause.code for cause in info.causes] == ["deadman", "robot_lost"]
    process.run(55)
    assert scene.only_incident().ended_ns is None
    process.run(10)
    assert scene.only_incident().ended_ns is not None
    assert scene.kept(info.name)[-1] == "1205"
    assert process.counts == {"deadman": 1}


def test_causes_beyond_the_listed_ones_are_counted_at_the_end(scene: Scene, process: Process) -> None:
    for _ in range(100):
        process.keep()
    process.run(70)
    info = scene.only_incident()
    assert len(info.causes) + info.more == 100


def test_an_incident_has_a_bounded_length_and_the_next_one_names_the_one_before(scene: Scene, process: Process) -> None:
    process.run(100)
    for _ in range(40):
        process.keep()
        process.run(10)
    process.run(100)
    infos = scene.folder.infos()
    assert len(infos) == 3
    assert (process.counts, process.spool.removed) == ({"deadman": 4}, 1)
    assert [info.before for info in infos] == ["20260101T000140Z-r1-deadman", *(info.name for info in infos[:-1])]
    for info in infos:
        assert info.ended_ns is not None
        assert (info.ended_ns - info.began_ns) / 1e9 <= process.spool.longest_s == 2 * MINUTE
    kept = [text for info in infos for text in scene.kept(info.name)]
    assert kept == [f"{seconds}" for seconds in range(int(kept[0]), int(kept[-1]) + 10, 10)], "no gap between them"


def test_a_cause_after_a_long_silence_is_an_incident_of_its_own(scene: Scene, process: Process) -> None:
    process.run(20)
    process.keep()
    scene.now += 300
    process.keep()
    assert [len(info.causes) for info in scene.folder.infos()] == [1, 1]


def test_an_incident_names_the_one_before_only_while_the_ring_lacks_what_that_one_took(
    scene: Scene, process: Process
) -> None:
    process.run(100)
    process.keep("first")
    process.run(70)
    process.keep("second")
    process.run(200)
    process.keep("third")
    first, second, third = scene.folder.infos()
    assert (first.before, second.before, third.before) == (None, first.name, None)


def test_two_incidents_of_one_second_and_code_have_different_names(scene: Scene, process: Process) -> None:
    for _ in range(3):
        process.keep()
        process.run(AFTER_S)
        scene.set_s -= AFTER_S
    assert scene.names == [f"20260101T000000Z-r1-deadman{copy}" for copy in ("", "-2", "-3")]


def test_only_the_newest_incidents_are_kept(scene: Scene, process: Process) -> None:
    for number in range(6):
        process.keep(f"code{number}")
        process.run(200)
    assert [info.causes[0].code for info in scene.folder.infos()] == ["code3", "code4", "code5"]
    assert len(os.listdir(scene.folder.incidents)) == 3
    assert process.spool.removed == 3


def test_a_cause_that_comes_again_and_again_makes_way_for_a_rare_one(scene: Scene, process: Process) -> None:
    for code in ("deadman", *["link_stalled"] * 6, "mark"):
        process.keep(code)
        process.run(200)
    assert [info.causes[0].code for info in scene.folder.infos()] == ["deadman", "link_stalled", "mark"]


def test_one_that_cannot_be_deleted_keeps_no_others(
    scene: Scene, process: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    process.run(20)
    process.keep("first")
    process.run(200)
    first, remove = scene.names[0], shutil.rmtree

    def fail(path: Path) -> None:
        if path.name == first:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        remove(path)

    monkeypatch.setattr(shutil, "rmtree", fail)
    for number in range(5):
        process.keep(f"code{number}")
        assert (process.spool.error is not None) == (number >= 2)
        process.run(200)
    infos = scene.folder.infos()
    assert [info.causes[0].code for info in infos] == ["first", "code2", "code3", "code4"]
    assert [len(info.causes) for info in infos] == [1, 1, 1, 1], "each was noted once"


def test_an_incident_that_is_deleted_while_it_is_open_is_forgotten(scene: Scene, process: Process) -> None:
    process.run(20)
    process.keep()
    process.run(20)
    scene.folder.remove(scene.names[0])
    process.run(100)
    assert (process.spool.incident, process.spool.error) == (None, None)
    assert texts(scene.ring)[-1] == "1130"
    process.keep("robot_lost")
    assert [cause.code for cause in scene.only_incident().causes] == ["robot_lost"]


def test_a_folder_that_is_deleted_is_made_again(scene: Scene, process: Process) -> None:
    process.run(20)
    shutil.rmtree(scene.folder.path)
    process.run(20)
    assert texts(scene.ring) == ["1020", "1030"]
    process.keep()
    assert len(scene.names) == 1


# Bounds


def bounds_hold(scene: Scene, process: Process, incidents: int, incident_bytes: int, ring_bytes: int) -> None:
    folders = os.listdir(scene.folder.incidents)
    assert len(folders) <= incidents
    assert len(scene.ring) <= FULL
    assert sum(path.stat().st_size for path in scene.ring) <= ring_bytes
    for folder in folders:
        segments = segments_of(scene.folder.incidents / folder)
        assert len(segments) <= FULL + process.spool.longest_s / SEGMENT_S + 1
        assert sum(path.stat().st_size for path in segments) <= incident_bytes


def test_a_thousand_incidents_in_an_hour_stay_within_their_bounds(scene: Scene, process: Process) -> None:
    process.run(70, "x" * 1000)
    for number in range(1000):
        process.keep(f"code{number % 7}")
        if number % 3 == 0:
            process.write(NextSegment([process.record("x" * 1000)]))
        scene.now += 3.6
        process.write(process.record("x" * 100))
        if number % 50 == 0:
            bounds_hold(scene, process, 3, 40_000, 10_000)
    process.run(70)
    bounds_hold(scene, process, 3, 40_000, 10_000)
    infos = scene.folder.infos()
    assert [info.ended_ns is None for info in infos] == [False] * 3
    assert all(len(info.causes) + info.more >= 30 for info in infos[:-1])
    assert process.counts.total() == 3600 // 120 == process.spool.removed + 3


def test_a_day_at_ten_messages_a_second_stays_within_its_bounds_all_the_time(scene: Scene, process: Process) -> None:
    """Written by the minute: what is kept is bounded by the number of segments, however long they are."""
    message, segment_bytes = bytes(100), 600 * (100 + 40) + 1000
    for minute in range(24 * 60):
        process.write(NextSegment(), *[process.record(message)] * 600)
        scene.now += MINUTE
        if minute % 100 == 99:
            process.keep()
        if minute % 10 == 0:
            bounds_hold(scene, process, 3, 11 * segment_bytes, FULL * segment_bytes)
    assert len(messages(scene.ring)) == FULL * 600
    assert process.spool.bytes > 24 * 3600 * 10 * 100
    assert process.spool.unwritten == 0


# Disks that fail


def test_a_full_disk_costs_what_came_meanwhile_and_it_is_counted(scene: Scene, process: Process, disk: Disk) -> None:
    process.say("before")
    disk.room = 0
    process.say("a", "b", "c")
    assert process.spool.error is not None
    assert process.spool.error.errno == errno.ENOSPC
    assert process.spool.unwritten == 3
    disk.room = None
    process.say("after")
    assert (process.spool.error, process.spool.unwritten) == (None, 3)
    assert texts(scene.ring)[-1] == "after"


def test_a_disk_that_failed_works_again_only_when_something_was_written(
    scene: Scene, process: Process, disk: Disk
) -> None:
    disk.room = 0
    process.say("x")
    disk.room = None
    for items in ((), (NextSegment(),)):
        process.write(*items)
        assert process.spool.error is not None
    process.say("x")
    assert process.spool.error is None


def test_a_block_that_was_half_written_is_cut_off_again(scene: Scene, process: Process, disk: Disk) -> None:
    process.say("before")
    size = scene.ring[0].stat().st_size
    for room in range(1, 40):
        disk.room = None
        process.write(NextSegment([process.record("before")]))
        disk.room = room
        process.say("half")
        assert scene.ring[-1].stat().st_size == size
    findings = Findings()
    assert set(texts(scene.ring)) == {"before"}
    messages(scene.ring, findings)
    assert findings.damaged == 0
    assert process.spool.unwritten == 39


def test_a_segment_whose_head_finds_no_room_leaves_no_file(scene: Scene, process: Process, disk: Disk) -> None:
    for room in (0, 1, 30):
        disk.room = room
        process.say("x")
        assert scene.ring == []


def test_a_full_disk_frees_the_oldest_segment_at_each_attempt(scene: Scene, process: Process, disk: Disk) -> None:
    process.run(70)
    disk.room = 0
    process.say("x")
    assert numbers(scene.ring) == [2, 3, 4, 5, 6, 7]
    process.say("x")
    assert numbers(scene.ring) == [3, 4, 5, 6, 7]
    for _ in range(20):
        process.say("x")
    assert scene.ring == []


@pytest.mark.parametrize("fault", [errno.EROFS, errno.EACCES, errno.EIO, errno.EMFILE])
def test_another_fault_of_the_disk_deletes_nothing(scene: Scene, process: Process, disk: Disk, fault: int) -> None:
    process.run(70)
    disk.fault = fault
    process.run(30)
    process.keep()
    assert process.spool.error is not None
    assert process.spool.error.errno == fault
    assert numbers(scene.ring) == [1, 2, 3, 4, 5, 6, 7]
    assert process.spool.unwritten == 6


def test_states_that_found_no_room_are_counted_to_the_last(scene: Scene, process: Process, disk: Disk) -> None:
    disk.room = 0
    process.write(NextSegment([process.record(bytes(200_000)) for _ in range(7)]))
    assert process.spool.unwritten == 7


@pytest.mark.parametrize("fault", [errno.EROFS, errno.EACCES])
def test_a_folder_that_cannot_be_made_is_an_error_and_the_next_begin_may_succeed(
    scene: Scene, disk: Disk, fault: int
) -> None:
    disk.fault = fault
    process = scene.process()
    with pytest.raises(OSError, match=os.strerror(fault)):
        process.begin()
    process.say("x")
    assert process.spool.error is not None
    disk.fault = None
    assert process.begin() == []
    process.say("y")
    assert texts(scene.ring) == ["y"]


def test_who_died_is_told_also_where_the_first_begin_failed(scene: Scene, disk: Disk) -> None:
    first, second = scene.process(100), scene.process(101)
    first.begin()
    first.run(20)
    first.keep()
    first.die()
    scene.now += 3600
    descriptors = len(os.listdir("/proc/self/fd"))
    for fault, room in ((errno.EROFS, None), (None, 0), (None, 0), (None, 0)):
        disk.fault, disk.room = fault, room
        with pytest.raises(OSError, match=r"No space|Read-only"):
            second.begin()
    assert len(os.listdir("/proc/self/fd")) == descriptors + 1, "of the live file"
    disk.room = None
    assert second.begin() == [100]
    assert scene.only_incident().ended_ns is not None
    second.end()


def test_causes_that_came_while_the_disk_failed_are_kept_once_it_works_again(
    scene: Scene, process: Process, disk: Disk
) -> None:
    process.run(70)
    disk.fault = errno.EROFS
    process.keep("deadman")
    process.keep("robot_lost")
    assert scene.names == []
    scene.now += 5
    disk.fault = None
    process.write()
    info = scene.only_incident()
    assert [cause.code for cause in info.causes] == ["deadman", "robot_lost"]
    assert len(scene.kept(info.name)) == FULL


def test_causes_that_wait_are_bounded(scene: Scene, process: Process, disk: Disk) -> None:
    disk.fault = errno.EROFS
    for number in range(1000):
        process.keep(f"code{number}")
    disk.fault = None
    process.write()
    info = process.spool.incident
    assert info is not None
    assert len(info.causes) + info.more == PENDING


def test_an_incident_that_finds_no_room_leaves_no_folder(scene: Scene, process: Process, disk: Disk) -> None:
    disk.room = 0
    process.keep()
    for _ in range(5):
        process.write()
    assert os.listdir(scene.folder.incidents) == []
    disk.room = None
    process.write()
    assert scene.only_incident().name == "20260101T000000Z-r1-deadman"


def test_a_disk_that_fails_during_an_incident_ends_neither_it_nor_the_process(
    scene: Scene, process: Process, disk: Disk
) -> None:
    process.run(30)
    process.keep()
    disk.fault = errno.EIO
    process.run(100)
    assert process.spool.unwritten == 20
    disk.fault = None
    process.run(20)
    info = scene.only_incident()
    assert info.ended_ns is not None
    assert texts(scene.ring)[-1] == "1140"


def test_an_end_on_a_disk_that_fails_raises_nothing(scene: Scene, process: Process, disk: Disk) -> None:
    process.run(20)
    process.keep()
    disk.fault, disk.room = errno.EROFS, 0
    process.end()
    process.end()


# Clocks


def test_a_clock_set_back_an_hour_loses_nothing_and_times_keep_rising(scene: Scene, process: Process) -> None:
    process.run(40)
    scene.set_s = -3600
    process.run(30)
    process.keep()
    process.run(100)
    info = scene.only_incident()
    assert info.name == "20251231T230110Z-r1-deadman"
    findings = Findings()
    kept = messages(segments_of(scene.folder.incidents / info.name), findings)
    assert [record.payload.decode() for record in kept] == [f"{seconds}" for seconds in range(1000, 1130, 10)]
    times = [record.at_ns for record in kept]
    assert times == sorted(times)
    assert findings.set_back_s == pytest.approx(3600)
    assert info.ended_ns is not None


def test_a_clock_set_forward_a_day_loses_nothing_and_ends_nothing(scene: Scene, process: Process) -> None:
    process.run(70)
    scene.set_s = 86_400
    process.keep()
    process.run(30)
    scene.set_s = 2 * 86_400
    process.run(25)
    info = scene.only_incident()
    assert info.ended_ns is None
    assert scene.kept(info.name) == [f"{seconds}" for seconds in range(1000, 1130, 10)]
    process.run(10)
    assert scene.only_incident().ended_ns is not None


# Processes


def successor(scene: Scene, pid: int = 101) -> Process:
    return scene.process(pid, minutes=1.0, keep=3)


def test_numbers_go_on_after_a_restart(scene: Scene, process: Process) -> None:
    process.run(30)
    process.keep()
    process.end()
    scene.now += AFTER_S + 1
    after = successor(scene)
    after.begin()
    after.run(10)
    assert numbers(scene.ring) == [4]


def test_an_incident_left_open_is_continued_within_its_minute(scene: Scene, process: Process) -> None:
    process.run(70)
    process.keep()
    process.run(20)
    process.end()
    after = successor(scene)
    after.begin()
    after.run(60)
    info = scene.only_incident()
    assert info.ended_ns is not None
    assert scene.kept(info.name) == [f"{seconds}" for seconds in range(1000, 1130, 10)]


def test_an_incident_left_open_is_ended_after_its_minute(scene: Scene, process: Process) -> None:
    process.run(70)
    process.keep()
    process.die()
    scene.now += AFTER_S + 1
    after = successor(scene)
    after.begin()
    after.run(10)
    info = scene.only_incident()
    assert info.ended_ns is not None
    assert scene.kept(info.name)[-1] == "1060"
    assert texts(scene.ring) == ["1131"]


def test_an_incident_left_open_beyond_its_longest_time_is_ended(scene: Scene, process: Process) -> None:
    process.run(10)
    for _ in range(3):
        process.keep()
        process.run(35)
    process.die()
    scene.now += 20
    assert scene.only_incident().ended_ns is None
    successor(scene).begin()
    assert scene.only_incident().ended_ns is not None


def test_an_end_in_order_leaves_the_incident_to_the_next_process(scene: Scene, process: Process) -> None:
    process.run(10)
    process.keep()
    assert [entry.open for entry in list_incidents(scene.folder).incidents] == [True]
    process.end()
    assert [entry.open for entry in list_incidents(scene.folder).incidents] == [False], "nobody writes it"
    after = successor(scene)
    after.begin()
    after.run(70)
    assert scene.only_incident().ended_ns is not None


def test_a_process_that_dies_again_and_again_makes_no_incident_without_end(scene: Scene, process: Process) -> None:
    process.run(70)
    for pid in range(101, 131):
        process.die()
        process = successor(scene, pid)
        assert process.begin() == [pid - 1]
        process.keep("gateway_died", died=True)
        process.run(20)
    process.run(70)
    for info in scene.folder.infos():
        assert info.ended_ns is not None
        assert (info.ended_ns - info.began_ns) / 1e9 <= process.spool.longest_s
    bounds_hold(scene, process, 3, 100_000, 100_000)


def test_of_several_incidents_left_open_all_but_the_newest_are_ended(scene: Scene, process: Process) -> None:
    process.run(20)
    second = successor(scene, 102)
    second.begin()
    process.keep("first")
    scene.now += 1
    second.keep("second")
    second.say("x")
    last = successor(scene, 104)
    last.begin()
    assert [info.ended_ns is None for info in scene.folder.infos()] == [False, True]


LAST_WORDS = payloads.encode(Status(state="offline", protocol="tcpudp"))


@pytest.mark.parametrize("pid", [101, 100], ids=["another id", "the same id"])
@pytest.mark.parametrize("reboots", [False, True])
def test_after_a_death_hours_ago_its_last_minutes_and_last_words_are_kept(
    scene: Scene, process: Process, pid: int, reboots: bool
) -> None:
    process.run(200)
    process.write(process.record(LAST_WORDS, "status"), process.record("last words"))
    process.die()
    scene.now += 5 * 3600
    if reboots:
        scene.boot, scene.booted = "another boot", scene.now - 30
    after = successor(scene, pid)
    assert after.begin() == [100]
    after.write(NextSegment([after.record(STATUS, "status")]), after.record("first words"))
    after.keep("gateway_died", frame=[after.record(STATUS, "status")], died=True)
    info = scene.only_incident()
    assert scene.kept(info.name) == [*(f"{second}" for second in range(1140, 1200, 10)), "last words", "first words"]
    assert info.frame["status"]["state"] == "offline"
    assert (info.frame["pid"], info.frame["versions"]) == (100, {"zbridge": "of 100"})


@pytest.mark.parametrize("reboots", [False, True])
def test_segments_of_hours_ago_do_not_belong_to_another_cause(scene: Scene, process: Process, reboots: bool) -> None:
    process.run(100)
    process.end()
    scene.now += 5 * 3600
    if reboots:
        scene.boot, scene.booted = "another boot", scene.now - 1000
    after = successor(scene)
    after.begin()
    after.run(20)
    after.keep("deadman")
    assert scene.kept(scene.only_incident().name) == ["19100", "19110"]


def test_two_processes_that_hand_over_overwrite_nothing_of_each_other(scene: Scene, process: Process) -> None:
    process.run(20)
    after = successor(scene)
    assert after.begin() == []
    for number in range(3):
        for each in (process, after):
            each.write(NextSegment([each.record(f"{each.pid} {number}")]))
    assert len(scene.ring) == 8 - 1
    assert texts(scene.ring)[-6:] == [f"{pid} {number}" for number in range(3) for pid in (100, 101)]
    process.say("100 end")
    process.end()
    after.run(10)
    assert "100 end" in texts(scene.ring)
    assert (process.spool.error, after.spool.error) == (None, None)


def test_an_incident_during_a_handover_keeps_the_segments_of_both(scene: Scene, process: Process) -> None:
    process.run(20)
    after = successor(scene)
    after.begin()
    process.write(NextSegment([process.record("old")]))
    after.write(NextSegment([after.record("new")]))
    after.keep()
    process.say("old goes on")
    process.end()
    after.run(20)
    assert scene.kept(scene.only_incident().name) == ["1000", "1010", "old", "old goes on", "new", "1020", "1030"]


def test_a_segment_that_the_other_process_deleted_keeps_no_others_from_being_kept(
    scene: Scene, process: Process, monkeypatch: pytest.MonkeyPatch
) -> None:
    process.run(50)
    rename, gone = Path.rename, scene.ring[1]

    def late(path: Path, target: Path) -> Path:
        if path == gone:
            gone.unlink()
        return rename(path, target)

    monkeypatch.setattr(Path, "rename", late)
    process.keep()
    assert process.spool.error is None
    assert scene.kept(scene.only_incident().name) == ["1000", "1020", "1030", "1040"]


def test_an_incident_whose_description_is_damaged_costs_the_next_process_nothing(
    scene: Scene, process: Process
) -> None:
    process.run(20)
    process.keep()
    process.die()
    (scene.folder.incidents / scene.names[0] / INFO).write_bytes(b"\x00")
    after = successor(scene)
    assert after.begin() == [100]
    after.run(20)
    after.keep("robot_lost")
    assert len(scene.names) == 1


def test_damaged_segments_of_the_ring_are_kept_as_they_are(scene: Scene, process: Process) -> None:
    process.run(40)
    for path in scene.ring[:2]:
        path.write_bytes(os.urandom(100))
    process.keep()
    info = scene.only_incident()
    assert len(segments_of(scene.folder.incidents / info.name)) == 4
    assert scene.kept(info.name) == ["1020", "1030"]
