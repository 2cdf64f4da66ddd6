"""``zbridge console user`` as it is typed: what it prints, what the file holds then, and its exit codes."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import pytest

from zbridge import cli
from zbridge.views.console.users import hash_token, is_password, load_users


class Terminal:
    """Types commands in a folder of its own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capsys = monkeypatch, capsys

    def types(self, command: str, password: str = "", code: int = 0) -> tuple[str, str]:
        """Type a command; give what it printed, on both streams."""
        self._monkeypatch.setattr(sys, "argv", ["zbridge", "console", "user", *command.split()])
        self._monkeypatch.setattr(sys, "stdin", io.StringIO(f"{password}\n"))
        try:
            cli.main()
            ended: object = 0
        except SystemExit as exit_:
            ended = exit_.code or 0
        printed = self._capsys.readouterr()
        assert ended == code, printed
        return printed.out, printed.err


@pytest.fixture
def terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Terminal:
    monkeypatch.chdir(tmp_path)
    return Terminal(monkeypatch, capsys)


FILE = Path("users.toml")


def test_users_are_added_listed_changed_and_removed(terminal: Terminal) -> None:
    terminal.types("add ann --role operator", "correct horse")
    terminal.types("add lab --role viewer --no-password")
    assert is_password(load_users(FILE)["ann"].password, "correct horse")
    assert load_users(FILE)["lab"].password is None
    out, _ = terminal.types("list")
    assert [line.split() for line in out.splitlines()] == [
        ["user", "role", "password", "tokens"],
        ["ann", "operator", "yes"],
        ["lab", "viewer", "no"],
    ]
    out, _ = terminal.types("list --json")
    assert [json.loads(line)["user"] for line in out.splitlines()] == ["ann", "lab"]
    terminal.types("passwd ann", "battery staple")
    assert is_password(load_users(FILE)["ann"].password, "battery staple")
    terminal.types("remove ann")
    assert set(load_users(FILE)) == {"lab"}


def test_a_token_is_shown_once_and_revoked_by_its_label(terminal: Terminal) -> None:
    terminal.types("add lab --role viewer --no-password")
    out, _ = terminal.types("token lab --label plotter")
    token = out.strip()
    assert load_users(FILE)["lab"].tokens == {"plotter": hash_token(token)}
    assert token not in FILE.read_text()
    _, error = terminal.types("token lab --label plotter", code=2)
    assert "has a token 'plotter'" in error
    terminal.types("token lab --label plotter --revoke")
    assert load_users(FILE)["lab"].tokens == {}
    _, error = terminal.types("token lab --label plotter --revoke", code=2)
    assert "lab has no token 'plotter'" in error


@pytest.mark.parametrize(
    ("command", "password", "said"),
    [
        ("add ann --role king", "correct horse", "--role 'king': expected one of viewer, operator, supervisor"),
        ("add a.b --role viewer", "correct horse", "user 'a.b': expected letters"),
        ("add ann --role viewer", "short", "a password of 5 characters: expected 8 to 1000"),
        ("passwd ann", "correct horse", "No such file"),
        ("remove ann", "", "No such file"),
        ("list", "", "No such file"),
    ],
)
def test_what_cannot_be_done_is_said_and_changes_nothing(
    terminal: Terminal, command: str, password: str, said: str
) -> None:
    _, error = terminal.types(command, password, code=2)
    assert said in error
    assert not FILE.exists()


def test_a_name_that_is_taken_or_unknown_is_an_error(terminal: Terminal) -> None:
    terminal.types("add ann --role viewer", "correct horse")
    before = FILE.read_bytes()
    for command, said in (
        ("add ann --role operator", "there is a user 'ann'"),
        ("passwd bob", "there is no user 'bob'"),
    ):
        _, error = terminal.types(command, "correct horse", code=2)
        assert said in error
    assert FILE.read_bytes() == before
