"""What ``zbridge record`` and ``zbridge replay`` refuse before they touch the bus, with the option."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import AsyncIterator, Coroutine
from pathlib import Path
from typing import Any

import pytest

from tests.fake_bus import FakeBus
from tests.views.recording import files
from zbridge.bus import BusSettings
from zbridge.cli.recording import RecordOptions, ReplayOptions, run_record, run_replay, run_wire, show_info
from zbridge.cli.terminal import Column, Table
from zbridge.errors import ConfigError
from zbridge.fleet import topics

NOWHERE = BusSettings(connect=("tcp/127.0.0.1:1",), multicast=False)
RECORD: dict[str, Any] = {
    "robots": (), "keys": "", "only": "", "wire": False, "split": "", "keep": 0, "duration": "",
    "compression": "zstd", "config": (), "buffer": "64MiB", "realm": "fleet",
}  # fmt: skip
REPLAY: dict[str, Any] = {
    "realm": "fleet", "robots": (), "speed": 1.0, "loop": False, "since": "", "until": "", "pause": False, "hq": (),
}  # fmt: skip
REFUSED = [
    ({"only": "x"}, "only = 'x'"),
    ({"split": "1 parsec"}, "split = '1 parsec'"),
    ({"keep": 3}, "keep: needs --split"),
    ({"compression": "rar"}, "compression = 'rar'"),
    ({"duration": "long"}, "duration = 'long'"),
    ({"buffer": "1kB"}, "'1kB'"),
    ({"realm": "a/b"}, "realm = 'a/b'"),
    ({"keys": "fleet/r1/pose*"}, r"keys = 'fleet/r1/pose\*': `\*` may only be preceded by"),
    ({"keys": "/fleet/**"}, r"keys = '/fleet/\*\*': .*: try 'fleet/\*\*'"),
    ({"config": (Path("/none.toml"),)}, "none.toml"),
]


@pytest.mark.parametrize(("given", "why"), REFUSED)
async def test_a_recording_with_a_wrong_option_is_refused(tmp_path: Path, given: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        await run_record(NOWHERE, RecordOptions(output=tmp_path / "a.mcap", **{**RECORD, **given}))
    assert not any(tmp_path.glob("*"))  # noqa: ASYNC240


async def test_a_file_that_exists_is_not_written_over(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").touch()
    with pytest.raises(ConfigError, match="exists"):
        await run_record(NOWHERE, RecordOptions(output=tmp_path / "a.mcap", **RECORD))


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"robots": ("x",)}, "give r1=x"),
        ({"since": "noon"}, "from = 'noon'"),
        ({"hq": ("tcpudp:11002",)}, "choose one by --robot"),
        ({"robots": ("r1=x",), "hq": ("tcpudp",)}, "hq = 'tcpudp'"),
    ],
)
async def test_a_replay_with_a_wrong_option_is_refused(tmp_path: Path, given: dict[str, Any], why: str) -> None:
    path = files.written(tmp_path / "a.mcap", [(f"fleet/{robot}/pose", 0.0, b"\x80") for robot in ("r1", "r2")])
    with pytest.raises(ConfigError, match=why):
        await run_replay(NOWHERE, ReplayOptions(file=path, **{**REPLAY, **given}))


@pytest.mark.parametrize(
    ("listen", "robots", "why"),
    [
        (["udp:1"], [], "listen = "),
        (["tcp://127.0.0.1:0", "tcp://127.0.0.1:0"], [], "at most 1 link"),
        (["tcp://127.0.0.1:0"], ["r9"], "the recording has r1"),
        (["tcp://127.0.0.1:0"], [], "no raw frames of link robot; the recording has other"),
    ],
)
async def test_a_robot_that_cannot_be_replayed_is_refused(
    tmp_path: Path, listen: list[str], robots: list[str], why: str
) -> None:
    path = files.written(tmp_path / "a.mcap", [("fleet/r1/@wire/other/in", 0.0, b"x")])
    with pytest.raises(ConfigError, match=why):
        await run_wire(path, "tcpudp", listen, robots, 1.0, "fleet")


@pytest.mark.parametrize(
    ("links", "count", "why"),
    [
        (
            ("drive", "laser"),
            1,
            "listen: the recorded robot has the links drive, laser: give 2 --listen, in this order",
        ),
        (("vehicle",), 2, "listen: the recorded robot has the links vehicle: give one --listen"),
        (("laser",), 2, "as-robot: no raw frames of link drive; the recording has laser"),
        ((), 2, "as-robot: no raw frames of link drive, laser; the recording has none: record it with --wire"),
    ],
)
async def test_a_robot_with_several_links_says_how_many_addresses_it_needs(
    tmp_path: Path, links: tuple[str, ...], count: int, why: str
) -> None:
    frames = [("fleet/r1/pose", 0.0, b"\x80"), *((f"fleet/r1/@wire/{link}/in", 0.0, b"x") for link in links)]
    path = files.written(tmp_path / "a.mcap", frames)
    with pytest.raises(ConfigError) as error:
        await run_wire(path, "alf", count * ["tcp://127.0.0.1:0"], [], 1.0, "fleet")
    assert str(error.value) == why


async def test_a_replay_counts_what_it_plays_and_what_it_leaves_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    told = [
        *((f"fleet/{robot}/pose", 0.0, b"\x80") for robot in ("r1", "r2", "r3")),
        ("fleet/r1/@cmd/drive", 0.1, b"\x80"),
        ("fleet/r1/pose", 0.2, b"\x80"),
    ]
    path = files.written(tmp_path / "a.mcap", told)

    @contextlib.asynccontextmanager
    async def joined(settings: BusSettings, realm: str | None) -> AsyncIterator[FakeBus]:
        yield FakeBus()

    monkeypatch.setattr("zbridge.cli.recording.joined", joined)
    await run_replay(NOWHERE, ReplayOptions(file=path, **{**REPLAY, "robots": ("r1=again",), "speed": 1000.0}))
    assert capsys.readouterr().err.splitlines() == [
        "r1 as again",
        "2 messages played, 3 left out (other robots, commands, queries, raw frames, pictures)",
    ]


async def test_record_and_info_say_the_same_number_of_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bus = FakeBus()

    @contextlib.asynccontextmanager
    async def joined(settings: BusSettings, realm: str | None) -> AsyncIterator[FakeBus]:
        yield bus.join("recorder")

    async def until_signal(work: Coroutine[Any, Any, None]) -> None:
        work.close()
        bus.publisher("fleet/r1/@cmd/drive", topics.CMD_DRIVE).put(b"\x80", b"")

    monkeypatch.setattr("zbridge.cli.recording.joined", joined)
    monkeypatch.setattr("zbridge.cli.recording.until_signal", until_signal)
    path = tmp_path / "a.mcap"
    assert await run_record(NOWHERE, RecordOptions(output=path, **RECORD))
    said = capsys.readouterr().err
    show_info(path, as_json=False)
    assert f"{path}: {path.stat().st_size} bytes, 2 messages\n" in capsys.readouterr().out
    assert re.search(rf"^2 messages in \d+\.\d s, \d+ bytes: {path}; 1 came from the bus$", said, re.MULTILINE), said


def test_information_of_many_keys_takes_a_bounded_time_for_each(capsys: pytest.CaptureFixture[str]) -> None:
    """A table of rich took 2 700 calls for a row of seven cells: 18 s for 20 000 keys."""
    rows, calls = [(f"fleet/r1/sensor/\u4e2d{n}", *map(str, range(n, n + 6))) for n in range(300)], 0

    def count(*_: object) -> None:
        nonlocal calls
        calls += 1

    sys.setprofile(count)
    try:
        Table([Column(""), *6 * [Column("", number=True)]], rows).print()
    finally:
        sys.setprofile(None)
    _, *lines = capsys.readouterr().out.splitlines()
    assert [tuple(line.split()) for line in lines] == rows
    assert calls / len(rows) < 300


def test_information_is_printed_whatever_the_file_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hostile = "fleet/r1/\x1b[2Jpose[red]"
    show_info(files.written(tmp_path / "a.mcap", [(hostile, 0.0, b"\x80")]), as_json=False)
    shown = capsys.readouterr().out
    assert "\x1b" not in shown
    assert "pose[red]" in shown
