"""What ``zbridge info`` counts."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.views.recording import files
from zbridge.errors import ConfigError
from zbridge.views.recording.contents import describe_configuration
from zbridge.views.recording.summary import summarize


def test_counts_rates_gaps_and_duration_of_each_key(tmp_path: Path) -> None:
    times = [number / 10 for number in range(50)] + [10 + number / 10 for number in range(50)]
    messages = [("fleet/r1/pose", seconds, b"\x80") for seconds in times] + [("fleet/r2/text", 15.0, b"\x80")]
    summary = summarize(files.written(tmp_path / "a.mcap", messages))
    pose, text = summary.keys
    assert (pose.topic, pose.count, pose.bytes, pose.gaps) == ("fleet/r1/pose", 100, 100, 1)
    assert pose.gap_s == pytest.approx(5.1)
    assert pose.rate_hz == pytest.approx(99 / 14.9)
    assert (text.count, text.rate_hz, text.gaps) == (1, 0.0, 0)
    assert (summary.robots, summary.messages, summary.fault) == (["r1", "r2"], 101, None)
    assert summary.duration_s == pytest.approx(15.0)


def test_a_file_that_was_cut_off_says_so(tmp_path: Path) -> None:
    path = files.written(tmp_path / "a.mcap", [("fleet/r1/pose", number / 10, b"\x80" * 200) for number in range(50)])
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    summary = summarize(path)
    assert 0 < summary.messages < 50
    assert (summary.fault or "").startswith("cut off")


def test_a_file_that_is_not_there_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        summarize(tmp_path / "none.mcap")


def test_a_configuration_is_kept_without_its_secrets(tmp_path: Path) -> None:
    (tmp_path / "r1.toml").write_text(
        '[robot]\nname = "r1"\n[device]\nconnect = ["tcp://10.0.0.1:1"]\n[device.options]\npassword = "hidden1"\n'
        'gap_s = 0.01\nurl = "http://me:hidden2@cam/x?size=4&token=hidden5"\nfrom_environment = "${SECRET}"\n'
        '[bus]\ntls = { ca = "hidden3", key = "hidden4" }\n'
    )
    kept = describe_configuration(tmp_path / "r1.toml")["configuration"]
    assert "hidden" not in kept
    assert all(part in kept for part in ("tcp://10.0.0.1:1", "0.01", "${SECRET}", "http://***@cam/x?size=4&token=***"))
