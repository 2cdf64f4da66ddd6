"""How a successor is started without a supervisor, and what systemd is notified of, over a real socket."""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from pathlib import Path

import pytest

from zbridge.app.handover import processes
from zbridge.app.handover.processes import Spawn, Systemd
from zbridge.errors import HandoverError

ECHO = [sys.executable, "-Sc", "import os, sys; os.write(int(sys.argv[4]), ' '.join(sys.argv[1:]).encode())"]
"""A program that says its arguments to the descriptor that is the fourth of them."""


@pytest.mark.parametrize("verbose", [False, True])
async def test_a_successor_is_told_its_file_and_the_descriptor_it_inherits(
    monkeypatch: pytest.MonkeyPatch, verbose: bool
) -> None:
    near, far = socket.socketpair()
    with near, far:
        monkeypatch.setattr(processes, "COMMAND", ECHO)
        spawn = Spawn(Path("/etc/r1.toml"), verbose=verbose)
        await spawn.start_successor(far)
        assert spawn.process is not None
        assert spawn.process.wait(5.0) == 0
        told = near.recv(200).decode().split()
        assert told == ["run", "/etc/r1.toml", "--take-over", str(far.fileno()), *["--verbose"] * verbose]
        assert not spawn.handed_over(), "nobody looks after two processes"


async def test_a_program_that_is_not_there_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "COMMAND", ["/no/such/program"])
    with socket.socket() as end, pytest.raises(HandoverError, match=r"no process can be started: .*No such file"):
        await Spawn(Path("r1.toml")).start_successor(end)


@pytest.mark.parametrize("abstract", [False, True])
async def test_systemd_is_told_which_process_serves_the_robot_from_now_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, abstract: bool
) -> None:
    name = f"@zbridge-{os.getpid()}" if abstract else str(tmp_path / "notify")
    monkeypatch.setattr(processes, "COMMAND", ["/bin/true"])
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd, socket.socket() as end:
        systemd.settimeout(5.0)
        systemd.bind(name.replace("@", "\0"))
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        spawn = Spawn(Path("r1.toml"))
        spawn.notify_systemd()
        await spawn.start_successor(end)
        assert spawn.process is not None
        spawn.process.wait(5.0)
        spawn.notify_systemd()
        assert systemd.recv(100) == f"MAINPID={spawn.process.pid}".encode()


def test_without_systemd_nobody_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    Systemd().notify("READY=1", waits=True)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "gone"))
    Systemd().notify("READY=1", waits=True)


@pytest.mark.parametrize("abstract", [False, True])
def test_systemd_is_told_where_it_asked_for_it(tmp_path: Path, abstract: bool) -> None:
    name = f"@{tmp_path}/notify" if abstract else str(tmp_path / "notify")
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as systemd:
        systemd.bind("\0" + name[1:] if abstract else name)
        assert Systemd({"NOTIFY_SOCKET": name}).notify("READY=1", "STATUS=8 robots")
        assert systemd.recv(100) == b"READY=1\nSTATUS=8 robots"


def test_nobody_is_told_where_nobody_asked(tmp_path: Path) -> None:
    assert Systemd({}).notify("READY=1")
    assert not Systemd({"NOTIFY_SOCKET": str(tmp_path / "gone")}).notify("READY=1")


@pytest.mark.parametrize(
    ("environment", "seconds"),
    [
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "30000000", "WATCHDOG_PID": "7"}, 15.0),
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "30000000"}, 15.0),
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "30000000", "WATCHDOG_PID": "8"}, 0.0),
        ({"WATCHDOG_USEC": "30000000"}, 0.0),
        ({"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "often"}, 0.0),
        ({"NOTIFY_SOCKET": "/x"}, 0.0),
    ],
)
def test_the_watchdog_is_fed_twice_in_its_time(environment: dict[str, str], seconds: float) -> None:
    assert Systemd(environment, pid=7).watchdog_s == seconds
