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


def established() -> Rig:
    rig = Rig()
    rig.conversation.attached(rig.link)
    rig.conversation.received(WELCOME)
    rig.link.written.clear()
    rig.happened.clear()
    return rig


async def test_a_link_that_is_up_opens_the_session_and_writes_its_first_frame() -> None:
    rig = Rig()
    rig.conversation.attached(rig.link)
    assert rig.session.peer == "tcp://toy.test:1"
    assert rig.link.written == [b"\x05hello"]
    assert rig.happened == [State.HANDSHAKING]


async def test_a_change_of_state_is_told_before_the_messages_of_the_same_read() -> None:
    rig = Rig()
    rig.conversation.attached(rig.link)
    rig.conversation.received(WELCOME + b"\x01a\x01b")
    assert rig.happened == [State.HANDSHAKING, State.ESTABLISHED, [b"a", b"b"]]


async def test_a_doubt_is_told_when_it_comes_and_when_it_goes() -> None:
    rig = established()
    for doubts in (("client id 3",), ("client id 3",), ()):
        rig.session.doubts = doubts
        rig.conversation.pump()
    assert rig.happened == [State.ESTABLISHED, State.ESTABLISHED]


async def test_what_becomes_due_while_the_process_is_frozen_waits_for_the_next_look() -> None:
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


async def test_a_read_without_a_whole_message_delivers_nothing() -> None:
    rig = established()
    rig.conversation.received(b"\x05ab")
    assert rig.happened == []
    rig.conversation.received(b"cde")
    assert rig.happened == [[b"abcde"]]


async def test_frames_are_written_one_at_a_time_with_the_gap_between_them() -> None:
    rig = established()
    await asyncio.sleep(1)
    for message in (b"a", b"b", b"c"):
        rig.session.send(message)
    rig.conversation.pump()
    assert rig.link.written == [b"\x01a"]
    await asyncio.sleep(0.0101)
    assert rig.link.written == [b"\x01a", b"\x01b"]
    await asyncio.sleep(0.0101)
    assert rig.link.written == [b"\x01a", b"\x01b", b"\x01c"]


async def test_nothing_is_written_to_a_link_that_is_not_ready_until_it_is() -> None:
    rig = established()
    await asyncio.sleep(1)
    rig.link.ready = False
    rig.session.send(b"a")
    rig.conversation.pump()
    await asyncio.sleep(10)
    assert rig.link.written == []
    rig.link.ready = True
    rig.conversation.writable()
    assert rig.link.written == [b"\x01a"]


async def test_an_unfinished_handshake_ends_the_conversation_and_its_link() -> None:
    rig = Rig()
    rig.conversation.attached(rig.link)
    await asyncio.sleep(4.9)
    assert not rig.conversation.ended.done()
    await asyncio.sleep(0.2)
    assert rig.conversation.ended.done()
    assert rig.link.closed
    assert rig.session.reason == "no handshake within 5 s"
    assert rig.happened == [State.HANDSHAKING, State.CLOSED]


async def test_a_lost_link_ends_the_conversation() -> None:
    rig = established()
    rig.conversation.lost("closed by peer")
    assert rig.conversation.ended.done()
    assert rig.session.reason == "closed by peer"
    assert rig.happened == [State.CLOSED]
    rig.conversation.pump()
    rig.conversation.received(b"\x01a")
    assert rig.happened == [State.CLOSED]
    assert rig.link.written == []


async def test_closing_writes_what_waits_and_then_closes_the_link() -> None:
    rig = established()
    rig.session.send(b"a")
    rig.session.send(b"b")
    rig.conversation.close("enough")
    assert not rig.link.closed
    await asyncio.wait_for(rig.conversation.ended, 1.0)
    assert rig.link.written == [b"\x01a", b"\x01b"]
    assert rig.link.closed
    assert rig.happened == [State.CLOSING, State.CLOSED]
    assert rig.session.reason == "enough"


async def test_closing_does_not_wait_long_for_a_link_that_takes_nothing() -> None:
    rig = established()
    rig.link.ready = False
    rig.session.send(b"a")
    rig.conversation.close("enough")
    start = rig.loop.time()
    await rig.conversation.ended
    assert rig.loop.time() - start == pytest.approx(LINGER_S)
    assert rig.link.closed


async def test_a_broken_stream_ends_conversation_and_link_after_the_messages_before_it() -> None:
    rig = established()
    rig.conversation.received(b"\x01a\xff")
    assert rig.happened == [[b"a"], State.CLOSED]
    assert rig.conversation.ended.done()
    assert rig.link.closed


async def test_messages_before_the_peers_farewell_are_delivered_before_the_end_is_told() -> None:
    rig = established()
    rig.conversation.received(b"\x01a\x03bye\x01b")
    await rig.conversation.ended
    assert rig.happened[0] == [b"a"]
    assert rig.happened[-1] is State.CLOSED
    assert [b"b"] not in rig.happened
    assert rig.link.written == [b"\x07bye too"]


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


async def test_a_session_that_drops_its_source_has_its_link_forget_it() -> None:
    rig = established()
    rig.conversation.pump()
    assert rig.link.sources_dropped == 0
    rig.session.drops_source = True
    rig.conversation.pump()
    rig.conversation.pump()
    assert rig.link.sources_dropped == 1


async def test_abandoning_ends_everything_at_once_and_twice_does_no_harm() -> None:
    rig = established()
    rig.session.send(b"a")
    rig.conversation.abandon()
    rig.conversation.abandon()
    assert rig.conversation.ended.done()
    assert rig.link.closed
    assert rig.link.written == []
    assert rig.session.state is State.CLOSED


async def test_a_conversation_that_never_had_a_link_can_be_abandoned() -> None:
    rig = Rig()
    rig.conversation.abandon()
    assert rig.conversation.ended.done()


async def test_an_ended_conversation_leaves_no_timer_behind() -> None:
    rig = Rig()
    rig.conversation.attached(rig.link)
    rig.conversation.lost("closed by peer")
    happened = list(rig.happened)
    await asyncio.sleep(100)
    assert rig.happened == happened


async def test_pause_and_resume_are_passed_to_the_link_while_there_is_one() -> None:
    rig = established()
    rig.conversation.pause()
    assert rig.link.paused
    rig.conversation.resume()
    assert not rig.link.paused
    rig.conversation.lost("closed by peer")
    rig.conversation.pause()
    assert not rig.link.paused


async def test_malformed_messages_are_logged_ever_more_rarely(caplog: pytest.LogCaptureFixture) -> None:
    rig = established()
    with caplog.at_level(logging.WARNING):
        for _ in range(100):
            rig.conversation.received(b"\x01?")
    assert [record.args[1] for record in caplog.records if isinstance(record.args, tuple)] == [1, 2, 4, 8, 16, 32, 64]
    assert "what is ?" in caplog.text


async def test_a_conversation_prints_its_session() -> None:
    assert repr(Rig().conversation) == "<Conversation <Toy robot connecting>>"


async def test_a_timer_that_does_not_tell_when_it_is_due_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    """uvloop gives a plain handle for a timer that is due at once."""
    rig = established()
    rig.session.send(b"one")
    rig.session.send(b"two")
    monkeypatch.setattr(rig.loop, "call_at", lambda when, callback: asyncio.Handle(callback, (), rig.loop))
    rig.conversation.pump()
    rig.session.send(b"three")
    rig.conversation.pump()
    assert rig.session.state is State.ESTABLISHED


# Faults of the protocol's own code


def raises(*arguments: object) -> None:
    raise KeyError(1)


FAULT = r"a fault of the protocol: KeyError: 1 \(test_conversation.py:\d+\)"


@pytest.mark.parametrize("method", ["opened", "accept", "decode", "on_timer", "_deliver"])
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
