"""A session over a fake link, with a clock that jumps: writing, timers, endings."""

import asyncio
import logging
import re
from typing import Any

import pytest

from tests.fake_link import FakeLink
from tests.protocol.test_session import LIMITS, Toy
from zbridge.errors import NotReady
from zbridge.metrics import Count
from zbridge.protocol.session import LINGER_S, State
from zbridge.protocol.traffic import SourceClaims
from zbridge.transport.accepted import ClientConversation
from zbridge.transport.conversation import ConversationHooks
from zbridge.transport.link import STALLED_S
from zbridge.transport.reading import BURST_S, FairShare

pytestmark = pytest.mark.jumping

WELCOME = b"\x07welcome"


class Rig:
    def __init__(self, made: type[Toy] = Toy, **more: Any) -> None:
        self.loop = asyncio.get_running_loop()
        self.session: Any = made(LIMITS, name="robot")
        self.link = FakeLink("tcp://toy.test:1")
        self.happened: list[object] = []
        hooks = {"deliver": self.happened.append, "changed": lambda: self.happened.append(self.session.state), **more}
        self.conversation = ClientConversation(self.session, self.loop, ConversationHooks(**hooks))

    def begin(self) -> "Rig":
        """Establish the session, and forget what happened."""
        self.conversation.attached(self.link)
        self.conversation.received(WELCOME)
        self.link.written.clear()
        self.happened.clear()
        return self


@pytest.fixture
async def rig() -> Rig:
    return Rig()


@pytest.fixture
async def up() -> Rig:
    return Rig().begin()


async def test_a_link_that_is_up_opens_the_session_and_changes_are_told_before_the_messages_of_a_read(rig) -> None:
    rig.conversation.attached(rig.link)
    assert rig.session.peer == "tcp://toy.test:1"
    assert rig.link.written == [b"\x05hello"]
    rig.conversation.received(WELCOME + b"\x01a\x01b\x02")
    assert rig.happened == [State.HANDSHAKING, State.ESTABLISHED, [b"a", b"b"]]
    rig.conversation.received(b"c")
    assert len(rig.happened) == 3, "a read without a whole message delivers nothing"


async def test_a_doubt_is_told_when_it_comes_and_when_it_goes(up: Rig) -> None:
    for doubts in (("client id 3",), ("client id 3",), ()):
        up.session.doubts = doubts
        up.conversation.pump()
    assert up.happened == [State.ESTABLISHED, State.ESTABLISHED]


async def test_what_becomes_due_while_the_process_is_frozen_waits_for_the_next_look() -> None:
    """The look comes before everything that is written: it stops a robot whose driver is silent."""
    clock_s, looks, freezes = [0.0], list[float](), list[float]()

    def look() -> None:
        looks.append(clock_s[0])
        if freezes:
            clock_s[0] += freezes.pop()  # just after the look

    up = Rig(clock=lambda: clock_s[0], before=look).begin()
    clock_s[0] = 1.0
    up.session.outbox.set("drive", (b"motion",), clock_s[0], period_s=0.25)
    up.conversation.pump()
    up.link.written.clear()
    clock_s[0], freezes = 1.1, [2.0]
    up.session.outbox.put(b"once")
    looks.clear()
    up.conversation.pump()
    assert (clock_s, looks[0], up.link.written[0]) == ([3.1], 1.1, b"once")
    clock_s[0] = 4.0  # after the gap
    up.conversation.pump()
    assert (looks[1:], up.link.written[1:]) == ([4.0], [b"motion"])


class Watching(Toy):
    """Ends when its peer says nothing for three seconds."""

    heard_at = 0.0

    def receive(self, data: bytes, now: float) -> list[bytes]:
        self.heard_at = now
        return super().receive(data, now)

    def timers(self) -> float:
        return self.heard_at + 3.0

    def on_timer(self, now: float) -> None:
        self.fail("no report for 3 s")


def watching(order: list[str]) -> Rig:
    """A session that watches for silence, and what it does in which order."""
    up = Rig(before=lambda: order.append("stop"), read=lambda: order.append("read"))
    up.session = up.conversation.session = Watching(LIMITS, name="robot")
    up.begin()
    order.clear()
    return up


@pytest.mark.parametrize("frozen_s", [0.6, 4.0])
@pytest.mark.parametrize("lasts_s", [2.9, 0.0])
async def test_a_process_that_was_frozen_stops_then_reads_what_waits_and_then_judges_silence(
    frozen_s: float, lasts_s: float
) -> None:
    order = list[str]()
    up = watching(order)
    await asyncio.sleep(lasts_s)  # of silence before the freeze
    up.loop._jumping.now += frozen_s
    up.loop.call_later(0.001, up.conversation.received, b"\x01a")  # it waited in the kernel; uvloop's timers come first
    await asyncio.sleep(0.1)
    assert up.session.state is State.ESTABLISHED
    assert order[0] == "stop"
    assert order.index("read") > 0
    await asyncio.sleep(2.8)
    assert up.session.state is State.ESTABLISHED
    await asyncio.sleep(0.2)
    assert up.session.reason == "no report for 3 s"


async def test_a_peer_that_said_nothing_during_a_freeze_is_lost_soon_after_it() -> None:
    up = watching([])
    up.loop._jumping.now += 4.0
    await asyncio.sleep(0.04)
    assert up.session.state is State.ESTABLISHED
    await asyncio.sleep(0.02)
    assert up.session.reason == "no report for 3 s"


async def test_frames_are_written_at_their_times_while_a_process_that_was_frozen_reads() -> None:
    up = watching([])
    up.loop._jumping.now += 4.0
    await asyncio.sleep(0)
    up.session.outbox.set("stop", (b"1", b"2", b"3"), up.loop.time(), urgent=True)
    up.conversation.pump()
    await asyncio.sleep(0.03)
    assert up.link.written == [b"1", b"2", b"3"]


async def test_nothing_is_looked_at_while_nothing_is_due() -> None:
    looks = list[float]()
    up = Rig(clock=lambda: 1.0, before=lambda: looks.append(1.0)).begin()
    up.session.outbox.set("drive", (b"motion",), 1.25)
    looks.clear()
    up.conversation.pump()
    assert (looks, up.link.written) == ([], [])
    up.conversation.abandon()


async def test_frames_are_written_one_at_a_time_with_the_gap_between_them_and_only_to_a_link_that_is_ready(up) -> None:
    await asyncio.sleep(1)
    up.link.ready = False
    for message in (b"a", b"b", b"c"):
        up.session.send(message)
    up.conversation.pump()
    await asyncio.sleep(10)
    assert up.link.written == []
    up.link.ready = True
    up.conversation.writable()
    for written in ([b"\x01a"], [b"\x01a", b"\x01b"], [b"\x01a", b"\x01b", b"\x01c"]):
        assert up.link.written == written
        await asyncio.sleep(0.0101)


# Endings


async def test_an_unfinished_handshake_ends_the_conversation_and_its_link(rig) -> None:
    rig.conversation.attached(rig.link)
    await asyncio.sleep(4.9)
    assert not rig.conversation.ended.done()
    await asyncio.sleep(0.2)
    assert (rig.conversation.ended.done(), rig.link.closed) == (True, True)
    assert rig.session.reason == "no handshake within 5 s"
    assert rig.happened == [State.HANDSHAKING, State.CLOSED]


@pytest.mark.parametrize("abandoned", [False, True])
async def test_a_lost_link_or_abandoning_ends_the_conversation_and_nothing_happens_after_it(up, abandoned) -> None:
    up.session.send(b"a")
    if abandoned:
        up.conversation.abandon()
        up.conversation.abandon()
    else:
        up.conversation.lost("closed by peer")
    assert (up.conversation.ended.done(), up.link.closed) == (True, abandoned)
    assert up.session.reason == ("abandoned" if abandoned else "closed by peer")
    up.conversation.pump()
    up.conversation.received(b"\x01a")
    up.conversation.reading.pause()
    await asyncio.sleep(100)
    assert (up.happened, up.link.written, up.link.paused) == ([State.CLOSED], [], False)
    Rig().conversation.abandon()  # it never had a link


@pytest.mark.parametrize(("ready", "written", "lasts_s"), [(True, [b"\x01a", b"\x01b"], 0.02), (False, [], LINGER_S)])
async def test_closing_writes_what_waits_but_waits_not_long_for_a_link_that_takes_nothing(up, ready, written, lasts_s):
    up.link.ready = ready
    up.session.send(b"a")
    up.session.send(b"b")
    up.conversation.close("enough")
    assert not up.link.closed
    start = up.loop.time()
    await up.conversation.ended
    assert up.loop.time() - start == pytest.approx(lasts_s, abs=0.01)
    assert (up.link.written, up.link.closed) == (written, True)
    assert (up.happened, up.session.reason) == ([State.CLOSING, State.CLOSED], "enough")


@pytest.mark.parametrize(
    ("last", "states", "written"),
    [(b"\xff", [State.CLOSED], []), (b"\x03bye\x01b", [State.CLOSING, State.CLOSED], [b"\x07bye too"])],
    ids=["broken stream", "farewell"],
)
async def test_messages_before_the_end_are_delivered_before_it_is_told_and_later_ones_never(up, last, states, written):
    up.conversation.received(b"\x01a" + last)
    await up.conversation.ended
    assert up.happened == [[b"a"], *states]
    assert (up.link.written, up.link.closed) == (written, True)


# What is malformed, and datagrams


async def test_malformed_messages_are_counted_and_logged_ever_more_rarely(caplog: pytest.LogCaptureFixture) -> None:
    count = Count()
    up = Rig(malformed=count).begin()
    up.conversation.received(b"\x01?\x01a\x01?")
    with caplog.at_level(logging.WARNING):
        for _ in range(98):
            up.conversation.received(b"\x01?")
    up.conversation.received(b"\x01a")
    assert count.value == 100
    assert [record.__dict__["fields"]["count"] for record in caplog.records] == [2, 4, 8, 16, 32, 64]
    assert "what is ?" in caplog.text


class Claimant(Toy, SourceClaims):
    """Claims ``mine`` from port 11000, and refuses a stray datagram in its peer's name."""

    def claims(self, datagram: bytes, port: int) -> bool:
        return (datagram, port) == (b"mine", 11000)

    def rivalled(self, now: float) -> None:
        self.close("rivalled", now)

    def stray(self, datagram: bytes) -> None:
        if datagram == b"in its name":
            raise NotReady("not taken")


async def test_what_becomes_of_datagrams_that_are_nobodys_is_the_sessions_to_say() -> None:
    rivals, foreign, refused = Count(), Count(), list[object]()
    up = Rig(Claimant, rivals=rivals, foreign=foreign, refused=refused.append).begin()
    assert [up.conversation.claims(b"mine", port) for port in (11000, 11001)] == [True, False]
    for datagram in (b"somebody's", b"in its name"):
        up.conversation.stray_datagram(datagram)
    assert [str(refusal) for refusal in refused] == ["not taken"]
    up.conversation.foreign_datagram()
    assert (foreign.value, up.session.traffic.foreign) == (1, 1)
    up.conversation.rivalled()
    await up.conversation.ended
    assert (rivals.value, up.session.reason) == (1, "rivalled")
    nobodys = Rig(rivals=rivals).begin()
    assert not nobodys.conversation.claims(b"mine", 11000)
    nobodys.conversation.stray_datagram(b"in its name")


async def test_a_session_that_drops_its_source_has_its_link_forget_it_once() -> None:
    up = Rig(Claimant).begin()
    for drops, dropped in ((False, 0), (True, 1), (False, 1)):
        up.session.drops_source = up.session.drops_source or drops
        up.conversation.pump()
        assert up.link.sources_dropped == dropped


async def test_a_timer_that_does_not_tell_when_it_is_due_is_replaced(up: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """uvloop gives a plain handle for a timer that is due at once."""
    monkeypatch.setattr(up.loop, "call_at", lambda when, callback: asyncio.Handle(callback, (), up.loop))
    for message in (b"one", b"two", b"three"):
        up.session.send(message)
        up.conversation.pump()
    assert up.session.state is State.ESTABLISHED


def raises(*arguments: object) -> None:
    raise KeyError(1)


FAULT = r"a fault of the protocol: KeyError: 1 in \S+ \(test_conversation.py:\d+\)"


@pytest.mark.parametrize("method", ["opened", "accept", "decode", "on_timer", "timers", "deliver"])
async def test_a_fault_of_the_protocol_ends_the_session_and_its_link_with_the_place(
    method: str, rig: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    if method == "deliver":
        rig = Rig(deliver=raises)
    else:
        monkeypatch.setattr(rig.session, method, raises)
    if method == "on_timer":
        monkeypatch.setattr(rig.session, "timers", lambda: 1.0)
    rig.conversation.attached(rig.link)
    await asyncio.sleep(1.1)
    rig.conversation.received(WELCOME + b"\x01a")
    assert (rig.conversation.ended.done(), rig.link.closed) == (True, True)
    assert re.fullmatch(FAULT, rig.session.reason or "")
    (record,) = caplog.records
    assert record.exc_info is not None
    assert re.search(FAULT, record.getMessage())


async def test_a_link_is_looked_at_again_after_a_write_though_nothing_else_is_due() -> None:
    begins = list[bool]()
    up = Rig(stalled=begins.append).begin()
    up.link.unacknowledged_s = 1e-9  # as at the moment of a write
    up.conversation.pump()
    up.link.unacknowledged_s = STALLED_S + 0.01
    await asyncio.sleep(STALLED_S + 0.01)
    assert begins == [True]


class Slow(Rig):
    """A rig whose receiver takes ``work_s`` for what each read brings."""

    def __init__(self, part: float) -> None:
        self.work_s = 0.0
        self.surplus = Count()
        super().__init__(share=FairShare(part), surplus=self.surplus, clock=self._time, deliver=self._deliver)
        self.spent_s = 0.0

    def _time(self) -> float:
        return self.loop.time() + getattr(self, "spent_s", 0.0)

    def _deliver(self, messages: list[Any]) -> None:
        self.happened.append(messages)
        self.spent_s += self.work_s


async def test_who_sends_more_than_its_share_allows_is_not_read_and_its_datagrams_are_dropped_meanwhile() -> None:
    slow = Slow(0.25)
    slow.begin()
    slow.work_s = BURST_S + 0.01
    slow.conversation.received(b"\x01a")
    assert slow.link.paused
    slow.conversation.received_datagram(b"\x01b")
    assert (slow.surplus.value, slow.happened) == (1, [[b"a"]])
    await asyncio.sleep(0.03)
    assert slow.link.paused
    await asyncio.sleep(0.02)
    assert not slow.link.paused, "0.01 s over a share of a quarter: 0.04 s of rest"


async def test_a_rest_ends_no_pause_that_the_bus_asked_for_and_the_bus_ends_no_rest() -> None:
    slow = Slow(0.25)
    slow.begin()
    slow.work_s = BURST_S + 0.01
    slow.conversation.received(b"\x01a")
    slow.conversation.reading.pause()
    await asyncio.sleep(0.1)
    assert slow.link.paused
    slow.conversation.reading.resume()
    assert not slow.link.paused
    slow.conversation.received(b"\x01a")
    slow.conversation.reading.pause()
    slow.conversation.reading.resume()
    assert slow.link.paused
    slow.conversation.abandon()
    await asyncio.sleep(1.0)
    assert slow.link.closed
