"""What a protocol contributes to put its robots on the bus, and how the installed protocols are found.

A package adds one by an entry point in the group ``zbridge.protocols`` that names its :class:`Protocol`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Iterable
from importlib.metadata import entry_points
from typing import Any, ClassVar

import msgspec

from zbridge.errors import ConfigError, Refused
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.link import Address
from zbridge.metrics import Metrics
from zbridge.session.session import Session, State

GROUP = "zbridge.protocols"

Telemetry = tuple[Topic, FleetMessage]
Translate = Callable[[Any, int], Iterable[Telemetry]]
"""``translate(message, stamp_ns)``; raises ProtocolError where a message has no meaning."""


class Outcome(msgspec.Struct, frozen=True):
    """What became of a command: telemetry it gives rise to, and what of it the robot cannot do."""

    telemetry: tuple[Telemetry, ...] = ()
    left_out: str | None = None


class Robot(ABC):
    """One robot as its protocol sees it: sessions of its links, and translation both ways. Sans-IO.

    Commands go to the sessions this object made; it is told the time and never asks for it.
    """

    dialect: ClassVar[str | None] = None
    link_names: tuple[str, ...]
    """One name for each configured address; the first link is the one that drives."""

    @abstractmethod
    def session(self, link: int, peer: str) -> Session[Any]:
        """Make the session for a new connection of one link."""

    @property
    @abstractmethod
    def driving(self) -> Session[Any] | None:
        """The session that takes drive commands, None before the first connection."""

    @abstractmethod
    def translator(self, kind: type) -> Translate:
        """Give the function that translates what the robot sends in messages of one class."""

    def telemetry(self, message: Any, stamp_ns: int) -> Iterable[Telemetry]:
        """Translate what the robot sent; raise ProtocolError where it has no meaning."""
        return self.translator(type(message))(message, stamp_ns)

    @abstractmethod
    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        """Send a command to the robot; raise Refused with the reason where it cannot take it."""

    @abstractmethod
    def stop(self, now: float, until: float) -> None:
        """Send the robot its stop before anything else, and repeat it until ``until``."""

    @abstractmethod
    def ask(self, topic: Topic) -> None:
        """Ask the robot for what it publishes on ``topic``; raise Refused where it cannot be asked."""

    @property
    def on_demand(self) -> tuple[Topic, ...]:
        """What the robot publishes only while somebody listens; :meth:`listened` is told."""
        return ()

    def listened(self, topic: Topic, on: bool) -> None:
        """Take note that the first listener of an on-demand topic came, or the last one went; raise Refused."""
        raise Refused(f"{topic.path} needs no listener")

    def begun(self, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Begin with a connection that was just established; give what there is to show at once."""
        return ()

    @property
    def ready(self) -> bool:
        """Whether the robot takes commands now."""
        session = self.driving
        return session is not None and session.state is State.ESTABLISHED and session.busy is None


class Simulation(msgspec.Struct, frozen=True):
    """How a simulated robot is started: one address for each of its links.

    ``ready`` is called with the addresses it listens on. What a protocol does not have (versions, dialects,
    datagrams) it refuses with ConfigError.
    """

    addresses: tuple[Address, ...]
    seed: int = 1
    version: str | None = None
    dialect: str | None = None
    udp: bool = False
    strict: bool = False
    ready: Callable[[tuple[Address, ...]], None] = lambda addresses: None


class Protocol(msgspec.Struct, frozen=True):
    """A protocol: its name, what it can be told in a configuration, and what it makes."""

    name: str
    summary: str
    options: type[msgspec.Struct]
    links: int
    robot: Callable[[Any, int, Metrics], Robot]
    """``robot(options, links, metrics)``: the device side for a robot with so many links."""
    simulate: Callable[[Simulation], Coroutine[Any, Any, None]]
    """Be a robot of this protocol until cancelled."""
    simulated: dict[str, Any] = {}
    """The options that fit the simulated robot, where the default ones do not."""
    template: str = ""
    """A commented configuration with the placeholder ``{name}``."""


def protocol_names() -> tuple[str, ...]:
    """List the installed protocols."""
    return tuple(sorted(point.name for point in entry_points(group=GROUP)))


def find_protocol(name: str) -> Protocol:
    """Find an installed protocol; raise ConfigError naming the ones there are."""
    for point in entry_points(group=GROUP, name=name):
        protocol = point.load()
        if isinstance(protocol, Protocol):
            return protocol
        raise ConfigError(f"protocol = {name!r}: {point.value} is no zbridge protocol")
    raise ConfigError(f"protocol = {name!r}: expected one of {', '.join(protocol_names()) or '(none installed)'}")
