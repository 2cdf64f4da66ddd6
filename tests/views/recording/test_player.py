"""When messages of a replay are due, and the stamps they get."""

from __future__ import annotations

import threading
from pathlib import Path

import msgpack
import pytest

from tests.views.recording import files
from zbridge.fleet.payload import with_stamp
from zbridge.views.recording.player import PlaybackClock, Player
from zbridge.views.recording.selection import Selection

S_NS = files.S_NS


@pytest.mark.parametrize(("speed", "expected"), [(1.0, 3.0), (2.0, 1.5), (0.5, 6.0)])
def test_a_moment_is_due_as_the_speed_says(speed: float, expected: float) -> None:
    clock = PlaybackClock(0, 2**64)
    clock.play(speed, 9.0)
    clock.seek(5 * S_NS, 10.0)
    assert clock.wait_s(8 * S_NS, 10.0) == expected


def test_a_pause_moves_what_follows_by_its_length() -> None:
    clock = PlaybackClock(0, 2**64)
    clock.play(1.0, 10.0)
    clock.pause(11.0)
    clock.pause(12.0)
    assert not clock.playing
    clock.play(1.0, 14.0)
    clock.play(1.0, 15.0)
    assert (clock.wait_s(2 * S_NS, 15.0), clock.playing) == (0.0, True)


class Clock:
    """A clock that sleeps at once, and what was played at which time."""

    def __init__(self) -> None:
        self.now = 100.0
        self.played: list[tuple[float, bytes]] = []
        self.skipped: list[bytes] = []
        self.ended: list[str | None] = []
        self._over = threading.Event()

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def end(self, fault: str | None) -> None:
        self.ended.append(fault)
        self._over.set()

    def play(self, path: Path, selection: Selection | None = None, *, most: int = 10**6, **options: object) -> None:
        def note(message, selected):  # type: ignore[no-untyped-def]
            if not selected:
                self.skipped.append(message.data)
                return
            self.played.append((round(self.now - 100.0, 6), message.data))
            if len(self.played) >= most:
                player._closing = True

        player = Player(
            *(path, selection or Selection(), note, self.end),
            clock=lambda: self.now,
            sleep=self.sleep,
            **options,  # type: ignore[arg-type]
        )
        player.start()
        assert self._over.wait(10.0)
        player.close()


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return files.written(tmp_path / "a.mcap", [("fleet/r1/pose", n / 2, bytes([n])) for n in range(5)])


def test_messages_are_played_when_they_are_due(recording: Path) -> None:
    clock = Clock()
    clock.play(recording, speed=2.0)
    assert clock.played == [(n / 4, bytes([n])) for n in range(5)]
    assert clock.ended == [None]


def test_only_the_selected_part_is_played_and_what_stands_before_it_is_shown(recording: Path) -> None:
    clock = Clock()
    clock.play(recording, Selection(since_ns=files.BEGAN_NS + S_NS, until_ns=files.BEGAN_NS + 2 * S_NS))
    assert clock.played == [(0.0, b"\x02"), (0.5, b"\x03")]
    assert clock.skipped == [b"\x00", b"\x01"]


def test_a_loop_begins_anew_at_the_end(recording: Path) -> None:
    clock = Clock()
    clock.play(recording, loop=True, most=12)
    assert [data[0] for _, data in clock.played] == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0, 1]


def test_a_loop_over_nothing_ends(recording: Path) -> None:
    clock = Clock()
    clock.play(recording, Selection(since_ns=2**63), loop=True)
    assert (clock.played, clock.ended) == ([], [None])


def test_a_file_that_is_cut_off_is_played_to_the_cut_and_says_so(recording: Path) -> None:
    whole = recording.read_bytes()
    recording.write_bytes(whole[: len(whole) // 4])
    clock = Clock()
    clock.play(recording)
    assert (clock.ended[0] or "").startswith("cut off")


def test_a_message_from_before_the_last_one_is_due_at_once(tmp_path: Path) -> None:
    path = files.written(tmp_path / "a.mcap", [("k/r/pose", at, b"\x80") for at in (0.0, 3.0, 1.0, 3.5)])
    clock = Clock()
    clock.play(path)
    assert [at for at, _ in clock.played] == [0.0, 3.0, 3.0, 3.5]


def test_a_stamp_is_moved_and_all_else_stays() -> None:
    ours = b"\x83\xa8stamp_ns\xcf" + bytes(8) + b"\xa1x\x01\xa1y\x02"
    assert with_stamp(ours, 258) == b"\x83\xa8stamp_ns\xcf" + bytes(6) + b"\x01\x02" + b"\xa1x\x01\xa1y\x02"
    others = files.packed(x=1, stamp_ns=5, ranges=b"ab")
    assert msgpack.unpackb(with_stamp(others, 258)) == {"x": 1, "stamp_ns": 258, "ranges": b"ab"}


@pytest.mark.parametrize(
    "payload", [b"", b"\xc1", files.packed(x=1), b"\x81\xa8stamp_ns", files.packed(text="stamp_ns")]
)
def test_what_has_no_stamp_stays_as_it_is(payload: bytes) -> None:
    assert with_stamp(payload, 258) == payload
