"""The console's server: one process on the bus, any number of pages and programs."""

from __future__ import annotations

import contextlib
import re
import socket
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
from starlette.applications import Starlette
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles

from zbridge.app.process_usage import process_metrics
from zbridge.bus import Bus
from zbridge.client.fleet import Fleet
from zbridge.control.audit_log import AuditFile
from zbridge.errors import ConfigError
from zbridge.protocol.address import Address
from zbridge.tasks import race
from zbridge.views.console.api import Api
from zbridge.views.console.callers import Callers
from zbridge.views.console.console import Console
from zbridge.views.console.guard import Guard
from zbridge.views.console.http_server import LOOPBACK, served, tls_context
from zbridge.views.console.journal import FILE_BYTES, FILES, Journal
from zbridge.views.console.roster import Roster

_STATIC = Path(__file__).parent / "static"
_DEFAULT_PORTS = {"http": 80, "https": 443}


class ConsoleSettings(msgspec.Struct, frozen=True):
    """How the console is reached, and by whom.

    hosts: names by which browsers know it, besides its address: ``host`` or ``host:port``. certificate, key: files for
    TLS. users: the file of the users; None: everybody who reaches it may do everything that the console may. journal:
    the file in which is written what they do. proxied: a reverse proxy with TLS on this machine passes requests on.
    own_role: of the console's certificate on a secure bus; None: the bus is open.
    """

    listen: Address
    hosts: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    users: Path | None = None
    journal: Path | None = None
    proxied: bool = False
    own_role: str | None = None

    @property
    def is_local(self) -> bool:
        """Whether only programs of this machine can reach it."""
        return self.listen.host in LOOPBACK and not (self.proxied or self.hosts)

    def __post_init__(self) -> None:
        if (self.certificate is None) is not (self.key is None):
            raise ConfigError("--tls-certificate and --tls-key: expected both, or neither")
        if self.listen.host not in LOOPBACK and self.certificate is None:
            raise ConfigError(
                f"{self.listen.host}: other machines can reach the console: expected --tls-certificate and --tls-key,"
                " or an address of loopback (127.0.0.1, localhost, ::1)"
            )
        if self.proxied and (self.listen.host not in LOOPBACK or not self.hosts):
            raise ConfigError("--proxied: expected an address of loopback, and --host with the name that browsers use")
        if self.listen.host in ("0.0.0.0", "::") and not self.hosts:
            raise ConfigError(f"{self.listen.host}: expected --host with the name by which browsers reach the console")
        if self.users is None and not self.is_local:
            raise ConfigError("other machines can reach the console: expected --users, the file of who may use it")
        if self.users is None and self.own_role is not None:
            raise ConfigError(
                "on a secure bus every user of this machine could use the console's certificate: expected --users"
            )

    def origins(self, host: str, port: int) -> list[str]:
        """Return the origins of the console's own pages, that of its printed address first. host, port: as bound."""
        scheme = "https" if self.certificate is not None or self.proxied else "http"
        names = list(self.hosts)
        if not self.proxied:
            names += [f"[{host}]" if ":" in host else host, *(("localhost",) if self.listen.host in LOOPBACK else ())]
            names = [name if _has_port(name) else f"{name}:{port}" for name in names]
        default = f":{_DEFAULT_PORTS[scheme]}"  # browsers leave it out
        names += [name.removesuffix(default) for name in names if name.endswith(default)]
        return [f"{scheme}://{name}" for name in names]


def _has_port(name: str) -> bool:
    return re.search(r":\d+$", name) is not None and not name.endswith("]")


async def serve(
    fleet: Fleet,
    bus: Bus,
    settings: ConsoleSettings,
    listening: socket.socket,
    roster: Roster,
    ready: Callable[[str], object],
) -> None:
    """Serve until cancelled. ready: called with the address for browsers, once it is served; raises ConfigError."""
    context = None
    if settings.certificate is not None and settings.key is not None:
        context = tls_context(settings.certificate, settings.key)
    callers, metrics, faults = Callers(settings.users, settings.own_role), process_metrics(), dict[str, str | None]()
    origins = settings.origins(*listening.getsockname()[:2])
    with contextlib.ExitStack() as stack:
        journal = Journal()
        if settings.journal is not None:
            tell = partial(faults.__setitem__, "journal")
            file = AuditFile(settings.journal, metrics, file_bytes=FILE_BYTES, files=FILES, tell=tell)
            stack.callback(file.close)
            journal = Journal(file.write)
        async with fleet.watch(lazy=True) as model:
            console = Console(fleet, bus, model, roster, callers, journal, metrics, faults)
            app = Guard(_application(console), frozenset(origins), metrics)
            async with served(app, listening, context, metrics, proxied=settings.proxied):
                ready(origins[0])
                try:
                    await race(console.run())
                finally:
                    await console.close()


def _application(console: Console) -> Starlette:
    async def index(request: Request) -> FileResponse:
        return FileResponse(_STATIC / "index.html")

    routes = [
        Route("/", index),
        WebSocketRoute("/socket", console.serve),
        WebSocketRoute("/drive/{robot}", console.drive),
        *Api(console).routes(),
        Mount("/static", StaticFiles(directory=_STATIC)),
    ]
    app = Starlette(routes=routes)
    app.add_middleware(GZipMiddleware)
    return app
