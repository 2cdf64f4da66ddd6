"""What the clients of one listener share on the bus of their robot. Knows no protocol and no link."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

from zbridge.bus import Bus, Publisher
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.fleet.view import RobotView
from zbridge.lease.lease_client import LeaseClient

PUBLISHERS = 512
"""Keys that the clients of a listener command at a time; a new one replaces the oldest."""


class Bridge:
    """The robot's keys, its view, and publishers for its commands. ``spawn`` starts a task."""

    def __init__(
        self, bus: Bus, keys: KeySpace, view: RobotView, spawn: Callable[[Coroutine[Any, Any, None]], object]
    ) -> None:
        self.bus = bus
        self.keys = keys
        self.view = view
        self.spawn = spawn
        self._publishers: dict[str, Publisher] = {}

    def __repr__(self) -> str:
        return f"<Bridge to {self.keys.robot}>"

    def put(
        self, topic: Topic, message: FleetMessage, lease: LeaseClient | None = None, given_ms: float | None = None
    ) -> None:
        """Put a command on the bus; ``lease`` proves one that needs the lease.

        given_ms: the raw clock when its program gave it; None: now.
        """
        publisher = self._publishers.get(topic.path)
        if publisher is None:
            if len(self._publishers) >= PUBLISHERS:
                self._publishers.pop(next(iter(self._publishers))).close()
            publisher = self._publishers[topic.path] = self.bus.publisher(self.keys.key(topic.path), topic)
        payload = payloads.encode(message)
        publisher.put(payload, lease.prove(publisher.key, payload, given_ms) if lease is not None else None)

    def close(self) -> None:
        """Close all publishers."""
        for publisher in self._publishers.values():
            publisher.close()
