"""The counters' page, over a real socket on loopback."""

import asyncio
import contextlib
import logging
import resource
import socket
import sys
import time
from pathlib import Path

import pytest

from tests.ports import free_port
from tests.scraped import samples
from zbridge.app import endpoint
from zbridge.app.endpoint import serve_metrics
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address


@pytest.fixture
def address() -> Address:
    return Address("127.0.0.1", free_port())


@pytest.fixture
def metrics() -> Metrics:
    metrics = Metrics()
    metrics.count("drives_slowed").value = 7
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
        metrics.count("drives_slowed").value += 1
        await asyncio.sleep(endpoint.FRESH_S)
        assert (await asked(address, request)).endswith(b"zbridge_drives_slowed_total 8\n")
    assert head.startswith(b"HTTP/1.0 200 OK\r\n")
    assert b"Content-Type: text/plain; version=0.0.4" in head
    assert f"Content-Length: {len(body)}".encode() in head
    assert samples(body.decode()) == {("zbridge_drives_slowed_total", frozenset()): 7}
    with pytest.raises(OSError):
        await asked(address)  # the page is gone with the context


@pytest.mark.parametrize(
    ("request_line", "status"),
    [
        (b"GET /other HTTP/1.0\r\n\r\n", 404),
        (b"POST /metrics HTTP/1.0\r\n\r\n", 405),
        (b"get /metrics HTTP/1.0\r\n\r\n", 400),
        (b"GET /metrics HTTP/2.0\r\n\r\n", 400),
        (b"GET /metrics\r\n", 400),
        (b"nonsense", 400),
        (b"\x16\x03\x01\x02\x00\x01", 400),
        (b"GET metrics", 400),
        (b"GET /metrics HTTP/1.0\r\nX: " + b"x" * 20_000, 431),
        (b"GET /" + b"x" * 20_000, 400),
    ],
)
async def test_what_is_no_request_for_a_page_is_refused_at_once(
    address: Address, metrics: Metrics, monkeypatch, request_line: bytes, status: int
) -> None:
    monkeypatch.setattr(endpoint, "REQUEST_S", 60.0)
    async with serve_metrics(address, metrics):
        response = await asked(address, request_line)
    assert response.startswith(f"HTTP/1.0 {status} ".encode())
    assert b"slowed" not in response


async def test_a_request_for_the_head_alone_gets_no_body_and_a_query_is_ignored(
    address: Address, metrics: Metrics
) -> None:
    async with serve_metrics(address, metrics):
        head = await asked(address, b"HEAD /metrics?debug=1 HTTP/1.1\r\nHost: x\r\n\r\n")
        page = await asked(address, b"GET /metrics?debug=1 HTTP/1.1\r\nHost: x\r\n\r\n")
    assert head.startswith(b"HTTP/1.0 200 OK\r\n")
    assert page.startswith(head)
    assert head.endswith(b"\r\n\r\n")


@pytest.mark.parametrize("request_begun", [b"GET /metr", b"GET /metrics HTTP/1.0\r\nHost: x\r\n", b""])
async def test_a_client_that_sends_too_little_is_closed_after_a_while(
    address, metrics, monkeypatch, request_begun: bytes
) -> None:
    monkeypatch.setattr(endpoint, "REQUEST_S", 0.1)
    async with serve_metrics(address, metrics):
        assert await asked(address, request_begun) == b""
        assert b"200 OK" in await asked(address)


async def test_a_request_may_come_a_byte_at_a_time(address: Address, metrics: Metrics) -> None:
    async with serve_metrics(address, metrics):
        reader, writer = await asyncio.open_connection(address.host, address.port)
        for byte in b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n":
            writer.write(bytes((byte,)))
            await writer.drain()
            await asyncio.sleep(0)
        assert (await reader.read()).endswith(b"ok\n")
        writer.close()


async def test_a_large_page_reaches_a_slow_reader_whole_and_one_that_reads_nothing_is_closed(
    address: Address, monkeypatch
) -> None:
    monkeypatch.setattr(endpoint, "REQUEST_S", 0.3)
    page = "x" * 10_000_000

    async def read() -> str:
        return page

    async with serve_metrics(address, read):
        slow, idle = [await asyncio.open_connection(address.host, address.port, limit=2**16) for _ in range(2)]
        for _, writer in (slow, idle):
            writer.write(b"GET /metrics HTTP/1.0\r\n\r\n")
        received = 0
        while data := await slow[0].read(2**20):
            received += len(data)
            await asyncio.sleep(0.02)
        await asyncio.sleep(0.5)
        with contextlib.suppress(ConnectionError):
            assert len(await idle[0].read()) < len(page)
        for _, writer in (slow, idle):
            writer.close()
    assert received > len(page)


async def test_all_who_ask_within_a_moment_get_one_text_and_one_that_cannot_be_read_is_an_error(
    address: Address, caplog, monkeypatch
) -> None:
    read_count = 0

    async def read() -> str:
        nonlocal read_count
        read_count += 1
        await asyncio.sleep(0.05)
        if read_count > 1:
            raise KeyError("broken")
        return "page\n"

    async with serve_metrics(address, read):
        monkeypatch.setattr(endpoint, "FRESH_MOST_S", 0.3)
        pages = await asyncio.gather(*(asked(address) for _ in range(20)))
        assert await asked(address) in pages
        assert read_count == 1
        await asyncio.sleep(endpoint.FRESH_MOST_S)
        assert (await asked(address)).startswith(b"HTTP/1.0 500 ")
        assert (await asked(address, b"GET /healthz HTTP/1.0\r\n\r\n")).endswith(b"ok\n")
    assert {page.rpartition(b"\r\n\r\n")[2] for page in pages} == {b"page\n"}
    assert "the metrics cannot be read" in caplog.text


CROWD = """
import socket, sys, time
host, port, count = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
begun = [b"", b"GET /metrics HTTP/1.0\\r\\nX: "]
def connect(number):
    client = socket.socket()
    client.setblocking(False)
    client.connect_ex((host, port))
    try:
        client.send(begun[number % 2])
    except OSError:
        pass
    return client
clients = [connect(number) for number in range(count)]
print("there", flush=True)
while True:  # who is turned out comes back
    for number, client in enumerate(clients):
        try:
            if client.recv(1, socket.MSG_PEEK) == b"":
                client.close()
                clients[number] = connect(number)
        except BlockingIOError:
            pass
        except OSError:
            client.close()
            clients[number] = connect(number)
    time.sleep(0.01)
"""


async def test_a_thousand_slow_clients_that_come_back_keep_no_scrape_waiting(address: Address) -> None:
    async def read() -> str:
        await asyncio.sleep(0.5)  # as a host does while one of its gateways hangs
        return "page\n"

    async with serve_metrics(address, read):
        crowd = await asyncio.create_subprocess_exec(
            sys.executable, "-c", f"import resource; resource.setrlimit(resource.RLIMIT_NOFILE, (2048, 2048)){CROWD}",
            address.host, str(address.port), "1000", stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        try:
            assert crowd.stdout is not None
            await crowd.stdout.readline()
            for path in (b"/metrics", b"/healthz"):
                begun = time.monotonic()
                assert b"200 OK" in await asked(address, b"GET " + path + b" HTTP/1.0\r\n\r\n")
                took_s = time.monotonic() - begun
                # A connection that the kernel drops is tried again after 1, 3 and 7 s.
                assert took_s < 3.0, f"{path.decode()} took {took_s:.1f} s"
        finally:
            crowd.kill()
            await crowd.wait()


async def test_of_too_many_clients_the_oldest_of_the_busiest_address_is_closed(metrics, monkeypatch) -> None:
    monkeypatch.setattr(endpoint, "REQUEST_S", 60.0)
    monkeypatch.setattr(endpoint, "CLIENTS", 8)
    address, loop = Address("127.0.0.1", free_port()), asyncio.get_running_loop()

    async def come(source: str) -> socket.socket:
        client = socket.socket()
        client.setblocking(False)
        client.bind((source, 0))
        await loop.sock_connect(client, (address.host, address.port))
        await asyncio.sleep(0.01)
        return client

    async with serve_metrics(address, metrics):
        alone = await come("127.0.0.2")
        crowd = [await come("127.0.0.3") for _ in range(12)]
        for client in crowd[:5]:
            assert await loop.sock_recv(client, 1) == b"", "the oldest are closed"
        for client in (alone, crowd[-1]):
            await loop.sock_sendall(client, b"GET /healthz HTTP/1.0\r\n\r\n")
            assert b"200 OK" in await loop.sock_recv(client, 1000)
    for client in (alone, *crowd):
        client.close()


async def test_clients_that_read_nothing_take_bounded_memory_of_the_kernel_and_give_way(address, monkeypatch) -> None:
    monkeypatch.setattr(endpoint, "CLIENTS", 8)
    loop, page = asyncio.get_running_loop(), "x" * 4_000_000

    async def read() -> str:
        return page

    async with serve_metrics(address, read):
        idle = []
        for _ in range(12):
            idle.append(client := socket.socket())
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
            client.setblocking(False)
            await loop.sock_connect(client, (address.host, address.port))
            await loop.sock_sendall(client, b"GET /metrics HTTP/1.0\r\n\r\n")
            await asyncio.sleep(0.02)
        assert len(await asked(address)) > len(page), "who reads is served"
        waiting = sum(unsent_bytes(address.port, client.getsockname()[1]) for client in idle)
        assert 0 < waiting < 12 * 4 * endpoint.SEND_BYTES
    for client in idle:
        client.close()


def unsent_bytes(port: int, peer: int) -> int:
    """Return what waits in the kernel at the endpoint's side of a connection; 0 if there is none."""
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        _, mine, theirs, _, queues, *_ = line.split()
        if (mine[-4:], theirs[-4:]) == (f"{port:04X}", f"{peer:04X}"):
            return int(queues.partition(":")[0], 16)
    return 0


async def test_without_descriptors_room_is_made_for_the_next_client(address, metrics, monkeypatch) -> None:
    monkeypatch.setattr(endpoint, "REQUEST_S", 60.0)
    async with serve_metrics(address, metrics) as (listening,):
        silent = [await asyncio.open_connection(address.host, address.port) for _ in range(3)]
        await asyncio.sleep(0.05)
        with monkeypatch.context() as full:
            full.setattr(endpoint, "PAUSE_S", 0.01)
            most = resource.getrlimit(resource.RLIMIT_NOFILE)
            asking = asyncio.ensure_future(asked(address, b"GET /healthz HTTP/1.0\r\n\r\n"))
            await asyncio.sleep(0)
            resource.setrlimit(resource.RLIMIT_NOFILE, (listening.fileno() + 1, most[1]))
            await asyncio.sleep(0.1)
            resource.setrlimit(resource.RLIMIT_NOFILE, most)
            assert (await asking).endswith(b"ok\n")
        assert await silent[0][0].read() == b"", "the oldest gave way"
    for _, writer in silent:
        writer.close()


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
