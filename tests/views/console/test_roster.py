"""The robots that were ever there: kept, bounded, and never read from what is no roster."""

from __future__ import annotations

from pathlib import Path

import pytest

from zbridge.errors import ConfigError
from zbridge.views.console.roster import MOST_BYTES, ROBOTS, Roster


def test_what_was_there_is_known_after_a_restart_until_it_is_forgotten(tmp_path: Path) -> None:
    file = tmp_path / "new" / "fleet.roster"
    first = Roster(file)
    first.load()
    first.add(["r2", "r1"])
    first.save()
    assert file.read_text() == "r1\nr2\n"
    second = Roster(file)
    second.load()
    second.forget("r1")
    second.save()
    assert file.read_text() == "r2\n"


def test_nothing_is_written_where_nothing_changed(tmp_path: Path) -> None:
    roster = Roster(tmp_path / "fleet.roster")
    roster.add(["r1"])
    roster.save()
    (tmp_path / "fleet.roster").unlink()
    roster.add(["r1"])
    roster.forget("r9")
    roster.save()
    assert not list(tmp_path.iterdir())


def test_a_disk_that_takes_nothing_is_said_and_tried_again(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    roster = Roster(tmp_path / "file" / "fleet.roster")
    roster.add(["r1"])
    roster.save()
    assert roster.fault is not None
    assert "file" in roster.fault
    (tmp_path / "file").unlink()
    roster.save()
    assert roster.fault is None
    assert (tmp_path / "file" / "fleet.roster").read_text() == "r1\n"


@pytest.mark.parametrize("content", [b"../r1\n", b"\xff\xfe", b"r 1\n", b"r" * (MOST_BYTES + 1), b"*\n"])
def test_what_is_no_roster_is_an_error_that_names_the_file(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "fleet.roster"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=r"fleet\.roster"):
        Roster(file).load()


def test_no_more_robots_are_remembered_than_a_fleet_may_have(tmp_path: Path) -> None:
    roster = Roster(tmp_path / "fleet.roster")
    roster.add(f"r{number}" for number in range(ROBOTS + 5))
    assert len(roster.names) == ROBOTS
