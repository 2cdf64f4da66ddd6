"""The raw frames of a robot's links (``@wire/<link>/in``, ``out``), published while somebody listens to them.

One declaration for all links tells whether anybody listens to any of them; only then each link and direction has a key
of its own, which is published while it is listened to.
"""

from __future__ import annotations

from zbridge.bus import Publisher
from zbridge.control.context import RobotContext
from zbridge.robot.connection import Connection, Links

_DIRECTIONS = ("in", "out")


class RawFrames:
    """Publishes the raw frames of one robot."""

    def __init__(self, context: RobotContext, links: Links) -> None:
        self._context = context
        self._links = links
        self._publishers: list[Publisher] = []

    def __repr__(self) -> str:
        return f"<RawFrames {self._context.keys.robot}, {len(self._publishers)} keys>"

    def listened(self, anybody: bool) -> None:
        """Begin when the first listener of any raw frames comes, and end with the last."""
        self.close()
        if anybody:
            for connection in self._links:
                self._publishers += [self._declare(connection, direction) for direction in _DIRECTIONS]

    def close(self) -> None:
        """Publish no raw frames; idempotent."""
        publishers, self._publishers = self._publishers, []
        for publisher in publishers:
            publisher.close()
        for connection in self._links:
            for direction in _DIRECTIONS:
                connection.watch(direction, None)

    def _declare(self, connection: Connection, direction: str) -> Publisher:
        """Publish the frames of one direction while somebody listens."""

        def listened(anybody: bool) -> None:
            if publisher in self._publishers:
                connection.watch(direction, publisher.put if anybody else None)

        key = self._context.keys.key(f"@wire/{connection.name}/{direction}")
        publisher = self._context.bus.frames(key, listened)
        return publisher
