"""Transport connections over real sockets on loopback."""

import asyncio
import contextlib
import gc
import socket
import struct
from collections.abc import AsyncIterator, Iterator

import pytest

from tests.clock import jumping
from tests.e2e.conftest import free_port
from tests.transport.recorder import SOON_S, Recorder
from zbridge.errors import LinkError
from zbridge.metrics import Count
from zbridge.protocol.address import Address
from zbridge.transport import tcp, udp
from zbridge.transport.fake import FakeLink
from zbridge.transport.link import STALLED_S, Link
from zbridge.transport.tcp import TcpLink, connect, listen
from zbridge.transport.udp import DatagramHub

LOCAL = Address("127.0.0.1", 0)


class Pair:
    """Both ends of one connection."""

    def __init__(self, address: Address, here: TcpLink, near: Recorder, far: Recorder) -> None:
        self.address, self.here, self.near, self.far = address, here, near, far

    @property
    def there(self) -> TcpLink:
        assert isinstance(self.far.link, TcpLink)
        return self.far.link


@contextlib.asynccontextmanager
async def connected() -> AsyncIterator[Pair]:
    near, far = Recorder(), Recorder()
    async with listen(LOCAL, lambda: far) as address:
        here = await connect(address, near)
        await far.until("attached")
        pair = Pair(address, here, near, far)
        yield pair
        here.abort()
        pair.there.abort()
        await near.until("lost")
        await far.until("lost")


async def test_both_ends_are_attached_first_and_know_their_peer() -> None:
    async with connected() as pair:
        assert pair.near.calls == ["attached"]
        assert pair.near.link is pair.here
        assert pair.here.peer == str(pair.address)
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


async def test_a_peer_whose_machine_answers_is_not_silent_even_if_its_program_reads_nothing() -> None:
    async with connected() as pair:
        pair.here.pause()
        pair.there.write(b"x" * 100)
        await asyncio.sleep(0.1)
        assert pair.there.silent_s == pair.here.silent_s == 0.0


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

    monkeypatch.setattr(tcp, "CONNECT_S", 0.01)
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
        with pytest.raises(LinkError, match=str(pair.address)):
            async with listen(pair.address, Recorder):
                pass


async def test_every_peer_of_a_listener_has_a_receiver_of_its_own() -> None:
    receivers: list[Recorder] = []

    def receiver() -> Recorder:
        receivers.append(Recorder())
        return receivers[-1]

    async with listen(LOCAL, receiver) as address:
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


async def test_what_goes_wrong_inside_is_not_the_listeners() -> None:
    with pytest.raises(FileNotFoundError):
        async with listen(LOCAL, Recorder):
            raise FileNotFoundError(2, "no such file")
    with pytest.raises(TimeoutError):
        async with listen(LOCAL, Recorder), asyncio.timeout(0):
            await asyncio.sleep(1)


async def test_a_listener_that_ends_takes_no_more_peers_and_frees_its_ports() -> None:
    async with listen(LOCAL, Recorder, datagrams=True) as address:
        pass
    with pytest.raises(LinkError):
        await connect(address, Recorder())
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as free:
        free.bind((address.host, address.port))


# Datagrams of a link that was connected


class Peer:
    """A robot's UDP socket, on the port number of its TCP listener, and a stranger's."""

    def __init__(self, pair: Pair) -> None:
        self.pair = pair
        self.socket = udp_socket((pair.address.host, pair.address.port))
        self.stranger = udp_socket(("127.0.0.1", 0))

    async def hears(self) -> tuple[bytes, tuple[str, int]]:
        return await heard_by(self.socket)


def udp_socket(address: tuple[str, int]) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setblocking(False)
    made.bind(address)
    return made


async def heard_by(listening: socket.socket) -> tuple[bytes, tuple[str, int]]:
    async with asyncio.timeout(SOON_S):
        return await asyncio.get_running_loop().sock_recvfrom(listening, 65_536)


@contextlib.asynccontextmanager
async def with_udp() -> AsyncIterator[Peer]:
    async with connected() as pair:
        peer = Peer(pair)
        with contextlib.closing(peer.socket), contextlib.closing(peer.stranger):
            yield peer


async def test_the_first_datagram_opens_a_socket_and_goes_to_the_peers_address_and_port() -> None:
    async with with_udp() as peer:
        peer.pair.here.write_datagram(b"five")
        data, source = await peer.hears()
        assert data == b"five"
        assert source[0] == "127.0.0.1"
        peer.pair.here.write_datagram(b"more")
        assert await peer.hears() == (b"more", source)


async def test_a_datagram_of_the_peer_is_received_whole_and_one_by_one() -> None:
    async with with_udp() as peer:
        peer.pair.here.write_datagram(b"five")
        _, source = await peer.hears()
        large = bytes(range(256)) * 234  # 59904 bytes
        for data in (b"six", b"", large):
            peer.socket.sendto(data, source)
        await peer.pair.near.until("datagram", datagrams=3)
        assert peer.pair.near.datagrams == [b"six", b"", large]
        assert peer.pair.near.data == b""


async def test_datagrams_from_elsewhere_are_counted_and_dropped() -> None:
    async with with_udp() as peer:
        peer.pair.here.write_datagram(b"five")
        _, source = await peer.hears()
        peer.stranger.sendto(b"six", source)
        peer.stranger.sendto(b"seven", source)
        peer.socket.sendto(b"true", source)
        await peer.pair.near.until("datagram", datagrams=1)
        assert peer.pair.near.datagrams == [b"true"]
        assert peer.pair.near.foreign == 2


async def test_a_burst_of_datagrams_is_taken_in_order() -> None:
    async with with_udp() as peer:
        peer.pair.here.write_datagram(b"five")
        _, source = await peer.hears()
        sent = [b"%d" % number for number in range(150)]
        for data in sent:
            peer.socket.sendto(data, source)
        await peer.pair.near.until("datagram", datagrams=150)
        assert peer.pair.near.datagrams == sent


async def test_datagrams_to_a_peer_that_hears_none_are_lost_without_a_word() -> None:
    async with connected() as pair:
        for _ in range(3):
            pair.here.write_datagram(b"five")
            await asyncio.sleep(0.01)
        pair.here.write_datagram(bytes(70_000))
        pair.here.write(b"still there")
        await pair.far.until("received", received=11)
        assert pair.near.calls == ["attached"]


async def test_a_lost_link_sends_and_receives_no_datagrams() -> None:
    async with with_udp() as peer:
        peer.pair.here.write_datagram(b"five")
        _, source = await peer.hears()
        peer.pair.here.abort()
        await peer.pair.near.until("lost")
        peer.pair.here.write_datagram(b"late")
        with contextlib.closing(udp_socket(source)) as free:  # the port is free again
            assert free.getsockname() == source
        with pytest.raises(BlockingIOError):
            peer.socket.recvfrom(100)


# Datagrams of a listener


class Served:
    """A listener with UDP, and the recorders of its links, in the order in which they came."""

    def __init__(self, marks: list[bytes]) -> None:
        self.marks = marks
        self.recorders: list[Recorder] = []
        self.ends: list[TcpLink] = []
        self.address = LOCAL

    def receiver(self) -> Recorder:
        self.recorders.append(Recorder(self.marks[len(self.recorders)]))
        return self.recorders[-1]

    def send(self, source: socket.socket, data: bytes) -> None:
        source.sendto(data, (self.address.host, self.address.port))

    def links(self, number: int) -> Link:
        link = self.recorders[number].link
        assert link is not None
        return link


@contextlib.asynccontextmanager
async def served(*marks: bytes) -> AsyncIterator[Served]:
    """A listener with one link for each mark."""
    serving = Served(list(marks))
    async with listen(LOCAL, serving.receiver, datagrams=True) as serving.address:
        for number in range(len(marks)):
            serving.ends.append(await connect(serving.address, Recorder()))
            async with asyncio.timeout(SOON_S):
                while len(serving.recorders) <= number:  # noqa: ASYNC110
                    await asyncio.sleep(0)
            await serving.recorders[number].until("attached")
        yield serving
        for end in serving.ends:
            end.abort()
        for recorder in serving.recorders:
            await recorder.until("lost")


@contextlib.contextmanager
def sources(count: int) -> Iterator[list[socket.socket]]:
    with contextlib.ExitStack() as stack:
        yield [stack.enter_context(contextlib.closing(udp_socket(("127.0.0.1", 0)))) for _ in range(count)]


async def test_a_listener_hears_datagrams_on_the_port_number_of_its_tcp() -> None:
    async with served(b"a") as serving:
        with sources(1) as (source,):
            serving.send(source, b"a5")
            serving.send(source, b"more")
            await serving.recorders[0].until("datagram", datagrams=2)
            assert serving.recorders[0].datagrams == [b"a5", b"more"]
            serving.links(0).write_datagram(b"six")
            assert await heard_by(source) == (b"six", (serving.address.host, serving.address.port))


async def test_two_links_of_the_same_host_each_have_the_source_they_claimed() -> None:
    async with served(b"a", b"b") as serving:
        with sources(2) as (one, two):
            serving.send(two, b"b5")
            await serving.recorders[1].until("datagram", datagrams=1)
            serving.send(one, b"a5")
            await serving.recorders[0].until("datagram", datagrams=1)
            serving.send(two, b"a again")
            await serving.recorders[1].until("datagram", datagrams=2)
            assert serving.recorders[0].datagrams == [b"a5"]
            assert serving.recorders[1].datagrams == [b"b5", b"a again"]
            serving.links(0).write_datagram(b"for a")
            serving.links(1).write_datagram(b"for b")
            assert (await heard_by(one))[0] == b"for a"
            assert (await heard_by(two))[0] == b"for b"


async def test_a_link_has_one_source_and_others_are_foreign() -> None:
    async with served(b"a") as serving:
        with sources(2) as (one, two):
            serving.send(one, b"a5")
            await serving.recorders[0].until("datagram", datagrams=1)
            serving.send(two, b"b5")
            serving.send(one, b"more")
            await serving.recorders[0].until("datagram", datagrams=2)
            assert serving.recorders[0].datagrams == [b"a5", b"more"]
            assert serving.recorders[0].stray == [b"b5"]
            assert serving.recorders[0].asked == [one.getsockname()[1], two.getsockname()[1]]


async def test_a_second_source_that_a_link_claims_costs_it_the_first() -> None:
    """One of the two speaks in the name of another, and nobody here knows which."""
    async with served(b"a", b"b") as serving:
        with sources(3) as (one, two, other):
            serving.send(one, b"a5")
            serving.send(two, b"a5")
            await serving.recorders[0].until("rivalled")
            serving.links(0).write_datagram(b"to nobody")
            for source in (one, two):
                serving.send(source, b"a more")
            serving.send(other, b"b5")
            await serving.recorders[1].until("datagram", datagrams=1)
            assert serving.recorders[0].datagrams == [b"a5"]
            assert serving.recorders[0].stray == [b"a more", b"a more"]
            assert serving.recorders[1].stray == [b"a more", b"a more"]
            for source in (one, two):
                with pytest.raises(BlockingIOError):
                    source.recv(100)


async def test_a_source_that_is_dropped_is_nobodys_until_it_is_claimed_again() -> None:
    async with served(b"a") as serving:
        with sources(2) as (one, two):
            serving.send(one, b"a5")
            await serving.recorders[0].until("datagram", datagrams=1)
            serving.links(0).drop_source()
            serving.links(0).drop_source()
            serving.send(one, b"more")
            serving.send(two, b"a5 again")
            await serving.recorders[0].until("datagram", datagrams=2)
            assert serving.recorders[0].datagrams == [b"a5", b"a5 again"]
            serving.links(0).write_datagram(b"six")
            assert (await heard_by(two))[0] == b"six"


async def test_a_link_that_has_claimed_nothing_sends_datagrams_nowhere(all_heard: None) -> None:
    async with served(b"a") as serving:
        with sources(1) as (source,):
            serving.links(0).write_datagram(b"early")
            serving.send(source, b"stranger")
            serving.links(0).write_datagram(b"early too")
            serving.send(source, b"a5")
            await serving.recorders[0].until("datagram", datagrams=1)
            assert serving.recorders[0].datagrams == [b"a5"]
            serving.links(0).write_datagram(b"six")
            assert (await heard_by(source))[0] == b"six"


async def test_a_source_is_free_again_when_its_link_is_lost() -> None:
    async with served(b"a", b"b") as serving:
        with sources(1) as (source,):
            serving.send(source, b"a5")
            await serving.recorders[0].until("datagram", datagrams=1)
            serving.ends[0].abort()
            await serving.recorders[0].until("lost")
            serving.send(source, b"b5")
            await serving.recorders[1].until("datagram", datagrams=1)
            assert serving.recorders[0].datagrams == [b"a5"]
            serving.links(1).write_datagram(b"six")
            assert (await heard_by(source))[0] == b"six"


async def test_a_datagram_that_two_links_claim_is_neithers() -> None:
    async with served(b"a", b"a", b"b") as serving:
        with sources(2) as (first, second):
            serving.send(first, b"a5")
            serving.send(second, b"b5")
            await serving.recorders[2].until("datagram", datagrams=1)
            assert [recorder.datagrams for recorder in serving.recorders] == [[], [], [b"b5"]]
            assert ["rivalled" in recorder.calls for recorder in serving.recorders] == [True, True, False]


async def test_datagrams_that_wait_are_taken_before_the_stream_that_followed_them() -> None:
    async with served(b"a") as serving:
        with sources(1) as (source,):
            serving.send(source, b"a5")
            await serving.recorders[0].until("datagram", datagrams=1)
            order: list[bytes] = []
            serving.recorders[0].received = order.append  # type: ignore[method-assign]
            serving.recorders[0].received_datagram = order.append  # type: ignore[method-assign]
            for number in range(200):
                serving.send(source, b"move %d" % number)
            serving.ends[0].write(b"stop")
            async with asyncio.timeout(SOON_S):
                while b"stop" not in order:  # noqa: ASYNC110
                    await asyncio.sleep(0)
            assert order == [*(b"move %d" % number for number in range(200)), b"stop"]


async def test_a_listener_without_datagrams_serves_no_udp() -> None:
    async with listen(LOCAL, Recorder) as address:
        with contextlib.closing(udp_socket((address.host, address.port))) as free:
            assert free.getsockname()[1] == address.port


async def test_a_udp_port_that_is_taken_is_a_link_error_and_leaves_nothing_open() -> None:
    host, port = "127.0.0.1", free_port()  # a number that no program of this machine is given by chance
    with contextlib.closing(udp_socket((host, port))):
        with pytest.raises(LinkError, match=f"tcp://{host}:{port}"):
            async with listen(Address(host, port), Recorder, datagrams=True):
                pass
        gc.collect()
        with contextlib.closing(socket.socket()) as free:
            free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            free.bind((host, port))


async def test_a_hub_gives_a_source_to_a_link_of_its_own_host_only() -> None:
    foreign = Count()
    hub, near, far = DatagramHub(foreign), Recorder(b"a"), Recorder(b"a")
    hub.add(FakeLink(), "10.0.0.1", near)
    hub.add(FakeLink(), "10.0.0.2", far)
    hub._take(b"a5", ("10.0.0.2", 11000))
    hub._take(b"a5", ("10.0.0.3", 11000))
    assert (near.datagrams, far.datagrams, foreign.value) == ([], [b"a5"], 1)


@pytest.fixture
def all_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    """Look at every datagram, however soon after one that nobody claimed."""
    monkeypatch.setattr(udp, "STRAY_S", 0.0)


@jumping
async def test_a_source_that_nobody_claimed_is_not_listened_to_for_a_moment() -> None:
    """So a flood costs little, however many links its host has."""
    foreign = Count()
    hub, recorder = DatagramHub(foreign), Recorder(b"a")
    hub.add(FakeLink(), "10.0.0.1", recorder)
    for _ in range(1000):
        hub._take(b"b5", ("10.0.0.1", 1))
    assert (recorder.asked, recorder.stray, foreign.value) == ([1], [b"b5"], 1000)
    hub._take(b"a5", ("10.0.0.1", 2))
    assert recorder.datagrams == [b"a5"], "another source is heard"
    await asyncio.sleep(udp.STRAY_S)
    hub._take(b"b5", ("10.0.0.1", 1))
    assert recorder.stray == [b"b5", b"b5"]


async def test_what_links_are_shown_of_strays_and_what_is_kept_of_them_is_bounded() -> None:
    foreign = Count()
    hub, recorder = DatagramHub(foreign), Recorder(b"a")
    hub.add(FakeLink(), "10.0.0.1", recorder)
    for port in range(5000):
        hub._take(b"b5", ("10.0.0.1", port))
    assert len(recorder.asked) == foreign.value == 5000
    assert udp.STRAYS_HZ <= len(recorder.stray) <= 10 * udp.STRAYS_HZ
    assert len(hub._deaf_until) <= udp.STRAY_SOURCES


async def test_a_hub_counts_what_nobody_claims_and_what_comes_after_its_link(all_heard: None) -> None:
    foreign = Count()
    hub, recorder, link = DatagramHub(foreign), Recorder(b"a"), FakeLink()
    hub.add(link, "10.0.0.1", recorder)
    hub._take(b"b5", ("10.0.0.1", 1))
    hub._take(b"a5", ("10.0.0.1", 1))
    hub._take(b"c5", ("10.0.0.1", 2))
    assert recorder.stray == [b"b5", b"c5"]
    hub.remove(link)
    hub.remove(link)
    hub._take(b"a5", ("10.0.0.1", 1))
    assert recorder.datagrams == [b"a5"]
    assert foreign.value == 3
    hub.send(link, b"into the void")
    hub.close()
    hub.close()


def test_a_fake_link_keeps_what_is_done_to_it() -> None:
    link = FakeLink("tcp://a:1")
    link.write(b"x")
    link.write_datagram(b"y")
    link.pause()
    assert (link.peer, link.ready, link.paused) == ("tcp://a:1", True, True)
    assert (link.written, link.datagrams) == ([b"x"], [b"y"])
    link.drop_source()
    assert link.sources_dropped == 1
    link.resume()
    link.close()
    assert (link.paused, link.closed) == (False, True)


# What a robot's machine has not acknowledged


async def waited(link: TcpLink, least_s: float) -> float:
    """Wait until bytes have waited for their acknowledgement for so long."""
    async with asyncio.timeout(SOON_S):
        while (waited_s := link.unacknowledged_s) < least_s:  # noqa: ASYNC110 - nothing tells when
            await asyncio.sleep(0.01)
    return waited_s


async def test_bytes_that_the_peers_machine_does_not_take_wait_for_their_acknowledgement_until_it_does() -> None:
    async with connected() as pair:
        pair.there.pause()
        pair.here.write(b"x" * 2_000_000)  # more than a kernel keeps whose program reads nothing
        await waited(pair.here, STALLED_S + 0.1)
        pair.there.resume()
        await pair.far.until("received", received=2_000_000)
        async with asyncio.timeout(SOON_S):
            while pair.here.unacknowledged_s:  # noqa: ASYNC110 - nothing tells when
                await asyncio.sleep(0.01)


async def test_bytes_that_arrive_do_not_wait_for_the_program_to_read_them() -> None:
    """A stalled program cannot be seen from here, as its kernel acknowledges."""
    async with connected() as pair:
        pair.there.pause()
        for _ in range(30):
            pair.here.write(b"x")
            await asyncio.sleep(0.02)
        assert pair.here.unacknowledged_s <= STALLED_S


async def test_only_a_robots_link_is_watched() -> None:
    async with connected() as pair:
        pair.here.pause()
        pair.there.write(b"x" * 10_000_000)
        await asyncio.sleep(STALLED_S + 0.1)
        assert pair.there.unacknowledged_s == 0.0


async def test_a_robots_connection_is_kept_for_a_minute_and_what_was_lost_sent_again_within_a_second() -> None:
    async with connected() as pair:
        here, there = (link._transport.get_extra_info("socket") for link in (pair.here, pair.there))  # type: ignore[union-attr]
        assert here.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 60_000
        assert there.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 10_000
        with contextlib.suppress(OSError):  # a kernel before 6.15
            assert here.getsockopt(socket.IPPROTO_TCP, 44) == 1000


async def test_a_platform_that_tells_nothing_is_said_once_and_has_no_gate(monkeypatch, caplog) -> None:
    def unknown(*_: object) -> bytes:
        raise OSError("Inappropriate ioctl for device")

    monkeypatch.setattr(tcp.fcntl, "ioctl", unknown)
    monkeypatch.setattr(tcp, "_unwatched_warned", False)
    for _ in range(2):
        async with connected() as pair:
            pair.there.pause()
            pair.here.write(b"x" * 10_000_000)
            await asyncio.sleep(STALLED_S + 0.1)
            assert pair.here.unacknowledged_s == 0.0
    assert [record.message for record in caplog.records if "acknowledged" in record.message] == [
        "this platform does not tell what robots acknowledged: drives are written to broken links too"
    ]
