"""Datagrams beside TCP links: the socket towards a robot, and the one that the links of a listener share."""

import asyncio
import contextlib

import pytest

from tests.bounds import most_kept
from tests.clock import jumping
from tests.fake_link import FakeLink
from tests.transport.recorder import LOCAL, Recorder, connected, heard_by, udp_socket, until
from zbridge.metrics import Count
from zbridge.transport import udp
from zbridge.transport.tcp import connect, listen
from zbridge.transport.udp import DatagramHub

# A link that was connected


async def test_the_first_datagram_opens_a_socket_that_hears_the_peer_and_nobody_else() -> None:
    async with connected() as pair, contextlib.AsyncExitStack() as stack:
        peer = stack.enter_context(contextlib.closing(udp_socket((pair.address.host, pair.address.port))))
        stranger = stack.enter_context(contextlib.closing(udp_socket(("127.0.0.1", 0))))
        pair.here.write_datagram(b"five")
        data, source = await heard_by(peer)
        assert (data, source[0]) == (b"five", "127.0.0.1")
        pair.here.write_datagram(b"more")
        assert await heard_by(peer) == (b"more", source)
        for data in (b"six", b"seven"):
            stranger.sendto(data, source)
        large = bytes(range(256)) * 234  # 59904 bytes
        sent = [b"six", b"", large, *(b"%d" % number for number in range(150))]
        for data in sent:
            peer.sendto(data, source)
        await pair.near.until("datagram", datagrams=len(sent))
        assert (pair.near.datagrams, pair.near.data, pair.near.foreign) == (sent, b"", 2)
        pair.here.abort()
        await pair.near.until("lost")
        pair.here.write_datagram(b"late")
        with contextlib.closing(udp_socket(source)):  # the port is free again
            pass
        with pytest.raises(BlockingIOError):
            peer.recvfrom(100)


async def test_datagrams_to_a_peer_that_hears_none_are_lost_without_a_word() -> None:
    async with connected() as pair:
        for _ in range(3):
            pair.here.write_datagram(b"five")
            await asyncio.sleep(0.01)
        pair.here.write_datagram(bytes(70_000))
        pair.here.write(b"still there")
        await pair.far.until("received", received=11)
        assert pair.near.calls == ["attached"]


# The links of a listener


async def test_links_of_a_listener_hear_and_answer_the_source_they_claimed_until_they_drop_it_or_are_lost() -> None:
    recorders = [Recorder(b"a"), Recorder(b"b")]
    waiting = iter(recorders)
    async with listen(LOCAL, lambda: next(waiting), datagrams=True) as address, contextlib.AsyncExitStack() as stack:
        first = await connect(address, Recorder())
        await recorders[0].until("attached")
        second = await connect(address, Recorder())
        await recorders[1].until("attached")
        one, two = (stack.enter_context(contextlib.closing(udp_socket(("127.0.0.1", 0)))) for _ in range(2))
        there, link = (address.host, address.port), recorders[0].link
        assert link is not None
        one.sendto(b"a5", there)
        one.sendto(b"more", there)
        await recorders[0].until("datagram", datagrams=2)
        assert recorders[0].datagrams == [b"a5", b"more"]
        link.write_datagram(b"six")
        assert await heard_by(one) == (b"six", there)
        link.drop_source()
        two.sendto(b"a again", there)
        await recorders[0].until("datagram", datagrams=3)
        link.write_datagram(b"six again")
        assert (await heard_by(two))[0] == b"six again"
        order: list[bytes] = []
        recorders[0].received = recorders[0].received_datagram = order.append  # type: ignore[method-assign]
        moves = [b"move %d" % number for number in range(200)]
        for move in moves:
            two.sendto(move, there)
        first.write(b"stop")
        await until(lambda: b"stop" in order)
        assert order == [*moves, b"stop"], "datagrams that wait are older than the stream that follows them"
        first.abort()
        await recorders[0].until("lost")
        two.sendto(b"b5", there)
        await recorders[1].until("datagram")
        assert recorders[1].datagrams == [b"b5"]
        second.abort()
        await recorders[1].until("lost")


class Hub(DatagramHub):
    """A hub without a socket; keeps what it sends, with the port it goes to."""

    def __init__(self) -> None:
        self.foreign, self.sent = Count(), list[str]()
        super().__init__(self.foreign)

    def receive(self, data: bytes, source: tuple[str, int]) -> None:
        """Let a datagram arrive."""
        self._take(data, source)

    def _send(self, data: bytes, destination: tuple[str, int]) -> None:
        self.sent.append(f"{destination[1]}:{data.decode()}")


SOURCES = {
    # links: by which first letter each of them claims datagrams. acts: what comes from which port, what a link sends or
    # does. heard: by each link (? claimed by nobody). sent: to which port. foreign: how many were nobody's.
    "each link of a host has the source it claimed": """
        links a b
        acts 2:b5 1:a5 2:a-again link0:for-a link1:for-b
        heard a5 | b5 a-again
        sent 1:for-a 2:for-b""",
    "a link has one source and others are foreign": """
        links a
        acts 1:a5 2:b5 1:more
        heard a5 more ?b5
        foreign 1""",
    "a second source that a link claims costs it the first, for nobody here knows which of the two it is": """
        links a b
        acts 1:a5 2:a5 link0:to-nobody 1:a-more 2:a-more 3:b5
        heard a5 ?a-more ?a-more rivalled | b5 ?a-more ?a-more
        foreign 3""",
    "a source that is dropped is nobody's until it is claimed again": """
        links a
        acts 1:a5 link0:drops link0:drops 1:more 2:a-again link0:six
        heard a5 a-again ?more
        sent 2:six
        foreign 1""",
    "a link that has claimed nothing sends datagrams nowhere": """
        links a
        acts link0:early 1:stranger link0:early 1:a5 link0:six
        heard a5 ?stranger
        sent 1:six
        foreign 1""",
    "a source is free again when its link is lost": """
        links a b
        acts 1:a5 link0:lost link0:lost link0:late 1:b5 link1:six
        heard a5 | b5
        sent 1:six""",
    "a datagram that two links claim is neither's": """
        links a a b
        acts 1:a5 2:b5
        heard rivalled | rivalled | b5
        foreign 1""",
    "what comes after the last link is foreign": """
        links a
        acts 1:b5 1:a5 2:c5 link0:lost 1:a5
        heard a5 ?b5 ?c5
        foreign 3""",
}


@pytest.mark.parametrize("script", SOURCES.values(), ids=SOURCES)
async def test_a_source_belongs_to_the_link_that_claims_it(script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(udp, "STRAY_S", 0.0)  # every datagram is looked at, however soon after one that nobody claimed
    parts = dict(line.strip().split(" ", 1) for line in script.strip().splitlines())
    hub, recorders = Hub(), [Recorder(mark.encode()) for mark in parts["links"].split()]
    links = [FakeLink(receiver=recorder) for recorder in recorders]
    for link in links:
        hub.add(link, "10.0.0.1")
    for act in parts["acts"].split():
        who, _, what = act.partition(":")
        if who.isdigit():
            hub.receive(what.encode(), ("10.0.0.1", int(who)))
        elif what == "drops":
            hub.unbind(links[int(who[-1])])
        elif what == "lost":
            hub.remove(links[int(who[-1])])
        else:
            hub.send(links[int(who[-1])], what.encode())
    heard = [
        [*map(bytes.decode, each.datagrams), *(f"?{stray.decode()}" for stray in each.stray)]
        + ["rivalled"] * each.calls.count("rivalled")
        for each in recorders
    ]
    assert " | ".join(map(" ".join, heard)) == parts["heard"]
    assert (" ".join(hub.sent), hub.foreign.value) == (parts.get("sent", ""), int(parts.get("foreign", 0)))


async def test_a_hub_gives_a_source_to_a_link_of_its_own_host_only() -> None:
    hub, near, far = Hub(), Recorder(b"a"), Recorder(b"a")
    hub.add(FakeLink(receiver=near), "10.0.0.1")
    hub.add(FakeLink(receiver=far), "10.0.0.2")
    hub.receive(b"a5", ("10.0.0.2", 11000))
    hub.receive(b"a5", ("10.0.0.3", 11000))
    assert (near.datagrams, far.datagrams, hub.foreign.value) == ([], [b"a5"], 1)
    hub.close()
    hub.close()


@jumping
async def test_a_source_that_nobody_claimed_is_not_listened_to_for_a_moment_and_a_flood_costs_little() -> None:
    hub, recorder = Hub(), Recorder(b"a")
    hub.add(FakeLink(receiver=recorder), "10.0.0.1")
    for _ in range(1000):
        hub.receive(b"b5", ("10.0.0.1", 1))
    assert (recorder.asked, recorder.stray, hub.foreign.value) == ([1], [b"b5"], 1000)
    hub.receive(b"a5", ("10.0.0.1", 2))
    assert recorder.datagrams == [b"a5"], "another source is heard"
    await asyncio.sleep(udp.STRAY_S)
    hub.receive(b"b5", ("10.0.0.1", 1))
    assert recorder.stray == [b"b5", b"b5"]
    for port in range(2000, 7000):
        hub.receive(b"b5", ("10.0.0.1", port))
    assert len(recorder.asked) == 5003
    assert len(recorder.stray) <= 2 + udp.STRAYS_HZ
    assert most_kept(hub) <= udp.STRAY_SOURCES
