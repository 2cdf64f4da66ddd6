"""``zbridge drive``: a session of keys against a gateway's own lease; no terminal."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Any

import pytest

from tests.client import World
from zbridge.cli import drive
from zbridge.cli.drive import DriveRun
from zbridge.errors import Held
from zbridge.fleet.messages import Drive

pytestmark = pytest.mark.jumping


class Scene:
    """One robot, and a session that drives it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(drive, "_raw_keys", self.raw_keys)
        self.world = World()
        self.session = DriveRun(self.world.robot, 0.5, who="ann", takeover=False)
        self.running = asyncio.ensure_future(self.session.run())

    def raw_keys(self, loop: asyncio.AbstractEventLoop, take: Callable[[str], None]) -> Any:
        """Stand in for the terminal."""
        self.type = take
        return contextlib.nullcontext()

    async def hold(self, key: str, seconds: float = 0.3) -> None:
        """Hold a key for so long, as terminals report it."""
        for _ in range(round(seconds * 30)):
            self.type(key)
            await asyncio.sleep(1 / 30)

    async def press(self, key: str) -> None:
        self.type(key)
        await asyncio.sleep(0.3)

    @property
    def moved(self) -> int:
        """How many drives that move were carried out since the last look."""
        commands = self.world.machine.commands
        count = sum(command != Drive() for _, command in commands)
        commands.clear()
        return count

    @property
    def holder(self) -> str | None:
        return self.world.gateway.control.holder


async def test_keys_drive_and_x_gives_the_robot_back(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch)
    await asyncio.sleep(0.2)
    assert (scene.holder, scene.moved) == ("ann", 0)
    await scene.hold("w")
    assert scene.moved
    await asyncio.sleep(0.3)
    scene.world.machine.commands.clear()
    await asyncio.sleep(10.0)
    assert (scene.holder, scene.moved) == ("ann", 0)
    await scene.press("x")
    await scene.running
    assert scene.holder is None


async def test_without_the_lease_a_held_key_moves_nothing_and_after_enter_it_drives(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = Scene(monkeypatch)
    await asyncio.sleep(0.2)
    await scene.hold("w")
    assert scene.moved
    await scene.press(" ")
    assert scene.holder is None
    assert "Enter: take the lease again, x: end" in capsys.readouterr().out
    scene.world.machine.commands.clear()
    await scene.hold("w", 1.0)
    assert (scene.holder, scene.moved) == (None, 0)
    scene.type("\r")
    await scene.hold("w", 1.0)
    assert scene.holder == "ann"
    assert scene.moved, "Enter released the key, and it was pressed again"
    await scene.press("x")
    await scene.running


async def test_a_robot_that_somebody_else_drives_ends_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch)
    async with scene.world.others.control("bob"):
        with pytest.raises(Held, match="bob"):
            await scene.running


async def test_a_refusal_is_said_and_the_drive_goes_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = Scene(monkeypatch)
    await asyncio.sleep(0.2)
    scene.world.machine.refusal = "no legs"
    await scene.hold("w")
    scene.world.machine.refusal = None
    await scene.hold("w")
    assert scene.moved
    assert "no legs" in capsys.readouterr().out
    await scene.press("x")
    await scene.running
