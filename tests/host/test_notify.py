"""What systemd is told, over a real socket."""

import contextlib
import socket
from pathlib import Path

import pytest

from zbridge.host.notify import Systemd


@pytest.mark.parametrize("abstract", [False, True])
def test_systemd_is_told_where_it_asked_for_it(tmp_path: Path, abstract: bool) -> None:
    name = f"@{tmp_path}/notify" if abstract else str(tmp_path / "notify")
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as systemd:
        systemd.bind("\0" + name[1:] if abstract else name)
        assert Systemd({"NOTIFY_SOCKET": name}).tell("READY=1", "STATUS=8 robots")
        assert systemd.recv(100) == b"READY=1\nSTATUS=8 robots"


def test_nobody_is_told_where_nobody_asked(tmp_path: Path) -> None:
    assert Systemd({}).tell("READY=1")
    assert not Systemd({"NOTIFY_SOCKET": str(tmp_path / "gone")}).tell("READY=1")


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
