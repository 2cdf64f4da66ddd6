"""The executor of handshake tables, with a toy table."""

import math
from typing import Any

from zbridge.protocol.handshake import Handshake


class Toy:
    """Writes down what its actions were told."""

    def __init__(self) -> None:
        self.acts: list[tuple[str, float, str]] = []
        self.handshake: Handshake[str, str] = Handshake(
            self, TABLE, "greeting", timeout="timeout", within_s={"greeting": 9.0, "waiting": 2.0}
        )

    def ask(self, now: float) -> None:
        self.acts.append(("ask", now, self.handshake.step))

    def give_up(self, now: float) -> None:
        self.acts.append(("give up", now, self.handshake.step))


TABLE: dict[str, dict[str, tuple[Any, str]]] = {
    "greeting": {"hello": (Toy.ask, "waiting")},
    "waiting": {"hello": (Toy.ask, "waiting"), "timeout": (Toy.give_up, "done")},
    "done": {},
}


def test_an_event_takes_the_next_step_and_then_acts_and_one_that_is_not_due_changes_nothing() -> None:
    toy = Toy()
    assert not toy.handshake.fire("timeout", 1.0)
    assert (toy.handshake.step, toy.handshake.deadline, toy.acts) == ("greeting", math.inf, [])
    assert toy.handshake.fire("hello", 1.0)
    assert (toy.acts, toy.handshake.deadline) == ([("ask", 1.0, "waiting")], 3.0)


def test_a_step_that_lasts_too_long_fires_the_timeout_once_and_one_that_follows_itself_begins_anew() -> None:
    toy = Toy()
    toy.handshake.fire("hello", 0.5)
    toy.handshake.fire("hello", 1.0)
    toy.handshake.expire(2.9)
    assert toy.handshake.step == "waiting"
    toy.handshake.expire(3.0)
    toy.handshake.expire(99.0)
    assert toy.acts[2:] == [("give up", 3.0, "done")]
    assert toy.handshake.deadline == math.inf
