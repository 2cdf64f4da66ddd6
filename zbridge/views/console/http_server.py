"""The HTTP server: uvicorn, behind an accept loop of our own that bounds connections and the time of each request.

uvicorn waits for ever for the first byte of a connection, and for the end of a request's head. Here at most
:data:`CONNECTIONS` are open, :data:`EACH` of one address, and each must complete its TLS handshake within
:data:`HANDSHAKE_S` and the head of a request within :data:`REQUEST_S`. What is refused is counted.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import ipaddress
import socket
import ssl
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from zbridge.errors import ConfigError, LinkError
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.tasks import Tasks
from zbridge.views.console.page import MOST_BYTES

CONNECTIONS, EACH = 512, 256
"""Most connections at a time, and most of one address; with a reverse proxy they all are of one."""
HANDSHAKE_S, REQUEST_S, IDLE_S = 5.0, 10.0, 5.0
HEAD_BYTES = 16_384
"""Bound of the head of a request."""
LOOPBACK = ("127.0.0.1", "localhost", "::1")


def listener(address: Address) -> socket.socket:
    """Listen; raise LinkError for an address that is taken or is not of this machine."""
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    try:
        return socket.create_server((address.host, address.port), family=family)
    except OSError as error:
        raise LinkError(f"{address}: {error.strerror or error}") from error


def tls_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """Return the TLS context of a server; raise ConfigError if the files cannot be used."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(f"{certificate}, {key}: {getattr(error, 'strerror', None) or error}") from error
    return context


@functools.lru_cache(1024)
def network_of(address: str) -> str:
    """Return what counts as one client: an address, or the network of an IPv6 address, of which one host has many."""
    try:
        found = ipaddress.IPv6Address(address.partition("%")[0])
    except ValueError:
        return address
    return str(found.ipv4_mapped or ipaddress.IPv6Network((found, 64), strict=False))


class _BoundedRequest(H11Protocol):
    """One connection: closed if the head of a request does not come in time. slow: called then."""

    _head_timer: asyncio.TimerHandle | None = None

    def __init__(self, slow: Callable[[], None], *arguments: Any, **more: Any) -> None:
        super().__init__(*arguments, **more)
        self._slow = slow

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._expect_head()

    def connection_lost(self, exc: Exception | None) -> None:
        self._cancel()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if self.conn.their_state is not h11.IDLE:
            self._cancel()
        elif self._head_timer is None:
            self._expect_head()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if self.conn.their_state is h11.SEND_BODY:  # nobody reads the rest of a body, however slowly it comes
            self.transport.close()

    def _expect_head(self) -> None:
        self._head_timer = self.loop.call_later(REQUEST_S, self._expire)

    def _expire(self) -> None:
        self._head_timer = None
        if self.conn.their_state is h11.IDLE:
            self._slow()
            self.transport.close()

    def _cancel(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None


class _Acceptor:
    """Accepts connections within the bounds; uvicorn closes it as one of its servers. make: a connection's protocol."""

    def __init__(
        self,
        listening: socket.socket,
        context: ssl.SSLContext | None,
        state: ServerState,
        make: Callable[[Callable[[], None]], asyncio.Protocol],
        metrics: Metrics,
    ) -> None:
        listening.setblocking(False)
        self._listening = listening
        self._context = context
        self._state = state
        self._make = make
        self._metrics = metrics
        self._handshaking: dict[socket.socket, str] = {}
        self._work = Tasks()
        self._work.start(self._accept())

    def close(self) -> None:
        """Accept nothing any more."""
        self._work.cancel()

    async def wait_closed(self) -> None:
        await self._work.end()

    def _refuse(self, why: str) -> None:
        self._metrics.count("console_connections_refused", reason=why).value += 1

    def _is_full(self, address: str) -> bool:
        connections: Iterable[Any] = self._state.connections
        clients = [network_of(each.client[0]) for each in connections if each.client is not None]
        clients += map(network_of, self._handshaking.values())
        return len(clients) >= CONNECTIONS or clients.count(network_of(address)) >= EACH

    async def _accept(self) -> None:
        while True:
            try:
                accepted, peer = await asyncio.get_running_loop().sock_accept(self._listening)
            except OSError:  # no descriptor is left, or the peer has gone already
                self._refuse("accept")
                await asyncio.sleep(0.1)
                continue
            if self._is_full(peer[0]):
                self._refuse("full")
                accepted.close()
            else:
                self._handshaking[accepted] = peer[0]
                self._work.start(self._connect(accepted))

    async def _connect(self, accepted: socket.socket) -> None:
        timeout = {"ssl_handshake_timeout": HANDSHAKE_S} if self._context is not None else {}

        def make() -> asyncio.Protocol:
            return self._make(lambda: self._refuse("slow"))

        try:
            accepted.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            loop = asyncio.get_running_loop()
            await loop.connect_accepted_socket(make, accepted, ssl=self._context, **timeout)
        except (OSError, ssl.SSLError, TimeoutError):
            self._refuse("handshake")
            accepted.close()
        finally:
            del self._handshaking[accepted]


class _Server(uvicorn.Server):
    """Leaves signals to the command line, and accepts connections by an acceptor."""

    def __init__(
        self, config: uvicorn.Config, listening: socket.socket, context: ssl.SSLContext | None, metrics: Metrics
    ) -> None:
        super().__init__(config)
        self._accepting = (listening, context, metrics)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        listening, context, metrics = self._accepting

        def make(slow: Callable[[], None]) -> asyncio.Protocol:
            return _BoundedRequest(slow, config=self.config, server_state=self.server_state, app_state={})

        await self.lifespan.startup()
        self.servers: list[Any] = [_Acceptor(listening, context, self.server_state, make, metrics)]
        self.started = True


@contextlib.asynccontextmanager
async def served(
    app: ASGIApp, listening: socket.socket, context: ssl.SSLContext | None, metrics: Metrics, *, proxied: bool
) -> AsyncIterator[None]:
    """Serve an application while the context lasts. proxied: a reverse proxy on this machine names its clients."""
    server = _Server(
        uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            log_level="warning",
            lifespan="off",
            server_header=False,
            proxy_headers=proxied,
            h11_max_incomplete_event_size=HEAD_BYTES,
            timeout_keep_alive=round(IDLE_S),
            ws="websockets-sansio",
            ws_max_size=MOST_BYTES,
            ws_per_message_deflate=False,  # on loopback it costs more than it saves
            timeout_graceful_shutdown=1,
        ),
        listening,
        context,
        metrics,
    )
    serving = asyncio.create_task(server.serve())
    try:
        yield
    finally:
        server.should_exit = True
        await serving
