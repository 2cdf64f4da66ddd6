"""A session over a fake link, with a clock that jumps: writing, timers, endings."""

import asyncio
import logging
import re

import pytest

from tests.protocol.test_session import LIMITS, Toy
from zbridge.errors import NotReady
from zbridge.metrics import Count
from zbridge.protocol.session import LINGER_S, State
from zbridge.transport.conversation import Conversation
from zbridge.transport.fake import FakeLink

pytestmark = pytest.mark.jumping

WELCOME = b"\x07welcome"


class Rig:
    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.session = Toy(LIMITS, name="robot")
        self.link = FakeLink("tcp://toy.test:1")
        self.happened: list[object] = []
        self.conversation = Conversation(
            self.session,
            self.loop,
            deliver=self.happened.append,
            changed=lambda: self.happened.append(self.session.state),
        )


@pytest.fixture
async def rig() -> Rig:
    return Rig()


@pytest.fixture
async def up(rig: Rig) -> Rig:
    """An established session."""
    rig.conversation.attached(rig.link)
    rig.conversation.received(WELCOME)
    rig.link.written.clear()
    rig.happened.clear()
    return rig


async def test_a_link_that_is_up_opens_the_session_and_changes_are_told_before_the_messages_of_a_read(rig) -> None:
    rig.conversation.attached(rig.link)
    assert rig.session.peer == "tcp://toy.test:1"
    assert rig.link.written == [b"\x05hello"]
    rig.conversation.received(WELCOME + b"\x01a\x01b")
    assert rig.happened == [State.HANDSHAKING, State.ESTABLISHED, [b"a", b"b"]]


async def test_a_doubt_is_told_when_it_comes_and_when_it_goes(up: Rig) -> None:
    for doubts in (("client id 3",), ("client id 3",), ()):
        up.session.doubts = doubts
        up.conversation.pump()
    assert up.happened == [State.ESTABLISHED, State.ESTABLISHED]


async def test_what_becomes_due_while_the_process_is_frozen_waits_for_the_next_look(up: Rig) -> None:
    """The look comes before everything that is written: it stops a robot whose driver is silent."""
    clock_s, looks = [0.0], []

    def look() -> None:
        looks.append(clock_s[0])
        if freezes:
            clock_s[0] += freezes.pop()  # just after the look

    freezes: list[float] = []
    loop, session, link = asyncio.get_running_loop(), Toy(LIMITS, name="robot"), FakeLink("tcp://toy.test:1")
    conversation = Conversation(session, loop, deliver=print, clock=lambda: clock_s[0], before=look)
    conversation.attached(link)
    conversation.received(WELCOME)
    clock_s[0] = 1.0
    session.outbox.set("drive", (b"motion",), clock_s[0], period_s=0.25)
    conversation.pump()
    link.written.clear()
    clock_s[0], freezes = 1.1, [2.0]
    conversation.pump()
    assert clock_s == [3.1]
    assert link.written == []
    conversation.pump()
    assert link.written == [b"motion"]
    assert looks[-1] == 3.1
    conversation.abandon()


async def test_a_read_without_a_whole_message_delivers_nothing(up: Rig) -> None:
    up.conversation.received(b"\x05ab")
    assert up.happened == []
    up.conversation.received(b"cde")
    assert up.happened == [[b"abcde"]]


async def test_frames_are_written_one_at_a_time_with_the_gap_between_them(up: Rig) -> None:
    await asyncio.sleep(1)
    for message in (b"a", b"b", b"c"):
        up.session.send(message)
    up.conversation.pump()
    assert up.link.written == [b"\x01a"]
    await asyncio.sleep(0.0101)
    assert up.link.written == [b"\x01a", b"\x01b"]
    await asyncio.sleep(0.0101)
    assert up.link.written == [b"\x01a", b"\x01b", b"\x01c"]


async def test_nothing_is_written_to_a_link_that_is_not_ready_until_it_is(up: Rig) -> None:
    await asyncio.sleep(1)
    up.link.ready = False
    up.session.send(b"a")
    up.conversation.pump()
    await asyncio.sleep(10)
    assert up.link.written == []
    up.link.ready = True
    up.conversation.writable()
    assert up.link.written == [b"\x01a"]


async def test_an_unfinished_handshake_ends_the_conversation_and_its_link(rig: Rig) -> None:
    rig.conversation.attached(rig.link)
    await asyncio.sleep(4.9)
    assert not rig.conversation.ended.done()
    await asyncio.sleep(0.2)
    assert rig.conversation.ended.done()
    assert rig.link.closed
    assert rig.session.reason == "no handshake within 5 s"
    assert rig.happened == [State.HANDSHAKING, State.CLOSED]


async def test_a_lost_link_ends_the_conversation(up: Rig) -> None:
    up.conversation.lost("closed by peer")
    assert up.conversation.ended.done()
    assert up.session.reason == "closed by peer"
    assert up.happened == [State.CLOSED]
    up.conversation.pump()
    up.conversation.received(b"\x01a")
    assert up.happened == [State.CLOSED]
    assert up.link.written == []


async def test_closing_writes_what_waits_and_then_closes_the_link(up: Rig) -> None:
    up.session.send(b"a")
    up.session.send(b"b")
    up.conversation.close("enough")
    assert not up.link.closed
    await asyncio.wait_for(up.conversation.ended, 1.0)
    assert up.link.written == [b"\x01a", b"\x01b"]
    assert up.link.closed
    assert up.happened == [State.CLOSING, State.CLOSED]
    assert up.session.reason == "enough"


async def test_closing_does_not_wait_long_for_a_link_that_takes_nothing(up: Rig) -> None:
    up.link.ready = False
    up.session.send(b"a")
    up.conversation.close("enough")
    start = up.loop.time()
    await up.conversation.ended
    assert up.loop.time() - start == pytest.approx(LINGER_S)
    assert up.link.closed


async def test_a_broken_stream_ends_conversation_and_link_after_the_messages_before_it(up: Rig) -> None:
    up.conversation.received(b"\x01a\xff")
    assert up.happened == [[b"a"], State.CLOSED]
    assert up.conversation.ended.done()
    assert up.link.closed


async def test_messages_before_the_peers_farewell_are_delivered_before_the_end_is_told(up: Rig) -> None:
    up.conversation.received(b"\x01a\x03bye\x01b")
    await up.conversation.ended
    assert up.happened[0] == [b"a"]
    assert up.happened[-1] is State.CLOSED
    assert [b"b"] not in up.happened
    assert up.link.written == [b"\x07bye too"]


async def test_malformed_messages_are_counted() -> None:
    count = Count()
    session = Toy(LIMITS, name="robot")
    conversation = Conversation(session, asyncio.get_running_loop(), deliver=lambda _: None, malformed=count)
    conversation.attached(FakeLink("tcp://toy.test:1"))
    conversation.received(WELCOME + b"\x01?\x01a\x01?")
    conversation.received(b"\x01?")
    conversation.received(b"\x01a")
    assert count.value == 3


class Wary(Toy):
    """A session that looks at its datagrams."""

    def claims(self, datagram: bytes, port: int) -> bool:
        return datagram == b"mine" and port == 11000

    def rivalled(self, now: float) -> None:
        self.close("rivalled", now)

    def stray(self, datagram: bytes) -> None:
        if datagram == b"in its name":
            raise NotReady("not taken")


async def test_what_becomes_of_datagrams_that_are_nobodys_is_the_sessions_to_say() -> None:
    rivals, refused = Count(), []
    loop = asyncio.get_running_loop()
    session = Wary(LIMITS, name="robot")
    conversation = Conversation(session, loop, deliver=lambda _: None, rivals=rivals, refused=refused.append)
    conversation.attached(FakeLink("tcp://toy.test:1"))
    assert conversation.claims(b"mine", 11000)
    assert not conversation.claims(b"mine", 11001)
    conversation.stray_datagram(b"somebody's")
    assert refused == []
    conversation.stray_datagram(b"in its name")
    assert [str(refusal) for refusal in refused] == ["not taken"]
    conversation.rivalled()
    assert rivals.value == 1
    await conversation.ended
    assert session.reason == "rivalled"


async def test_a_session_that_drops_its_source_has_its_link_forget_it(up: Rig) -> None:
    up.conversation.pump()
    assert up.link.sources_dropped == 0
    up.session.drops_source = True
    up.conversation.pump()
    up.conversation.pump()
    assert up.link.sources_dropped == 1


async def test_abandoning_ends_everything_at_once_and_twice_does_no_harm(up: Rig) -> None:
    up.session.send(b"a")
    up.conversation.abandon()
    up.conversation.abandon()
    assert up.conversation.ended.done()
    assert up.link.closed
    assert up.link.written == []
    assert up.session.state is State.CLOSED


async def test_a_conversation_that_never_had_a_link_can_be_abandoned(rig: Rig) -> None:
    rig.conversation.abandon()
    assert rig.conversation.ended.done()


async def test_an_ended_conversation_leaves_no_timer_behind(rig: Rig) -> None:
    rig.conversation.attached(rig.link)
    rig.conversation.lost("closed by peer")
    happened = list(rig.happened)
    await asyncio.sleep(100)
    assert rig.happened == happened


async def test_pause_and_resume_are_passed_to_the_link_while_there_is_one(up: Rig) -> None:
    up.conversation.pause()
    assert up.link.paused
    up.conversation.resume()
    assert not up.link.paused
    up.conversation.lost("closed by peer")
    up.conversation.pause()
    assert not up.link.paused


async def test_malformed_messages_are_logged_ever_more_rarely(up: Rig, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        for _ in range(100):
            up.conversation.received(b"\x01?")
    assert [record.args[1] for record in caplog.records if isinstance(record.args, tuple)] == [1, 2, 4, 8, 16, 32, 64]
    assert "what is ?" in caplog.text


async def test_a_conversation_prints_its_session() -> None:
    assert repr(Rig().conversation) == "<Conversation <Toy robot connecting>>"


async def test_a_timer_that_does_not_tell_when_it_is_due_is_replaced(up: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """uvloop gives a plain handle for a timer that is due at once."""
    up.session.send(b"one")
    up.session.send(b"two")
    monkeypatch.setattr(up.loop, "call_at", lambda when, callback: asyncio.Handle(callback, (), up.loop))
    up.conversation.pump()
    up.session.send(b"three")
    up.conversation.pump()
    assert up.session.state is State.ESTABLISHED


# Faults of the protocol's own code


def raises(*arguments: object) -> None:
    raise KeyError(1)


FAULT = r"a fault of the protocol: KeyError: 1 \(test_conversation.py:\d+\)"


@pytest.mark.parametrize("method", ["opened", "accept", "decode", "on_timer", "timers", "_deliver"])
async def test_a_fault_of_the_protocol_ends_the_session_and_its_link_with_the_place(
    method: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    rig = Rig()
    owner: object = rig.conversation if method.startswith("_") else rig.session
    monkeypatch.setattr(owner, method, raises)
    if method == "on_timer":
        monkeypatch.setattr(rig.session, "timers", lambda: 1.0)
    rig.conversation.attached(rig.link)
    await asyncio.sleep(1.1)
    rig.conversation.received(WELCOME + b"\x01a")
    assert rig.conversation.ended.done()
    assert rig.link.closed
    assert re.fullmatch(FAULT, rig.session.reason or "")
    (record,) = caplog.records
    assert record.exc_info is not None
    assert re.search(FAULT, record.getMessage())
