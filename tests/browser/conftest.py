"""A Chromium, and pages whose feed is mocked. Without one the tests are skipped, and say where it was looked for."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import shutil
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from tests.fake_bus import FakeBus
from tests.ports import HOST
from zbridge.client import Fleet
from zbridge.protocol.address import Address
from zbridge.views.console import server
from zbridge.views.console.roster import Roster

CHROMIUM = os.environ.get("ZBRIDGE_CHROMIUM") or shutil.which("chromium")
ARGUMENTS = ("--no-sandbox", "--disable-quic", "--disable-background-networking", "--disable-component-update")
WIDE, NARROW = {"width": 1200, "height": 700}, {"width": 360, "height": 740}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs a browser where there is none."""
    try:
        import playwright  # noqa: F401
    except ImportError:
        why = "playwright is not installed"
    else:
        why = "" if CHROMIUM else "no Chromium (looked in PATH and ZBRIDGE_CHROMIUM)"
    ours = [item for item in items if item.path.parent.name == "browser"]
    for item in ours if why else ():
        item.add_marker(pytest.mark.skip(reason=f"{why}: {len(ours)} browser tests not run"))


class Browser:
    """Pages of one Chromium, and what they complained of."""

    def __init__(self, chromium: Any, at: str) -> None:
        self._chromium, self.at = chromium, at
        self.complaints: list[str] = []

    async def open(self, *, feed: Callable[[Any], None] | None = None, size: Any = WIDE, scheme: str = "light") -> Any:
        """Open the console; ``feed`` is given the page's socket, of which nobody else hears."""
        context = await self._chromium.new_context(viewport=size, color_scheme=scheme, reduced_motion="reduce")
        page = await context.new_page()
        page.on("console", lambda message: self.complaints.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        if feed is not None:
            await page.route_web_socket("**/socket", feed)
        await page.goto(self.at)
        return page


class Feed:
    """Plays the console's server to one page: what it says, and what it was asked for."""

    def __init__(self, *rows: dict[str, Any], **more: Any) -> None:
        self.asked: list[dict[str, Any]] = []
        self._begin = {"full": True, "realm": "fleet", "bus": True, "notices": {}, "roster": None, **more}
        self._rows = rows
        self._socket: Any = None

    def __call__(self, socket: Any) -> None:
        self._socket = socket
        socket.on_message(lambda text: self.asked.append(json.loads(text)))
        socket.send(json.dumps({**self._begin, "rows": self._rows}))

    def tell(self, **message: Any) -> None:
        self._socket.send(json.dumps(message))

    async def close(self) -> None:
        await self._socket.close()


@pytest.fixture
async def browser(tmp_path: Any) -> AsyncIterator[Browser]:
    """A Chromium before a console without robots."""
    from playwright.async_api import async_playwright

    served: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    bus = FakeBus().join("console")
    with contextlib.closing(server.listener(Address(HOST, 0))) as listening:
        roster = Roster(tmp_path / "roster")
        serving = asyncio.create_task(server.serve(Fleet(bus), bus, listening, roster, served.set_result))
        async with async_playwright() as playwright:
            chromium = await playwright.chromium.launch(executable_path=CHROMIUM, args=[*ARGUMENTS])
            yield Browser(chromium, await served)
            await chromium.close()
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


def row(name: str, state: str = "established", severity: int = 9, **fields: Any) -> dict[str, Any]:
    """A robot as the console tells it."""
    return {
        "name": name,
        "state": state,
        "severity": severity,
        "reason": "",
        "driver": "",
        "latched": [],
        "protocol": "tcpudp",
        "version": "1.3",
        "commands": ["stop", "drive"],
        "rate": 20.0,
        "refused": 0,
        "gaps": 0,
        "host": "hub",
        "gateway": "0.1.0",
        "seen": None,
        **fields,
    }
