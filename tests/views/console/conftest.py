"""Two robots on a fake bus, and a console for them on a real socket."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect

from tests.client import World
from tests.views.console.serving import served
from zbridge.views.console.roster import Roster


class Scene:
    """Two robots, and a console for them."""

    def __init__(self, world: World, at: str, roster: Roster) -> None:
        self.world, self.at, self.roster = world, at.removeprefix("http://"), roster

    async def get(self, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
        """Get a path over a connection of its own."""

        def ask() -> tuple[int, dict[str, str], bytes]:
            connection = http.client.HTTPConnection(self.at, timeout=5)
            with contextlib.closing(connection):
                connection.request("GET", path, headers={"Host": self.at, **headers})
                answer = connection.getresponse()
                return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()

        return await asyncio.to_thread(ask)

    @contextlib.asynccontextmanager
    async def page(self, path: str = "/socket", **options: Any) -> AsyncIterator[ClientConnection]:
        """Open a socket as a page of the console does."""
        options = {"origin": f"http://{self.at}", "proxy": None, **options}
        async with connect(f"ws://{self.at}{path}", **options) as opened:
            yield opened


@pytest.fixture
async def scene(tmp_path: Path) -> AsyncIterator[Scene]:
    world, roster = World("r1", "r2"), Roster(tmp_path / "fleet.roster")
    async with served(world.fleet, world.bus.join("console"), roster) as at:
        yield Scene(world, at, roster)
