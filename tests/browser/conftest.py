"""A Chromium, and pages whose feed is mocked.

Without a Chromium the tests are skipped and say where it was looked for; where ``ZBRIDGE_CHROMIUM`` names one that is
not there, they fail. Of all workers two have a browser at a time: more would starve the tests that measure time.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import json
import os
import shutil
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest
import pytest_asyncio

from tests.fake_bus import FakeBus
from tests.views.console.serving import served
from zbridge.client import Fleet

NAMED = os.environ.get("ZBRIDGE_CHROMIUM")
CHROMIUM = NAMED or shutil.which("chromium")
PICTURES = os.environ.get("ZBRIDGE_PICTURES")
"""A folder in which each page that a test photographs is kept."""
ARGUMENTS = ("--no-sandbox", "--disable-quic", "--disable-background-networking", "--disable-component-update")
WIDE, NARROW = {"width": 1200, "height": 700}, {"width": 360, "height": 740}
AT_ONCE = 2
_READS_BACK = "Canvas2D: Multiple readback operations"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs a browser where there is none."""
    try:
        import playwright  # noqa: F401
    except ImportError:
        why = "playwright is not installed"
    else:
        why = "" if CHROMIUM else "no Chromium (looked in PATH and ZBRIDGE_CHROMIUM)"
    ours = [item for item in items if item.path.parent.name == "browser"]
    for item in ours if why and not NAMED else ():
        item.add_marker(pytest.mark.skip(reason=f"{why}: {len(ours)} browser tests not run"))


class Browser:
    """Pages of one Chromium, and what they complained of."""

    def __init__(self, chromium: Any, at: str) -> None:
        self._chromium, self.at = chromium, at
        self.complaints: list[str] = []

    async def open(
        self, path: str = "", *, feed: Callable[[Any], None] | None = None, size: Any = WIDE, scheme: str = "light"
    ) -> Any:
        """Open the console; ``feed`` is given the page's socket, of which nobody else hears."""
        context = await self._chromium.new_context(viewport=size, color_scheme=scheme, reduced_motion="reduce")
        page = await context.new_page()
        page.on("console", lambda message: self._complain(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: self._complain(str(error)))
        if feed is not None:
            await page.route_web_socket("**/socket", feed)
        await page.goto(self.at + path)
        return page

    async def photograph(self, page: Any, name: str) -> None:
        """Keep a picture of the whole page for people to look at, if somebody asked for it."""
        if PICTURES is not None:
            (Path(PICTURES) / f"{name}.png").write_bytes(await page.screenshot(full_page=True))

    def _complain(self, text: str) -> None:
        if _READS_BACK not in text:  # the tests themselves do that
            self.complaints.append(text)


async def pushed(page: Any, push: Callable[[], Any], let_go: Callable[[], Any], moves: Callable[[], Any]) -> None:
    """Push a stick until it drives. On a busy machine it must be centred and pushed again, as people do."""
    for _ in range(5):
        await push()
        with contextlib.suppress(TimeoutError, AssertionError):
            await moves()
            return
        await let_go()
        await page.get_by_text("Ready.").wait_for()
    pytest.fail("the stick drives nothing")


def told(action: str, text: str, *, good: bool | None) -> dict[str, Any]:
    """A notice of the console's, of now."""
    return {"action": action, "text": text, "at": time.time(), "good": good}


class Feed:
    """Plays the console's server to one page: what it says, and what it was asked for."""

    def __init__(self, *rows: dict[str, Any], **more: Any) -> None:
        self.asked: list[dict[str, Any]] = []
        self._begin = {"full": True, "realm": "fleet", "bus": True, "notices": {}, "fault": None, **more}
        self._rows = rows
        self._socket: Any = None
        self.quiet = False
        """Whether it says nothing while nothing changes, as a console that hangs."""
        self._alive: asyncio.Task[None] | None = None

    def __call__(self, socket: Any) -> None:
        self._socket, self.quiet = socket, False
        socket.on_message(lambda text: self.asked.append(json.loads(text)))
        socket.send(json.dumps({"now": time.time(), **self._begin, "rows": self._rows}))
        self._alive = asyncio.get_running_loop().create_task(self._stay_alive())

    def tell(self, **message: Any) -> None:
        self._socket.send(json.dumps({"now": time.time(), **message}))

    def publish(
        self, robot: str, *, period_s: float = 1.0, age_s: float = 0.0, late_s: float = 0.0, **messages: Any
    ) -> None:
        """Send messages of a robot by their paths (``__`` for ``/``); bytes are sent as they are.

        age_s: how long ago the console received them. late_s: how long this frame was on its way.
        """
        now = time.monotonic() - late_s
        news = [
            (path.replace("__", "/"), now - age_s, period_s, each if isinstance(each, bytes) else msgpack.packb(each))
            for path, each in messages.items()
        ]
        self._socket.send(msgpack.packb({"robot": robot, "now": now, "news": news}))

    def requests(self, *do: str) -> list[dict[str, Any]]:
        """Give what was asked for, besides looking at robots; or only what these words ask for."""
        return [each for each in self.asked if (each["do"] in do if do else each["do"] != "look")]

    async def looked_at(self, robot: str) -> None:
        """Wait until the page looks at a robot."""
        await soon(lambda: {"do": "look", "robot": robot} in self.asked)

    async def close(self, code: int | None = None) -> None:
        self.quiet = True
        await self._socket.close(code=code)

    async def _stay_alive(self) -> None:
        with contextlib.suppress(Exception):  # the browser is gone
            while True:
                await asyncio.sleep(1.0)
                if not self.quiet:
                    self.tell()


async def soon(condition: Callable[[], Any], within_s: float = 10.0) -> None:
    async with asyncio.timeout(within_s):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.02)


@pytest_asyncio.fixture(loop_scope="session", scope="session")
async def launched() -> AsyncIterator[Any]:
    """The Chromium of this worker."""
    async with chromium() as running:
        yield running


@contextlib.asynccontextmanager
async def chromium() -> AsyncIterator[Any]:
    """Run a Chromium."""
    from playwright.async_api import async_playwright

    async with async_playwright() as playwright:
        running = await playwright.chromium.launch(executable_path=CHROMIUM, args=[*ARGUMENTS])
        try:
            yield running
        finally:
            await running.close()


@pytest_asyncio.fixture(loop_scope="session")
async def shared(launched: Any) -> AsyncIterator[Any]:
    """The Chromium of this worker, when fewer than :data:`AT_ONCE` are used."""
    with await asyncio.to_thread(_turn):
        yield launched
        for context in launched.contexts:
            await context.close()


def _turn() -> contextlib.AbstractContextManager[None]:
    """Wait for a place among all workers."""
    places = [Path(tempfile.gettempdir()) / f"zbridge-browser-{os.getuid()}-{place}" for place in range(AT_ONCE)]
    files = [place.open("w") for place in places]
    while True:
        for file in files:
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return _closing(files)
        time.sleep(0.05)


@contextlib.contextmanager
def _closing(files: list[Any]) -> Iterator[None]:
    try:
        yield
    finally:
        for file in files:
            file.close()


@pytest_asyncio.fixture(loop_scope="session")
async def browser(tmp_path: Any, shared: Any) -> AsyncIterator[Browser]:
    """A browser before a console without robots."""
    bus = FakeBus().join("console")
    async with served(Fleet(bus), bus, tmp_path / "roster") as at:
        yield Browser(shared, at)


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
