"""Latched stops on disk: whole at any moment, and latched where nobody knows what stood there."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import msgpack
import pytest

from zbridge.control.faults import OpenFaults
from zbridge.control.latch import Latches, LatchRecord
from zbridge.control.latch_store import MOST_BYTES, LatchStore, state_folder
from zbridge.fleet.messages import Latch
from zbridge.fleet.topics import KeySpace

KEYS = KeySpace("fleet", "r1")
ANN = Latch(b"a" * 16, "ann", "wet floor")
BOB = Latch(b"b" * 16, "bob", None, True)


def store(folder: Path, open_faults: OpenFaults | None = None) -> LatchStore:
    return LatchStore(KEYS, open_faults or OpenFaults(), folder)


def latches(*those: Latch) -> Latches:
    made = Latches()
    for latch in those:
        made.add(latch)
    return made


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "state" / "zbridge"


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({"STATE_DIRECTORY": "/var/lib/zbridge", "XDG_STATE_HOME": "/x", "HOME": "/h"}, "/var/lib/zbridge"),
        ({"STATE_DIRECTORY": "/var/lib/a:/var/lib/b"}, "/var/lib/a"),
        ({"XDG_STATE_HOME": "/x", "HOME": "/h"}, "/x/zbridge"),
        ({"XDG_STATE_HOME": "", "HOME": "/h"}, "/h/.local/state/zbridge"),
        ({}, "/.local/state/zbridge"),
    ],
)
def test_the_folder_is_the_services_else_the_users(environment: dict[str, str], expected: str) -> None:
    assert state_folder(environment) == Path(expected)


async def test_what_is_in_force_and_what_was_released_survives(folder: Path) -> None:
    made, kept = latches(ANN, BOB), store(folder)
    made.add(Latch(b"c" * 16))
    made.release(b"c" * 16, fleet=False)
    kept.save(made)
    await kept.flush()
    again = store(folder).load()
    assert again.in_force == (ANN, BOB)
    assert not again.add(Latch(b"c" * 16))
    (file,) = folder.iterdir()
    assert file.name == "fleet@r1.latches"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700


async def test_a_robot_that_was_never_latched_leaves_no_file(folder: Path) -> None:
    kept = store(folder)
    kept.save(kept.load())
    await kept.flush()
    assert not folder.exists()


@pytest.mark.parametrize("content", [b"", b"\xc1", b"\x80\x80", b"x" * (MOST_BYTES + 1), b"\x81\xa7latches\x01"])
async def test_what_cannot_be_read_means_latched_until_that_is_released(folder: Path, content: bytes) -> None:
    folder.mkdir(parents=True)
    (folder / "fleet@r1.latches").write_bytes(content)
    kept = store(folder)
    (latch,) = (found := kept.load()).in_force
    assert latch.who == "gateway"
    assert "cannot be read" in (latch.reason or "")
    assert not kept.known, "a gateway that waits tells the owner what it knows, not what it cannot read"
    found.release(latch.id, fleet=False)
    kept.save(found)
    await kept.flush()
    assert not store(folder).load()


async def test_a_file_that_is_a_folder_cannot_be_read_either(folder: Path) -> None:
    (folder / "fleet@r1.latches").mkdir(parents=True)
    assert store(folder).load()


async def test_what_cannot_be_written_is_said_and_tried_again(tmp_path: Path) -> None:
    in_the_way = tmp_path / "zbridge"
    in_the_way.write_text("no folder")
    open_faults, made = OpenFaults(), latches(ANN)
    kept = store(in_the_way, open_faults)
    kept.save(made)
    await kept.flush()
    (text,) = open_faults.texts
    assert text.startswith(f"latched stops do not survive a restart: {in_the_way}")
    in_the_way.unlink()
    kept.save(made)
    await kept.flush()
    assert open_faults.texts == ()
    assert store(in_the_way).load().in_force == (ANN,)


async def test_of_several_changes_the_newest_counts_and_no_other_file_is_left(folder: Path) -> None:
    kept, made = store(folder), Latches()
    for number in range(10):
        made.add(Latch(bytes([number]) * 16))
        kept.save(made)
    await kept.flush()
    assert store(folder).load().in_force == made.in_force
    assert [file.name for file in folder.iterdir()] == ["fleet@r1.latches"]


async def test_a_gateway_that_waits_keeps_what_the_other_one_says_beside_the_file_of_the_owner(folder: Path) -> None:
    owner, waiting = store(folder), store(folder)
    owner.save(latches(ANN))
    await owner.flush()
    waiting.mirror(LatchRecord((ANN, BOB)))
    await waiting.flush()
    waiting.mirror(LatchRecord((BOB,)))
    await waiting.flush()
    taken = waiting.load()
    assert set(taken.in_force) == {ANN, BOB}
    taken.release(BOB.id, fleet=True)
    waiting.save(taken)
    await waiting.flush()
    assert store(folder).load().in_force == (ANN,), "what it waited with is in the owner's file from now on"


async def test_that_the_robot_was_told_to_move_by_itself_is_kept_whoever_wrote_it_down(folder: Path) -> None:
    owner, waiting = store(folder), store(folder)
    assert not owner.load().autonomous
    assert not owner.known.autonomous
    waiting.mirror(LatchRecord(autonomous=True))
    waiting.mirror(LatchRecord((BOB,)))  # of a gateway that does not know of it
    await waiting.flush()
    assert waiting.known.autonomous
    taken = owner.load()
    assert (taken.autonomous, owner.known.autonomous, taken.in_force) == (True, True, (BOB,))
    taken.release(BOB.id, fleet=True)
    owner.save(taken)
    await owner.flush()
    again = store(folder)
    assert again.load().autonomous
    assert again.known.autonomous


async def test_a_file_of_an_earlier_version_says_nothing_of_motion_by_itself(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "fleet@r1.latches").write_bytes(msgpack.packb({"latches": [], "released": [], "released_fleet": []}))
    assert not store(folder).load().autonomous


async def test_names_of_other_robots_and_realms_never_meet(folder: Path) -> None:
    for number, keys in enumerate((KeySpace("a.b", "c"), KeySpace("a", "b.c"), KeySpace("..", ".."))):
        kept = LatchStore(keys, OpenFaults(), folder)
        assert not kept.load()
        kept.save(latches(Latch(bytes([number]) * 16)))
        await kept.flush()
    assert len(list(folder.iterdir())) == 3
    assert os.listdir(folder.parent) == [folder.name]
