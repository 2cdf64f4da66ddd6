"""Conditions: what status tells people of a robot that is served all the same."""

from zbridge.control.context import Conditions


def test_conditions_are_told_oldest_first_and_only_when_they_change() -> None:
    told: list[tuple[str, ...]] = []
    conditions = Conditions(lambda: told.append(conditions.texts))
    conditions.set("link", "takes nothing")
    conditions.set("audit", "disk full")
    conditions.set("link", "takes nothing")
    conditions.set("link", None)
    conditions.set("link", None)
    assert told == [("takes nothing",), ("takes nothing", "disk full"), ("disk full",)]
