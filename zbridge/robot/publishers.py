"""The publishers of one robot, made on first use. Those of names that the robot chooses are bounded in number."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from zbridge.blackbox import BlackBox
from zbridge.bus import Bus, Publisher
from zbridge.control.faults import FaultCode, OpenFaults
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import KeySpace, Topic, find
from zbridge.protocol.kept import Budget
from zbridge.robot.names import NAMES, NameBudget


class _Muted:
    """Stands for a publisher while nothing is published: remembers the last value of a key that keeps it."""

    def __init__(self, key: str, topic: Topic, last: bytes | None) -> None:
        self.key = key
        self.last = last
        self._keeps_last = topic.qos.keeps_last

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        if self._keeps_last:
            self.last = payload
        return True

    def close(self) -> None:
        pass


class RobotPublishers:
    """Publishes on the keys of one robot.

    clock: seconds. kept: called for each new key that keeps its last value. box: records what is published.
    """

    def __init__(
        self,
        bus: Bus,
        keys: KeySpace,
        open_faults: OpenFaults,
        clock: Callable[[], float],
        kept: Callable[[], object] = lambda: None,
        box: BlackBox | None = None,
    ) -> None:
        self._box = box
        self.known: dict[str, Publisher] = {}
        """The publishers there are, by path."""
        self._bus = bus
        self._keys = keys
        self._open_faults = open_faults
        self._clock = clock
        self._kept = kept
        self._names = NameBudget()
        self.muted = False
        """Whether nothing is published: another gateway serves the robot."""

    def __len__(self) -> int:
        return len(self.known)

    def __repr__(self) -> str:
        return f"<RobotPublishers {self._keys.robot} {len(self)}, {self._names!r}>"

    def publish(self, topic: Topic, message: FleetMessage) -> None:
        """Publish a message; drop it where the robot has too many names."""
        publisher = self.get(topic)
        if publisher is not None:
            payload = payloads.encode(message)
            publisher.put(payload)
            if self._box is not None and not self.muted:
                self._box.put(publisher.key, payload)

    def get(self, topic: Topic) -> Publisher | None:
        """Return the publisher of a topic; None if the robot has too many names."""
        path = topic.path
        publisher = self.known.get(path)
        if publisher is None:
            if _is_named(path) and not self._names.admit(path, self._clock()):
                self._show_names()
                return None
            publisher = self.known[path] = self._make(topic)
            if topic.qos.keeps_last:
                self._kept()
        return publisher

    def _make(self, topic: Topic, last: bytes | None = None) -> Publisher:
        key = self._keys.key(topic.path)
        return _Muted(key, topic, last) if self.muted else self._bus.publisher(key, topic, last)

    def mute(self, muted: bool) -> None:
        """Give up every key, and publish nothing; ``mute(False)``: declare them again, with last values."""
        self.muted = muted
        for path, publisher in self.known.items():
            topic = find(path)
            assert topic is not None
            publisher.close()
            self.known[path] = self._make(topic, publisher.last)
        if not muted:
            self.repeat()

    def export(self, budget: Budget | None = None) -> list[list[object]]:
        """List the keys, each with the last value that it keeps. budget: of a deposit, which lacks large values."""
        known = [(path, publisher.last) for path, publisher in self.known.items()]
        return [[path, last if budget is None or budget.admits(path, last) else None] for path, last in known]

    def states(self) -> list[tuple[str, bytes]]:
        """List keys and last values of all that keep it."""
        return [(publisher.key, last) for publisher in self.known.values() if (last := publisher.last) is not None]

    def restore(self, known: Iterable[tuple[str, bytes | None]]) -> None:
        """Declare the keys of another process, which answer for their last values; nothing is published."""
        for path, last in known:
            topic = find(path)
            if topic is not None and (not _is_named(path) or self._names.admit(path, self._clock())):
                self.known[path] = self._make(topic, last)

    def repeat(self) -> None:
        """Publish again the last values that are kept: who asked for them before they were restored got none."""
        for publisher in self.known.values():
            if publisher.last is not None:
                publisher.put(publisher.last)

    def forget_names(self) -> None:
        """Give up the names of a connection that has ended."""
        for path in [path for path in self.known if _is_named(path)]:
            self.known.pop(path).close()

    def expire(self) -> None:
        """Begin a new hour of names where it is time. To be called once a second."""
        self._names.expire(self._clock())
        self._show_names()

    def close(self) -> None:
        """Give up every key."""
        for publisher in self.known.values():
            publisher.close()

    def _show_names(self) -> None:
        text = f"more than {NAMES} different names within an hour: the others are not published"
        self._open_faults.set(FaultCode.TOO_MANY_NAMES, text if self._names.over else None)


def _is_named(path: str) -> bool:
    """Tell a topic of a family, whose last chunk the robot chooses: ``sensor/front``."""
    return "/" in path
