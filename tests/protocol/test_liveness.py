"""A robot that falls silent is not driven and then lost; its watchdog is fed; both survive a restart."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import pytest

from zbridge.errors import ProtocolError
from zbridge.protocol import KeepAlive, Limits, Role, Session, State

SILENT, LOST = "nothing came for 0.5 s", "nothing came for 2 s"


class Streaming(Session[bytes]):
    """Frames of one byte; ``!`` is none."""

    role = Role.HQ
    silent_s, lost_s = 0.5, 2.0
    keep_alive = KeepAlive(b"p", 1.0, 3.0)

    @staticmethod
    def frame_end(data: bytes, start: int) -> int:
        return start + 1

    def encode(self, message: bytes) -> bytes:
        return message

    def decode(self, frame: bytes) -> bytes:
        if frame == b"!":
            raise ProtocolError("noise")
        return frame

    def accept(self, message: bytes, now: float) -> bool:
        self.establish("", ())
        return True


def established(kind: type[Streaming] = Streaming, at: float = 10.0) -> Streaming:
    session = kind(Limits(frame_bytes=10, handshake_s=5.0))
    session.open(at - 1.0)
    session.receive(b"x", at)
    assert session.state is State.ESTABLISHED
    return session


def run(session: Streaming, now: float, until: float) -> dict[float, bytes]:
    """Do what is due until then; return what was written, and when."""
    written: dict[float, bytes] = {}
    while (due := session.deadline()) is not None and due <= until:
        now = max(now, due)
        session.expire(now)
        while (frame := session.outgoing(now)) is not None:
            written[round(now, 6)] = frame
    return written


def test_a_silent_robot_is_not_driven_and_then_lost() -> None:
    session = established()
    run(session, 10.0, 10.49)
    assert session.busy is None
    run(session, 10.49, 10.5)
    assert session.busy == SILENT
    run(session, 10.5, 11.99)
    assert session.state is State.ESTABLISHED
    run(session, 11.99, 12.0)
    assert (session.state, session.reason) == (State.CLOSED, LOST)


def test_one_message_ends_a_silence_and_noise_does_not() -> None:
    session = established()
    run(session, 10.0, 11.0)
    session.receive(b"!!!", 11.0)
    assert session.busy == SILENT
    session.receive(b"!x", 11.1)
    assert session.busy is None
    session.receive(b"!!!!", 11.5)
    run(session, 11.5, 11.6)
    assert session.busy == SILENT
    session.receive_datagram(b"x", 11.7)
    assert session.busy is None


def test_another_reason_to_be_busy_is_neither_hidden_nor_ended_by_a_silence() -> None:
    session = established()
    session.busy = "on a cliff"
    run(session, 10.0, 11.0)
    session.receive(b"x", 11.0)
    assert session.busy == "on a cliff"


def test_nothing_is_judged_before_the_session_is_established() -> None:
    session = Streaming(Limits(frame_bytes=10, handshake_s=5.0))
    session.open(0.0)
    assert run(session, 0.0, 4.9) == {}
    assert (session.state, session.busy) == (State.HANDSHAKING, None)


def test_a_session_that_sets_nothing_is_never_silent() -> None:
    class Quiet(Streaming):
        silent_s = lost_s = keep_alive = None

    session = established(Quiet)
    assert session.deadline() is None
    session.expire(1e9)
    assert session.state is State.ESTABLISHED


def test_the_watch_begins_without_a_message_where_a_session_is_established_at_once() -> None:
    class Hasty(Streaming):
        def opened(self, now: float) -> None:
            self.establish("", ())

    session = Hasty(Limits(frame_bytes=10, handshake_s=5.0))
    session.open(3.0)
    assert run(session, 3.0, 3.0) == {3.0: b"p"}
    run(session, 3.0, 5.0)
    assert session.reason == LOST


def test_the_keep_alive_is_repeated_and_survives_what_clears_the_outbox() -> None:
    session = established()
    session.silence.lost_s = math.inf
    assert run(session, 10.0, 12.5) == {10.0: b"p", 11.0: b"p", 12.0: b"p"}
    session.outbox.mute(True)
    session.outbox.set("motion", (b"m",), 12.5)
    assert run(session, 12.5, 13.5) == {13.0: b"p"}
    session.outbox.mute(False)
    session.outbox.forget()
    assert run(session, 13.5, 14.5) == {14.0: b"p"}


def test_a_keep_alive_is_set_in_an_outbox_that_is_muted_already() -> None:
    session = Streaming(Limits(frame_bytes=10, handshake_s=5.0))
    session.outbox.mute(True)
    session.open(0.0)
    session.receive(b"x", 0.1)
    assert run(session, 0.1, 0.2) == {0.1: b"p"}


def test_a_stop_goes_before_a_keep_alive_that_is_due() -> None:
    session = established()
    session.outbox.set("motion", (b"s",), 10.0, until=10.0, urgent=True)
    assert [session.outgoing(10.0), session.outgoing(10.0)] == [b"s", b"p"]


@pytest.mark.parametrize("silent_for", [0.1, 0.7])
def test_another_process_goes_on_with_the_silence_and_the_keep_alive(silent_for: float) -> None:
    session = established()
    run(session, 10.0, 10.0 + silent_for)
    state: Any = msgspec.msgpack.decode(msgspec.msgpack.encode(session.export()))
    heir = Streaming(Limits(frame_bytes=10, handshake_s=5.0))
    heir.restore(state)
    assert heir.busy == session.busy
    assert run(heir, 10.7, 11.9) == {11.0: b"p"}
    assert heir.busy == SILENT
    run(heir, 11.9, 12.1)
    assert heir.reason == LOST


def test_a_time_in_which_nothing_was_read_is_no_silence() -> None:
    session = established()
    session.silence.restart(11.9)
    run(session, 11.9, 12.3)
    assert session.busy is None
    run(session, 12.3, 12.5)
    assert session.busy == SILENT


def test_a_closing_session_has_no_deadline_in_the_past() -> None:
    session = established()
    session.outbox.put(b"last")
    session.close("bye", 10.1)
    assert session.deadline(writing=False) == 10.6


def test_a_session_closes_once_the_slots_that_are_due_are_written() -> None:
    class Slow(Streaming):
        keep_alive = None

    session = Slow(Limits(frame_bytes=10, handshake_s=5.0, gap_s=0.1))
    session.open(0.0)
    session.receive(b"x", 0.0)
    session.outbox.set("motors", (b"1", b"2"), 0.0)
    session.close("bye", 0.0)
    assert [session.outgoing(0.0), session.outgoing(0.05)] == [b"1", None]
    assert (session.outgoing(0.1), session.state) == (b"2", State.CLOSING)
    assert (session.outgoing(0.3), session.state) == (None, State.CLOSED)
