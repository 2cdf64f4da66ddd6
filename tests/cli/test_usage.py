"""What a user types wrongly is one line, and what ``init`` prints is what is deployed."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from zbridge import cli
from zbridge.protocol.plugin import find_protocol, protocol_names

ROOT = Path(__file__).parents[2]
NOBODY = "tcp://127.0.0.1:1"


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


@pytest.mark.parametrize(
    ("command", "code", "said"),
    [
        ("stop", 2, "ROBOT"),
        ("stop r1 --all", 2, "--all"),
        ("stop a%b", 2, "ROBOT = 'a%b': expected letters, digits, '_', '.' and '-' only\n"),
        ("drive a%b", 2, "ROBOT = 'a%b': expected letters, digits, '_', '.' and '-' only\n"),
        ("init tcpudp --name a%b", 2, "--name = 'a%b': expected letters, digits, '_', '.' and '-' only\n"),
        ("echo /fleet/r1/pose", 2, "try 'fleet/r1/pose'\n"),
        ("record --keys /fleet/** -o never.mcap", 2, "try 'fleet/**'\n"),
        ("simulate tcpudp --listen tcp://127.0.0.1:0 --hq tcp://127.0.0.1:1", 2, "give either --listen"),
        ("simulate tcpudp --drive 0.3", 2, "--drive is an HQ program's: expected with --hq"),
        (f"simulate tcpudp --hq {NOBODY} --drive fast", 2, "drive = 'fast': expected FORWARD or FORWARD,TURN"),
        ("simulate tcpudp --listen udp://127.0.0.1:1", 1, "expected tcp://host:port"),
        ("simulate tcpudp --listen tcp://127.0.0.1:0 --camera 8000", 1, "expected tcp://host:port"),
        ("simulate tcpudp --hq tcp://127.0.0.1:1 --camera 127.0.0.1:8000", 2, "--camera is a robot's"),
        ("simulate tcpudp --listen tcp://127.0.0.1:0 --version 1.0", 2, "expected one of 1.1, 1.2, 1.3, 1.4"),
        (f"probe tcpudp {NOBODY}", 2, "uses it up"),
    ],
)
def test_what_cannot_be_done_is_said_without_a_traceback(command: str, code: int, said: str, zbridge: Typed) -> None:
    ran = zbridge(*command.split())
    assert (ran.code, ran.out) == (code, "")
    assert said in ran.err
    assert not (ROOT / "never.mcap").exists()
