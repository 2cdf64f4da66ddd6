"""What a protocol contributes to put its robots on the bus, and how the installed protocols are found.

A package adds one by an entry point in the group ``zbridge.protocols`` that names its :class:`Protocol`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Iterable
from typing import Any, ClassVar

import msgspec

from zbridge.address import Address
from zbridge.errors import ConfigError, Unsupported
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.metrics import Metrics
from zbridge.protocol.codec import Codec
from zbridge.protocol.session import Limits, Session, State

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
    """One name for each configured address, in the order of the configuration; the first link drives the robot."""

    @abstractmethod
    def session(self, link: str, peer: str) -> Session[Any]:
        """Make the session for a new connection of the link of this name; ``peer``: its address, for logs."""

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
        """Send the robot its stop before anything else, and repeat it until ``until``; once if that is ``now``."""

    @abstractmethod
    def ask(self, topic: Topic) -> None:
        """Ask the robot for what it publishes on ``topic``; raise Refused where it cannot be asked."""

    def known(self, topic: Topic) -> FleetMessage | None:
        """Give what is answered at once to who asks for ``topic``; None where the robot is to be asked."""
        return None

    @property
    def on_demand(self) -> tuple[Topic, ...]:
        """What the robot publishes only while somebody listens; :meth:`listened` is told."""
        return ()

    def listened(self, topic: Topic, on: bool) -> None:
        """Take note that the first listener of an on-demand topic came, or the last one went; raise Refused."""
        raise Unsupported(f"{topic.path} needs no listener")

    def begun(self, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Begin with a connection that was just established; give what there is to show at once."""
        return ()

    @property
    def ready(self) -> bool:
        """Whether the robot takes commands now."""
        session = self.driving
        return session is not None and session.state is State.ESTABLISHED and session.busy is None


Send = Callable[[Any, float], object]
"""``send(session, now)``: puts what was encoded into the outbox of one client's session; raises Refused."""


class HqSide(ABC):
    """What one listener shows its HQ programs of a robot, and how it understands them. Sans-IO.

    Made with the listener's options and the :class:`RobotView` that all listeners of a process share. What goes to
    many clients is encoded once: :meth:`show` does it, or does it when the first client needs it.
    """

    name: ClassVar[str]
    """The protocol's name: a robot of the same one is passed on whole."""
    deadman_s: ClassVar[float]
    """Seconds after which motion of a silent client ends."""
    modes: ClassVar[bool] = False
    """Whether a client says first that it wants to drive (:class:`Mode`), and motion before that is refused."""
    steers: ClassVar[bool] = False
    """Whether a turn without motion only sets wheels, and so is neutral."""
    hold: bool = False
    """Whether what a client set once is repeated while its link lives."""
    datagrams: bool = False
    """Whether clients are heard by datagrams too."""
    numbers: range = range(1, 1_000_000)
    """The numbers that clients are given."""
    quiet_s: float = 0.0
    """Seconds before a number is given again."""
    follows: tuple[str, ...]
    """The paths (``pose``, ``sensor/*``) whose messages :meth:`show` is given."""

    @abstractmethod
    def session(self, number: int, bounds: Limits) -> Session[Any]:
        """Make the session of a new client; of ``bounds`` the protocol sets what is its own."""

    @abstractmethod
    def begin(self, session: Any, now: float) -> None:
        """Send a client whose session was just established what it is to know first."""

    @abstractmethod
    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        """Translate what is new of the robot; None where no client is to be told."""

    @abstractmethod
    def take(self, session: Any, message: Any) -> Iterable[Telemetry]:
        """Translate what a client sent to commands and queries; raise ProtocolError where it has no meaning."""

    def answer(self, session: Any, topic: Topic, message: FleetMessage | None, now: float) -> None:
        """Answer a client's question; None where the robot gave no answer. Raises Refused, EncodeError."""
        raise Unsupported(f"nothing can be asked for {topic.path}")

    def tell(self, session: Any, text: str, now: float) -> None:
        """Say something to the people at a client, where the protocol can."""
        return

    def presence(self, there: bool) -> Send | None:
        """Show that the robot is there again, or is lost; None where clients are shown nothing of that."""
        return None

    def deadline(self, session: Any) -> float:
        """Tell when :meth:`expire` wants to be called because of what a client said; ``inf`` for never."""
        return math.inf

    def expire(self, session: Any, now: float) -> Iterable[Telemetry]:
        """Translate what a client said and what waited for more of it."""
        return ()

    def wanted(self) -> tuple[Topic, ...]:
        """List what clients want besides ``follows``, only now and then."""
        return ()


class HqSimulation(msgspec.Struct, frozen=True):
    """How a simulated HQ program is started: where it connects, and what it is. It is as fragile as deployed ones."""

    address: Address
    version: str | None = None
    dialect: str | None = None
    udp: bool = False


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
    fragile: bool = False
    ready: Callable[[tuple[Address, ...]], None] = lambda addresses: None


class _NoOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


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
    hq: Callable[[Any, RobotView, Metrics], HqSide] | None = None
    """``hq(options, view, metrics)``: what a listener shows HQ programs; None: the protocol has no listeners."""
    hq_options: type[msgspec.Struct] = _NoOptions
    """What a listener can be told in a configuration."""
    simulate_hq: Callable[[HqSimulation], Coroutine[Any, Any, None]] | None = None
    """Be an HQ program of this protocol until cancelled, or until it dies."""
    template: str = ""
    """The commented ``[device]`` table of a configuration, ``[device.options]`` with it."""
    codecs: tuple[Codec, ...] = ()
    """The messages, for the conformance kit."""
    hq_template: str = ""
    """What a commented ``[[hq]]`` table says of this protocol: ``protocol``, ``listen`` and ``[hq.options]``."""


def protocol_names() -> tuple[str, ...]:
    """List the installed protocols."""
    from importlib.metadata import entry_points  # here: it loads sockets and threads

    return tuple(sorted(point.name for point in entry_points(group=GROUP)))


def find_protocol(name: str) -> Protocol:
    """Find an installed protocol; raise ConfigError naming the ones there are."""
    from importlib.metadata import entry_points

    for point in entry_points(group=GROUP, name=name):
        protocol = point.load()
        if isinstance(protocol, Protocol):
            return protocol
        raise ConfigError(f"protocol = {name!r}: {point.value} is no zbridge protocol")
    raise ConfigError(f"protocol = {name!r}: expected one of {', '.join(protocol_names()) or '(none installed)'}")
