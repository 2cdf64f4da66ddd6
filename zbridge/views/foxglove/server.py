"""The WebSocket server: accepts connections that the admission lets in, makes a viewer of each, and serves a source."""

from __future__ import annotations

import asyncio
import contextlib
import http
import logging
import ssl
from collections import Counter
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed, InvalidHeader
from websockets.headers import parse_subprotocol
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response
from websockets.protocol import State
from websockets.typing import Subprotocol

from zbridge.app.endpoint import serve_metrics
from zbridge.bus import BusSettings, open_bus
from zbridge.client import Fleet
from zbridge.errors import ConfigError
from zbridge.fleet.printable import shown
from zbridge.log import Log
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.views.foxglove.admission import Admitted, Policy, ViewerAdmission
from zbridge.views.foxglove.commands import RobotCommands
from zbridge.views.foxglove.hub import Hub
from zbridge.views.foxglove.live import LiveSource
from zbridge.views.foxglove.playback import IndexedRecording, Playback
from zbridge.views.foxglove.replies import SUBPROTOCOL
from zbridge.views.foxglove.settings import FoxglovePlan
from zbridge.views.foxglove.source import ViewerSource
from zbridge.views.foxglove.viewer import Overrun, Viewer

log = Log("zbridge.foxglove")

MESSAGE_BYTES = 1024 * 1024
"""Bound of a viewer's message."""
WAITING = 16
"""Messages of a viewer that are read ahead."""
WRITE_BYTES = 256 * 1024
"""Bytes that wait in this process for a viewer's socket; all else waits in its outbox, where newer ones win."""
HANDSHAKE_S = 5.0
CLOSE_S = 1.0
PING_S = 20.0
_POLICY_VIOLATION = 1008
_silent = logging.getLogger("zbridge.foxglove.websockets")
"""What peers do wrong is counted here, not logged there: a log grows by what strangers send."""
_silent.addHandler(logging.NullHandler())
_silent.propagate = False


class ViewerServer:
    """Serves a source at an address. tls: None for plain WebSockets."""

    def __init__(
        self,
        source: ViewerSource,
        address: Address,
        policy: Policy,
        metrics: Metrics,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        self.address = address
        self.viewers: set[Viewer] = set()
        self.open = 0
        """Connections, those in their handshake too."""
        self.refused: Counter[str] = Counter()
        self._source = source
        self.admission = ViewerAdmission(policy)
        self._metrics = metrics
        self._tls = tls
        self._numbers = 0

    def __repr__(self) -> str:
        return f"<ViewerServer {self.address}, {len(self.viewers)} viewers>"

    @contextlib.asynccontextmanager
    async def serve(self) -> AsyncIterator[None]:
        """Serve viewers while the context lasts; ``address`` has the port then. Raise ConfigError for a bad address."""
        try:
            server = await serve(
                self._serve,
                self.address.host,
                self.address.port,
                ssl=self._tls,
                ssl_handshake_timeout=HANDSHAKE_S if self._tls is not None else None,
                process_request=self._admit,
                subprotocols=[Subprotocol(SUBPROTOCOL)],
                create_connection=type("Guarded", (_Guarded,), {"owner": self}),
                compression=None,  # scans hardly shrink, and a core is worth more
                server_header=None,
                logger=_silent,
                max_size=MESSAGE_BYTES,
                max_queue=WAITING,
                write_limit=WRITE_BYTES,
                open_timeout=HANDSHAKE_S,
                close_timeout=CLOSE_S,
                ping_interval=PING_S,
                ping_timeout=PING_S,
            )
        except OSError as error:
            raise ConfigError(f"--listen {self.address}: {error.strerror or error}") from error
        self.address = Address(self.address.host, int(next(iter(server.sockets)).getsockname()[1]))
        try:
            yield
        finally:
            server.close()
            await server.wait_closed()
            if self.refused:
                refused = ", ".join(f"{reason} {count}" for reason, count in sorted(self.refused.items()))
                log.info("connections_refused", "connections refused: {counts}", counts=refused)

    def turn_away(self, reason: str, host: str, what: str = "") -> None:
        """Count a connection that is refused. what: of it people need to know, from the peer."""
        self._metrics.count("foxglove_refused", reason=reason).value += 1
        self.refused[reason] += 1
        template = "{peer} turned away: {reason} {what}"
        log.debug("viewer_turned_away", template, peer=host, reason=reason, what=shown(what))

    def _admit(self, connection: ServerConnection, request: HttpRequest) -> Response | None:
        """Turn a handshake away, or note what the viewer is."""
        try:
            offered = [
                name for line in request.headers.get_all("Sec-WebSocket-Protocol") for name in parse_subprotocol(line)
            ]
            origins = request.headers.get_all("Origin")
            decision = self.admission.admit(request.path, origins, offered, _host(connection), len(self.viewers))
        except (InvalidHeader, ValueError):
            self.turn_away("malformed", _host(connection))
            return connection.respond(http.HTTPStatus.BAD_REQUEST, "malformed\n")
        if isinstance(decision, Admitted):
            connection.admitted = decision  # type: ignore[attr-defined]
            return None
        self.turn_away(decision.reason, _host(connection), " ".join(origins))
        return connection.respond(decision.status, decision.text + "\n")

    async def _serve(self, connection: ServerConnection) -> None:
        assert isinstance(connection, _Guarded)
        admitted: Admitted = connection.admitted  # type: ignore[attr-defined]
        policy = self.admission.policy
        if len(self.viewers) >= policy.viewers:  # others came during its handshake
            self.turn_away("full", _host(connection))
            return
        self._numbers += 1
        name = f"{policy.who}.{admitted.label}.{self._numbers}"
        clock = asyncio.get_running_loop().time
        viewer = Viewer(name, self._source, connection, may_drive=admitted.may_drive, clock=clock)
        self.viewers.add(viewer)
        rights = ", may drive" if admitted.may_drive else ""
        log.info("viewer_came", "{session} came{rights}", session=name, rights=rights, peer=_host(connection))
        why = "left"
        try:
            await viewer.run()
        except ConnectionClosed as closed:
            why = f"is gone: {shown(closed)}"
        except TimeoutError:
            why = "ended: it reads nothing"
        except Overrun as overrun:
            why = f"ended: {overrun}"
            await connection.close(_POLICY_VIOLATION, str(overrun))
        finally:
            self.viewers.discard(viewer)
            for reason, count in viewer.counts.items():
                self._metrics.count("foxglove_viewer_messages", what=reason).value += count
            counted = ", ".join(f"{reason} {count}" for reason, count in sorted(viewer.counts.items()) if count)
            counts = counted or "sent nothing"
            log.info("viewer_left", "{session} {reason} ({counts})", session=name, reason=why, counts=counts)


class _Guarded(ServerConnection):
    """A connection that is closed before it costs anything, if the admission rejects it.

    It sends without a task where the socket takes it: each turn of the event loop less is a tenth of the latency.
    """

    owner: ViewerServer
    _counted = False

    def send_now(self, message: bytes) -> bool:
        """Send a binary message without waiting; False if it would have to wait, or the connection ends."""
        if self.protocol.state is not State.OPEN or self.transport.get_write_buffer_size():
            return False
        self.protocol.send_binary(message)
        self.transport.write(b"".join(self.protocol.data_to_send()))
        return True

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        peer: Any = transport.get_extra_info("peername")
        host = str(peer[0]) if peer else ""
        refused = self.owner.admission.refusal(host, self.owner.open, asyncio.get_running_loop().time())
        if refused is not None:
            self.owner.turn_away(refused, host)
            transport.abort()  # type: ignore[attr-defined]
            return
        self._counted = True
        self.owner.open += 1
        super().connection_made(transport)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._counted:
            self.owner.open -= 1
            super().connection_lost(exc)


def tls_context(certificate: str, key: str) -> ssl.SSLContext:
    """Return the TLS settings of a server; raise ConfigError if the files cannot be used."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    try:
        context.load_cert_chain(certificate, key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(f"--tls-certificate {certificate}, --tls-key {key}: {error}") from error
    return context


def _host(connection: ServerConnection) -> str:
    peer: Any = connection.remote_address
    return str(peer[0])


async def serve_live(
    plan: FoxglovePlan, bus: BusSettings, realm: str, metrics: Metrics, on_ready: Callable[[ViewerServer], None]
) -> None:
    """Serve the robots of a realm; raise BusError or ConfigError. on_ready: called when viewers are accepted."""
    async with contextlib.AsyncExitStack() as stack:
        joined = await open_bus(bus, metrics, wait_for_peers=True)
        stack.push_async_callback(joined.close)
        hub = Hub()
        commands = RobotCommands(hub, Fleet(joined, realm), plan.scales, plan.policy.who)
        live = LiveSource(hub, joined, realm, plan.robots, commands, metrics)
        stack.push_async_callback(live.close)
        live.start()
        await _serve(plan, live, metrics, on_ready)


async def serve_file(
    plan: FoxglovePlan, file: Path, metrics: Metrics, on_ready: Callable[[ViewerServer], None]
) -> None:
    """Serve a recording; raise ZbridgeError if it cannot be read. on_ready: called when viewers are accepted."""
    recording = await asyncio.to_thread(IndexedRecording, file)
    if not recording.whole:
        text = "{file}: has no index, as if it was cut off; it is played up to the cut"
        log.warning("recording_without_index", text, file=file)
    await _serve(plan, Playback(Hub(), recording), metrics, on_ready)


async def _serve(
    plan: FoxglovePlan, source: ViewerSource, metrics: Metrics, on_ready: Callable[[ViewerServer], None]
) -> None:
    tls = tls_context(*plan.tls) if plan.tls is not None else None
    server = ViewerServer(source, plan.address, plan.policy, metrics, tls)
    counters = serve_metrics(plan.metrics, metrics) if plan.metrics is not None else contextlib.nullcontext()
    async with server.serve(), counters:
        on_ready(server)
        await source.run()
