"""What ``zbridge blackbox`` refuses, on a folder without a gateway; ``tests/e2e/test_blackbox.py`` has the rest."""

from pathlib import Path

import pytest

from zbridge.blackbox import BoxFolder, IncidentInfo
from zbridge.blackbox.incidents import INFO, IncidentCause
from zbridge.cli.incidents import list_here, remove_here, show_here
from zbridge.errors import ZbridgeError

NAME = "20261127T173604Z-r1-mark"


@pytest.fixture
def folder(tmp_path: Path) -> BoxFolder:
    made = BoxFolder(tmp_path, "fleet", "r1")
    made.make()
    (made.incidents / NAME).mkdir()
    made.write_info(
        IncidentInfo(NAME, "fleet", "r1", 1, (IncidentCause("mark", "a dent\x1b[2J", 1_700_000_000 * 10**9),))
    )
    return made


def test_an_incident_that_is_being_written_is_not_deleted(tmp_path: Path, folder: BoxFolder) -> None:
    writing = folder.take_life()
    with pytest.raises(ZbridgeError, match="still being written"):
        remove_here(tmp_path, [NAME])
    folder.end_life(writing)
    remove_here(tmp_path, [NAME])
    assert folder.infos() == []


@pytest.mark.parametrize("name", ["", ".", "..", "../live", "/etc", "20260101T000000Z-r1-mark"])
def test_what_is_no_incident_is_said(tmp_path: Path, folder: BoxFolder, name: str) -> None:
    for command in (lambda: remove_here(tmp_path, [name]), lambda: show_here(tmp_path, name, as_json=False)):
        with pytest.raises(ZbridgeError, match="no such incident"):
            command()
    assert (folder.incidents / NAME / INFO).exists()


def test_a_damaged_incident_is_not_shown_and_can_be_deleted(tmp_path: Path, folder: BoxFolder) -> None:
    (folder.incidents / NAME / INFO).write_text("{")
    with pytest.raises(ZbridgeError, match="damaged"):
        show_here(tmp_path, NAME, as_json=False)
    remove_here(tmp_path, [NAME])
    assert list(folder.incidents.iterdir()) == []


def test_texts_of_a_file_are_safe_to_print(
    tmp_path: Path, folder: BoxFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    show_here(tmp_path, NAME, as_json=False)
    list_here(tmp_path, as_json=True)
    printed = capsys.readouterr().out
    assert "\x1b" not in printed
    assert "a dent" in printed
