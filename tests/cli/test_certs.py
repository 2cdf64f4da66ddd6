"""``zbridge certs`` as it is typed: what it prints, and its exit codes; ``tests/security/certs`` checks the files."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import pytest

from zbridge import cli
from zbridge.security.roles import Member, load_roles

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "secure-bus.md"
RESTART = "Restart the router, which reads roles.toml when it starts. That loses the bus: every driven robot stops.\n"


class Terminal:
    """Types commands in a folder of its own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch = monkeypatch
        self._capsys = capsys

    def fails(self, *words: str) -> tuple[object, str]:
        """Give the exit code and what stands on stderr."""
        self._monkeypatch.setattr(sys, "argv", ["zbridge", "certs", *words])
        self._capsys.readouterr()
        with pytest.raises(SystemExit) as raised:
            cli.main()
        self.printed = self._capsys.readouterr()
        return raised.value.code, self.printed.err

    def types(self, *words: str) -> str:
        """Give what stands on stdout after success."""
        code, errors = self.fails(*words)
        assert (code, errors) == (0, "")
        return self.printed.out


@pytest.fixture
def terminal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Terminal:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("zbridge.cli.certs.now", lambda: datetime(2030, 1, 31, 12, tzinfo=UTC))
    monkeypatch.setattr("os.fsync", lambda descriptor: None)  # some 20 ms each
    return Terminal(monkeypatch, capsys)


def test_a_lab_is_set_up_listed_and_packed(terminal: Terminal) -> None:
    assert "Keep certs/ca-key.pem secret" in terminal.types("init")
    made = terminal.types("issue", "hub", "--role", "router", "--host", "hub.lab", "--host", "127.0.0.1")
    assert made.startswith("certs/hub: router.hub, expires 2031-01-31, ")
    assert made.endswith(RESTART)
    terminal.types("issue", "g1", "--role", "gateway", "--robot", "r1", "--robot", "r2", "--days", "29")
    table = terminal.types("list").splitlines()
    assert table[0].split() == ["name", "role", "robots", "hosts", "expires", "fingerprint", "problem"]
    assert table[1].split()[:5] == ["hub", "router", "hub.lab", "127.0.0.1", "2031-01-31"]
    assert table[2].split()[:5] == ["g1", "gateway", "r1", "r2", "2030-03-01"]
    assert table[2].rstrip().endswith("...  expires in 29 days")
    packed = terminal.types("bundle", "g1", "-o", "carry")
    assert packed.split() == ["carry/ca.pem", "carry/certificate.pem", "carry/key.pem", "carry/bus.toml"]
    assert 'connect = ["tls/hub.lab:7447"]' in Path("carry/bus.toml").read_text()


def test_the_list_as_json_has_all_fields(terminal: Terminal) -> None:
    terminal.types("init")
    for name in ("ann", "bob"):
        terminal.types("issue", name, "--role", "viewer")
    terminal.types("revoke", "ann")
    first, second = map(json.loads, terminal.types("list", "--json").splitlines())
    assert (first["name"], first["role"], first["robots"], first["hosts"]) == ("bob", "viewer", [], [])
    assert first["expires"] == "2031-01-31T12:00:00+00:00"
    assert len(first["fingerprint"].split(":")) == 32
    assert second == {
        "name": "ann",
        "role": None,
        "robots": [],
        "hosts": [],
        "expires": None,
        "fingerprint": None,
        "problem": "revoked",
    }


def test_revoking_says_what_it_does_not_do(terminal: Terminal) -> None:
    terminal.types("init")
    terminal.types("issue", "ann", "--role", "viewer")
    terminal.types("issue", "hub", "--role", "router", "--host", "localhost")
    said = terminal.types("revoke", "ann")
    assert said.startswith(
        "viewer.ann is revoked, and ann cannot be issued again.\nIts certificate is valid until 2031-01-31: "
    )
    assert "Zenoh has no revocation lists" in said
    assert "pose as a router" not in said
    assert said.endswith(RESTART)
    assert "pose as a router, which no rule prevents" in terminal.types("revoke", "hub")


def test_a_gateway_with_listeners_is_marked_in_the_roles(terminal: Terminal) -> None:
    terminal.types("init")
    for name, words in (("g1", ["--listeners"]), ("g2", [])):
        terminal.types("issue", name, "--role", "gateway", "--robot", "r1", *words)
    names = load_roles(Path("certs/roles.toml")).names
    assert names == {"g1": Member("gateway", ("r1",), True), "g2": Member("gateway", ("r1",))}


def test_renewing_takes_names_or_all(terminal: Terminal) -> None:
    terminal.types("init")
    for name in ("ann", "bob"):
        terminal.types("issue", name, "--role", "viewer")
    assert terminal.types("renew", "bob").startswith("certs/bob: viewer.bob, expires ")
    assert [line.split(":")[0] for line in terminal.types("renew", "--all").splitlines()[:2]] == [
        "certs/ann",
        "certs/bob",
    ]
    for words in (["renew"], ["renew", "ann", "--all"]):
        assert terminal.fails(*words) == (2, "zbridge: name one NAME or more, or give --all\n")


def test_replacing_and_servers_that_are_no_routers_are_warned_of(terminal: Terminal) -> None:
    terminal.types("init")
    terminal.types("issue", "ann", "--role", "viewer")
    said = terminal.types("issue", "ann", "--role", "viewer", "--host", "localhost", "--force")
    assert "The certificate that it replaces is valid until" in said
    assert "If its key is lost: zbridge certs revoke ann, and issue another name." in said
    assert "whoever has its key can pose as a router on these hosts" in said


def test_every_command_takes_another_folder(terminal: Terminal) -> None:
    terminal.types("init", "--dir", "a/lab")
    terminal.types("init", "b")
    assert Path("b/ca.pem").exists()
    terminal.types("issue", "ann", "--role", "viewer", "--dir", "a/lab")
    assert terminal.types("list", "--dir", "a/lab").splitlines()[1].split()[:2] == ["ann", "viewer"]
    terminal.types("renew", "ann", "--dir", "a/lab")
    terminal.types("bundle", "ann", "-o", "carry", "--connect", "tls/hub.lab:7447", "--dir", "a/lab")
    terminal.types("revoke", "ann", "--dir", "a/lab")
    assert not Path("certs").exists()


def test_the_commands_of_the_page_work_one_after_the_other(terminal: Terminal) -> None:
    commands = re.findall(r"^(?:\$ )?zbridge certs (.+?)(?: +#.*)?$", PAGE.read_text(), re.MULTILINE)
    assert len(commands) >= 25
    for command in commands:
        terminal.types(*shlex.split(command))
    assert [line.split()[0] for line in terminal.types("list").splitlines()] == [
        *("name", "r1", "ben", "g2", "h1", "ann2", "hub2", "vic", "ann", "hub"),
    ]
    assert "another authority" not in terminal.types("list")
    assert Path("r1-bus/bus.toml").exists()


FAILURES = [
    (("init",), "certs/ca.pem: exists already; --force makes another authority"),
    (("issue", "ann", "--role", "viewer"), "certs/ann/key.pem: exists already; `zbridge certs renew`"),
    (("issue", "bob", "--role", "driver"), "--role 'driver': expected one of viewer, operator, supervisor, gateway"),
    (
        ("issue", "bob", "--role", "viewer", "--days", "4000"),
        "--days 4000: expected 1 to 3650: the authority",
    ),
    (("issue", "bob", "--role", "viewer", "--listeners"), "--listeners: a gateway's; the role viewer has none"),
    (("issue", "hq", "--role", "viewer"), "NAME = 'hq': the names of all listeners begin with it"),
    (("issue", "bob", "--role", "viewer", "--dir", "none"), "none: No such file or directory: expected the folder"),
    (("renew", "bob"), "certs/roles.toml: 'bob' is not a name of this bus; known: ann"),
    (("revoke", "\x1b[31m"), "certs/roles.toml: '\\x1b[31m' is not a name of this bus; known: ann"),
    (("bundle", "ann", "-o", "carry"), "--connect: missing: no router is issued yet"),
    (("list", "--dir", "none"), "none/roles.toml: No such file or directory"),
]


@pytest.mark.parametrize(("words", "error"), FAILURES)
def test_what_fails_is_one_line_and_exit_code_two(terminal: Terminal, words: tuple[str, ...], error: str) -> None:
    terminal.types("init")
    terminal.types("issue", "ann", "--role", "viewer")
    code, errors = terminal.fails(*words)
    assert code == 2
    assert errors.startswith(f"zbridge: {error}")
    assert errors.count("\n") == 1


def test_a_missing_package_is_named_with_the_extra(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    error = "zbridge: zbridge certs needs the package cryptography: pip install 'zbridge[certs]'\n"
    assert terminal.fails("init") == (2, error)
    assert terminal.fails("list") == (2, error)


def test_other_commands_do_not_load_the_package() -> None:
    modules = "'cryptography' in sys.modules or 'zbridge.security.certs' in sys.modules"
    code = f"import sys, zbridge.cli.app; sys.exit({modules})"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
