"""The session that all protocols share, shown with the smallest protocol there is.

A frame is a length byte and so many bytes; ``welcome`` ends the handshake, ``bye`` the conversation.
"""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import ProtocolError
from zbridge.protocol.session import LINGER_S, Limits, Role, Session, State

LIMITS = Limits(frame_bytes=100, handshake_s=5.0, gap_s=0.01)


def frame_end(data: bytes, start: int) -> int:
    if data[start] == 255:
        raise ProtocolError("length 255")
    return start + 1 + data[start]


class Toy(Session[bytes]):
    role = Role.HQ
    handled = frozenset({bytes})
    frame_end = staticmethod(frame_end)

    def encode(self, message: bytes) -> bytes:
        return bytes([len(message)]) + message

    def decode(self, frame: bytes) -> bytes:
        if frame[1:] == b"?":
            raise ProtocolError("what is ?")
        return frame[1:]

    def opened(self, now: float) -> None:
        self.send(b"hello")

    def accept(self, message: bytes, now: float) -> bool:
        if message == b"welcome":
            self.establish("2.0", ("wings",))
        elif message == b"bye":
            self.send(b"bye too")
            self.close("the peer said bye", now)
        elif message == b"not yet":
            raise ProtocolError("too early")
        else:
            return True
        return False


WELCOME = b"\x07welcome"


@pytest.fixture
def session() -> Toy:
    return Toy(LIMITS, name="robot", peer="tcp://toy.test:1")


@pytest.fixture
def established(session: Toy) -> Toy:
    session.open(0.0)
    assert session.outgoing(0.0) == b"\x05hello"
    assert session.receive(WELCOME, 0.1) == []
    return session


@pytest.mark.parametrize("lifted", [False, True])
def test_the_handshake_begins_when_the_link_is_up_and_fails_at_its_limit_unless_that_is_lifted(session, lifted) -> None:
    assert (session.deadline(), session.outgoing(0.0)) == (None, None)
    session.open(10.0)
    assert (session.state, session.outgoing(10.0)) == (State.HANDSHAKING, b"\x05hello")
    session.send(b"more")
    assert (session.deadline(), session.deadline(writing=False)) == (10.01, 15.0)
    session.expire(math.nextafter(15.0, 0))
    assert session.state is State.HANDSHAKING
    if lifted:
        session.lift_limit()
    session.expire(15.0)
    ended = (State.HANDSHAKING, None) if lifted else (State.CLOSED, "no handshake within 5 s")
    assert (session.state, session.reason) == ended
    assert session.deadline(writing=False) is None


def test_the_handshake_ends_with_version_and_features_and_then_there_is_no_limit(established: Toy) -> None:
    assert (established.version, established.features) == ("2.0", ("wings",))
    assert established.deadline() is None
    established.open(1.0)
    established.expire(1e6)
    assert (established.state, established.outgoing(1e6)) == (State.ESTABLISHED, None), "it is opened once"


def test_a_session_that_was_ended_before_its_link_was_up_stays_ended(session: Toy) -> None:
    session.close("gateway stopped", 0.0)
    session.open(0.1)
    assert session.over
    assert session.outgoing(0.1) is None, "not even the first step of the handshake"
    session.establish("9.9", ("wings",))
    assert (session.state, session.reason, session.version) == (State.CLOSED, "gateway stopped", None)


# What is received


def test_messages_may_follow_the_handshake_at_once_and_one_that_is_not_accepted_is_counted_and_skipped(session) -> None:
    session.open(0.0)
    assert session.receive(WELCOME + b"\x01a\x01?\x01b", 1.0) == [b"a", b"b"]
    assert (session.state, session.last_malformed) == (State.ESTABLISHED, "what is ?")
    assert session.receive(b"\x07not yet\x01c", 1.0) == [b"c"]
    assert session.last_malformed == "too early"
    traffic = session.traffic
    assert (traffic.malformed, traffic.frames_in, traffic.bytes_in) == (2, 6, len(WELCOME) + 16)


@pytest.mark.parametrize(
    ("broken", "reason"),
    [(b"\xff\x01b", "broken stream: length 255"), (b"\x64", "broken stream: frame of 101 bytes exceeds 100")],
)
def test_a_broken_stream_ends_the_session_after_the_messages_before_it(established: Toy, broken, reason) -> None:
    assert established.receive(b"\x01a" + broken, 1.0) == [b"a"]
    assert (established.state, established.reason, established.traffic.malformed) == (State.CLOSED, reason, 1)


@given(st.lists(st.binary(max_size=60), max_size=8))
def test_random_bytes_never_raise_and_the_state_only_moves_down(reads: list[bytes]) -> None:
    session, states = Toy(LIMITS), []
    session.open(0.0)
    for step, data in enumerate(reads):
        assert all(isinstance(message, bytes) for message in session.receive(data, step * 0.1))
        session.outgoing(step * 0.1)
        states.append(session.state)
    assert states == sorted(states, key=list(State).index)


# The end


def test_a_closing_session_writes_what_waits_ignores_what_comes_and_then_is_closed(established: Toy) -> None:
    assert established.receive(b"\x01a\x03bye\x01b", 1.0) == [b"a"]
    assert established.over
    received = established.traffic.bytes_in
    assert established.receive(b"\x01a", 1.0) == []
    assert established.traffic.bytes_in == received
    assert established.outgoing(1.0) == b"\x07bye too"
    assert established.outgoing(1.02) is None
    assert (established.state, established.reason) == (State.CLOSED, "the peer said bye")


def test_a_closing_session_waits_for_the_gap_before_its_last_frames(established: Toy) -> None:
    established.send(b"one")
    assert established.outgoing(1.0) == b"\x03one"
    established.send(b"two")
    established.outbox.set("motion", (b"\x04stop",), 1.001, urgent=True)
    established.close("enough", 1.001)
    assert established.outgoing(1.001) is None
    assert (established.state, established.deadline()) == (State.CLOSING, pytest.approx(1.01))
    assert [established.outgoing(now) for now in (1.01, 1.02, 1.03)] == [b"\x04stop", b"\x03two", None]
    assert established.state is State.CLOSED


def test_a_closing_session_does_not_wait_for_a_peer_that_takes_nothing(established: Toy) -> None:
    established.send(b"one")
    established.close("enough", 1.0)
    assert established.deadline(writing=False) == 1.0 + LINGER_S
    for now, state in ((1.0 + LINGER_S - 0.01, State.CLOSING), (1.0 + LINGER_S, State.CLOSED)):
        established.expire(now)
        assert established.state is state


def test_the_first_reason_for_an_end_stands_and_a_closed_session_writes_nothing(established: Toy) -> None:
    established.send(b"one")
    established.close("enough", 1.0)
    established.close("again", 1.1)
    established.lost("closed by peer")
    established.fail("whatever")
    assert (established.state, established.reason) == (State.CLOSED, "enough")
    assert (established.deadline(), established.outgoing(2.0)) == (None, None)


# What is shown


def test_a_tap_is_shown_every_frame_of_both_directions_malformed_ones_too(established: Toy) -> None:
    shown: list[tuple[str, bytes]] = []
    established.tap = lambda direction, frame: shown.append((direction, frame))
    established.receive(b"\x01a\x01?\x01", 1.0)
    established.send(b"b")
    established.outgoing(1.0)
    established.tap = None
    established.receive(b"c", 1.0)
    assert shown == [("in", b"\x01a"), ("in", b"\x01?"), ("out", b"\x01b")]


def test_the_snapshot_does_not_change_with_the_session(established: Toy) -> None:
    established.send(b"abc")
    established.outgoing(1.0)
    established.left_out["wings (7)"] += 2
    shown = established.snapshot()
    established.receive(b"\x01a", 1.0)
    established.left_out["wings (7)"] += 1
    established.lost("closed by peer")
    assert (shown.name, shown.peer, shown.role, shown.transport) == ("robot", "tcp://toy.test:1", "hq", "tcp")
    assert (shown.state, shown.version, shown.features, shown.reason) == ("established", "2.0", ("wings",), None)
    counted = {"frames_in": 1, "frames_out": 2, "bytes_in": 8, "bytes_out": 10}
    not_counted = ("malformed", "foreign", "dropped", "refused", "unanswered")
    assert shown.counters == counted | dict.fromkeys(not_counted, 0)
    assert shown.left_out == {"wings (7)": 2}


@pytest.mark.parametrize("end", [lambda toy: toy.close("enough", 1.0), lambda toy: toy.lost("enough")])
def test_a_session_says_why_its_peer_must_not_be_moved_two_doubts_and_not_one_and_why_it_ended(session, end) -> None:
    session.open(0.0)
    session.establish("", ())
    session.busy = "handshaking"
    assert (session.snapshot().reason, session.snapshot().version) == ("handshaking", None)
    session.doubts = ("client id 3",)
    assert session.doubtful is None
    session.doubts = ("client id 3", "malformed packets")
    assert session.doubtful == "connection in doubt: client id 3; malformed packets"
    end(session)
    assert (session.doubts, session.doubtful, session.snapshot().reason) == ((), None, "enough")


# The peer's rate


def limited(rate_hz: float) -> Toy:
    session = Toy(Limits(frame_bytes=100, handshake_s=5.0, rate_hz=rate_hz))
    session.open(100.0)
    session.receive(WELCOME, 100.0)
    return session


@pytest.mark.parametrize(
    ("reads", "delivered"),
    [
        ([b"\x01a" * 9, b"\x01a" * 2], [9, 0]),  # the welcome was the tenth
        ([b"\x01a" * 100], [9]),  # what came before is delivered
        ([b"\x01", b"?"] * 9 + [b"\x01?"], [0] * 19),  # the malformed count, half frames do not
    ],
    ids=["in two reads", "in one", "malformed, byte by byte"],
)
def test_a_peer_may_send_a_seconds_worth_at_once_and_one_more_ends_the_session(reads, delivered) -> None:
    session = limited(10.0)
    for read, count in zip(reads, delivered, strict=True):
        assert session.state is State.ESTABLISHED
        assert len(session.receive(read, 100.0)) == count
    assert (session.state, session.reason) == (State.CLOSED, "flood: more than 10 messages a second")


def test_a_peer_at_its_rate_is_served_for_ever_and_one_without_a_rate_may_send_all_at_once() -> None:
    session = limited(10.0)
    assert all(session.receive(b"\x01a", 100.0 + step / 10) == [b"a"] for step in range(1, 1001))
    session = limited(math.inf)
    assert [len(session.receive(b"\x01a" * count, 100.0)) for count in (10_000, 1)] == [10_000, 1]


def test_datagrams_share_the_rate_with_the_stream() -> None:
    session = limited(5.0)
    assert session.receive(b"\x01a" * 2, 100.0) == [b"a", b"a"]
    assert session.receive_datagram(b"\x01b", 100.0) == [b"b"]
    assert session.receive_datagram(b"no frame", 100.0) == []
    assert session.state is State.ESTABLISHED
    assert session.receive_datagram(b"\x01b", 100.0) == []
    assert (session.state, session.reason) == (State.CLOSED, "flood: more than 5 messages a second")
