"""What the listeners of a process follow of one robot: subscribed once, decoded once. Knows no protocol."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from zbridge.bus import Bus, Handle, Sample
from zbridge.errors import PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Delivery, KeySpace, Topic
from zbridge.fleet.view import RobotView
from zbridge.log import Log
from zbridge.metrics import Metrics

log = Log("zbridge.hq")

Follow = Callable[[Topic, FleetMessage], None]
_KNOWN = 1024
"""Keys whose topics are cached."""
_STATES = (topics.STATUS.path, topics.CONTROL.path)


class RobotSubscription:
    """Keeps the view of one robot up to date and calls its followers. Call :meth:`open` first."""

    def __init__(self, bus: Bus, keys: KeySpace, metrics: Metrics) -> None:
        self.view = RobotView()
        self.bus = bus
        self.keys = keys
        self._followers: dict[str, list[Follow]] = {}
        self._topics: dict[str, Topic] = {}
        self._gateway: list[Callable[[bool], None]] = []
        self._handles: dict[str, Handle] = {}
        self._watch: Handle | None = None
        self._malformed = metrics.count("telemetry_malformed")

    def __repr__(self) -> str:
        return f"<RobotSubscription of {self.keys.robot}, {sorted(self._followers)}>"

    def follow(self, paths: Iterable[str], follower: Follow, on_gateway: Callable[[bool], None]) -> None:
        """Call ``follower`` for each message on these paths, and on ``status`` and ``control``.

        on_gateway: called with whether the robot has a gateway: now, and when one comes or goes. Of a path that others
        follow already, ``follower`` gets only what comes from now on; :attr:`view` has the last value.
        """
        self._gateway.append(on_gateway)
        on_gateway(self.view.alive)
        for path in dict.fromkeys((*_STATES, *paths)):
            self.also_follow(path, follower)

    def unfollow(self, path: str, follower: Follow) -> None:
        """Call ``follower`` no longer for one path; unsubscribe if nobody else follows it."""
        followers = self._followers.get(path, [])
        if follower in followers:
            followers.remove(follower)
            if not followers:
                self._handles.pop(path).close()
                del self._followers[path]

    def also_follow(self, path: str, follower: Follow) -> None:
        """Call ``follower`` for one more path too."""
        self._followers.setdefault(path, []).append(follower)
        if path not in self._handles:
            self._subscribe(path)

    def open(self) -> None:
        """Watch the liveliness token of the robot's gateway."""
        self._watch = self.bus.watch_alive(self.keys.alive("gateway"), self._on_gateway)

    def close(self) -> None:
        """Unsubscribe from everything."""
        for handle in (*self._handles.values(), *((self._watch,) if self._watch is not None else ())):
            handle.close()
        self._handles.clear()

    def _subscribe(self, path: str) -> None:
        followers = self._followers[path]
        topic = topics.find(path)
        history = topic is not None and topic.delivery is Delivery.STATE

        def take(sample: Sample) -> None:
            self._take(sample, followers)

        self._handles[path] = self.bus.subscribe(self.keys.key(path), take, history=history)

    def _take(self, sample: Sample, followers: list[Follow]) -> None:
        topic = self._topics.get(sample.key) or self._topic(sample.key)
        if topic is None:
            return
        try:
            message = payloads.decode(topic.message, sample.payload)
        except PayloadError as error:
            self._malformed.value += 1
            log.debug("message_malformed", "{key}: {error}", key=sample.key, error=error)
            return
        self.view.note(topic, message)
        for follower in tuple(followers):
            follower(topic, message)

    def _topic(self, key: str) -> Topic | None:
        topic = topics.find(self.keys.path(key))
        if topic is not None:
            if len(self._topics) >= _KNOWN:  # a robot may invent new names without end
                self._topics.clear()
            self._topics[key] = topic
        return topic

    def _on_gateway(self, key: str, alive: bool) -> None:
        self.view.alive = alive
        if not alive:
            self.view.status = None  # it says nothing about the next gateway
        for tell in self._gateway:
            tell(alive)
