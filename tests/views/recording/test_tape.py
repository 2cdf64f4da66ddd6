"""The files of a recording: blocks on the disk, splitting, and a disk that is full."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from tests.views.recording import files
from zbridge.views.recording import tape as written
from zbridge.views.recording.contents import channel_of
from zbridge.views.recording.reader import RecordingReader
from zbridge.views.recording.tape import CHUNK_S, Tape, TapeSettings

KEY = "fleet/r1/scan"
NOISE = [os.urandom(200_000) for _ in range(10)]


def begun(path: Path, **settings: object) -> tuple[Tape, int]:
    tape = Tape(TapeSettings(path, **settings))  # type: ignore[arg-type]
    tape.begin(0.0, {"zbridge": {"version": "1"}})
    channel = tape.register(channel_of(KEY))
    assert channel is not None
    return tape, channel


def put(tape: Tape, channel: int, number: int, data: bytes = b"\x80") -> None:
    tape.write(KEY, channel, files.BEGAN_NS + number, files.BEGAN_NS - number, number, data)


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_the_library_reads_back_what_was_written(tmp_path: Path, compression: str) -> None:
    tape, channel = begun(tmp_path / "a.mcap", compression=compression)
    for number in range(3):
        put(tape, channel, number, bytes([number]))
    tape.close()
    expected = [(KEY, files.BEGAN_NS + n, files.BEGAN_NS - n, bytes([n])) for n in range(3)]
    assert files.read(tmp_path / "a.mcap") == expected


def test_a_message_is_on_the_disk_after_a_second(tmp_path: Path) -> None:
    tape, channel = begun(tmp_path / "a.mcap")
    put(tape, channel, 1)
    tape.keep_time(CHUNK_S - 0.1)
    assert messages(tmp_path / "a.mcap") == 0
    tape.keep_time(CHUNK_S)
    assert messages(tmp_path / "a.mcap") == 1


def test_a_full_chunk_is_on_the_disk_at_once(tmp_path: Path) -> None:
    tape, channel = begun(tmp_path / "a.mcap")
    for number in range(8):
        put(tape, channel, number, NOISE[number])
    tape.keep_time(0.01)
    assert messages(tmp_path / "a.mcap") == 8


def messages(path: Path) -> int:
    with path.open("rb") as file:
        return len(list(RecordingReader(file).messages()))


class Disk:
    """Stands in for ``os.write``: has room for so many bytes."""

    def __init__(self, room: int) -> None:
        self.room = room
        self._write = os.write

    def __call__(self, descriptor: int, data: memoryview) -> int:
        if self.room <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        done = self._write(descriptor, data[: self.room])
        self.room -= done
        return done


def test_a_full_disk_leaves_a_file_that_ends_properly_and_counts_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tape, channel = begun(tmp_path / "a.mcap")
    disk = Disk(900_000)
    monkeypatch.setattr(written.os, "write", disk)
    for number in range(4):
        put(tape, channel, number, NOISE[number])
        tape.keep_time(number + 1.0)
    put(tape, channel, 4, NOISE[4])
    with pytest.raises(OSError, match="No space"):
        tape.keep_time(5.0)
    size = (tmp_path / "a.mcap").stat().st_size
    monkeypatch.setattr(written.os, "ftruncate", lambda descriptor, to: _freeing(disk, descriptor, size, to))
    assert tape.salvage()
    kept = files.read(tmp_path / "a.mcap")
    assert (len(kept), dict(tape.unwritten)) == (4, {KEY: 1})


def _freeing(disk: Disk, descriptor: int, size: int, to: int, truncate=os.ftruncate) -> None:  # type: ignore[no-untyped-def]
    truncate(descriptor, to)
    disk.room += size - to


def test_a_disk_without_room_for_the_end_gives_back_the_last_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tape, channel = begun(tmp_path / "a.mcap")
    for number in range(3):
        put(tape, channel, number, NOISE[number])
        tape.keep_time(number + 1.0)
    disk = Disk(0)
    monkeypatch.setattr(written.os, "write", disk)
    size = (tmp_path / "a.mcap").stat().st_size
    monkeypatch.setattr(written.os, "ftruncate", lambda descriptor, to: _freeing(disk, descriptor, size, to))
    assert tape.salvage()
    assert len(files.read(tmp_path / "a.mcap")) == 2
    assert dict(tape.unwritten) == {KEY: 1}


def test_a_split_recording_keeps_its_last_files_and_each_stands_for_itself(tmp_path: Path) -> None:
    tape, _ = begun(tmp_path / "a.mcap", split_s=10.0, keep=2)
    for number in range(4):
        channel = tape.register(channel_of(KEY))
        assert channel is not None
        put(tape, channel, number)
        assert tape.full(10.0 * number + 10.0)
        if number < 3:
            tape.begin(10.0 * (number + 1), {})
    tape.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a-0003.mcap", "a-0004.mcap"]
    assert [len(files.read(path)) for path in sorted(tmp_path.iterdir())] == [1, 1]


def test_a_file_splits_by_size(tmp_path: Path) -> None:
    tape, channel = begun(tmp_path / "a.mcap", split_bytes=1_000_000)
    assert not tape.full(99.0)
    for number in range(8):
        put(tape, channel, number, NOISE[number])
    assert tape.full(99.0)


def test_an_index_that_grows_too_large_begins_another_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(written, "INDEX_ENTRIES", 10)
    tape, channel = begun(tmp_path / "a.mcap")
    for number in range(6):
        put(tape, channel, number)
        tape.keep_time(2.0 * number)
    assert tape.full(12.0)


def test_a_file_that_exists_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("mine")
    with pytest.raises(FileExistsError):
        begun(tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_text() == "mine"


def test_more_channels_than_a_file_may_have_are_not_registered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(written, "CHANNELS", 2)
    tape, _ = begun(tmp_path / "a.mcap")
    assert tape.register(channel_of("fleet/r1/pose")) is not None
    assert tape.register(channel_of("fleet/r1/map")) is None
