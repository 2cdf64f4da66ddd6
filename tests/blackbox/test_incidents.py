"""The files of a robot's black box: names, descriptions that are damaged, processes that live and die."""

from __future__ import annotations

import os

import pytest

from tests.blackbox.scene import EPOCH_NS, Scene, scene, segment
from zbridge.blackbox.incidents import (
    CAUSES,
    INFO,
    BoxFolder,
    IncidentCause,
    IncidentInfo,
    boxes,
    head_of,
    is_incident_name,
    segments_of,
)
from zbridge.blackbox.reading import list_incidents
from zbridge.fleet import payload as payloads

__all__ = ["scene"]
CAUSE = IncidentCause("deadman", "no command", EPOCH_NS)


def described(folder: BoxFolder, name: str = "one", number: int = 1) -> IncidentInfo:
    """Make an incident without segments."""
    folder.make()
    info = IncidentInfo(name, "fleet", "r1", number, (CAUSE,), frame={"host": "h"})
    (folder.incidents / name).mkdir()
    folder.write_info(info)
    return info


@pytest.mark.parametrize("name", ["20260101T000000Z-r1-deadman-2", "a", "..a", "A_b.c-d"])
def test_a_name_without_slashes_may_be_an_incident(name: str) -> None:
    assert is_incident_name(name)


@pytest.mark.parametrize(
    "name", ["", ".", "..", "...", "a/b", "/", "/etc/passwd", "../../etc/passwd", "a\n", "a\0", "ä", "a b", "*", "%2e"]
)
def test_what_could_be_a_path_is_no_incident(name: str) -> None:
    assert not is_incident_name(name)


def test_a_description_is_read_as_it_was_written_and_replaced_as_a_whole(scene: Scene) -> None:
    info = described(scene.folder)
    assert scene.folder.info("one") == info
    joined = info.joined(IncidentCause("robot_lost", "closed", EPOCH_NS + 1))
    scene.folder.write_info(joined, fsync=True)
    assert scene.folder.info("one") == joined
    assert os.listdir(scene.folder.incidents / "one") == [INFO]


def test_causes_beyond_the_bound_are_counted() -> None:
    info = IncidentInfo("one", "fleet", "r1", 1, (CAUSE,))
    for _ in range(CAUSES + 9):
        info = info.joined(CAUSE)
    assert (len(info.causes), info.more) == (CAUSES, 10)


def test_a_description_that_was_cut_off_or_damaged_is_none_and_never_an_error(scene: Scene) -> None:
    described(scene.folder)
    path = scene.folder.incidents / "one" / INFO
    data = path.read_bytes()
    for position in range(len(data)):
        for byte in (None, b"9"):
            path.write_bytes(data[:position] + (byte + data[position + 1 :] if byte else b""))
            payloads.encode(list_incidents(scene.folder))
    path.write_bytes(data[: len(data) // 2])
    assert scene.folder.infos() == []
    assert scene.folder.surplus(0) == ["one"], "it is deleted as the others"


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        "[]",
        "[" * 100_000,
        '{"name": "one", "realm": "fleet", "robot": "r1", "number": 1, "causes": []}',
        '{"name": "one", "realm": "f", "robot": "r", "number": 1, "causes": [{"code": "", "text": "", "at_ns": 1e9}]}',
    ],
)
def test_a_description_with_another_content_is_none(scene: Scene, text: str) -> None:
    described(scene.folder)
    (scene.folder.incidents / "one" / INFO).write_text(text)
    assert scene.folder.info("one") is None


def test_the_name_of_an_incident_is_that_of_its_folder(scene: Scene) -> None:
    described(scene.folder)
    (scene.folder.incidents / "one").rename(scene.folder.incidents / "two")
    assert scene.names == ["two"]


def test_the_oldest_and_the_damaged_ones_are_surplus(scene: Scene) -> None:
    for number, name in enumerate(["c", "a", "b"], 1):
        described(scene.folder, name, number)
    (scene.folder.incidents / "z").mkdir()
    assert [scene.folder.surplus(keep) for keep in (5, 4, 3, 1)] == [[], [], ["z"], ["z", "c", "a"]]


def test_only_segments_are_segments_and_the_newest_number_counts_wherever_it_is(scene: Scene) -> None:
    described(scene.folder)
    for name in ("0000000002.zbb", "0000000010.zbb", "1.zbb", "0000000011.zbb.tmp", "00000000012.zbb", "x"):
        (scene.folder.ring / name).write_bytes(b"")
    assert [path.name for path in scene.ring] == ["0000000002.zbb", "0000000010.zbb"]
    assert scene.folder.last_number() == 10
    (scene.folder.incidents / "one" / "0000000044.zbb").write_bytes(b"")
    assert scene.folder.last_number() == 44
    assert [path.name for path in scene.folder.parts("one")] == [INFO, "0000000044.zbb"]
    assert segments_of(scene.path / "none") == []


def test_the_head_of_a_segment_that_is_damaged_or_gone_is_none(scene: Scene) -> None:
    path = scene.path / "0000000001.zbb"
    assert head_of(path) is None
    path.write_bytes(segment()[:-1])
    assert head_of(path) is None
    path.write_bytes(segment())
    assert head_of(path) is not None


def test_all_robots_of_a_folder_are_found(scene: Scene) -> None:
    assert list(boxes(scene.path / "none")) == []
    for name in ("fleet@r1", "fleet@r2", "stray"):
        (scene.path / name).mkdir()
    (scene.path / "a@file").write_text("")
    assert [(box.realm, box.robot) for box in boxes(scene.path)] == [("fleet", "r1"), ("fleet", "r2")]


def test_nobody_else_may_read_commands_and_configurations(scene: Scene) -> None:
    process = scene.process()
    process.begin()
    process.run(20)
    process.keep()
    for path in scene.folder.path.rglob("*"):
        assert path.stat().st_mode & 0o077 == 0, path
    process.end()


# Processes


def test_a_process_that_died_is_found_exactly_once(scene: Scene) -> None:
    first = scene.process(100)
    assert first.begin() == []
    first.die()
    second = scene.process(101)
    assert second.begin() == [100]
    second.end()
    third = scene.process(102)
    assert third.begin() == []
    third.end()


def test_a_process_that_died_is_found_by_one_with_the_same_id(scene: Scene) -> None:
    first, second = scene.process(1), scene.process(1)
    first.begin()
    first.die()
    assert second.begin() == [1]
    second.end()
    assert list(scene.folder.live.iterdir()) == []


def test_a_process_that_ended_in_order_is_not_found(scene: Scene) -> None:
    first, second = scene.process(100), scene.process(101)
    first.begin()
    first.end()
    assert second.begin() == []
    second.end()


def test_a_process_that_lives_is_not_found_until_it_dies(scene: Scene) -> None:
    first, second, third = (scene.process(pid) for pid in (100, 101, 102))
    first.begin()
    assert second.begin() == []
    first.die()
    assert third.begin() == [100]
    second.end()
    third.end()


def test_what_else_lies_among_the_live_files_is_no_process(scene: Scene) -> None:
    scene.folder.make()
    (scene.folder.live / "notes").write_text("")
    (scene.folder.live / "4711").write_text("")
    (scene.folder.live / "4712").mkdir()
    process = scene.process()
    assert process.begin() == [4711]
    process.end()
