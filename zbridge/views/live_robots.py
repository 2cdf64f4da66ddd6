"""What views of live robots share: which robots live, payloads that are read or counted, subscriptions on demand."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import TypeVar

from zbridge.bus import Bus, Handle
from zbridge.errors import PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import is_name, split_key
from zbridge.metrics import Count

ROBOTS = 256
"""Most robots that a view shows at a time."""
M = TypeVar("M", bound=FleetMessage)


def watch_robots(bus: Bus, realm: str, robots: Collection[str], changed: Callable[[str, bool], None]) -> Handle:
    """Call ``changed`` with a robot's name and whether its gateway lives. robots: those watched; empty for all."""

    def on_token(key: str, alive: bool) -> None:
        split = split_key(key)
        if split is not None and is_name(split[1]) and (not robots or split[1] in robots):
            changed(split[1], alive)

    return bus.watch_alive(f"{realm}/*/@alive/gateway", on_token)


def read_payload(kind: type[M], payload: bytes, malformed: Count, *, arrays: bool = True) -> M | None:
    """Decode a fleet message; count as malformed what cannot be decoded, and return None."""
    try:
        return payloads.decode(kind, payload, arrays=arrays)
    except PayloadError:
        malformed.value += 1
        return None


class OnDemandSubscriptions:
    """The subscriptions of one robot, by path below it. declare: subscribes to a path."""

    def __init__(self, declare: Callable[[str], Handle]) -> None:
        self._declare = declare
        self._handles: dict[str, Handle] = {}

    def __repr__(self) -> str:
        return f"<OnDemandSubscriptions {sorted(self._handles)}>"

    def need(self, paths: set[str]) -> None:
        """Subscribe to these paths, and to no others."""
        for path in self._handles.keys() - paths:
            self._handles.pop(path).close()
        for path in paths - self._handles.keys():
            self._handles[path] = self._declare(path)
