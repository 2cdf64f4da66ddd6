"""Puts a program's commands on the bus, each proven and numbered as it is put."""

from __future__ import annotations

from zbridge.bus import Bus, Publisher
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.lease.lease_client import LeaseClient

PUBLISHERS = 512
"""Keys that are commanded at a time; a new one replaces the oldest."""


class CommandPublishers:
    """Publishers for the commands to one robot.

    A drive is put at once. A thread of the bus writes all other commands: the next command must not overtake them, and
    has to wait until the bus is flushed.
    """

    def __init__(self, bus: Bus, keys: KeySpace) -> None:
        self.bus = bus
        self.keys = keys
        self._publishers: dict[str, Publisher] = {}

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.keys.robot}>"

    def put(
        self, topic: Topic, message: FleetMessage, lease: LeaseClient | None = None, given_ms: float | None = None
    ) -> bool:
        """Put a command on the bus; return whether the bus must be flushed before the next one.

        lease: proves a command that needs the lease. given_ms: the raw clock when its program gave it; None: now.
        """
        publisher = self._publishers.get(topic.path)
        if publisher is None:
            if len(self._publishers) >= PUBLISHERS:
                self._publishers.pop(next(iter(self._publishers))).close()
            publisher = self._publishers[topic.path] = self.bus.publisher(self.keys.key(topic.path), topic)
        payload = payloads.encode(message)
        publisher.put(payload, lease.prove(publisher.key, payload, given_ms) if lease is not None else None)
        return topic is not topics.CMD_DRIVE

    def close(self) -> None:
        """Close all publishers."""
        for publisher in self._publishers.values():
            publisher.close()
