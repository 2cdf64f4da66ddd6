"""How a gateway process is started, and why not; the fork server is played."""

from __future__ import annotations

import asyncio
import os
import socket
from pathlib import Path
from typing import Any

import pytest

from zbridge.errors import NotReady
from zbridge.host import succession
from zbridge.host.fd_channel import FdChannel, Fork
from zbridge.host.files import RobotFile
from zbridge.host.succession import Launcher


class ForkClient:
    """Notes what it is to fork. refuses: why it does not."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []
        self.refuses: NotReady | None = None

    async def fork(
        self, request: Fork, channel: socket.socket, content: bytes, take_over: int | None, *, at_once: bool
    ) -> int:
        self.asked.append((request, content, take_over, at_once))
        if self.refuses is not None:
            raise self.refuses
        channel.send(b"here")
        return 7


def made(pid: int, channel: FdChannel, file: RobotFile) -> Any:
    return pid, channel, file


def launcher(forks: ForkClient) -> Launcher:
    return Launcher(forks, made, Fork("", "", verbose=True, log_format="json"))  # type: ignore[arg-type]


async def test_a_process_is_forked_with_its_file_its_post_and_what_it_takes_over(tmp_path: Path) -> None:
    path, forks = tmp_path / "r1.toml", ForkClient()
    path.write_text("changed meanwhile")
    file = RobotFile(path, b"as it was checked", ("fleet", "r1"))
    started: Any = await launcher(forks).start(file, 5, at_once=True)
    assert forks.asked == [(Fork(str(path), "r1", True, "json"), b"as it was checked", 5, True)]
    pid, channel, of = started
    assert (pid, of) == (7, file)
    assert os.read(channel.fileno(), 10) == b"here", "the far end is the process's"
    channel.close()


async def test_a_fork_that_fails_leaves_no_socket_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, forks = tmp_path / "r1.toml", ForkClient()
    path.write_text("")
    pairs: list[tuple[FdChannel, socket.socket]] = []
    pair = FdChannel.pair
    monkeypatch.setattr(FdChannel, "pair", lambda: pairs.append(pair()) or pairs[-1])
    forks.refuses = NotReady("the fork server is gone")
    with pytest.raises(NotReady, match="the fork server is gone"):
        await launcher(forks).start(RobotFile(path, b""))
    ((near, far),) = pairs
    assert (near.fileno(), far.fileno()) == (-1, -1)


async def test_without_a_free_descriptor_nothing_is_forked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(socket, "socketpair", fail)
    forks = ForkClient()
    with pytest.raises(NotReady, match=r"^Too many open files$"):
        await launcher(forks).start(RobotFile(tmp_path, b""))
    assert forks.asked == []


async def test_a_file_that_is_gone_starts_nothing_and_a_disk_that_does_not_answer_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    forks, path = ForkClient(), tmp_path / "r1.toml"
    with pytest.raises(NotReady, match=r"r1\.toml is gone"):
        await launcher(forks).start(RobotFile(path, b""))
    assert forks.asked == []

    async def never(*_: object) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(succession, "STAT_S", 0.01)
    monkeypatch.setattr(asyncio, "to_thread", never)
    started: Any = await launcher(forks).start(RobotFile(path, b""))
    started[1].close()
