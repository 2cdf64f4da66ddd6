"""The WebSocket server on loopback: who becomes a viewer, who is turned away, and how connections end."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import json
import socket
import ssl
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Origin, Subprotocol

from tests.certificates import Authority
from zbridge.errors import ConfigError
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.views.foxglove.admission import Policy
from zbridge.views.foxglove.hub import Hub
from zbridge.views.foxglove.server import MESSAGE_BYTES, ViewerServer, tls_context
from zbridge.views.foxglove.source import ViewerSource
from zbridge.views.pictures import ViewerChannel
from zbridge.views.schemas import Schema

HOST = "127.0.0.1"
FOXGLOVE = Origin("https://app.foxglove.dev")
POSE = ViewerChannel("/r1/pose", "pose", Schema("S", "jsonschema", b"{}", "json"))


class Scene:
    """A server of one channel, and the connections to it."""

    def __init__(self, policy: Policy, tls: ssl.SSLContext | None = None) -> None:
        self.hub, self.metrics = Hub(), Metrics()
        self.hub.offer([POSE])
        self.server = ViewerServer(ViewerSource(self.hub), Address(HOST, 0), policy, self.metrics, tls)
        self.scheme = "ws" if tls is None else "wss"
        self._open = contextlib.AsyncExitStack()

    async def connect(self, path: str = "/", **options: Any) -> ClientConnection:
        settings = {"subprotocols": [Subprotocol("foxglove.sdk.v1")], "proxy": None, **options}
        url = f"{self.scheme}://{HOST}:{self.server.address.port}{path}"
        return await self._open.enter_async_context(connect(url, **settings))

    async def refused(self, path: str = "/", **options: Any) -> int:
        """Connect, and be turned away; give the HTTP status."""
        with pytest.raises(InvalidStatus) as raised:
            await self.connect(path, **options)
        return raised.value.response.status_code

    async def until(self, viewers: int) -> None:
        """Wait for a number of viewers, and of connections."""
        async with asyncio.timeout(10.0):
            while len(self.server.viewers) != viewers or self.server.open != viewers:  # noqa: ASYNC110
                await asyncio.sleep(0.001)

    def turned_away(self, reason: str) -> int:
        assert self.metrics.count("foxglove_refused", reason=reason).value == self.server.refused[reason]
        return self.server.refused[reason]

    async def close(self) -> None:
        await self._open.aclose()


@contextlib.asynccontextmanager
async def serving(policy: Policy | None = None, tls: ssl.SSLContext | None = None) -> AsyncIterator[Scene]:
    scene = Scene(policy or Policy(), tls)
    async with scene.server.serve():
        try:
            yield scene
        finally:
            await scene.close()


async def test_a_connection_becomes_a_viewer_that_is_shown_the_channels_and_their_messages() -> None:
    async with serving() as scene:
        client = await scene.connect("/?name=ann")
        assert client.subprotocol == "foxglove.sdk.v1"
        assert json.loads(await client.recv())["op"] == "serverInfo"
        assert json.loads(await client.recv())["channels"][0]["topic"] == "/r1/pose"
        await client.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": 1}]}))
        async with asyncio.timeout(10.0):
            while not scene.hub.wanted():  # noqa: ASYNC110
                await asyncio.sleep(0.001)
        scene.hub.publish("/r1/pose", 5, b"here")
        assert await client.recv() == b"\x01" + bytes([7, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0]) + b"here"
        (viewer,) = scene.server.viewers
        assert (viewer.name, viewer.may_drive) == ("foxglove.ann.1", False)
        await client.close()
        await scene.until(viewers=0)
        assert scene.metrics.count("foxglove_viewer_messages", what="said").value == 1
        assert scene.hub.wanted() == []


async def test_viewers_have_numbers_of_their_own_and_drive_where_that_is_allowed() -> None:
    async with serving(Policy(drive=True)) as scene:
        await scene.connect("/?name=ann", origin=FOXGLOVE)
        await scene.connect("/?name=ann")
        await scene.until(viewers=2)
        found = sorted((viewer.name, viewer.may_drive) for viewer in scene.server.viewers)
        assert found == [("foxglove.ann.1", True), ("foxglove.ann.2", False)]


async def test_who_is_not_admitted_is_turned_away_with_a_status_and_counted() -> None:
    async with serving(Policy(viewers=2, token="secret")) as scene:
        assert await scene.refused() == 401
        assert await scene.refused("/?token=secret", origin=Origin("https://evil.example")) == 403
        assert await scene.refused("/?token=secret", subprotocols=None) == 400
        assert await scene.refused(additional_headers={"Sec-WebSocket-Protocol": "a b"}, subprotocols=None) == 400
        for _ in range(2):
            await scene.connect("/?token=secret")
        await scene.until(viewers=2)
        assert await scene.refused("/?token=secret") == 503
        reasons = ("token", "origin", "subprotocol", "malformed", "full")
        assert [scene.turned_away(reason) for reason in reasons] == [1] * 5


async def test_a_connection_of_another_network_is_closed_before_it_says_anything() -> None:
    async with serving(Policy(networks=(ipaddress.ip_network("10.0.0.0/8"),))) as scene:
        reader, writer = await asyncio.open_connection(HOST, scene.server.address.port)
        with contextlib.suppress(ConnectionError):
            assert await reader.read() == b""
        writer.close()
        assert (scene.turned_away("network"), scene.server.open) == (1, 0)


async def test_connections_in_their_handshake_are_bounded_too() -> None:
    async with serving(Policy(viewers=1)) as scene:
        silent = [await asyncio.open_connection(HOST, scene.server.address.port) for _ in range(3)]
        with contextlib.suppress(ConnectionError):
            assert await silent[2][0].read() == b""
        assert (scene.turned_away("full"), scene.server.open) == (1, 2)
        for _, writer in silent:
            writer.close()
        await scene.until(viewers=0)


async def test_a_viewer_that_breaks_a_limit_is_told_and_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zbridge.views.foxglove.viewer.RATE_HZ", 5.0)
    async with serving() as scene:
        fast, large = await scene.connect(), await scene.connect()
        with contextlib.suppress(ConnectionClosed):
            for _ in range(50):
                await fast.send("{")
        await fast.wait_closed()
        assert (fast.close_code, fast.close_reason) == (1008, "more than 5 messages a second")
        with contextlib.suppress(ConnectionClosed):
            await large.send("x" * (MESSAGE_BYTES + 1))
        await scene.until(viewers=0)


async def test_an_address_in_use_and_files_that_are_no_certificate_are_told(tmp_path: Path) -> None:
    with socket.create_server((HOST, 0)) as taken:
        port = taken.getsockname()[1]
        server = ViewerServer(ViewerSource(Hub()), Address(HOST, port), Policy(), Metrics())
        with pytest.raises(ConfigError, match=f"--listen tcp://{HOST}:{port}: .*[Aa]ddress already in use"):
            await server.serve().__aenter__()
    with pytest.raises(ConfigError, match=r"--tls-certificate no\.pem, --tls-key no\.key"):
        tls_context("no.pem", "no.key")


async def test_a_server_with_a_certificate_speaks_tls(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    files = authority.issue("foxglove.view")
    tls = tls_context(str(files / "certificate.pem"), str(files / "key.pem"))
    async with serving(tls=tls) as scene:
        client = await scene.connect(ssl=ssl.create_default_context(cafile=str(authority.ca)))
        assert json.loads(await client.recv())["op"] == "serverInfo"
