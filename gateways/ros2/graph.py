"""Who publishes a robot's topics and who subscribes to its commands, by the liveliness tokens of ROS nodes. Sans-IO."""

from __future__ import annotations

import msgspec

from gateways.ros2.messages import RECEIVED, TRANSIENT_LOCAL, TWIST, TWIST_STAMPED, Received, TwistCommand
from gateways.ros2.options import RosOptions
from zbridge.protocol import ProtocolError
from zbridge.ros2.rmw_zenoh import Endpoint, Kind, endpoints_of, read_token
from zbridge.ros2.types import NO_HASH, Types

ENDPOINTS = 64
"""Most known publishers of the robot, subscribers to its commands, and other drivers, each; the rest is ignored."""


class Wanted(msgspec.Struct, frozen=True):
    """One topic that is read. latched: a late subscriber gets the last message."""

    name: str
    received: type[Received]
    types: tuple[str, ...]
    latched: bool


class Graph:
    """The endpoints of one robot's topics."""

    def __init__(self, options: RosOptions, types: Types) -> None:
        self._domain = options.domain
        self._types = types
        self.command_topic = options.topic("cmd_vel")
        self._wanted = {
            name: Wanted(name, received, (type_name,), option in TRANSIENT_LOCAL)
            for option, (received, type_name) in RECEIVED.items()
            if (name := options.topic(option)) is not None
        }
        self._command = Wanted(self.command_topic or "", TwistCommand, (TWIST, TWIST_STAMPED), latched=False)
        self.own_zid: str | None = None
        """The Zenoh id of our own node."""
        self.publishers: dict[str, Endpoint] = {}
        """By their tokens, as the next two."""
        self.subscribers: dict[str, Endpoint] = {}
        self.drivers: dict[str, Endpoint] = {}
        """Other nodes that publish on the topic of commands."""
        self.wrong: dict[str, str] = {}
        """Endpoints on the robot's topics that are not what they should be, and why."""
        self.gids: dict[bytes, Endpoint] = {}
        self.keys: dict[str, tuple[Wanted, str]] = {}
        """For each key that is read: what it is, and the type of its messages."""

    def __repr__(self) -> str:
        return (
            f"<Graph publishers={len(self.publishers)} subscribers={len(self.subscribers)} drivers={len(self.drivers)}>"
        )

    def watched(self) -> list[str]:
        """List the expressions of the tokens that matter."""
        watched = [(Kind.PUBLISHER, name) for name in self._wanted]
        if self.command_topic is not None:
            watched += [(Kind.SUBSCRIBER, self.command_topic), (Kind.PUBLISHER, self.command_topic)]
        return [endpoints_of(self._domain, kind, name) for kind, name in watched]

    def appeared(self, token: str) -> Endpoint:
        """Enter an endpoint; raise ProtocolError for one that is not of this robot, or not as it should be."""
        endpoint = read_token(token)
        if not isinstance(endpoint, Endpoint):
            raise ProtocolError(f"token {token[:200]!r}")
        table, wanted = self._place(endpoint)
        try:
            self._check(endpoint, wanted)
        except ProtocolError as error:
            if len(self.wrong) < ENDPOINTS:
                self.wrong[token] = str(error)
            raise
        if len(table) >= ENDPOINTS:
            raise ProtocolError(f"{endpoint.name}: more than {ENDPOINTS} endpoints")
        table[token] = endpoint
        if endpoint.kind is Kind.PUBLISHER:
            self.gids |= dict.fromkeys(endpoint.gids(), endpoint)
        self.keys[endpoint.key] = (wanted, endpoint.type_name)
        return endpoint

    def knows(self, token: str) -> bool:
        """Return whether a token is our own, or was read before."""
        tables = (self.publishers, self.subscribers, self.drivers, self.wrong)
        return token.split("/", 3)[2:3] == [self.own_zid] or any(token in table for table in tables)

    def gone(self, token: str) -> bool:
        """Forget an endpoint; False if it was not known."""
        if self.wrong.pop(token, None) is not None:
            return True
        for table in (self.publishers, self.subscribers, self.drivers):
            if (endpoint := table.pop(token, None)) is not None:
                for gid in endpoint.gids():
                    self.gids.pop(gid, None)
                return True
        return False

    def of_topic(self, name: str) -> Wanted:
        """Return what is wanted of a topic."""
        return self._wanted.get(name, self._command)

    @property
    def features(self) -> tuple[str, ...]:
        """The names of the topics that the robot publishes."""
        return tuple(sorted({endpoint.name for endpoint in self.publishers.values()}))

    @property
    def waiting_for(self) -> str:
        """Return why nothing of the robot is known."""
        if self.publishers:
            return "its publishers are silent"
        if self.wrong:
            return next(iter(self.wrong.values()))
        return f"nobody publishes {', '.join(self._wanted)}"

    @property
    def drive_problem(self) -> str | None:
        """Return why the robot cannot be driven; None if it can."""
        if self.subscribers:
            return None
        if self.command_topic is None:
            return "cmd_vel is turned off"
        wrong = (text for text in self.wrong.values() if text.startswith(f"{self.command_topic} "))
        return next(wrong, f"nobody subscribes to {self.command_topic}")

    def _place(self, endpoint: Endpoint) -> tuple[dict[str, Endpoint], Wanted]:
        if endpoint.name == self.command_topic:
            if endpoint.kind is Kind.SUBSCRIBER:
                return self.subscribers, self._command
            if endpoint.kind is Kind.PUBLISHER:
                return self.drivers, self._command
        wanted = self._wanted.get(endpoint.name)
        if wanted is None or endpoint.kind is not Kind.PUBLISHER:
            raise ProtocolError(f"{endpoint.name}: nothing of this robot")
        return self.publishers, wanted

    def _check(self, endpoint: Endpoint, wanted: Wanted) -> None:
        expected = " or ".join(wanted.types)
        if endpoint.type_name not in wanted.types:
            raise ProtocolError(f"{endpoint.name} is {endpoint.type_name}, expected {expected}")
        if endpoint.type_hash not in (NO_HASH, self._types.computed_hash(endpoint.type_name)):
            raise ProtocolError(f"{endpoint.name} has another {endpoint.type_name}: hash {endpoint.type_hash[:20]}")
