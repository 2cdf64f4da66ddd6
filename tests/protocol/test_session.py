"""The session that all protocols share, shown with the smallest protocol there is.

A frame is a length byte and so many bytes; ``welcome`` ends the handshake, ``bye`` the conversation.
"""

import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.errors import ProtocolError
from zbridge.protocol.session import Limits, Role, Session, State

LIMITS = Limits(frame_bytes=100, handshake_s=5.0, gap_s=0.01)


def frame_end(data: bytes, start: int) -> int:
    if data[start] == 255:
        raise ProtocolError("length 255")
    if data[start] == 254:
        return start  # a fault of the protocol's own
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
        elif message == b"early":
            raise ProtocolError("too early")
        else:
            return True
        return False


BROKEN = {"!": b"\xff", "#": b"\x64", "@": b"\xfe"}
"""What cannot begin a frame, a header of a frame that is too long, and one for which the framing does not advance."""


def play(session: Any, script: str, **verbs: Callable[[str, float], Any]) -> None:
    """Play the steps of a script, with semicolons between them; a word is a message:

    ``at 1.5``: the time from now on; ``open``, ``lift``, ``expire``, ``send a``, ``urgent a``, ``close why``, ``lost
    why``; ``hear a b = a``: messages come, and what is handed on; ``out = a`` or ``= nothing``; ``due 1.5`` or ``due
    never``: the next deadline, ``limit 1.5``: that of a link that takes nothing; ``is closed (why)``.
    ``verbs``: others, called with what follows them and the time; what they give has to be what is written.
    """
    now = 0.0

    def framed(word: str) -> bytes:
        return BROKEN.get(word) or session.encode(word.encode())

    acts: dict[str, Callable[[str, float], Any]] = {
        "open": lambda _, now: session.open(now),
        "lift": lambda _, now: session.lift_limit(),
        "expire": lambda _, now: session.expire(now),
        "send": lambda word, now: session.send(word.encode()),
        "urgent": lambda word, now: session.outbox.set("motion", (framed(word),), now, until=now, urgent=True),
        "close": lambda why, now: session.close(why, now),
        "lost": lambda why, now: session.fail(why),
        "hear": lambda words, now: b" ".join(session.receive(b"".join(map(framed, words.split())), now)).decode(),
        "out": lambda _, now: (session.outgoing(now) or framed("nothing")).decode(),
        "due": lambda _, now: f"{session.deadline():g}" if session.deadline() is not None else "never",
        "limit": lambda _, now: f"{session.deadline(writing=False):g}",
        "is": lambda _, now: session.state.value + (f" ({session.reason})" if session.reason else ""),
    }
    for step in filter(str.strip, script.split(";")):
        said, equals, wanted = step.strip().partition(" =")
        verb, _, rest = said.partition(" ")
        wanted = wanted.strip() if equals else rest
        if verb == "at":
            now = float(rest)
            continue
        result = (acts | verbs)[verb](rest, now)
        assert result in (None, framed(wanted).decode() if verb == "out" else wanted), step


OPEN = "open; out = hello; hear welcome =; is established; at 1; "
SCRIPTS = {
    "the handshake begins when the link is up and fails at its limit and not before": (
        "due never; out = nothing; is connecting; at 10; open; is handshaking; out = hello; send more; due 10.01;"
        "limit 15; at 14.999; expire; is handshaking; at 15; expire; is closed (no handshake within 5 s); due never"
    ),
    "a handshake whose limit is lifted takes as long as its own timers": (
        "open; out = hello; lift; at 1e9; expire; is handshaking; due never"
    ),
    "a session is opened once, and has no limit when it is established": (
        OPEN + "due never; at 1e6; open; expire; out = nothing; is established"
    ),
    "a session that was ended before its link was up takes no first step": (
        "close gateway stopped; open; is closing (gateway stopped); out = nothing; is closed (gateway stopped)"
    ),
    "messages may follow the handshake at once, and what is malformed or comes too early is skipped": (
        "open; hear welcome a ? b = a b; hear early c = c; is established"
    ),
    "what is no frame ends it after the messages before": (
        OPEN + "hear a ! b = a; is closed (broken stream: length 255)"
    ),
    "a frame that is too long does so too": (
        OPEN + "hear a # = a; is closed (broken stream: frame of 101 bytes exceeds 100)"
    ),
    "framing that does not advance ends it too, and names the protocol's function": (
        OPEN + "hear a @ b = a; is closed (broken stream: tests.protocol.test_session.frame_end returned a frame of "
        "0 bytes, expected 1 or more)"
    ),
    "a closing session writes what waits, ignores what comes, and then is closed": (
        OPEN
        + "hear a bye b = a; is closing (the peer said bye); hear c =; out = bye too; is closing (the peer said bye);"
        "at 1.02; out = nothing; is closed (the peer said bye)"
    ),
    "a closing session waits for the gap before its last frames": (
        OPEN + "send one; out = one; send two; urgent stop; at 1.001; close enough; out = nothing; due 1.01;"
        "at 1.01; out = stop; at 1.02; out = two; at 1.03; out = nothing; is closed (enough)"
    ),
    "a closing session does not wait for a peer that takes nothing": (
        OPEN
        + "send one; close enough; limit 1.5; at 1.49; expire; is closing (enough); at 1.5; expire; is closed (enough)"
    ),
    "the first reason stands, and a closed session neither writes nor takes anything": (
        OPEN + "send one; close enough; close again; lost closed by peer; is closed (enough); due never; out = nothing;"
        "hear a =; open; close late; is closed (enough)"
    ),
}


@pytest.mark.parametrize("script", SCRIPTS.values(), ids=SCRIPTS)
def test_a_conversation_begins_goes_on_and_ends_as_it_should(script: str) -> None:
    play(Toy(LIMITS), script)


@given(st.lists(st.binary(max_size=60), max_size=8))
def test_random_bytes_never_raise_and_the_state_only_moves_down(reads: list[bytes]) -> None:
    session, states = Toy(LIMITS), []
    session.open(0.0)
    for step, data in enumerate(reads):
        assert all(isinstance(message, bytes) for message in session.receive(data, step * 0.1))
        session.outgoing(step * 0.1)
        states.append(session.state)
    assert states == sorted(states, key=list(State).index)


@pytest.fixture
def session() -> Toy:
    session = Toy(LIMITS, name="robot", peer="tcp://toy.test:1")
    play(session, OPEN)
    return session


def test_the_snapshot_tells_what_was_agreed_and_counted_and_does_not_change_with_the_session(session: Toy) -> None:
    play(session, "send abc; at 1; out = abc; hear ? a early = a")
    assert session.last_malformed == "too early"
    session.left_out["wings (7)"] += 2
    shown = session.snapshot()
    play(session, "hear a = a; lost closed by peer")
    session.left_out["wings (7)"] += 1
    assert (shown.name, shown.peer, shown.role, shown.transport) == ("robot", "tcp://toy.test:1", "hq", "tcp")
    assert (shown.state, shown.version, shown.features, shown.reason) == ("established", "2.0", ("wings",), None)
    counted = {"frames_in": 4, "frames_out": 2, "bytes_in": 18, "bytes_out": 10, "malformed": 2}
    assert shown.counters == counted | dict.fromkeys(("foreign", "dropped", "refused", "unanswered"), 0)
    assert shown.left_out == {"wings (7)": 2}


def test_a_tap_is_shown_every_frame_of_both_directions_malformed_ones_too(session: Toy) -> None:
    shown: list[tuple[str, bytes]] = []
    session.tap = lambda direction, frame: shown.append((direction, frame))
    session.receive(b"\x01a\x01?\x01", 1.0)
    session.send(b"b")
    session.outgoing(1.0)
    session.tap = None
    session.receive(b"c", 1.0)
    assert shown == [("in", b"\x01a"), ("in", b"\x01?"), ("out", b"\x01b")]


@pytest.mark.parametrize("end", [lambda toy: toy.close("enough", 1.0), lambda toy: toy.fail("enough")])
def test_a_session_says_why_its_peer_must_not_be_moved_two_doubts_and_not_one_and_why_it_ended(session, end) -> None:
    session.establish("", ())
    session.busy = "handshaking"
    assert (session.snapshot().reason, session.snapshot().version) == ("handshaking", None)
    session.doubts = ("client id 3",)
    assert session.doubtful is None
    session.doubts = ("client id 3", "malformed packets")
    assert session.doubtful == "connection in doubt: client id 3; malformed packets"
    end(session)
    session.establish("9.9", ("wings",))
    assert (session.doubts, session.doubtful, session.version, session.features) == ((), None, "", ())
    assert session.snapshot().reason == "enough"


# The peer's rate

FLOODED = "is closed (flood: more than 10 messages a second)"
AT_10_HZ = {
    "a second's worth at once, the welcome among them, and one more ends it": (
        f"hear{9 * ' a'} ={9 * ' a'}; is established; hear a a =; {FLOODED}"
    ),
    "half frames do not count": f"{9 * 'bytewise a = a; '}is established; bytewise a =; {FLOODED}",
    "what came before it in one read is handed on": f"hear{100 * ' a'} ={9 * ' a'}; {FLOODED}",
    "the malformed count": f"{9 * 'hear ? =; '}is established; hear ? =; {FLOODED}",
    "datagrams share the rate with the stream": (
        f"hear{7 * ' a'} ={7 * ' a'}; datagram b = b; datagram ! =; is established; datagram b =; {FLOODED}"
    ),
    "at its rate it is served for ever": "; ".join(f"at {1 + step / 10}; hear a = a" for step in range(1000)),
}


@pytest.mark.parametrize("script", AT_10_HZ.values(), ids=AT_10_HZ)
def test_a_peer_may_send_as_often_as_its_rate_says(script: str) -> None:
    session = Toy(Limits(frame_bytes=100, handshake_s=5.0, rate_hz=10.0))

    def datagram(word: str, now: float) -> str:
        return b" ".join(session.receive_datagram(BROKEN.get(word) or session.encode(word.encode()), now)).decode()

    def bytewise(word: str, now: float) -> str:
        read = (session.receive(bytes([byte]), now) for byte in session.encode(word.encode()))
        return b"".join(itertools.chain.from_iterable(read)).decode()

    play(session, "open; hear welcome =; " + script, datagram=datagram, bytewise=bytewise)


def test_a_peer_without_a_rate_may_send_all_at_once() -> None:
    session = Toy(Limits(frame_bytes=100, handshake_s=5.0, rate_hz=math.inf))
    session.open(0.0)
    assert [len(session.receive(b"\x01a" * count, 0.0)) for count in (10_000, 1)] == [10_000, 1]


def test_an_empty_datagram_is_malformed_and_no_framing_function_sees_it() -> None:
    session = Toy(LIMITS)
    session.open(0.0)
    assert session.receive_datagram(b"", 0.0) == []
    assert (session.traffic.malformed, session.last_malformed) == (1, "datagram of 0 bytes holds a frame of 1")
    assert not session.over
