"""What a protocol contributes, and how the installed protocols are found. Sans-IO.

A package adds a protocol by an entry point in the group ``zbridge.protocols`` that names its :class:`Protocol`.
"""

from __future__ import annotations

import math
import operator
import typing
from abc import ABC, abstractmethod
from collections.abc import Callable, Coroutine, Iterable, Sequence
from importlib import import_module
from typing import Any, ClassVar

import msgspec

from zbridge.errors import ConfigError, NotReady, Unsupported, describe
from zbridge.fleet.messages import Drive, FleetMessage, Motor
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address, DeviceAddress, ZenohAddress, parse_device_address, parse_port
from zbridge.protocol.entry_points import entry_points, find_entry_point
from zbridge.protocol.kept import Kept
from zbridge.protocol.session import Limits, Session, State
from zbridge.protocol.session_table import ClientIds
from zbridge.protocol.trial import Codec as Codec
from zbridge.protocol.trial import Example as Example
from zbridge.protocol.trial import HqSimulation as HqSimulation
from zbridge.protocol.trial import Simulation as Simulation
from zbridge.protocol.trial import Truth as Truth

GROUP = "zbridge.protocols"

Telemetry = tuple[Topic, FleetMessage]
Translate = Callable[[Any, int], Iterable[Telemetry]]
"""``translate(message, stamp_ns)``: one message to telemetry; raises ProtocolError for a message without meaning."""


class Outcome(msgspec.Struct, frozen=True):
    """The outcome of a command: telemetry to publish, and which part of the command the robot cannot do, in words."""

    telemetry: tuple[Telemetry, ...] = ()
    left_out: str | None = None


class RobotSide(Kept, ABC):
    """One robot as its protocol sees it: makes the sessions of its links, and translates both ways. Sans-IO.

    Commands are put into the outboxes of the sessions that this object made. The time is an argument.
    """

    dialect: ClassVar[str | None] = None
    hands_over: ClassVar[bool] = False
    """Whether this class and its sessions name in ``kept`` all that they must not lose when the gateway restarts."""
    closing_harmless: ClassVar[bool] = False
    """Whether a robot with two connections obeys one as before when the other is closed; most legacy ones do not."""
    link_names: tuple[str, ...]
    """One name for each configured address, in the order of the configuration; the first link drives the robot."""
    driving: Session[Any] | None = None
    """The session that takes drive commands; None before the first connection."""

    @abstractmethod
    def session(self, link: str, peer: str) -> Session[Any]:
        """Make the session for a new connection of the link of this name; ``peer``: its address, for logs."""

    @abstractmethod
    def translator(self, kind: type) -> Translate:
        """Return the function that translates messages of one class; asked once for each class."""

    def telemetry(self, message: Any, stamp_ns: int) -> Iterable[Telemetry]:
        """Translate one message of the robot; raise ProtocolError if it has no meaning."""
        return self.translator(type(message))(message, stamp_ns)

    @abstractmethod
    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        """Send a command to the robot; raise Refused with the reason if the robot cannot take it."""

    @property
    def accepts(self) -> tuple[str, ...]:
        """The commands besides ``stop`` that the robot accepts in its present session, as their keys name them.

        Those of motors, sensors and raw messages are ``motor``, ``sensor`` and ``raw``, without the name behind.
        """
        return ("drive",)

    @abstractmethod
    def stop(self, now: float, until: float) -> None:
        """Send the robot its stop before anything else, and repeat it until ``until``; once if ``until`` is ``now``."""

    def rest(self, now: float, until: float) -> None:
        """Stop the robot although nobody ordered it: see :meth:`stop`, which is called unless this is overridden.

        Called while nobody drives, for a new connection, and when motion ends by itself: the driver is silent or lost,
        the robot is not ready. Override for a robot that others may drive too: leave it alone once they do.
        """
        self.stop(now, until)

    def was_autonomous(self) -> None:
        """Record that the robot was ordered to move by itself, perhaps by another gateway: stops must end that too.

        Called once that is known, even before the first session. Override if a stop alone does not end it.
        """
        return

    @property
    def idle_stop_s(self) -> float:
        """Most seconds between two stops while nobody drives; ``inf``: as the configuration says."""
        return math.inf

    def stop_frames(self) -> tuple[bytes, ...]:
        """Return the frames of a stop as the driving session would write them now; change nothing.

        The supervisor writes them if this process dies. Empty: nobody can stop the robot then.
        """
        return ()

    @abstractmethod
    def ask(self, topic: Topic) -> None:
        """Request from the robot what it publishes on ``topic``; raise Refused if that is not possible."""

    def known(self, topic: Topic) -> FleetMessage | None:
        """Return the answer to a query for ``topic`` that is known already; None: :meth:`ask` the robot."""
        return None

    @property
    def on_demand(self) -> tuple[Topic, ...]:
        """Topics that the robot measures only while somebody subscribes; see :meth:`listened`."""
        return ()

    def listened(self, topic: Topic, on: bool) -> None:
        """Switch an on-demand topic: the first subscriber appeared (``on``), or the last one left. Raise Refused."""
        raise Unsupported(f"{topic.path} needs no listener")

    def leased(self, on: bool, now: float) -> None:
        """Prepare the robot for a driver (``on``), or put it to rest, as by switching its motors. Raise Refused.

        Called when a program takes the lease, when nobody has it any more (the stop goes first), and after each
        connection is established, with what holds then. A lease that passes from one program to another changes
        nothing. Use a slot of its own, due at ``-inf``: it leaves behind stops and before motion, and an "on" that
        follows replaces an "off" that still waits.
        """
        return

    def begun(self, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Start with a newly established connection; return the telemetry that is known at once."""
        return ()

    def connected(self) -> Session[Any]:
        """Return the session that takes commands, once it is established; raise NotReady before."""
        session = self.driving
        if session is None or session.state is not State.ESTABLISHED:
            raise NotReady("offline")
        return session

    @property
    def ready(self) -> bool:
        """Whether the robot takes commands now."""
        session = self.driving
        return session is not None and session.state is State.ESTABLISHED and session.busy is None


Send = Callable[[Any, float], object]
"""``send(session, now)``: puts encoded frames into the outbox of one client's session; raises Refused."""


ATTEND_S = 0.1
"""Seconds between two calls of :meth:`HqSide.attend`."""


class RobotUser(typing.Protocol):
    """A client that holds the robot, as :meth:`HqSide.attend` sees it."""

    @property
    def silent_s(self) -> float:
        """Seconds for which the client's machine has not acknowledged anything."""

    def repeat(self) -> None:
        """Send the robot the client's motion again, unless neutral is needed."""

    def let_go(self, why: str) -> None:
        """Release the robot; the client must send neutral before it drives again."""


class HqSide(Kept, ABC):
    """Shows a robot to the HQ programs (clients) of one listener, and translates what they send. Sans-IO.

    Made with the listener's options and the :class:`RobotView` that all listeners of a process share. :meth:`show`
    encodes once what goes to many clients.
    """

    name: ClassVar[str]
    """The protocol's name. Clients get the raw messages of a robot of the same protocol too."""
    deadman_s: ClassVar[float]
    """Seconds after which the motion of a silent client ends."""
    hands_over: ClassVar[bool] = False
    """Whether this class and its sessions name in ``kept`` all that they must not lose when the gateway restarts."""
    datagrams: bool = False
    """Whether clients send datagrams too."""
    follows: tuple[str, ...]
    """Paths (``pose``, ``sensor/*``, ``control``) whose messages :meth:`show` gets; it gets ``status`` too."""

    @abstractmethod
    def session(self, number: int, bounds: Limits) -> Session[Any]:
        """Make the session of a new client; replace in ``bounds`` what the protocol itself fixes."""

    @abstractmethod
    def begin(self, session: Any, now: float) -> None:
        """Send a client its first messages: its session was just established."""

    @abstractmethod
    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        """Translate news of the robot; None: no client is notified."""

    @abstractmethod
    def take(self, session: Any, message: Any) -> Iterable[Telemetry]:
        """Translate a client's message to commands and queries; raise ProtocolError if it has no meaning."""

    def answer(self, session: Any, topic: Topic, message: FleetMessage | None, now: float) -> None:
        """Answer a client's query; ``message`` None: the robot gave no answer. Raise Refused, EncodeError."""
        raise Unsupported(f"{topic.path} cannot be queried")

    def tell(self, session: Any, text: str, now: float) -> None:
        """Show a text to the people at a client, if the protocol can."""
        return

    def not_driving(self, session: Any, now: float) -> None:
        """Show a client that it does not drive, as :meth:`tell` explains: refused motion, or a lease that has ended."""
        return

    def presence(self, there: bool) -> Send | None:
        """Show that the robot is present, or lost; None: no client is notified."""
        return None

    def deadline(self, session: Any) -> float:
        """Return the time of the next :meth:`expire` for a client; ``inf``: never."""
        return math.inf

    def expire(self, session: Any, now: float) -> Iterable[Telemetry]:
        """Translate messages of a client that waited for a deadline."""
        return ()

    def wanted(self) -> tuple[Topic, ...]:
        """List the topics that clients want now besides ``follows``."""
        return ()

    def numbers(self, clients: int) -> ClientIds:
        """Make the source of client numbers, at most ``clients`` at a time; 1 and up unless overridden."""
        return ClientIds(range(1, clients + 1), quiet_s=0.0)

    def initial_commands(self) -> tuple[Telemetry, ...]:
        """List the commands that a client counts as having sent when it connects."""
        return ()

    def is_motion(self, command: Drive | Motor) -> bool:
        """Return whether a command of this protocol's programs is motion, False for neutral.

        A neutral that still sets something (wheels) is carried out only for the program that drives the robot.
        """
        return command.moving

    def attend(self, client: RobotUser) -> None:
        """Attend to a client that holds the robot; called every :data:`ATTEND_S`.

        Legacy programs repeat their motion, or the deadman ends it. For those that set it once, override this.
        """
        return


class Advice(msgspec.Struct, frozen=True):
    """What is wrong with a robot, as its protocol knows it. code: for programs; text, remedy: for people.

    sign: a part of the reason that this protocol's own sessions give for it.
    """

    sign: str
    code: str
    text: str
    remedy: str


class _NoOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    pass


class Protocol(msgspec.Struct, frozen=True):
    """A protocol: its name, its options, and how its sides and simulators are made."""

    name: str
    summary: str
    options: type[msgspec.Struct]
    """``[device.options]``."""
    links: int
    """Most links of a robot."""
    robot: Callable[[Any, int, Metrics], RobotSide]
    """``robot(options, links, metrics)``: the robot side, for ``links`` links (1 to ``Protocol.links``)."""
    simulate: Callable[[Simulation], Coroutine[Any, Any, None]]
    """Run a simulated robot until cancelled."""
    simulated: dict[str, Any] = {}
    """Options that fit the simulated robot; empty: the defaults fit."""
    hq: Callable[[Any, RobotView, Metrics], HqSide] | None = None
    """``hq(options, view, metrics)``: the HQ side; None: the protocol has no listeners."""
    hq_options: type[msgspec.Struct] = _NoOptions
    """``[hq.options]``."""
    simulate_hq: Callable[[HqSimulation], Coroutine[Any, Any, None]] | None = None
    """Run a simulated HQ program until cancelled, or until it gives up."""
    template: str = ""
    """The commented ``[device]`` and ``[device.options]`` tables of a configuration."""
    codecs: tuple[Codec, ...] = ()
    """The messages, for the conformance kit."""
    hq_template: str = ""
    """The lines of a commented ``[[hq]]`` table: ``protocol``, ``listen`` and ``[hq.options]``."""
    keyed: bool = False
    """Whether its robots speak Zenoh: a link is a Zenoh session of its own, and its frames are those of
    :mod:`zbridge.protocol.samples`."""
    datagrams: bool = False
    """Whether its robots and HQ programs may be connected by datagrams alone: a datagram holds whole frames."""
    requires: tuple[str, ...] = ()
    """Modules that its robots need beyond what zbridge itself does; an extra installs them."""
    advice: tuple[Advice, ...] = ()
    """What its robots are known to suffer from, for ``zbridge doctor``."""
    examples: tuple[Example, ...] = ()
    """Bytes from the maker's manual, for the conformance kit."""
    plausible: dict[str, tuple[float, float]] = {}
    """The least and the most that a healthy robot shows of a number, by path and field, in the bus's units:
    ``{"battery.voltage": (9.0, 15.0), "sensor/sonar*.value": (0.0, 5.0)}``; ``*`` stands for anything."""

    def advise(self, reasons: Sequence[str]) -> tuple[Advice, ...]:
        """Return what is wrong with a robot. reasons: what ``status`` says, and why its last session ended."""
        return tuple(each for each in self.advice if any(each.sign in reason for reason in reasons))

    def device_address(self, text: str) -> DeviceAddress:
        """Read the address of a robot of this protocol; raise LinkError that names what was expected."""
        if not self.keyed:
            return parse_device_address(text, ("tcp", "udp", "udp-in") if self.datagrams else ("tcp",))
        router = Address.parse(text)
        return ZenohAddress(router.host, router.port)

    def port(self, text: str) -> Address:
        """Read where a listener or a simulated robot of this protocol is; raise LinkError."""
        return parse_port(text, ("tcp", "udp")) if self.datagrams else Address.parse(text)


def protocol_names() -> tuple[str, ...]:
    """List the installed protocols, those that cannot be loaded too."""
    return tuple(sorted({point.name for point in entry_points(GROUP)}))


def find_protocol(name: str) -> Protocol:
    """Find an installed protocol; raise ConfigError that lists the installed ones, or says why it fails to load."""
    where = find_entry_point(GROUP, name)
    if where is None:
        raise ConfigError(f"protocol = {name!r}: expected one of {', '.join(protocol_names()) or '(none installed)'}")
    module, _, attributes = where.partition(":")
    try:
        protocol = operator.attrgetter(attributes)(import_module(module))
    except (Exception, SystemExit) as error:  # of a foreign package: it must not affect other protocols
        raise ConfigError(f"protocol = {name!r}: {where} cannot be loaded: {describe(error)}") from error
    if isinstance(protocol, Protocol):
        return protocol
    raise ConfigError(f"protocol = {name!r}: {where} is no zbridge protocol")
