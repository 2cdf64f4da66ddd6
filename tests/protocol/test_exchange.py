"""Request and answer: one at a time on the wire, time limits, polls, the stop first, silence."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import ProtocolError, Refused
from zbridge.protocol.exchange import LATE_S, SILENT, Exchange, ExchangeSession
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


def run(session: Asker, start: float, end: float, answer: bytes | None = None) -> list[tuple[float, bytes]]:
    """Take what is written from ``start`` to ``end``; each request gets ``answer`` (its letter if empty) at once."""
    written, now = [], start
    while now <= end:
        session.expire(now)
        frame = session.outgoing(now)
        if frame is not None:
            written.append((round(now, 6), frame))
            if answer is not None:
                session.receive(answer or frame[:1].lower() + b"\n", now)
            continue
        deadline = session.deadline()
        if deadline is None:
            break
        assert deadline > now or session.over, "a deadline that has passed must have had an effect"
        now = deadline
    return written


def test_the_next_request_waits_for_the_whole_answer_to_the_one_before(asker: Asker) -> None:
    asker.ask("H", "N")
    assert asker.receive(b"h,1", 1.0) == []
    assert asker.outgoing(1.0) is None
    assert asker.receive(b",2\n", 1.01) == [Line("h,1,2")]
    assert asker.outgoing(1.01) == b"N\n"


def test_a_request_that_expects_no_answer_holds_nothing_up(asker: Asker) -> None:
    asker.ask("X", "H")
    assert asker.outgoing(1.0) == b"H\n"


def test_an_answer_to_nothing_is_malformed_and_not_handed_on(asker: Asker) -> None:
    assert asker.receive(b"h,1,2\n", 1.0) == []
    asker.ask("H")
    assert asker.receive(b"n,1\n", 1.0) == []
    assert asker.traffic.malformed == 2
    assert asker.last_malformed is not None
    assert "answers no request" in asker.last_malformed
    assert asker.receive(b"h,1,2\n", 1.0) == [Line("h,1,2")]


def test_what_may_come_unasked_is_handed_on_and_completes_nothing(asker: Asker) -> None:
    asker.ask("H")
    assert asker.receive(b"!bump\n", 1.0) == [Line("!bump")]
    assert asker.exchange.awaited == b"H\n"


def test_a_request_without_an_answer_fails_is_counted_and_the_next_one_goes(asker: Asker) -> None:
    asker.ask("H", "N")
    assert asker.deadline() == pytest.approx(1.2)
    asker.expire(1.1999)
    assert asker.outgoing(1.1999) is None
    asker.expire(1.2)
    assert (asker.failures, asker.traffic.unanswered, asker.exchange.failed) == ([b"H\n"], 1, 1)
    assert asker.outgoing(1.2) == b"N\n"


def test_an_answer_that_waited_while_the_process_stood_still_is_in_time(asker: Asker) -> None:
    asker.ask("H")
    asker.expire(9.0)
    assert asker.deadline() == pytest.approx(9.0 + LATE_S)
    assert asker.receive(b"h,1\n", 9.0) == [Line("h,1")]
    asker.ask("H", now=9.1)
    asker.expire(12.0)
    asker.expire(13.0)
    assert asker.failures == [b"H\n"]


def test_the_time_limit_begins_when_the_request_was_written_and_holds_on_a_link_that_takes_nothing(asker) -> None:
    asker.ask("H")
    assert asker.deadline(writing=False) == pytest.approx(1.2)
    asker.outbox.written(1.5)
    assert asker.deadline() == pytest.approx(1.7)


def test_half_an_answer_that_came_too_late_does_not_spoil_the_next_one(asker: Asker) -> None:
    asker.ask("H", "N")
    asker.receive(b"h,1", 1.1)
    asker.expire(1.2)
    asker.outgoing(1.2)
    assert asker.receive(b"n,5\n", 1.25) == [Line("n,5")]


def test_silence_takes_the_robot_from_its_drivers_an_answer_gives_it_back_and_long_silence_ends_it(asker) -> None:
    asker.poll("position", Line("H"), 1.0, 0.05)
    run(asker, 1.0, 1.19)
    assert asker.busy is None
    run(asker, 1.2, 1.5)
    assert (asker.busy, asker.state) == (SILENT, State.ESTABLISHED)
    asker.receive(b"h,1\n", 1.5)
    assert asker.busy is None
    assert asker.exchange.failed_in_a_row == 0
    unanswered = asker.traffic.unanswered
    run(asker, 1.5, 9.0)
    assert (asker.state, asker.reason) == (State.CLOSED, "no answer to 4 requests in a row")
    assert asker.traffic.unanswered == unanswered + 4
    assert asker.deadline() is None


def test_a_robot_that_never_answers_is_asked_again_until_the_handshake_is_over() -> None:
    session = Asker()
    session.open(0.0)
    assert [when for when, _ in run(session, 0.0, 9.0)] == [0.0, 1.0, 2.0, 3.0]
    assert session.state is State.CLOSED


def test_a_stop_goes_before_all_that_waits_and_replaces_the_motion(asker: Asker) -> None:
    for number in range(60):
        asker.send(Line(f"L,{number}"))
    asker.poll("position", Line("H"), 1.0, 0.05)
    asker.outbox.set("drive", (b"D,9,9\n",), 1.0)
    asker.outbox.set("drive", (b"D,0,0\n",), 1.0, until=1.0, urgent=True)
    taken = [frame for _, frame in run(asker, 1.0, 3.0, b"")]
    assert taken[0] == b"D,0,0\n"
    assert b"D,9,9\n" not in taken
    assert taken.count(b"D,0,0\n") == 1


def test_a_stop_waits_for_one_answer_at_most(asker: Asker) -> None:
    asker.ask("H", "N")
    asker.outbox.set("drive", (b"D,0,0\n",), 1.05, until=1.05, urgent=True)
    assert asker.outgoing(1.05) is None
    asker.expire(1.2)
    assert asker.outgoing(1.2) == b"D,0,0\n"


def test_only_the_newest_motion_is_sent(asker: Asker) -> None:
    asker.ask("H")
    for speed in range(5):
        asker.outbox.set("drive", (b"D,%d\n" % speed,), 1.0)
    asker.receive(b"h\n", 1.1)
    assert run(asker, 1.1, 2.0, b"") == [(1.1, b"D,4\n")]


def test_polls_come_in_their_periods_and_missed_ones_are_not_made_up(asker: Asker) -> None:
    asker.poll("position", Line("H"), 1.0, 0.05)
    assert run(asker, 1.0, 1.21, b"") == [(1.0, b"H\n"), (1.05, b"H\n"), (1.1, b"H\n"), (1.15, b"H\n"), (1.2, b"H\n")]
    assert run(asker, 2.0, 2.07, b"") == [(2.0, b"H\n"), (2.05, b"H\n")]


def test_polls_and_requests_share_the_wire(asker: Asker) -> None:
    for name in "HNE":
        asker.poll(name, Line(name), 1.0, 0.0)  # always due
    for _ in range(3):
        asker.send(Line("L"))
    taken: list[bytes] = []
    for step in range(12):
        now = 1.0 + step / 100
        taken += filter(None, [asker.outgoing(now)])
        asker.receive(taken[-1][:1].lower() + b"\n", now)
    assert {line: taken.count(line) for line in taken} == {b"H\n": 3, b"N\n": 3, b"E\n": 3, b"L\n": 3}


def test_one_request_too_many_is_refused_and_a_stop_never() -> None:
    exchange = Exchange(0.2, limit=2)
    exchange.put(b"a")
    exchange.put(b"b")
    with pytest.raises(Refused, match="2 packets"):
        exchange.put(b"c")
    exchange.set("drive", (b"stop",), 0.0, until=0.0, urgent=True)
    assert exchange.take(0.0) == b"stop"


def test_the_gap_is_kept_between_requests() -> None:
    session = Asker(gap_s=0.1)
    session.open(0.0)
    assert session.outgoing(0.0) == b"B\n"
    session.send(Line("X"))
    session.receive(b"b,7\n", 0.02)
    assert session.outgoing(0.02) is None
    assert session.deadline() == pytest.approx(0.1)
    assert session.outgoing(0.1) == b"X\n"


def test_last_words_are_written_without_waiting_for_answers(asker: Asker) -> None:
    asker.ask("H")
    asker.send(Line("N"))
    asker.outbox.set("drive", (b"D,0,0\n",), 1.0, until=1.0, urgent=True)
    asker.close("gateway stopped", 1.0)
    assert [asker.outgoing(1.0), asker.outgoing(1.0), asker.outgoing(1.0)] == [b"D,0,0\n", b"N\n", None]
    assert asker.state is State.CLOSED


def test_an_exchange_tells_what_it_awaits(asker: Asker) -> None:
    asker.ask("H")
    assert repr(asker.exchange) == "<Exchange awaits b'H\\n', 0 failed in a row, <Outbox 0 waiting, slots []>>"
    assert (asker.exchange.deadline(), asker.exchange.answer_at) == (None, pytest.approx(1.2))
    asker.receive(b"h\n", 1.0)
    assert asker.exchange.answer_at == math.inf


Step = st.one_of(
    st.tuples(st.sampled_from(["send", "drive", "stop", "poll", "answer", "wrong"]), st.integers(0, 9)),
    st.tuples(st.just("wait"), st.integers(0, 300)),
)


@given(st.lists(Step, max_size=40))
def test_at_no_time_are_two_requests_on_the_wire_and_a_stop_is_next(steps: list[tuple[str, int]]) -> None:
    session = Asker()
    session.lost_after = 10**6
    session.open(0.0)
    now, on_wire, stops = 0.0, None, 0
    for what, value in steps:
        if what == "send":
            session.send(Line(f"L,{value}"))
        elif what == "drive":
            session.outbox.set("drive", (b"D,%d\n" % (value + 1),), now)
        elif what == "stop":
            stops = 1
            session.outbox.set("drive", (b"D,0,0\n",), now, until=now, urgent=True)
        elif what == "poll":
            session.poll(f"poll {value % 3}", Line("H"), now, 0.05)
        elif what == "answer" and on_wire is not None:
            session.receive(on_wire[:1].lower() + b",1\n", now)
            on_wire = None
        elif what == "wrong":
            session.receive(b"z\n", now)
        else:
            now += value / 1000
        if session.exchange.answer_at <= now:
            on_wire = None
        session.expire(now)
        if session.over:
            return
        frame = session.outgoing(now)
        if frame is not None:
            assert on_wire is None
            on_wire = frame
            assert not stops or frame == b"D,0,0\n"
            stops = 0
