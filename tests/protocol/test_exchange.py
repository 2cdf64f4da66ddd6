"""Request and answer: one at a time on the wire, time limits, polls, the stop first, silence."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.protocol.test_session import play
from zbridge.errors import ProtocolError
from zbridge.protocol.exchange import ExchangeSession
from zbridge.protocol.session import Limits, Role
from zbridge.wire.lines import Lines


class Asker(ExchangeSession[bytes]):
    """Lines; an answer begins with the request's letter in lower case. ``!`` comes unasked, ``X`` has no answer."""

    role = Role.HQ
    frame_end = staticmethod(Lines.end)
    lost_after = 4

    def __init__(self, gap_s: float = 0.0) -> None:
        super().__init__(Limits(frame_bytes=100, handshake_s=5.0, gap_s=gap_s))
        self.failures: list[bytes] = []

    def encode(self, message: bytes) -> bytes:
        return message + b"\n"

    def read(self, frame: bytes) -> bytes:
        if not frame.isascii():
            raise ProtocolError(f"{frame!r}")
        return frame[:-1]

    def answers(self, request: bytes, message: bytes) -> bool:
        return message[:1] == request[:1].lower()

    def expects(self, request: bytes) -> bool:
        return not request.startswith(b"X")

    def unasked(self, message: bytes) -> bool:
        return message.startswith(b"!")

    def unanswered(self, request: bytes, now: float) -> None:
        self.failures.append(request[:-1])

    def opened(self, now: float) -> None:
        self.poll("version", b"B", now, 1.0)

    def accept(self, message: bytes, now: float) -> bool:
        if message.startswith(b"b"):
            self.unpoll("version")
            self.establish(message[2:].decode(), ())
        return False


def fail(*times: float) -> str:
    """Requests, each without an answer until its time."""
    return "; ".join(f"send H; out = H; at {time}; expire" for time in times)


OPEN = "open; out = B; hear b,7 =; is established; at 1; "
SCRIPTS = {
    "the next request waits for the whole answer to the one before, if there is to be one": (
        OPEN + "send X; send H; send N; out = X; out = H; half h,1 =; out = nothing; hear ,2 = h,1,2; out = N"
    ),
    "an answer to nothing is malformed, what comes unasked is handed on and completes nothing": (
        OPEN + "hear h,1 =; malformed 1; send H; out = H; hear n,1 !bump = !bump; malformed 2; out = nothing;"
        "hear h,1 = h,1; due never"
    ),
    "a request without a whole answer fails, and half an answer does not spoil the next": (
        OPEN + "send H; send N; out = H; due 1.2; limit 1.2; half h,1 =; at 1.1999; expire; out = nothing;"
        "at 1.2; expire; failed H; out = N; at 1.5; written; due 1.7; hear n,5 = n,5"
    ),
    "silence takes the robot from its drivers, an answer gives it back, and long silence ends the session": (
        OPEN + f"{fail(1.2)}; busy no; {fail(1.4)}; busy the robot does not answer; is established; send H; out = H;"
        f"hear h = h; busy no; {fail(1.6, 1.8, 2.0, 2.2)}; is closed (no answer to 4 requests in a row); due never;"
        "unanswered 6"
    ),
    "a stop waits for one answer at most, and replaces the motion": (
        OPEN + "send H; send N; drive D,9,9; out = H; at 1.05; urgent D,0,0; out = nothing; at 1.2; expire;"
        "out = D,0,0; hear d = d; out = N; hear n = n; out = nothing"
    ),
    "polls come in their periods, and missed ones are not made up": (
        OPEN + "poll H; out = H; hear h = h; due 1.05; at 1.05; out = H; hear h = h; at 2; out = H; hear h = h;"
        "out = nothing; due 2.05"
    ),
    "last words are written without waiting for answers": (
        OPEN + "send H; send N; out = H; urgent D,0,0; close gateway stopped; out = D,0,0; out = N; out = nothing;"
        "is closed (gateway stopped)"
    ),
}


@pytest.mark.parametrize("script", SCRIPTS.values(), ids=SCRIPTS)
def test_requests_and_answers_take_turns(script: str) -> None:
    session = Asker()
    play(
        session,
        script,
        half=lambda line, now: b" ".join(session.receive(line.encode(), now)).decode(),
        written=lambda _, now: session.outbox.written(now),
        drive=lambda line, now: session.outbox.set("motion", (session.encode(line.encode()),), now),
        poll=lambda line, now: session.poll("position", line.encode(), now, 0.05),
        failed=lambda _, now: b" ".join(session.failures).decode(),
        malformed=lambda _, now: str(session.traffic.malformed),
        unanswered=lambda _, now: str(session.traffic.unanswered),
        busy=lambda _, now: session.busy or "no",
    )


def test_a_gap_is_kept_between_requests() -> None:
    script = "open; out = B; send X; at 0.02; hear b,7 =; out = nothing; due 0.1; at 0.1; out = X"
    play(Asker(gap_s=0.1), script)


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
            session.send(b"L,%d" % value)
        elif what == "drive":
            session.outbox.set("drive", (b"D,%d\n" % (value + 1),), now)
        elif what == "stop":
            session.outbox.set("drive", (b"D,0,0\n",), now, until=now, urgent=True)
        elif what == "poll":
            session.poll(f"poll {value % 3}", b"H", now, 0.05)
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
