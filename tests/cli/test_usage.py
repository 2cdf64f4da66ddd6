"""What a user types wrongly is one line, and what ``init`` prints is what is deployed."""

from __future__ import annotations

import functools
import re
import signal
import socket
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
import typer.main

from tests.certificates import Authority
from zbridge import cli
from zbridge.cli.app import app
from zbridge.protocol.plugin import find_protocol, protocol_names

ROOT = Path(__file__).parents[2]
NOBODY = "tcp://127.0.0.1:1"
built = functools.cache(typer.main.get_command)


class Ran(NamedTuple):
    """What a command gave."""

    code: int
    out: str
    err: str


Typed = Callable[..., Ran]


@pytest.fixture
def zbridge(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Typed:
    """Run a command line in this process."""

    def typed(*words: str) -> Ran:
        monkeypatch.setattr(sys, "argv", ["zbridge", *words])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert isinstance(ended.value.code, int | None)
        return Ran(ended.value.code or 0, *capsys.readouterr())

    return typed


@pytest.mark.parametrize("protocol", protocol_names())
def test_the_deployed_configurations_are_what_init_prints_and_check_takes_them(
    protocol: str, tmp_path: Path, zbridge: Typed
) -> None:
    assert (ROOT / f"deploy/config/{protocol}.toml").read_text() == zbridge("init", protocol).out
    if find_protocol(protocol).hq is not None:
        assert (ROOT / f"deploy/config/hq-{protocol}.toml").read_text() == zbridge("init", protocol, "--hq").out
    file, made = tmp_path / "arm.toml", zbridge("init", protocol, "--name", "arm-7").out
    assert tomllib.loads(made)["robot"]["name"] == "arm-7"
    file.write_text(made)
    checked = zbridge("check", str(file))
    assert (checked.code, checked.err) == (0, "")
    assert f"fleet/arm-7, {protocol} at tcp://127.0.0.1:" in checked.out


ADDRESSES = {
    "alf": ["tcp://10.0.0.7:6666", "tcp://10.0.0.7:6667"],
    "tcpudp": ["serial:///dev/ttyUSB0?baud=57600"],
    "wc2ec": ["tcp://[fd00::7]:27015"],
    "ros2": ["tcp://ros.lab:7448"],
    "mavlink": ["serial:///dev/ttyACM0?baud=115200"],
}


@pytest.mark.parametrize("protocol", protocol_names())
def test_init_fills_in_the_addresses_and_changes_nothing_else(protocol: str, zbridge: Typed) -> None:
    options = [word for address in ADDRESSES[protocol] for word in ("--connect", address)]
    before, made = zbridge("init", protocol).out, zbridge("init", protocol, *options).out
    assert tomllib.loads(made)["device"]["connect"] == ADDRESSES[protocol]
    changed = [lines for lines in zip(before.splitlines(), made.splitlines(), strict=True) if lines[0] != lines[1]]
    assert len(changed) == 1
    assert changed[0][1].partition("#")[2] == changed[0][0].partition("#")[2]


@pytest.mark.parametrize("words", [("--connect", "tcp://10.0.0.7:11001"), ("--hq",)])
def test_what_init_makes_for_a_secure_bus_passes_the_check_with_the_files_of_a_bundle(
    words: tuple[str, ...], tmp_path: Path, zbridge: Typed
) -> None:
    made = zbridge("init", "tcpudp", "--secure", *words).out
    file, folder = tmp_path / "r1.toml", tmp_path / "r1-bus"
    file.write_text(made)
    missing = zbridge("check", str(file))
    assert (missing.code, missing.out) == (2, "")
    assert missing.err == f"zbridge: {file}: {folder}/certificate.pem: No such file or directory\n"
    Authority(tmp_path / "lab").issue("gateway.r1", days=60).rename(folder)
    checked = zbridge("check", str(file))
    assert (checked.code, checked.err) == (0, "")
    assert "bus as client, certificate of gateway.r1 until" in checked.out
    if "--hq" in words:
        assert tomllib.loads(made)["hq"] == tomllib.loads(zbridge("init", "tcpudp", "--hq").out)["hq"]


NAMES = "expected letters, digits, '_', '.' and '-' only"
CLOSED = "--connect tcp/127.0.0.1:1"
"""Nobody listens there."""
WRONG: list[tuple[str, int, str]] = [
    ("console --listen nonsense", 2, "--listen 'nonsense': expected host:port"),
    ("console --listen 0.0.0.0:80", 2, "expected --tls-certificate"),
    # what is typed
    ("frobnicate", 2, "No such command 'frobnicate'"),
    ("--frobnicate", 2, "No such option: --frobnicate"),
    ("ls r1", 2, "unexpected extra argument"),
    ("stop", 2, "ROBOT"),
    ("stop r1 --all", 2, "--all"),
    ("unlatch", 2, "ROBOT"),
    ("restart", 2, "ROBOT"),
    ("drive", 2, "Missing argument"),
    ("echo", 2, "Missing argument"),
    ("check", 2, "Missing argument"),
    ("record r1", 2, "Missing option"),
    ("record r1 --all -o never.mcap", 2, "name ROBOTs, or give --all or --keys\n"),
    ("export none.mcap", 2, "give either --csv or --npz\n"),
    ("replay none.mcap --as-robot tcpudp", 2, "--as-robot and --listen belong together\n"),
    ("run --together . --watch", 2, "--watch: not with --together"),
    ("simulate tcpudp --listen tcp://127.0.0.1:0 --hq tcp://127.0.0.1:1", 2, "give either --listen"),
    ("simulate tcpudp --drive 0.3", 2, "--drive: only with --hq"),
    ("simulate tcpudp --hq tcp://127.0.0.1:1 --camera 127.0.0.1:8000", 2, "--camera: not with --hq"),
    ("simulate ros2 --hq tcp://127.0.0.1:1", 2, "there is no simulated HQ program of ros2\n"),
    (f"init tcpudp --hq --connect {NOBODY}", 2, "--connect: not with --hq"),
    (f"init tcpudp --connect {NOBODY} --connect {NOBODY}", 2, "--connect: a tcpudp robot has at most 1 link\n"),
    # numbers
    ("drive r1 --speed fast", 2, "--speed"),
    ("drive r1 --speed 2", 2, "--speed"),
    ("echo fleet/** --count -1", 2, "--count"),
    ("echo fleet/** --count many", 2, "--count"),
    ("echo fleet/** --seconds -1", 2, "--seconds"),
    ("echo fleet/** --seconds nan", 2, "--seconds"),
    ("echo fleet/** --seconds inf", 2, "--seconds"),
    ("demo --seconds -1", 2, "--seconds"),
    ("simulate tcpudp --seed x", 2, "--seed"),
    ("replay none.mcap --speed 0", 2, "--speed"),
    ("foxglove --viewers 0", 2, "--viewers"),
    ("ros2 --domain -1", 2, "domain = -1: expected 0 to 232\n"),
    ("run text.toml --take-over x", 2, "--take-over"),
    (f"simulate tcpudp --hq {NOBODY} --drive fast", 2, "drive = 'fast': expected FORWARD or FORWARD,TURN"),
    # names and keys
    ("stop a%b", 2, f"ROBOT = 'a%b': {NAMES}\n"),
    ("drive a%b", 2, f"ROBOT = 'a%b': {NAMES}\n"),
    ("health a%b", 2, f"ROBOT = 'a%b': {NAMES}\n"),
    ("init tcpudp --name a%b", 2, f"--name = 'a%b': {NAMES}\n"),
    ("init nothing", 2, "protocol = 'nothing': expected one of alf, mavlink, ros2, tcpudp, wc2ec\n"),
    ("ls --realm a/b", 2, f"--realm = 'a/b': {NAMES}\n"),
    ("echo /fleet/r1/pose", 2, "try 'fleet/r1/pose'\n"),
    ("echo fleet//pose", 2, "empty chunks are forbidden"),
    ("record --keys /fleet/** -o never.mcap", 2, "try 'fleet/**'\n"),
    ("certs issue x --role nothing", 2, "--role 'nothing': expected one of viewer, operator"),
    ("drive \udcff", 2, f"ROBOT = '\\udcff': {NAMES}\n"),
    ("echo fleet/\udcff", 2, "KEY = 'fleet/\\udcff': "),
    ("check \udcff.toml", 2, "\\udcff.toml: No such file or directory\n"),
    # addresses
    ("ls --connect hello", 2, "--connect 'hello': expected an endpoint like tcp/192.168.0.2:7447\n"),
    ("ls --connect tcp/\udcff:1", 2, "--connect 'tcp/\\udcff:1': expected an endpoint"),
    (f"ls {CLOSED}", 1, "nobody listens at 127.0.0.1:1\n"),
    (f"stop --all {CLOSED}", 1, "nobody listens at 127.0.0.1:1\n"),
    (f"mark \udcff {CLOSED}", 1, "nobody listens at 127.0.0.1:1\n"),
    ("ls --tls empty --connect tcp/127.0.0.1:1", 2, "expected tls/host:port"),
    ("init tcpudp --connect 10.0.0.7", 2, "--connect '10.0.0.7': expected tcp://host:port or serial:///path?baud=N\n"),
    ("init ros2 --connect serial:///dev/tty1?baud=9600", 2, "expected tcp://host:port"),
    ("simulate tcpudp --listen udp://127.0.0.1:1", 2, "expected tcp://host:port"),
    ("simulate tcpudp --listen tcp://127.0.0.1:99999", 2, "Port out of range"),
    ("simulate tcpudp --listen tcp://nohost.invalid:1", 1, "Name or service not known\n"),
    ("simulate tcpudp --listen tcp://127.0.0.1:0 --camera 8000", 2, "expected tcp://host:port"),
    ("simulate tcpudp --listen tcp://127.0.0.1:0 --version 1.0", 2, "expected one of 1.1, 1.2, 1.3, 1.4"),
    ("simulate tcpudp --hq hello", 2, "--hq 'hello': expected tcp://host:port\n"),
    (f"probe tcpudp {NOBODY}", 2, "uses it up"),
    ("probe tcpudp hello", 2, "ADDRESS 'hello': expected tcp://host:port"),
    (f"probe tcpudp {NOBODY} --yes", 1, f"{NOBODY}: Connection refused\n"),
    ("router --listen hello", 2, "listen[0] = 'hello'"),
    ("router --listen tcp/1.2.3.4:7447", 2, "expected a loopback address"),
    ("foxglove --listen hello", 2, "--listen hello: expected host:port"),
    ("foxglove --listen 0.0.0.0:8000", 2, "other machines need --tls-certificate"),
    ("ros2 --ros hello", 2, "ros = ['hello']: expected Zenoh endpoints"),
    # files
    *((f"{command} /none", 2, "/none: No such file or directory\n") for command in ("run", "check", "info", "router")),
    *((f"{command} binary", 2, "binary: not TOML: ") for command in ("run", "check", "router", "ros2")),
    *((f"{command} text.toml", 2, "text.toml: not TOML: ") for command in ("run", "check", "run --watch")),
    *((f"{command} empty", 2, "empty: no robot file") for command in ("run", "run --together", "check")),
    ("run missing.toml text.toml", 2, "missing.toml: No such file or directory\n"),
    ("router empty", 2, "empty: expected a regular file\n"),
    ("info binary", 2, "binary: not an MCAP file\n"),
    ("info empty", 2, "empty: Is a directory\n"),
    ("export empty --npz", 2, "empty: Is a directory\n"),
    ("replay binary", 2, "binary: no robot in it: not an MCAP file\n"),
    ("foxglove empty", 1, "empty: Is a directory\n"),
    ("foxglove --token binary", 2, "--token binary: "),
    ("ls --tls /none", 2, "--tls /none: no such folder"),
    ("ls --tls empty", 2, "--tls empty: no bus.toml there; give --connect"),
    ("router --tls empty --roles text.toml --listen tls/127.0.0.1:0", 2, "tls.ca = 'empty/ca.pem': no such file\n"),
    ("certs list --dir empty", 2, "empty/roles.toml: No such file or directory\n"),
    ("certs list --dir binary", 2, "binary/roles.toml: Not a directory\n"),
    ("certs init binary", 2, "binary: File exists\n"),
    # the terminal
    ("drive r1", 1, "drive needs a terminal to read keys from\n"),
]


@pytest.mark.parametrize(("command", "code", "said"), WRONG)
def test_what_cannot_be_done_is_said_without_a_traceback(
    command: str, code: int, said: str, zbridge: Typed, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("typer.main.get_command", built)  # most of the time is spent there
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "binary").write_bytes(bytes(range(255, -1, -1)))
    (tmp_path / "text.toml").write_text("robot")
    ran = zbridge(*command.split())
    assert (ran.code, ran.out) == (code, "")
    assert said in ran.err
    assert "Traceback" not in ran.err
    assert ran.err.count("\n") == 1 or ran.err.startswith("Usage: ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["binary", "empty", "text.toml"]


def test_at_least_sixty_mistakes_were_tried() -> None:
    assert len(WRONG) >= 60


def started(command: str) -> subprocess.CompletedProcess[str]:
    """Run a command line of a shell, in which ``zbridge`` is this one."""
    shell = ("bash", "-c", f'set -o pipefail; zbridge() {{ {sys.executable} -m zbridge "$@"; }}; {command}')
    return subprocess.run(shell, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60.0)


@pytest.mark.parametrize(
    ("command", "code", "said"),
    [
        ("zbridge init tcpudp | head -c 0", 1, ""),
        ("zbridge check deploy/config/tcpudp.toml | head -c 0", 1, ""),
        (
            "zbridge check deploy/config/tcpudp.toml >/dev/full",
            1,
            "zbridge: OSError: [Errno 28] No space left on device",
        ),
        (f"zbridge ls {CLOSED} >&-", 1, "zbridge: nobody listens at 127.0.0.1:1\n"),
        (f"zbridge ls {CLOSED} 2>&-", 1, ""),
        ("zbridge drive r1 <&-", 1, "zbridge: drive needs a terminal to read keys from\n"),
        ("PYTHONIOENCODING=ascii zbridge init tcpudp --connect tcp://\u00e9.lab:1", 0, ""),
    ],
)
def test_a_reader_that_has_gone_and_streams_that_are_closed_or_full_cause_no_traceback(
    command: str, code: int, said: str
) -> None:
    ran = started(command)
    assert ran.returncode == code
    assert ran.stderr.startswith(said)
    assert ran.stderr.count("\n") == bool(said)


@pytest.mark.parametrize("early", [True, False])
def test_an_interruption_ends_a_command_without_a_traceback(early: bool) -> None:
    """Early: while modules are loaded; then while the bus is joined."""
    code = "import sys, zbridge.__main__\nprint(flush=True)\n"
    code += "" if early else "import zbridge.cli.app, zbridge.cli.bus, zbridge.bus.zenoh\nprint(flush=True)\n"
    silent = socket.create_server(("127.0.0.1", 0))  # whoever connects waits for an answer
    code += f"sys.argv = ['zbridge', 'ls', '--connect', 'tcp/127.0.0.1:{silent.getsockname()[1]}']\n"
    code += "zbridge.__main__.main()\n"
    with silent, subprocess.Popen((sys.executable, "-c", code), cwd=ROOT, stdout=-1, stderr=-1, text=True) as process:
        assert process.stdout is not None
        for _ in range(1 if early else 2):
            process.stdout.readline()
        time.sleep(0.1 if early else 0.3)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30.0)
    assert process.returncode in (-signal.SIGINT, 130)
    assert errors == ""


def test_help_says_the_exit_codes_that_the_page_lists(zbridge: Typed) -> None:
    page = (ROOT / "docs" / "reference" / "commands.md").read_text().partition("## Exit codes")[2].partition("\n## ")[0]
    own = re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)
    assert len(own) > 5
    commands = built(app).commands  # type: ignore[attr-defined]
    assert {name for name, command in commands.items() if "Exit code" in (command.help or "")} == set(own)
    assert "Exit codes: 0 done, 1 failed, 2 wrong arguments" in zbridge("--help").out
