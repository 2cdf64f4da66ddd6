"""Keys are declared while somebody listens to any of them, and each is told of its own listeners."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from zbridge.robot.on_demand import OnDemand

ANY, IN, OUT = "fleet/r1/@wire/**", "fleet/r1/@wire/robot/in", "fleet/r1/@wire/robot/out"


class Declared:
    def __init__(self, bus: DeclaringBus, key: str) -> None:
        self._bus, self.key = bus, key

    def close(self) -> None:
        del self._bus.listened[self.key]


class DeclaringBus:
    """A bus on which only listeners are watched; the test says when they come and go."""

    def __init__(self) -> None:
        self.listened: dict[str, Callable[[bool], None]] = {}

    def frames(self, key: str, listened: Callable[[bool], None]) -> Declared:
        assert key not in self.listened
        self.listened[key] = listened
        return Declared(self, key)

    watch_listeners = frames


Told = list[tuple[str, bool]]


@pytest.fixture
def bus() -> DeclaringBus:
    return DeclaringBus()


@pytest.fixture
def told() -> Told:
    return []


@pytest.fixture
def demand(bus: DeclaringBus, told: Told) -> OnDemand:
    def tell(publisher: Any, anybody: bool) -> None:
        told.append((publisher.key, anybody))

    demand = OnDemand(bus, ANY, {IN: tell, OUT: tell})  # type: ignore[arg-type]
    demand.open()
    return demand


def test_one_declaration_waits_for_the_first_listener_of_any_key(bus, demand, told) -> None:
    assert set(bus.listened) == {ANY}
    bus.listened[ANY](True)
    bus.listened[ANY](True)
    assert set(bus.listened) == {ANY, IN, OUT}
    assert told == []


def test_each_key_is_told_of_its_own_listeners_and_of_each_change_once(bus, demand, told) -> None:
    bus.listened[ANY](True)
    for anybody in (False, True, True, False, True):
        bus.listened[OUT](anybody)
    assert told == [(OUT, True), (OUT, False), (OUT, True)]


def test_with_the_last_listener_of_all_every_key_is_taken_back_and_told(bus, demand, told) -> None:
    bus.listened[ANY](True)
    bus.listened[IN](True)
    late = bus.listened[IN]
    bus.listened[ANY](False)
    assert set(bus.listened) == {ANY}
    assert told == [(IN, True), (IN, False)]
    late(False)
    assert len(told) == 2, "news that were on their way"
    bus.listened[ANY](True)
    bus.listened[IN](True)
    assert told[2:] == [(IN, True)]


def test_when_it_is_closed_nothing_is_declared_and_nobody_is_told(bus, demand, told) -> None:
    bus.listened[ANY](True)
    bus.listened[IN](True)
    watch = bus.listened[ANY]
    demand.close()
    demand.close()
    watch(True)
    assert bus.listened == {}
    assert told == [(IN, True)]
