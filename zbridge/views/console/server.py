"""The console's server: one process on the bus, any number of pages on loopback."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request as HttpRequest
from starlette.responses import FileResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles

from zbridge.bus import Bus
from zbridge.client.fleet import Fleet
from zbridge.errors import ConfigError, LinkError
from zbridge.protocol.address import Address
from zbridge.tasks import race
from zbridge.views.console.console import Console
from zbridge.views.console.guard import Guard
from zbridge.views.console.page import MOST_BYTES
from zbridge.views.console.roster import Roster

_STATIC = Path(__file__).parent / "static"


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
        WebSocketRoute("/drive/{robot}", console.drive),
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
            ws_per_message_deflate=False,  # on loopback it costs more than it saves
            timeout_graceful_shutdown=1,
        )
    )
    serving = asyncio.create_task(server.serve(sockets=[listening]))
    try:
        yield
    finally:
        server.should_exit = True
        await serving
