"""The console's server: one process on the bus, any number of pages on loopback."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import msgspec
import uvicorn
from starlette.applications import Starlette
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request as HttpRequest
from starlette.responses import FileResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from zbridge.bus import Bus
from zbridge.client.fleet import Fleet
from zbridge.client.fleet_model import FleetModel
from zbridge.client.stops import summarize
from zbridge.errors import ConfigError, LinkError, ZbridgeError
from zbridge.protocol.address import Address
from zbridge.tasks import Tasks, race
from zbridge.views.console.feed import FleetFeed
from zbridge.views.console.fleet_stop import StopReport, stop_fleet
from zbridge.views.console.guard import Guard
from zbridge.views.console.page import MOST_BYTES, Page, Request
from zbridge.views.console.roster import Roster

REFRESH_S = 0.5
"""Seconds between two looks at the fleet."""
PAGES = 100
"""Most pages at a time; further ones are told so."""
STOPS = 32
"""Most stops of single robots at a time."""
_FULL = 1013
_STATIC = Path(__file__).parent / "static"
_encode = msgspec.json.Encoder().encode


class StopNotice(msgspec.Struct, frozen=True):
    """What pages are told of the last stop. at: Unix seconds. good: None while the stop is on its way."""

    text: str
    at: float
    good: bool | None = None


class Console:
    """What the pages see and do."""

    def __init__(self, fleet: Fleet, bus: Bus, model: FleetModel, roster: Roster) -> None:
        self.notice: StopNotice | None = None
        self._fleet = fleet
        self._bus = bus
        self._model = model
        self._roster = roster
        self._feed = FleetFeed(model)
        self._pages: set[Page] = set()
        self._stopping: asyncio.Task[None] | None = None
        self._work = Tasks()
        self._connected = True

    def __repr__(self) -> str:
        return f"<Console {self._feed!r}, {len(self._pages)} pages>"

    async def run(self) -> None:
        """Follow the fleet, and tell the pages."""
        with contextlib.closing(self._bus.watch_connected(self._follow_bus)):
            while True:
                self._look()
                await asyncio.to_thread(self._roster.save)
                await asyncio.sleep(REFRESH_S)

    async def serve(self, socket: WebSocket) -> None:
        """Serve one page."""
        if len(self._pages) >= PAGES:
            await socket.close(_FULL, f"{PAGES} pages are open, the most there may be")
            return
        await socket.accept()
        page = Page(socket, self._snapshot, self._carry_out)
        self._pages.add(page)
        try:
            await page.serve()
        finally:
            self._pages.discard(page)

    async def close(self) -> None:
        """Wait for the stops that are on their way."""
        stopping = [self._stopping] if self._stopping is not None else []
        await asyncio.gather(*stopping, *self._work.running, return_exceptions=True)

    def _follow_bus(self, connected: bool) -> None:
        """The bus was lost, or is back: robots then have some seconds to show that they are there too."""
        if connected:
            self._model.opened_at = self._model.clock()
        self._connected = connected
        self._tell(_encode({"bus": connected}))

    def _look(self) -> None:
        self._roster.add(name for name, entry in self._model.robots.items() if entry.alive)
        changes = self._feed.refresh(self._roster.names, connected=self._connected)
        if changes is not None:
            self._tell(changes)

    def _snapshot(self) -> bytes:
        return self._feed.snapshot(
            realm=self._fleet.realm, bus=self._connected, notice=self.notice, roster=self._roster.fault
        )

    def _tell(self, message: bytes) -> None:
        for page in self._pages:
            page.tell(message)

    def _notify(self, text: str, *, good: bool | None = None) -> None:
        self.notice = StopNotice(text, time.time(), good)
        self._tell(_encode({"notice": self.notice}))

    # What pages ask for

    def _carry_out(self, request: Request) -> None:
        if request.do == "stop_all":
            if self._stopping is None or self._stopping.done():  # else it is being repeated until it is confirmed
                self._notify("STOP ALL is sent; waiting for the gateways to confirm it")
                self._stopping = asyncio.create_task(self._stop_all())
        elif request.do == "release":
            self._spawn(self._release())
        elif request.do == "stop" and request.robot:
            self._spawn(self._stop(request.robot))
        elif request.do == "forget" and not self._is_alive(request.robot):
            self._roster.forget(request.robot)
            self._model.robots.pop(request.robot, None)
            self._look()

    def _spawn(self, work: Coroutine[Any, Any, None]) -> None:
        if len(self._work) < STOPS:
            self._work.start(work)
        else:
            work.close()
            self._notify(f"{STOPS} stops are on their way, the most there may be", good=False)

    async def _stop_all(self) -> None:
        try:
            report = await stop_fleet(self._fleet, self._bus, self._roster.names.copy(), _Alive(self._model))
        except ZbridgeError as error:
            report = StopReport(f"STOP ALL: {error}", good=False)
        self._notify(report.text, good=report.good)

    async def _release(self) -> None:
        try:
            outcomes = await self._fleet.unlatch()
        except ZbridgeError as error:
            self._notify(f"Release: {error}", good=False)
            return
        good = bool(outcomes) and not any(outcomes.values())
        self._notify(summarize(outcomes, "released") if outcomes else "No gateway is on the bus", good=good)

    async def _stop(self, robot: str) -> None:
        self._notify(f"{robot}: the stop is sent; waiting for its gateway to confirm it")
        try:
            await self._fleet[robot].stop("console")
        except ZbridgeError as error:
            self._notify(str(error), good=False)
        else:
            self._notify(f"{robot} stopped (its gateway sent it)", good=True)

    def _is_alive(self, robot: str) -> bool:
        entry = self._model.robots.get(robot)
        return entry is not None and entry.alive


class _Alive:
    """The robots that have a gateway now."""

    def __init__(self, model: FleetModel) -> None:
        self._model = model

    def __contains__(self, robot: object) -> bool:
        entry = self._model.robots.get(str(robot))
        return entry is not None and entry.alive

    def __iter__(self) -> Iterator[str]:
        return (name for name, entry in self._model.robots.items() if entry.alive)

    def __len__(self) -> int:
        return sum(1 for _ in self)


class _Server(uvicorn.Server):
    """Leaves signals to the command line."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def listener(address: Address) -> socket.socket:
    """Listen on loopback; raise ConfigError for another address, LinkError for one that is taken."""
    if address.host not in ("127.0.0.1", "localhost", "::1"):
        raise ConfigError(f"{address.host}: the console listens on loopback only: expected 127.0.0.1, localhost or ::1")
    family = socket.AF_INET6 if address.host == "::1" else socket.AF_INET
    try:
        return socket.create_server((address.host, address.port), family=family)
    except OSError as error:
        raise LinkError(f"{address}: {error.strerror or error}") from error


async def serve(
    fleet: Fleet, bus: Bus, listening: socket.socket, roster: Roster, ready: Callable[[str], object]
) -> None:
    """Serve pages until cancelled. ready: called with the address for browsers, once it is served."""
    host, port = listening.getsockname()[:2]
    shown = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
    async with fleet.watch(lazy=True) as model:
        console = Console(fleet, bus, model, roster)
        app = Guard(_application(console), frozenset((shown, f"localhost:{port}")))
        async with _served(app, listening):
            ready(f"http://{shown}")
            try:
                await race(console.run())
            finally:
                await console.close()


def _application(console: Console) -> Starlette:
    async def index(request: HttpRequest) -> FileResponse:
        return FileResponse(_STATIC / "index.html")

    routes = [
        Route("/", index),
        WebSocketRoute("/socket", console.serve),
        Mount("/static", StaticFiles(directory=_STATIC)),
    ]
    app = Starlette(routes=routes)
    app.add_middleware(GZipMiddleware)
    return app


@contextlib.asynccontextmanager
async def _served(app: Guard, listening: socket.socket) -> AsyncIterator[None]:
    """Run the HTTP server while the context lasts."""
    server = _Server(
        uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            log_level="warning",
            lifespan="off",
            server_header=False,
            ws="websockets-sansio",
            ws_max_size=MOST_BYTES,
            timeout_graceful_shutdown=1,
        )
    )
    serving = asyncio.create_task(server.serve(sockets=[listening]))
    try:
        yield
    finally:
        server.should_exit = True
        await serving
