"""The counters' page, over a real socket on loopback."""

import asyncio
import contextlib
import logging
import socket

import pytest

from tests.ports import free_port
from zbridge.app import prometheus as exporter
from zbridge.app.prometheus import serve_metrics
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address


@pytest.fixture
def address() -> Address:
    return Address("127.0.0.1", free_port())


@pytest.fixture
def metrics() -> Metrics:
    metrics = Metrics()
    metrics.count("published").value = 7
    return metrics


async def asked(address: Address, request: bytes = b"GET / HTTP/1.0\r\n\r\n") -> bytes:
    """Send a request; give what comes back until the end."""
    reader, writer = await asyncio.open_connection(address.host, address.port)
    writer.write(request)
    try:
        async with asyncio.timeout(5):
            return await reader.read()
    finally:
        writer.close()
        await writer.wait_closed()


@pytest.mark.parametrize("path", [b"/metrics", b"/"])
async def test_the_page_shows_the_counters_as_they_are_now(address: Address, metrics: Metrics, path: bytes) -> None:
    request = b"GET " + path + b" HTTP/1.1\r\nHost: x\r\n\r\n"
    async with serve_metrics(address, metrics):
        head, body = (await asked(address, request)).split(b"\r\n\r\n", 1)
        metrics.count("published").value += 1
        assert (await asked(address, request)).endswith(b"zbridge_published_total 8\n")
    assert head.startswith(b"HTTP/1.0 200 OK\r\n")
    assert b"Content-Type: text/plain; version=0.0.4" in head
    assert f"Content-Length: {len(body)}".encode() in head
    assert body == b"# TYPE zbridge_published_total counter\nzbridge_published_total 7\n"
    with pytest.raises(OSError):
        await asked(address)  # the page is gone with the context


@pytest.mark.parametrize("request_line", [b"GET /other HTTP/1.0", b"POST /metrics HTTP/1.0", b"nonsense"])
async def test_anything_else_is_not_found(address: Address, metrics: Metrics, request_line: bytes) -> None:
    async with serve_metrics(address, metrics):
        response = await asked(address, request_line + b"\r\n\r\n")
    assert response.startswith(b"HTTP/1.0 404 ")
    assert b"published" not in response


@pytest.mark.parametrize("request_begun", [b"GET /metrics HTTP/1.0\r\nX: " + b"x" * 20_000, b"GET /metr", b""])
async def test_a_client_that_sends_too_much_or_too_little_is_left_without_answer(
    address, metrics, monkeypatch, request_begun: bytes
) -> None:
    async with serve_metrics(address, metrics):
        monkeypatch.setattr(exporter, "REQUEST_S", 0.05 if len(request_begun) < 1000 else 60.0)
        with contextlib.suppress(ConnectionError):
            assert await asked(address, request_begun) == b""
        monkeypatch.setattr(exporter, "REQUEST_S", 60.0)
        assert b"200 OK" in await asked(address)


async def test_a_crowd_of_silent_clients_keeps_nobody_waiting_and_is_closed_from_the_oldest_on(
    address, metrics, monkeypatch
) -> None:
    """Nobody's time is over: only room that is made lets the last one in."""
    monkeypatch.setattr(exporter, "REQUEST_S", 60.0)
    monkeypatch.setattr(exporter, "PAUSE_S", 0.0)  # else the kernel's queue fills, and it drops connections
    loop = asyncio.get_running_loop()
    async with serve_metrics(address, metrics):
        silent = list[socket.socket]()
        for _ in range(2 * exporter.CLIENTS):
            silent.append(client := socket.socket())
            client.setblocking(False)
            await loop.sock_connect(client, (address.host, address.port))
        asking = asyncio.gather(*(asked(address, b"GET /healthz HTTP/1.0\r\n\r\n") for _ in range(10)))
        assert all(page.endswith(b"ok\n") for page in await asking)
        tasks = [task.get_coro().__name__ for task in asyncio.all_tasks()]  # type: ignore[union-attr]
        assert tasks.count("_serve") <= exporter.CLIENTS
        for client in silent[: exporter.CLIENTS]:
            assert await loop.sock_recv(client, 1) == b"", "the oldest are closed"
    for client in silent:
        client.close()  # who says nothing does not keep the gateway from ending


async def test_without_the_address_the_context_is_entered_all_the_same(metrics, caplog) -> None:
    entered = False
    with socket.socket() as taken, caplog.at_level(logging.ERROR):
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        async with serve_metrics(Address("127.0.0.1", taken.getsockname()[1]), metrics):
            entered = True
    assert entered
    assert "metrics endpoint tcp://127.0.0.1" in caplog.text


@pytest.mark.parametrize(
    ("path", "missing", "status", "body"),
    [
        (b"/healthz", ("robot offline",), b"200 OK", b"ok\n"),
        (b"/readyz", (), b"200 OK", b"ok\n"),
        (b"/readyz", ("no bus", "robot offline"), b"503 Service Unavailable", b"no bus\nrobot offline\n"),
    ],
)
async def test_the_probes_tell_whether_the_gateway_lives_and_is_of_use(
    address: Address, metrics: Metrics, path: bytes, missing: tuple[str, ...], status: bytes, body: bytes
) -> None:
    async with serve_metrics(address, metrics, lambda: missing):
        response = await asked(address, b"GET " + path + b" HTTP/1.1\r\nHost: x\r\n\r\n")
    head, _, shown = response.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.0 " + status + b"\r\n")
    assert shown == body
