"""Transport connections over real sockets on loopback."""

import asyncio
import contextlib
import socket
import struct
from collections.abc import AsyncIterator

import pytest

from zbridge import link as links
from zbridge.errors import LinkError
from zbridge.link import Address, FakeLink, Link, TcpLink, connect, listen

SOON_S = 5.0


class Recorder:
    """A receiver that keeps what a link brings."""

    def __init__(self) -> None:
        self.link: Link | None = None
        self.data = b""
        self.reason: str | None = None
        self.calls: list[str] = []
        self._changed = asyncio.Event()

    def attached(self, link: Link) -> None:
        self.link = link
        self._note("attached")

    def received(self, data: bytes) -> None:
        assert type(data) is bytes
        self.data += data
        self._note("received")

    def lost(self, reason: str) -> None:
        self.reason = reason
        self._note("lost")

    def writable(self) -> None:
        self._note("writable")

    def _note(self, call: str) -> None:
        self.calls.append(call)
        self._changed.set()

    async def until(self, call: str, *, received: int = 0) -> None:
        async with asyncio.timeout(SOON_S):
            while call not in self.calls or len(self.data) < received:
                self._changed.clear()
                await self._changed.wait()


class Pair:
    """Both ends of one connection."""

    def __init__(self, server: asyncio.Server, here: TcpLink, near: Recorder, far: Recorder) -> None:
        self.server, self.here, self.near, self.far = server, here, near, far

    @property
    def there(self) -> TcpLink:
        assert isinstance(self.far.link, TcpLink)
        return self.far.link


@contextlib.asynccontextmanager
async def connected() -> AsyncIterator[Pair]:
    near, far = Recorder(), Recorder()
    server = await listen(Address("127.0.0.1", 0), lambda: far)
    async with server:
        here = await connect(Address(*server.sockets[0].getsockname()[:2]), near)
        await far.until("attached")
        pair = Pair(server, here, near, far)
        yield pair
        here.abort()
        pair.there.abort()
        await near.until("lost")
        await far.until("lost")


@pytest.mark.parametrize(
    ("text", "host", "port", "shown"),
    [
        ("tcp://127.0.0.1:11001", "127.0.0.1", 11001, "tcp://127.0.0.1:11001"),
        ("tcp://robot.test:1", "robot.test", 1, "tcp://robot.test:1"),
        ("tcp://[::1]:7447", "::1", 7447, "tcp://[::1]:7447"),
    ],
)
def test_an_address_is_read_and_written(text: str, host: str, port: int, shown: str) -> None:
    address = Address.parse(text)
    assert address == Address(host, port)
    assert str(address) == shown


@pytest.mark.parametrize(
    "text",
    [
        "",
        "robot",
        "127.0.0.1:11001",
        "udp://a:1",
        "tcp://a",
        "tcp://:1",
        "tcp://a:x",
        "tcp://a:65536",
        "tcp://a:1/b",
        "tcp://[a:1",
        "tcp://a:1?b",
    ],
)
def test_what_is_no_address_is_an_error_that_says_what_was_expected(text: str) -> None:
    with pytest.raises(LinkError, match="expected tcp://host:port") as caught:
        Address.parse(text)
    assert repr(text) in str(caught.value)


async def test_both_ends_are_attached_first_and_know_their_peer() -> None:
    async with connected() as pair:
        assert pair.near.calls == ["attached"]
        assert pair.near.link is pair.here
        host, port = pair.server.sockets[0].getsockname()[:2]
        assert pair.here.peer == f"tcp://{host}:{port}"
        assert pair.there.peer.startswith("tcp://127.0.0.1:")
        assert repr(pair.here) == f"<TcpLink {pair.here.peer}>"


async def test_bytes_travel_both_ways() -> None:
    async with connected() as pair:
        pair.here.write(b"ping")
        await pair.far.until("received", received=4)
        assert pair.far.data == b"ping"
        pair.there.write(b"pong")
        await pair.near.until("received", received=4)
        assert pair.near.data == b"pong"


async def test_a_megabyte_arrives_whole() -> None:
    async with connected() as pair:
        data = bytes(range(256)) * 4096
        pair.here.write(data)
        await pair.far.until("received", received=len(data))
        assert pair.far.data == data


async def test_every_write_is_a_segment_of_its_own() -> None:
    async with connected() as pair:
        for end in (pair.here, pair.there):
            assert end._transport is not None
            sock = end._transport.get_extra_info("socket")
            assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)


async def test_a_peer_that_closes_is_noticed_once() -> None:
    async with connected() as pair:
        pair.there.close()
        await pair.near.until("lost")
        assert pair.near.reason == "closed by peer"
        assert pair.near.calls == ["attached", "lost"]
        assert not pair.here.ready


async def test_a_peer_that_breaks_off_is_noticed_with_the_reason() -> None:
    async with connected() as pair:
        assert pair.there._transport is not None
        sock = pair.there._transport.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        pair.there.abort()
        await pair.near.until("lost")
        assert pair.near.reason is not None
        assert pair.near.reason.startswith("connection lost: ")


async def test_what_was_written_before_closing_arrives() -> None:
    async with connected() as pair:
        pair.here.write(b"last words")
        pair.here.close()
        pair.here.close()
        await pair.far.until("lost")
        assert pair.far.data == b"last words"


async def test_a_lost_link_takes_calls_without_effect() -> None:
    async with connected() as pair:
        pair.there.close()
        await pair.near.until("lost")
        pair.here.write(b"x")
        pair.here.pause()
        pair.here.resume()
        pair.here.close()
        pair.here.abort()
        assert pair.near.calls == ["attached", "lost"]


async def test_a_paused_link_reads_nothing_until_it_is_resumed() -> None:
    async with connected() as pair:
        pair.here.pause()
        pair.here.pause()
        pair.there.write(b"waits")
        await asyncio.sleep(0.05)
        assert pair.near.data == b""
        pair.here.resume()
        pair.here.resume()
        await pair.near.until("received", received=5)
        assert pair.near.data == b"waits"


async def test_a_peer_that_takes_nothing_makes_the_link_unready_and_writable_again_later() -> None:
    async with connected() as pair:
        pair.there.pause()
        assert pair.here.ready
        written = 0
        while pair.here.ready:
            pair.here.write(bytes(64 * 1024))
            written += 64 * 1024
            assert written < 64 * 2**20
        pair.there.resume()
        await pair.near.until("writable")
        assert pair.here.ready
        await pair.far.until("received", received=written)


async def test_nobody_there_is_a_link_error_that_names_address_and_reason() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(LinkError, match=f"tcp://127.0.0.1:{port}: .*(refused|failed)"):
        await connect(Address("127.0.0.1", port), Recorder())


async def test_a_peer_that_does_not_answer_is_a_link_error(monkeypatch: pytest.MonkeyPatch) -> None:
    async def forever(*args: object) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(links, "CONNECT_S", 0.01)
    monkeypatch.setattr(asyncio.get_running_loop(), "create_connection", forever, raising=False)
    with pytest.raises(LinkError, match=r"tcp://robot\.test:1: no answer within 0\.01 s"):
        await connect(Address("robot.test", 1), Recorder())


class GoneTransport(asyncio.Transport):
    """A connection that was reset before it was looked at."""

    def __init__(self) -> None:
        super().__init__()
        self.aborted = False

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass

    def abort(self) -> None:
        self.aborted = True


def test_a_peer_that_is_gone_before_it_is_looked_at_is_lost_and_nothing_else() -> None:
    recorder = Recorder()
    link = TcpLink(recorder)
    transport = GoneTransport()
    link.connection_made(transport)
    assert transport.aborted
    link.connection_lost(None)
    assert "attached" not in recorder.calls
    assert recorder.calls == ["lost"]


async def test_an_address_that_is_taken_is_a_link_error() -> None:
    async with connected() as pair:
        taken = Address(*pair.server.sockets[0].getsockname()[:2])
        with pytest.raises(LinkError, match=str(taken)):
            await listen(taken, Recorder)


async def test_every_peer_of_a_listener_has_a_receiver_of_its_own() -> None:
    receivers: list[Recorder] = []

    def receiver() -> Recorder:
        receivers.append(Recorder())
        return receivers[-1]

    server = await listen(Address("127.0.0.1", 0), receiver)
    async with server:
        address = Address(*server.sockets[0].getsockname()[:2])
        ends = [await connect(address, Recorder()) for _ in range(2)]
        for number, end in enumerate(ends):
            end.write(b"%d" % number)
            end.close()
        async with asyncio.timeout(SOON_S):
            while len(receivers) < 2:  # noqa: ASYNC110
                await asyncio.sleep(0)
        for each in receivers:
            await each.until("lost")
    assert sorted(each.data for each in receivers) == [b"0", b"1"]


def test_a_fake_link_keeps_what_is_done_to_it() -> None:
    link = FakeLink("tcp://a:1")
    link.write(b"x")
    link.pause()
    assert (link.peer, link.ready, link.written, link.paused) == ("tcp://a:1", True, [b"x"], True)
    link.resume()
    link.close()
    assert (link.paused, link.closed) == (False, True)
