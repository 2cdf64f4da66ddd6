"""A listener at a UDP port: its clients are the sources that send."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator

import pytest

from tests.bounds import most_kept
from tests.transport.recorder import Recorder, heard_by, udp_socket, until
from zbridge.errors import LinkError, ProtocolError
from zbridge.metrics import Count
from zbridge.protocol.address import DatagramAddress
from zbridge.transport import Link, Parcel, listen, sources
from zbridge.transport.kernel import KERNEL
from zbridge.transport.link import Receiver
from zbridge.transport.sources import SourceDoor

pytestmark = pytest.mark.both_loops
LOCAL = DatagramAddress("127.0.0.1", 0)


class Refuser(Receiver):
    """Closes its link at once, as an admission does that refuses."""

    def attached(self, link: Link) -> None:
        link.close()


class Served:
    """A listener of recorders, and programs that send to it. full: how many it accepts."""

    def __init__(self, stack: contextlib.AsyncExitStack) -> None:
        self.stack = stack
        self.came: list[Recorder] = []
        self.refused = 0
        self.full = 100
        self.foreign = Count()
        self.address = LOCAL

    def receiver(self) -> Receiver:
        if len(self.came) >= self.full:
            self.refused += 1
            return Refuser()
        self.came.append(Recorder())
        return self.came[-1]

    async def begin(self, door: SourceDoor, address: DatagramAddress = LOCAL) -> None:
        listening = listen(address, self.receiver, foreign=self.foreign, door=door)
        bound = await self.stack.enter_async_context(listening)
        assert isinstance(bound, DatagramAddress)
        self.address = bound

    def program(self) -> socket.socket:
        made = self.stack.enter_context(contextlib.closing(udp_socket(("127.0.0.1", 0))))
        made.connect((self.address.host, self.address.port))
        return made


@pytest.fixture
async def served() -> AsyncIterator[Served]:
    async with contextlib.AsyncExitStack() as stack:
        yield Served(stack)


async def test_each_source_is_a_client_with_a_link_of_its_own(served: Served) -> None:
    await served.begin(SourceDoor())
    one, two = served.program(), served.program()
    one.send(b"one")
    two.send(b"two")
    one.send(b" more")
    await until(lambda: len(served.came) == 2 and len(served.came[0].data) == 8)
    first, second = served.came
    assert (first.data, second.data, first.calls) == (b"one more", b"two", ["attached", "received", "received"])
    assert first.link is not None
    assert second.link is not None
    assert (first.link.peer, first.link.ready) == (f"udp://127.0.0.1:{one.getsockname()[1]}", True)
    second.link.write(b"answer")
    second.link.write(b"again")
    assert [(await heard_by(two))[0] for _ in range(2)] == [b"answer", b"again"]
    first.link.pause_reading()
    one.send(b"paused")
    two.send(b"!")
    await second.until("received", received=4)
    assert first.data == b"one more"


async def test_a_client_is_gone_after_silence_and_comes_back_with_its_next_datagram(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sources, "SILENT_S", 0.1)
    await served.begin(SourceDoor())
    quiet, talking = served.program(), served.program()
    quiet.send(b"here")
    for _ in range(10):
        talking.send(b".")
        await asyncio.sleep(0.02)
    first, second = served.came
    assert (first.reason, second.reason) == ("silent for 0.1 s", None)
    assert first.link is not None
    assert not first.link.ready
    first.link.write(b"nobody")
    quiet.send(b"back")
    await until(lambda: len(served.came) == 3 and served.came[2].data == b"back")


async def test_a_flood_of_one_source_that_is_refused_costs_one_receiver_a_second(served: Served) -> None:
    await served.begin(SourceDoor())
    served.full = 1
    first, second = served.program(), served.program()
    first.send(b"in")
    await until(lambda: len(served.came) == 1)
    for _ in range(200):
        second.send(b"out")
    first.send(b"!")
    await served.came[0].until("received", received=3)
    assert (served.refused, served.foreign.value) == (1, 199)
    link = served.came[0].link
    assert link is not None
    link.close()
    await served.came[0].until("lost")
    served.full = 2
    first.send(b"closed by our side")
    await until(lambda: served.foreign.value == 200)
    assert len(served.came) == 1


async def test_a_flood_of_sources_leaves_no_more_than_the_bounds(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sources, "RESTING", 8)
    door = SourceDoor()
    await served.begin(door)
    served.full = 2
    programs = [served.program() for _ in range(30)]
    for program in programs:
        program.send(b"x")
    await until(lambda: len(served.came) + served.refused + served.foreign.value == 30)
    assert (len(served.came), served.refused) == (2, 28)
    kept = most_kept(door, depth=2)
    for program in programs:
        program.send(b"x")
    await until(lambda: sum(len(each.data) for each in served.came) == 4)
    assert most_kept(door, depth=2) <= max(kept, 8)


async def test_an_address_to_is_a_client_unasked_lasts_in_silence_and_is_made_again(
    served: Served, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sources, "SILENT_S", 0.05)
    monkeypatch.setattr(sources, "TO_S", 0.02)
    with contextlib.closing(udp_socket(("127.0.0.1", 0))) as desk:
        port = desk.getsockname()[1]
        to = (DatagramAddress("localhost", port), DatagramAddress(70 * "x", 1))
        await served.begin(SourceDoor(to=to))
        await until(lambda: len(served.came) == 1)
        first = served.came[0]
        assert first.link is not None
        await asyncio.sleep(0.15)
        assert (first.reason, first.link.speaks_first, first.link.peer) == (None, True, f"udp://127.0.0.1:{port}")
        first.link.write(b"heartbeat")
        data, listener = await heard_by(desk)
        desk.sendto(b"hello", listener)
        await first.until("received", received=5)
        assert (data, len(served.came)) == (b"heartbeat", 1)
        first.link.abort()
        await until(lambda: len(served.came) == 2)
    assert [record.message.endswith("tried again") for record in caplog.records] == [True], "once"


async def test_the_socket_goes_to_another_process_with_all_clients(served: Served) -> None:
    door = SourceDoor()
    await served.begin(door)
    one, two = served.program(), served.program()
    one.send(b"one")
    await until(lambda: len(served.came) == 1)
    link = served.came[0].link
    assert link is not None
    assert link.blocker is None
    door.shut()
    two.send(b"not now")
    await until(lambda: served.foreign.value == 1)
    door.suspend()
    link.suspend()
    one.send(b"early")
    await asyncio.sleep(0.02)
    parcel = Parcel()
    state, client, source = door.export(parcel), link.export(parcel), door.source(link)
    link.detach()
    door.close()
    async with contextlib.AsyncExitStack() as stack:
        after, heir, other = Served(stack), Recorder(), SourceDoor(state, parcel)
        await after.begin(other, served.address)
        await other.admit(client.get("tcp"), heir, source)
        assert heir.calls == ["attached"]
        await other.open()
        await heir.until("received", received=5)
        two.send(b"now")
        await until(lambda: len(after.came) == 1 and after.came[0].data == b"now")
        assert heir.link is not None
        heir.link.write(b"same")
        assert await heard_by(one) == (b"same", (served.address.host, served.address.port))
        assert (heir.data, served.came[0].data, after.address) == (b"early", b"one", served.address)
        assert "lost" not in served.came[0].calls
        with pytest.raises(ProtocolError):
            await other.admit(None, Recorder(), None)
    await heir.until("lost")


async def test_a_door_of_other_sockets_and_a_port_in_use_are_refused(served: Served) -> None:
    await served.begin(SourceDoor())
    with pytest.raises(LinkError, match=f"udp://127.0.0.1:{served.address.port}: Address already in use"):
        await Served(served.stack).begin(SourceDoor(), served.address)
    with pytest.raises(ProtocolError):
        await Served(served.stack).begin(SourceDoor({"tcp": [], "udp": None}, Parcel(), KERNEL), LOCAL)
