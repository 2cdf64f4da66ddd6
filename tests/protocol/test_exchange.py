"""Request and answer: one at a time on the wire, time limits, polls, the stop first, silence."""

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import ProtocolError
from zbridge.protocol.exchange import LATE_S, SILENT, ExchangeSession
from zbridge.protocol.session import Limits, Role, State


class Line(msgspec.Struct, frozen=True):
    text: str


def line_end(data: bytes, start: int) -> int:
    end = data.find(b"\n", start)
    return len(data) + 1 if end < 0 else end + 1


class Asker(ExchangeSession[Line]):
    """Lines; an answer begins with the request's letter in lower case. ``!`` comes unasked, ``X`` has no answer."""

    role = Role.HQ
    frame_end = staticmethod(line_end)
    lost_after = 4

    def __init__(self, gap_s: float = 0.0) -> None:
        super().__init__(Limits(frame_bytes=100, handshake_s=5.0, gap_s=gap_s))
        self.failures: list[bytes] = []

    def encode(self, message: Line) -> bytes:
        return message.text.encode() + b"\n"

    def read(self, frame: bytes) -> Line:
        if not frame[:-1].isascii():
            raise ProtocolError(f"{frame!r}")
        return Line(frame[:-1].decode())

    def answers(self, request: bytes, message: Line) -> bool:
        return message.text[:1].encode() == request[:1].lower()

    def expects(self, request: bytes) -> bool:
        return not request.startswith(b"X")

    def unasked(self, message: Line) -> bool:
        return message.text.startswith("!")

    def unanswered(self, request: bytes, now: float) -> None:
        self.failures.append(request)

    def ask(self, letter: str, *then: str, now: float = 1.0) -> None:
        """Send and write one request; others wait."""
        for each in (letter, *then):
            self.send(Line(each))
        assert self.outgoing(now) == letter.encode() + b"\n"

    def opened(self, now: float) -> None:
        self.poll("version", Line("B"), now, 1.0)

    def accept(self, message: Line, now: float) -> bool:
        if message.text.startswith("b"):
            self.unpoll("version")
            self.establish(message.text[2:], ())
        return False


@pytest.fixture
def asker() -> Asker:
    """An established session with nothing to write."""
    session = Asker()
    session.open(0.0)
    assert session.outgoing(0.0) == b"B\n"
    session.receive(b"b,7\n", 0.0)
    assert (session.state, session.version) == (State.ESTABLISHED, "7")
    return session


def run(session: Asker, start: float, end: float, answered: bool = False) -> list[tuple[float, bytes]]:
    """Take what is written from ``start`` to ``end``; ``answered``: each request is, at once."""
    written, now = [], start
    while now <= end:
        session.expire(now)
        frame = session.outgoing(now)
        if frame is not None:
            written.append((round(now, 6), frame))
            if answered:
                session.receive(frame[:1].lower() + b"\n", now)
            continue
        deadline = session.deadline()
        if deadline is None:
            break
        assert deadline > now or session.over, "a deadline that has passed must have had an effect"
        now = deadline
    return written


def test_the_next_request_waits_for_the_whole_answer_to_the_one_before_if_there_is_to_be_one(asker: Asker) -> None:
    asker.ask("X", "H", "N")
    assert asker.outgoing(1.0) == b"H\n"
    assert asker.receive(b"h,1", 1.0) == []
    assert asker.outgoing(1.0) is None
    assert asker.receive(b",2\n", 1.01) == [Line("h,1,2")]
    assert asker.exchange.answer_at == math.inf
    assert asker.outgoing(1.01) == b"N\n"


def test_an_answer_to_nothing_is_malformed_and_what_comes_unasked_is_handed_on_and_completes_nothing(asker) -> None:
    assert asker.receive(b"h,1,2\n", 1.0) == []
    asker.ask("H")
    assert asker.receive(b"n,1\n!bump\n", 1.0) == [Line("!bump")]
    assert (asker.traffic.malformed, asker.exchange.awaited) == (2, b"H\n")
    assert "answers no request" in str(asker.last_malformed)
    assert asker.receive(b"h,1,2\n", 1.0) == [Line("h,1,2")]


def test_a_request_without_a_whole_answer_fails_and_half_an_answer_does_not_spoil_the_next(asker: Asker) -> None:
    asker.ask("H", "N")
    assert asker.deadline() == asker.deadline(writing=False) == pytest.approx(1.2)
    asker.receive(b"h,1", 1.1)
    asker.expire(1.1999)
    assert asker.outgoing(1.1999) is None
    asker.expire(1.2)
    assert (asker.failures, asker.traffic.unanswered, asker.exchange.failed) == ([b"H\n"], 1, 1)
    assert asker.outgoing(1.2) == b"N\n"
    asker.outbox.written(1.5)
    assert asker.deadline() == pytest.approx(1.7), "its time begins when it was written"
    assert asker.receive(b"n,5\n", 1.6) == [Line("n,5")]


def test_an_answer_that_waited_while_the_process_stood_still_is_in_time(asker: Asker) -> None:
    asker.ask("H")
    asker.expire(9.0)
    assert asker.deadline() == pytest.approx(9.0 + LATE_S)
    assert asker.receive(b"h,1\n", 9.0) == [Line("h,1")]
    asker.ask("H", now=9.1)
    asker.expire(12.0)
    asker.expire(13.0)
    assert asker.failures == [b"H\n"], "it is given more time once"


def test_silence_takes_the_robot_from_its_drivers_an_answer_gives_it_back_and_long_silence_ends_it(asker) -> None:
    asker.poll("position", Line("H"), 1.0, 0.05)
    run(asker, 1.0, 1.19)
    assert asker.busy is None
    run(asker, 1.2, 1.5)
    assert (asker.busy, asker.state) == (SILENT, State.ESTABLISHED)
    asker.receive(b"h,1\n", 1.5)
    assert (asker.busy, asker.exchange.failed_in_a_row) == (None, 0)
    unanswered = asker.traffic.unanswered
    run(asker, 1.5, 9.0)
    assert (asker.state, asker.reason) == (State.CLOSED, "no answer to 4 requests in a row")
    assert asker.traffic.unanswered == unanswered + 4
    assert asker.deadline() is None


def test_a_stop_waits_for_one_answer_at_most(asker: Asker) -> None:
    asker.ask("H", "N")
    asker.outbox.set("drive", (b"D,9,9\n",), 1.0)
    asker.outbox.set("drive", (b"D,0,0\n",), 1.05, until=1.05, urgent=True)
    assert asker.outgoing(1.05) is None
    assert run(asker, 1.2, 3.0, answered=True) == [(1.2, b"D,0,0\n"), (1.2, b"N\n")]


def test_polls_come_in_their_periods_and_missed_ones_are_not_made_up(asker: Asker) -> None:
    asker.poll("position", Line("H"), 1.0, 0.05)
    for start, end, times in ((1.0, 1.16, [1.0, 1.05, 1.1, 1.15]), (2.0, 2.07, [2.0, 2.05])):
        assert run(asker, start, end, answered=True) == [(when, b"H\n") for when in times]


def test_the_gap_is_kept_between_requests() -> None:
    session = Asker(gap_s=0.1)
    session.open(0.0)
    assert session.outgoing(0.0) == b"B\n"
    session.send(Line("X"))
    session.receive(b"b,7\n", 0.02)
    assert run(session, 0.02, 1.0) == [(0.1, b"X\n")]


def test_last_words_are_written_without_waiting_for_answers(asker: Asker) -> None:
    asker.ask("H", "N")
    asker.outbox.set("drive", (b"D,0,0\n",), 1.0, until=1.0, urgent=True)
    asker.close("gateway stopped", 1.0)
    assert [asker.outgoing(1.0), asker.outgoing(1.0), asker.outgoing(1.0)] == [b"D,0,0\n", b"N\n", None]
    assert asker.state is State.CLOSED


STEPS = st.one_of(
    st.tuples(st.sampled_from(["send", "drive", "stop", "poll", "answer", "wrong"]), st.integers(0, 9)),
    st.tuples(st.just("wait"), st.integers(0, 300)),
)


@given(st.lists(STEPS, max_size=40))
def test_at_no_time_are_two_requests_on_the_wire_and_a_stop_is_next(steps: list[tuple[str, int]]) -> None:
    session, now, on_wire, stops = Asker(), 0.0, b"", False
    session.lost_after = 10**6
    session.open(0.0)
    for what, value in steps:
        if what == "send":
            session.send(Line(f"L,{value}"))
        elif what == "drive":
            session.outbox.set("drive", (b"D,%d\n" % (value + 1),), now)
        elif what == "stop":
            session.outbox.set("drive", (b"D,0,0\n",), now, until=now, urgent=True)
        elif what == "poll":
            session.poll(f"poll {value % 3}", Line("H"), now, 0.05)
        elif what in ("answer", "wrong"):
            session.receive(on_wire[:1].lower() + b",1\n" if what == "answer" else b"z\n", now)
        else:
            now += value / 1000
        stops = stops or what == "stop"
        if session.exchange.answer_at <= now or what == "answer":
            on_wire = b""
        session.expire(now)
        if session.over:
            return
        frame = session.outgoing(now)
        if frame is not None:
            assert on_wire == b""
            assert not stops or frame == b"D,0,0\n"
            on_wire, stops = frame, False
