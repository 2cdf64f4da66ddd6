"""Tables and arrays made of a recording."""

from __future__ import annotations

import csv
import struct
from pathlib import Path

import numpy as np
import pytest

from tests.views.recording import files
from zbridge.errors import ConfigError
from zbridge.fleet.topics import matches
from zbridge.views.recording import export
from zbridge.views.recording.export import export_arrays, export_tables
from zbridge.views.recording.selection import Selection

SCAN = {"angle_min": -1.0, "angle_increment": 0.5, "range_min": 0.1, "range_max": 8.0}


def scan(*ranges: float) -> bytes:
    return files.packed(**SCAN, ranges=struct.pack(f"<{len(ranges)}f", *ranges))


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    poses = [("fleet/r1/pose", n / 10, files.packed(x=float(n), y=-1.0, heading=0.5)) for n in range(20)]
    others = [
        ("fleet/r1/scan", 2.0, scan(1.0, float("nan"))),
        ("fleet/r1/scan", 2.1, scan(1.0, 2.0, 3.0)),
        ("fleet/r1/@wire/robot/in", 2.2, b"\x01\x02"),
        ("fleet/r1/pose", 2.3, b"\xc1"),
        ("../../evil", 2.4, b"\x80"),
    ]
    return files.written(tmp_path / "a.mcap", poses + others)


def test_each_key_has_a_table_with_times_and_fields(recording: Path, tmp_path: Path) -> None:
    done = export_tables(recording, tmp_path / "out", Selection())
    assert (done.files, done.messages, done.skipped, done.fault) == (4, 24, 1, None)
    with (tmp_path / "out" / "fleet" / "r1" / "pose.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(row["log_ns"]) - files.BEGAN_NS for row in rows[:2]] == [0, 100_000_000]
    assert [float(row["x"]) for row in rows] == [float(n) for n in range(20)]
    assert (tmp_path / "out" / "fleet" / "r1" / "@wire" / "robot" / "in.csv").read_text().endswith(",0102\n")
    outside = [path for path in tmp_path.rglob("*") if path.is_file() and tmp_path / "out" not in path.parents]
    assert outside == [recording]


def test_arrays_have_scans_filled_with_nan_and_poses(recording: Path, tmp_path: Path) -> None:
    export_arrays(recording, tmp_path / "a.npz", Selection())
    arrays = np.load(tmp_path / "a.npz")
    assert arrays["r1/pose/x"].tolist() == [float(n) for n in range(20)]
    np.testing.assert_array_equal(arrays["r1/scan/ranges"], np.float32([[1, np.nan, np.nan], [1, 2, 3]]))
    assert arrays["r1/scan/stamp_ns"].tolist() == [files.BEGAN_NS + 2 * files.S_NS, files.BEGAN_NS + 2_100_000_000]


def test_keys_and_times_choose_what_is_written(recording: Path, tmp_path: Path) -> None:
    chosen = Selection("fleet/*/pose", files.BEGAN_NS + 500_000_000, files.BEGAN_NS + 1_000_000_000)
    assert export_tables(recording, tmp_path / "out", chosen).messages == 5


def test_more_tables_than_a_folder_should_hold_are_refused(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "TABLES", 3)
    with pytest.raises(ConfigError, match="more than 3 keys: choose some by --keys"):
        export_tables(recording, tmp_path / "out", Selection())
    assert export_tables(recording, tmp_path / "fewer", Selection("fleet/r1/*")).files == 2


def test_more_than_memory_should_hold_is_refused(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export, "ARRAY_BYTES", 500)
    with pytest.raises(ConfigError, match="--from"):
        export_arrays(recording, tmp_path / "a.npz", Selection())


def test_a_table_is_not_written_over(recording: Path, tmp_path: Path) -> None:
    export_tables(recording, tmp_path / "out", Selection())
    with pytest.raises(ConfigError, match="exists"):
        export_tables(recording, tmp_path / "out", Selection())


EXPRESSIONS = [
    ("fleet/**", "fleet/r1/pose", True),
    ("fleet/**", "fleet", True),
    ("fleet/**", "fleet/r1/@cmd/drive", False),
    ("fleet/*/@cmd/**", "fleet/r1/@cmd/drive", True),
    ("fleet/*", "fleet/r1/pose", False),
    ("**/pose", "fleet/r1/pose", True),
    ("fleet/r1/pose", "fleet/r1/poses", False),
    ("**/**/**/**/x", "a/b/c/d/e/f/g/h/i", False),
]


@pytest.mark.parametrize(("expression", "key", "expected"), EXPRESSIONS)
def test_key_expressions_match_as_on_the_bus(expression: str, key: str, expected: bool) -> None:
    assert matches(expression, key) is expected
