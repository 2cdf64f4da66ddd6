"""The relay on loopback: who is let in, what each request is answered, and how a client's stream ends."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
from collections.abc import AsyncIterator, Callable
from typing import NamedTuple

import pytest

from tests.camera.camera_bytes import HEAD, jpeg, part
from tests.ports import free_port
from zbridge.camera import relay as relays
from zbridge.camera.demand import Demand
from zbridge.camera.mjpeg import MjpegReader
from zbridge.camera.relay import Latest, Relay
from zbridge.camera.settings import CameraPlan, CameraSettings, CameraSource
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address

HOST = "127.0.0.1"
GET = b"GET /stream.mjpg HTTP/1.1\r\nHost: robot\r\n\r\n"
SOON_S = 20.0


class Scene(NamedTuple):
    port: int
    demand: Demand
    latest: Latest
    metrics: Metrics
    told: list[str | None]
    writers: list[asyncio.StreamWriter]

    async def ask(self, request: bytes) -> asyncio.StreamReader:
        reader, writer = await asyncio.open_connection(HOST, self.port)
        self.writers.append(writer)
        writer.write(request)
        return reader

    def show(self, *pictures: bytes, head: bytes = HEAD) -> None:
        stream = MjpegReader()
        for each in stream.receive(head + b"".join(map(part, pictures))):
            self.latest.show(stream, each)


@contextlib.asynccontextmanager
async def serving(port: int = 0, *allow: str, clients: int = 16) -> AsyncIterator[Scene]:
    """Run a relay until the end of the context."""
    settings = CameraSettings(url="http://robot/", clients=clients)
    networks = tuple(map(ipaddress.ip_network, allow))
    scene = Scene(port or free_port(), Demand(), Latest(), Metrics(), [], [])
    plan = CameraPlan(CameraSource("robot", 80, "/"), settings, None, networks)
    relay = Relay(plan, Address(HOST, scene.port), scene.demand, scene.latest, scene.metrics, scene.told.append)
    running = asyncio.create_task(relay.run())
    try:
        async with asyncio.timeout(SOON_S):
            await until(lambda: scene.told)
            yield scene
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        assert scene.demand.clients == 0, "the end of a relay is the end of its clients"
        for writer in scene.writers:
            writer.transport.abort()


async def until(condition: Callable[[], object]) -> None:
    """Wait until ``condition()`` is true; the scene bounds it."""
    while not condition():  # noqa: ASYNC110 - of any kind
        await asyncio.sleep(0.01)


async def test_a_client_gets_the_head_and_the_newest_picture_as_the_camera_wrote_them() -> None:
    async with serving() as scene:
        scene.show(jpeg(1), jpeg(2))
        reader = await scene.ask(GET)
        expected = HEAD + part(jpeg(2))
        assert await reader.readexactly(len(expected)) == expected
        scene.show(jpeg(3))
        assert await reader.readexactly(len(part(jpeg(3)))) == part(jpeg(3))


ANSWERS = {
    "another path": (b"GET /index.html HTTP/1.0\r\n\r\n", b"HTTP/1.0 404 "),
    "a path that begins so": (b"GET /stream.mjpgs HTTP/1.0\r\n\r\n", b"HTTP/1.0 404 "),
    "another method": (b"POST /stream.mjpg HTTP/1.0\r\n\r\n", b"HTTP/1.0 404 "),
    "a page of a browser": (GET[:-2] + b"oriGin: http://evil.test\r\n\r\n", b"HTTP/1.0 403 "),
    "a query and no version": (b"GET /stream.mjpg?1 HTTP/1.0\r\n\r\n", HEAD),
    "an old request": (b"GET /stream.mjpg\r\n\r\n", HEAD),
    "noise": (b"\0\xff\r\n\r\n", b"HTTP/1.0 404 "),
    "an endless request": (b"GET /stream.mjpg HTTP/1.0\r\nX: " + b"x" * 20_000, b""),
}


@pytest.mark.parametrize("name", ANSWERS)
async def test_only_a_get_of_the_stream_is_answered_with_it(name: str) -> None:
    request, expected = ANSWERS[name]
    async with serving() as scene:
        scene.show(jpeg(1))
        reader = await scene.ask(request)
        with contextlib.suppress(ConnectionError):
            received = await reader.read(len(expected) or 1)
            while len(received) < len(expected) and (more := await reader.read(len(expected) - len(received))):
                received += more
            assert received == expected
        assert expected == HEAD or scene.demand.clients == 0


async def closed(reader: asyncio.StreamReader) -> bool:
    """Whether the connection ends without a byte."""
    with contextlib.suppress(ConnectionError):
        return await reader.read() == b""
    return True


@pytest.mark.parametrize(
    ("allow", "clients", "accepted"),
    [((), 2, 2), (("127.0.0.0/8",), 1, 1), (("10.0.0.0/8", "::1/128"), 3, 0)],
    ids=["two at most", "one of the network", "another network"],
)
async def test_clients_are_bounded_in_number_and_may_be_of_some_networks_only(allow, clients, accepted) -> None:
    async with serving(0, *allow, clients=clients) as scene:
        scene.show(jpeg(1))
        for _ in range(accepted):
            assert await (await scene.ask(GET)).readexactly(len(HEAD)) == HEAD
        assert await closed(await scene.ask(GET))
        assert scene.metrics.total("camera_relay_refused") == 1
        assert scene.demand.clients == accepted


async def test_a_client_that_goes_is_no_longer_counted_as_one_who_watches() -> None:
    async with serving() as scene:
        scene.show(jpeg(1))
        await (await scene.ask(GET)).readexactly(len(HEAD))
        assert scene.demand.wanted
        scene.writers[0].close()
        await until(lambda: not scene.demand.wanted)


async def test_a_client_is_closed_when_the_camera_is_away_or_another_one_answers(monkeypatch) -> None:
    async with serving() as scene:
        scene.show(jpeg(1))
        reader = await scene.ask(GET)
        await reader.readexactly(len(HEAD + part(jpeg(1))))
        scene.latest.forget()
        scene.show(jpeg(2), head=HEAD.replace(b"Age: 0", b"Age: 1"))
        assert await reader.readexactly(len(part(jpeg(2)))) == part(jpeg(2)), "the same camera, once more"
        other = MjpegReader()
        (picture,) = other.receive(HEAD.replace(b"FRAME", b"other") + part(jpeg(3)).replace(b"FRAME", b"other"))
        scene.latest.show(other, picture)
        assert await closed(reader)
        scene.latest.forget()
        monkeypatch.setattr(relays, "AWAY_S", 0.01)
        assert await closed(await scene.ask(GET))
        monkeypatch.setattr(relays, "REQUEST_S", 0.01)
        assert await closed(await scene.ask(GET[:20])), "half a request"


async def test_an_address_in_use_is_told_and_tried_again() -> None:
    with contextlib.closing(relays.socket.create_server((HOST, 0))) as taken:
        port = taken.getsockname()[1]
        async with serving(port) as scene:
            assert scene.told == [f"camera relay {HOST}:{port}: Address already in use"]
            taken.close()
            await until(lambda: scene.told[-1] is None)
            scene.show(jpeg(1))
            assert await (await scene.ask(GET)).readexactly(len(HEAD)) == HEAD


async def test_a_slow_client_gets_the_newest_picture_and_what_it_missed_is_counted() -> None:
    async with serving() as scene:
        scene.show(jpeg(1))
        reader = await scene.ask(GET)
        await reader.readexactly(len(HEAD + part(jpeg(1))))
        scene.show(jpeg(2), jpeg(3), jpeg(4))  # before it is its turn
        assert await reader.readexactly(len(part(jpeg(4)))) == part(jpeg(4))
        await until(lambda: scene.metrics.total("camera_relay_pictures") == 2)
        assert scene.metrics.total("camera_relay_skipped") == 2
        assert scene.metrics.total("camera_relay_accepted") == 1
        scene.latest.forget()
        scene.show(jpeg(5))
        assert await reader.readexactly(len(part(jpeg(5)))) == part(jpeg(5))
        assert scene.metrics.total("camera_relay_skipped") == 2


async def test_a_client_that_takes_nothing_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(relays, "SEND_S", 0.05)
    async with serving() as scene:
        await scene.ask(GET)
        await until(lambda: scene.demand.clients == 1)
        for number in range(100):
            scene.show(jpeg(number, size=2**20))
            if scene.demand.clients == 0:
                break
            await asyncio.sleep(0.01)
        await until(lambda: scene.demand.clients == 0)
        assert scene.metrics.total("camera_relay_pictures") < 100
