"""What waits to be sent to one viewer: the newest wins. Sans-IO.

Messages of channels wait in a queue for each subscription, and go in the order in which they came. A full queue loses
its oldest message, and so does the whole outbox when its bytes exceed their bound. Answers and news of the server are
never dropped: a viewer that lets too many of them wait is ended.
"""

from __future__ import annotations

from collections import deque

DEPTH = 32
"""Most messages of one subscription that wait."""
MOST_BYTES = 16 * 1024 * 1024
"""Bound of the messages that wait; one that is larger by itself is sent all the same."""
CONTROLS = 1024
"""Most answers and news that wait."""
CONTROL_BYTES = 16 * 1024 * 1024
"""Bound of the answers and news that wait."""


class ViewerOutbox:
    """A viewer's outbox. dropped: messages that newer ones replaced. overrun: the viewer has to be ended."""

    def __init__(self) -> None:
        self.dropped = 0
        self.overrun = False
        self._controls: deque[str | bytes] = deque()
        self._control_bytes = 0
        self._queues: dict[int, deque[bytes]] = {}
        self._order: deque[int] = deque()
        """A subscription for each message that waits; the order of sending."""
        self._bytes = 0

    def __repr__(self) -> str:
        return f"<ViewerOutbox of {len(self._controls)} + {len(self._order)} messages, {self._bytes} bytes>"

    def __len__(self) -> int:
        return len(self._controls) + len(self._order)

    def say(self, message: str | bytes) -> None:
        self._controls.append(message)
        self._control_bytes += len(message)
        self.overrun |= len(self._controls) > CONTROLS or self._control_bytes > CONTROL_BYTES

    def show(self, subscription: int, message: bytes) -> None:
        queue = self._queues.get(subscription)
        if queue is None:
            queue = self._queues[subscription] = deque()
        queue.append(message)
        self._bytes += len(message)
        if len(queue) > DEPTH:  # the newer one takes the turn of the oldest
            self._bytes -= len(queue.popleft())
            self.dropped += 1
        else:
            self._order.append(subscription)
        while self._bytes > MOST_BYTES and len(self._order) > 1:
            self._pop()
            self.dropped += 1

    def next(self) -> str | bytes | None:
        """Take what is to be sent next; None if nothing waits."""
        if self._controls:
            message = self._controls.popleft()
            self._control_bytes -= len(message)
            return message
        return self._pop() if self._order else None

    def forget(self, subscription: int) -> None:
        """Drop what waits of a subscription that has ended."""
        for message in self._queues.pop(subscription, ()):
            self._bytes -= len(message)
        if subscription in self._order:
            self._order = deque(one for one in self._order if one != subscription)

    def _pop(self) -> bytes:
        message = self._queues[self._order.popleft()].popleft()
        self._bytes -= len(message)
        return message
