"""TCP links over real sockets on loopback."""

import asyncio
import contextlib
import gc
import socket
import struct

import pytest

from tests.ports import free_port
from tests.transport.recorder import LOCAL, SOON_S, Recorder, connected, socket_of, udp_socket, until
from zbridge.errors import LinkError
from zbridge.protocol.address import Address
from zbridge.transport import kernel, tcp, tcp_options
from zbridge.transport.link import STALLED_S, Link
from zbridge.transport.tcp import TcpLink, connect, listen


async def test_both_ends_are_attached_first_know_their_peer_and_exchange_bytes() -> None:
    async with connected() as pair:
        assert pair.near.calls == ["attached"]
        assert pair.near.link is pair.here
        assert (pair.here.peer, pair.there.peer[:16]) == (str(pair.address), "tcp://127.0.0.1:")
        data = bytes(range(256)) * 4096
        pair.here.write(data)
        await pair.far.until("received", received=len(data))
        assert pair.far.data == data
        pair.there.write(b"pong")
        await pair.near.until("received", received=4)
        assert pair.near.data == b"pong"
        for link, give_up_ms in ((pair.here, 60_000), (pair.there, 10_000)):  # a robot's connection is kept for longer
            with socket_of(link) as sock:
                assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY), "every write is a segment"
                assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
                assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == give_up_ms
        with contextlib.suppress(OSError), socket_of(pair.here) as sock:
            # a kernel before 6.15 has no such option; what was lost is sent again within a second
            assert sock.getsockopt(socket.IPPROTO_TCP, 44) == 1000


class Watcher(Recorder):
    """Watches the reads of its link: which began and brought nothing yet."""

    reading = False

    def attached(self, link: Link) -> None:
        super().attached(link)
        link.reads = lambda: setattr(self, "reading", True)

    def received(self, data: bytes) -> None:
        super().received(data)
        self.reading = False


@pytest.mark.both_loops
async def test_who_watches_the_reads_learns_the_end_of_each_also_of_one_that_found_nothing() -> None:
    watcher = Watcher()
    async with connected(watcher, buffer=bytearray(64)) as pair:
        for count in range(1, 4):
            pair.there.write(bytes(64))  # fills the buffer, so the loop reads once more
            await watcher.until("received", received=64 * count)
            await until(lambda: not watcher.reading)


async def test_what_was_written_before_closing_arrives_and_a_lost_link_takes_calls_without_effect() -> None:
    async with connected() as pair:
        pair.there.write(b"last words")
        pair.there.close()
        pair.there.close()
        await pair.near.until("lost")
        assert (pair.near.data, pair.near.reason) == (b"last words", "closed by peer")
        assert not pair.here.ready
        pair.here.write(b"x")
        for call in (pair.here.pause_reading, pair.here.resume_reading, pair.here.close, pair.here.abort):
            call()
        await asyncio.sleep(0)
        assert pair.near.calls == ["attached", "received", "lost"]


async def test_a_peer_that_breaks_off_is_noticed_with_the_reason() -> None:
    async with connected() as pair:
        with socket_of(pair.there) as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        pair.there.abort()
        await pair.near.until("lost")
        assert (pair.near.reason or "").startswith("connection lost: ")


async def test_a_paused_link_reads_nothing_until_it_is_resumed_and_its_machine_is_not_silent(monkeypatch) -> None:
    async with connected() as pair:
        for _ in range(2):
            pair.here.pause_reading()
        pair.there.write(b"waits")
        await asyncio.sleep(0.05)
        assert pair.near.data == b""
        assert pair.there.silent_s == pair.here.silent_s == 0.0
        monkeypatch.setattr(tcp, "KEEPALIVE_S", 0.0)  # as if the kernel had asked for a sign of life meanwhile
        assert 0.0 < pair.there.silent_s < SOON_S
        for _ in range(2):
            pair.here.resume_reading()
        await pair.near.until("received", received=5)


async def test_a_peer_that_takes_nothing_makes_the_link_unready_and_writable_again_later() -> None:
    async with connected() as pair:
        pair.there.pause_reading()
        written = 0
        while pair.here.ready:
            pair.here.write(bytes(64 * 1024))
            written += 64 * 1024
            assert written < 64 * 2**20
        pair.there.resume_reading()
        await pair.near.until("writable")
        assert pair.here.ready
        await pair.far.until("received", received=written)


async def test_nobody_there_and_no_answer_are_link_errors_that_name_address_and_reason(monkeypatch) -> None:
    port = free_port()
    with pytest.raises(LinkError, match=f"tcp://127.0.0.1:{port}: .*(refused|failed)"):
        await connect(Address("127.0.0.1", port), Recorder())

    async def forever(*args: object) -> None:
        await asyncio.Event().wait()

    monkeypatch.setattr(tcp, "CONNECT_S", 0.01)
    monkeypatch.setattr(asyncio.get_running_loop(), "create_connection", forever, raising=False)
    with pytest.raises(LinkError, match=r"tcp://robot\.test:1: no answer within 0\.01 s"):
        await connect(Address("robot.test", 1), Recorder())


def test_a_peer_that_is_gone_before_it_is_looked_at_is_lost_and_nothing_else() -> None:
    class Gone(asyncio.Transport):
        aborted = False

        def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
            pass

        def abort(self) -> None:
            self.aborted = True

    recorder, transport = Recorder(), Gone()
    link = TcpLink(recorder)
    link.connection_made(transport)
    assert transport.aborted
    link.connection_lost(None)
    assert recorder.calls == ["lost"]


# Listeners


async def test_every_peer_of_a_listener_has_a_receiver_of_its_own_and_its_address_is_taken() -> None:
    receivers: list[Recorder] = []

    def receiver() -> Recorder:
        receivers.append(Recorder())
        return receivers[-1]

    async with listen(LOCAL, receiver) as address:
        with pytest.raises(LinkError, match=str(address)):
            async with listen(address, Recorder):
                pass
        for number in range(2):
            end = await connect(address, Recorder())
            end.write(b"%d" % number)
            end.close()
            await until(lambda number=number: len(receivers) > number)
            await receivers[number].until("lost")
        assert [each.data for each in receivers] == [b"0", b"1"]
        with contextlib.closing(udp_socket((address.host, address.port))):
            pass  # without datagrams it serves no UDP


async def test_a_listener_that_ends_takes_no_more_peers_and_frees_its_ports() -> None:
    with pytest.raises(FileNotFoundError):  # what goes wrong inside is not the listener's
        async with listen(LOCAL, Recorder, datagrams=True) as address:
            raise FileNotFoundError(2, "no such file")
    with pytest.raises(LinkError):
        await connect(address, Recorder())
    with contextlib.closing(udp_socket((address.host, address.port))):
        pass


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


# What a robot's machine has not acknowledged


async def test_bytes_that_the_peers_machine_does_not_take_wait_for_their_acknowledgement_until_it_does() -> None:
    async with connected() as pair:
        pair.there.pause_reading()
        pair.here.write(b"x" * 2_000_000)  # more than a kernel keeps whose program reads nothing
        await until(lambda: pair.here.unacknowledged_s >= STALLED_S + 0.1)
        pair.there.resume_reading()
        await pair.far.until("received", received=2_000_000)
        await until(lambda: pair.here.unacknowledged_s == 0.0)


async def test_bytes_that_arrive_do_not_wait_for_the_program_to_read_them() -> None:
    """A stalled program cannot be seen from here, as its kernel acknowledges."""
    async with connected() as pair:
        pair.there.pause_reading()
        for _ in range(30):
            pair.here.write(b"x")
            await asyncio.sleep(0.02)
        assert pair.here.unacknowledged_s <= STALLED_S
        pair.here.pause_reading()
        pair.there.write(b"x" * 10_000_000)
        await asyncio.sleep(STALLED_S + 0.1)
        assert pair.there.unacknowledged_s == 0.0, "only a robot's link is watched"


async def test_a_platform_that_tells_nothing_is_said_once_and_has_no_gate(monkeypatch, caplog) -> None:
    def unknown(*_: object) -> bytes:
        raise OSError("Inappropriate ioctl for device")

    monkeypatch.setattr(kernel.fcntl, "ioctl", unknown)
    monkeypatch.setattr(tcp_options, "_unwatched_warned", False)
    for _ in range(2):
        async with connected() as pair:
            pair.there.pause_reading()
            pair.here.write(b"x" * 10_000_000)
            await asyncio.sleep(STALLED_S + 0.1)
            assert pair.here.unacknowledged_s == 0.0
    assert [record.message for record in caplog.records if "acknowledged" in record.message] == [
        "this platform does not report unacknowledged bytes: drives are also written to broken links"
    ]
