"""The counters' page, over a real socket on loopback."""

import asyncio
import logging
import socket

import pytest

from zbridge.app import prometheus as exporter
from zbridge.app.prometheus import serve_metrics
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@pytest.fixture
def address() -> Address:
    return Address("127.0.0.1", free_port())


@pytest.fixture
def metrics() -> Metrics:
    metrics = Metrics()
    metrics.count("published").value = 7
    return metrics


async def asked(address: Address, request: bytes) -> bytes:
    reader, writer = await asyncio.open_connection(address.host, address.port)
    writer.write(request)
    try:
        async with asyncio.timeout(5):
            return await reader.read()
    finally:
        writer.close()
        await writer.wait_closed()


@pytest.mark.parametrize("path", [b"/metrics", b"/"])
async def test_the_page_shows_the_counters(address: Address, metrics: Metrics, path: bytes) -> None:
    async with serve_metrics(address, metrics):
        response = await asked(address, b"GET " + path + b" HTTP/1.1\r\nHost: x\r\n\r\n")
    head, body = response.split(b"\r\n\r\n", 1)
    assert head.startswith(b"HTTP/1.0 200 OK\r\n")
    assert b"Content-Type: text/plain; version=0.0.4" in head
    assert f"Content-Length: {len(body)}".encode() in head
    assert body == b"# TYPE zbridge_published_total counter\nzbridge_published_total 7\n"


async def test_the_page_shows_the_counters_as_they_are_now(address: Address, metrics: Metrics) -> None:
    async with serve_metrics(address, metrics):
        await asked(address, b"GET /metrics HTTP/1.0\r\n\r\n")
        metrics.count("published").value += 1
        assert (await asked(address, b"GET /metrics HTTP/1.0\r\n\r\n")).endswith(b"zbridge_published_total 8\n")


@pytest.mark.parametrize("request_line", [b"GET /other HTTP/1.0", b"POST /metrics HTTP/1.0", b"nonsense"])
async def test_anything_else_is_not_found(address: Address, metrics: Metrics, request_line: bytes) -> None:
    async with serve_metrics(address, metrics):
        response = await asked(address, request_line + b"\r\n\r\n")
    assert response.startswith(b"HTTP/1.0 404 ")
    assert b"published" not in response


async def test_a_request_that_is_too_long_is_left_without_answer(address: Address, metrics: Metrics) -> None:
    async with serve_metrics(address, metrics):
        try:
            response = await asked(address, b"GET /metrics HTTP/1.0\r\nX: " + b"x" * 20_000)
        except ConnectionError:
            response = b""
        assert response == b""
        assert b"200 OK" in await asked(address, b"GET / HTTP/1.0\r\n\r\n")


async def test_a_client_that_sends_nothing_is_left(address, metrics, monkeypatch) -> None:
    monkeypatch.setattr(exporter, "REQUEST_S", 0.05)
    async with serve_metrics(address, metrics):
        assert await asked(address, b"GET /metr") == b""


async def test_a_client_that_goes_at_once_does_no_harm(address: Address, metrics: Metrics) -> None:
    async with serve_metrics(address, metrics):
        _, writer = await asyncio.open_connection(address.host, address.port)
        writer.close()
        await writer.wait_closed()
        assert b"200 OK" in await asked(address, b"GET / HTTP/1.0\r\n\r\n")


async def connected(address: Address) -> socket.socket:
    """Connect and say nothing."""
    client = socket.socket()
    client.setblocking(False)
    await asyncio.get_running_loop().sock_connect(client, (address.host, address.port))
    return client


async def test_few_clients_are_served_at_a_time_and_the_next_when_one_has_gone(address, metrics, monkeypatch) -> None:
    monkeypatch.setattr(exporter, "REQUEST_S", 60.0)
    async with serve_metrics(address, metrics):
        silent = [await connected(address) for _ in range(exporter.CLIENTS)]
        asking = asyncio.create_task(asked(address, b"GET / HTTP/1.0\r\n\r\n"))
        for _ in range(100):  # whatever is ready runs
            await asyncio.sleep(0)
        assert not asking.done()
        silent.pop().close()
        assert b"200 OK" in await asking
    for client in silent:  # who says nothing does not keep the gateway from ending
        client.close()


async def test_a_crowd_of_clients_takes_no_more_than_a_few_places(address: Address, metrics: Metrics) -> None:
    async with serve_metrics(address, metrics):
        crowd = [socket.socket() for _ in range(exporter.WAITING)]
        for client in crowd:
            client.setblocking(False)
            client.connect_ex((address.host, address.port))
        taken = 0
        for _ in range(100):
            await asyncio.sleep(0)
            tasks = [task.get_coro().__name__ for task in asyncio.all_tasks()]  # type: ignore[union-attr]
            taken = max(taken, tasks.count("_serve"))
    for client in crowd:
        client.close()
    assert taken == exporter.CLIENTS


async def test_everybody_of_a_crowd_that_asks_is_answered_in_turn(address: Address, metrics: Metrics) -> None:
    async with serve_metrics(address, metrics):
        crowd = [asked(address, b"GET / HTTP/1.0\r\n\r\n") for _ in range(3 * exporter.CLIENTS)]
        assert all(b"200 OK" in page for page in await asyncio.gather(*crowd))


async def test_the_page_is_gone_with_the_context(address: Address, metrics: Metrics) -> None:
    async with serve_metrics(address, metrics):
        pass
    with pytest.raises(OSError):
        await asyncio.open_connection(address.host, address.port)


async def test_without_the_address_the_context_is_entered_all_the_same(metrics, caplog) -> None:
    entered = False
    with socket.socket() as taken, caplog.at_level(logging.ERROR):
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        async with serve_metrics(Address("127.0.0.1", taken.getsockname()[1]), metrics):
            entered = True
    assert entered
    assert "metrics endpoint tcp://127.0.0.1" in caplog.text
