"""The executor of state tables."""

from __future__ import annotations

import pytest

from zbridge.machine import step


class Door:
    """Notes who knocked."""

    def __init__(self) -> None:
        self.knocks: list[str] = []

    def knock(self, who: str) -> int:
        self.knocks.append(who)
        return len(self.knocks)

    def lock(self, who: str) -> int:
        raise ValueError(who)


TABLE = {
    "shut": {"knock": (Door.knock, None), "push": (Door.knock, "open"), "turn": (Door.lock, "locked")},
    "open": {"push": (Door.knock, "open")},
}


def test_an_action_gets_the_callers_arguments_and_its_result_comes_with_the_next_state() -> None:
    door = Door()
    assert step(TABLE, "shut", "push", door, "ann") == ("open", 1)
    assert step(TABLE, "open", "push", door, who="bob") == ("open", 2)
    assert door.knocks == ["ann", "bob"]


def test_without_a_next_state_the_state_stays() -> None:
    assert step(TABLE, "shut", "knock", Door(), "ann") == ("shut", 1)


def test_a_pair_that_the_table_lacks_changes_nothing() -> None:
    door = Door()
    assert step(TABLE, "open", "knock", door, "ann") == ("open", None)
    assert door.knocks == []


def test_an_action_that_raises_gives_no_next_state() -> None:
    with pytest.raises(ValueError, match="ann"):
        step(TABLE, "shut", "turn", Door(), "ann")
