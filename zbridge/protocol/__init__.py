"""What the author of a protocol imports.

Beside it :mod:`zbridge.wire` (messages as bytes) and :mod:`zbridge.fleet` (messages on the bus). Sans-IO: knows no
event loop, socket, clock, bus, and no robot in particular.

=============== ===================================================================================================
plugin          :class:`Protocol`: what an entry point names. :class:`RobotSide` and :class:`HqSide`: its sides, with
                :class:`Outcome`, :data:`Telemetry`, :data:`Translate` and :data:`Send`; :class:`RobotUser`: what a
                side may do for a client every ``ATTEND_S`` seconds.
                :class:`Simulation`, :class:`HqSimulation`: how its simulators are started; :class:`Truth`: what a
                simulated robot reports to the conformance kit. :class:`Codec`: the messages, for the kit;
                :class:`Example`: bytes from the maker's manual. :class:`Advice`: what ``zbridge doctor`` says.
session         :class:`Session`: one conversation, in a :class:`Role`, within :class:`Limits`, in a :class:`State`,
                with its :class:`Traffic`; a :class:`Datagram` is a frame that goes by UDP, and a session with
                :class:`SourceClaims` says which of them are its peer's.
liveness        :class:`KeepAlive`: what a session repeats so that the robot's watchdog lets it move. A session watches
                for the robot's silence itself (``Session.silent_s``, ``lost_s``).
session_table   :class:`ClientIds`: the ids that a robot gives its clients.
outbox          :class:`Outbox`: what a session still has to write; ``LIMIT`` frames may wait. ``KEEP_ALIVE``: the slot
                of a keep-alive.
handshake       :class:`Handshake`: executes the table of a handshake, with the time limit of each step.
                :func:`agree`, :func:`newest`, :func:`parse_versions`: which version both sides speak.
device_clock    :class:`DeviceClock`: when a device measured, by its own millisecond counter.
rate_limit      :class:`RateLimit`: how often something may happen.
exchange        :class:`ExchangeSession`, :class:`Exchange`: a session that asks, awaits the answer and polls.
kinematics      :class:`Differential`, :class:`Factors`: from drives to wheels, and back; :data:`Positive` for options.
                :class:`Odometry`: from the robot's own counters to a pose.
kept            :class:`Kept`: what survives a restart of the gateway, as :class:`Exported`; :class:`Form`, ``FRAME``,
                ``FRAMES`` for what no type describes; :class:`Spare`: what may be left out where it is large;
                :class:`Frame`: a frame of a kind of its own.
bearings        :class:`BearingScan`, :class:`Sectors`: from distance sensors to scans, and back.
errors          :class:`ProtocolError` for bytes that are no message, :class:`EncodeError` for values that no message
                can carry, :class:`ConfigError` for options; :class:`Refused` for commands: :class:`Unsupported`,
                :class:`NotReady` or :class:`Malformed`, each with a :class:`Code`.
address         :class:`Address`: where simulators listen.
samples         :class:`KeyedSample` of a :class:`SampleKind`: the frames of a protocol whose robots speak Zenoh
                (``Protocol.keyed``), of :data:`SAMPLE_BYTES` at most, with :func:`write_sample`, :func:`read_sample`,
                :func:`sample_end` and :func:`subscription`.
metrics         :class:`Metrics`, :class:`Count`: counters.
=============== ===================================================================================================
"""

from zbridge.errors import (
    Code,
    ConfigError,
    EncodeError,
    Malformed,
    NotReady,
    ProtocolError,
    Refused,
    Unsupported,
)
from zbridge.metrics import Count, Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.bearings import BearingScan, Sectors
from zbridge.protocol.device_clock import DeviceClock
from zbridge.protocol.exchange import Exchange, ExchangeSession
from zbridge.protocol.handshake import Handshake, agree, newest, parse_versions
from zbridge.protocol.kept import FRAME, FRAMES, Exported, Form, Frame, Kept, Spare
from zbridge.protocol.kinematics import Differential, Factors, Odometry, Positive
from zbridge.protocol.liveness import KeepAlive
from zbridge.protocol.outbox import KEEP_ALIVE, LIMIT, Outbox
from zbridge.protocol.plugin import (
    ATTEND_S,
    Advice,
    Codec,
    Example,
    HqSide,
    HqSimulation,
    Outcome,
    Protocol,
    RobotSide,
    RobotUser,
    Send,
    Simulation,
    Telemetry,
    Translate,
    Truth,
)
from zbridge.protocol.rate_limit import RateLimit
from zbridge.protocol.samples import (
    SAMPLE_BYTES,
    KeyedSample,
    SampleKind,
    read_sample,
    sample_end,
    subscription,
    write_sample,
)
from zbridge.protocol.session import Datagram, Limits, Role, Session, State, Traffic
from zbridge.protocol.session_table import ClientIds
from zbridge.protocol.traffic import SourceClaims

__all__ = [
    "ATTEND_S",
    "FRAME",
    "FRAMES",
    "KEEP_ALIVE",
    "LIMIT",
    "SAMPLE_BYTES",
    "Address",
    "Advice",
    "BearingScan",
    "ClientIds",
    "Code",
    "Codec",
    "ConfigError",
    "Count",
    "Datagram",
    "DeviceClock",
    "Differential",
    "EncodeError",
    "Example",
    "Exchange",
    "ExchangeSession",
    "Exported",
    "Factors",
    "Form",
    "Frame",
    "Handshake",
    "HqSide",
    "HqSimulation",
    "KeepAlive",
    "Kept",
    "KeyedSample",
    "Limits",
    "Malformed",
    "Metrics",
    "NotReady",
    "Odometry",
    "Outbox",
    "Outcome",
    "Positive",
    "Protocol",
    "ProtocolError",
    "RateLimit",
    "Refused",
    "RobotSide",
    "RobotUser",
    "Role",
    "SampleKind",
    "Sectors",
    "Send",
    "Session",
    "Simulation",
    "SourceClaims",
    "Spare",
    "State",
    "Telemetry",
    "Traffic",
    "Translate",
    "Truth",
    "Unsupported",
    "agree",
    "newest",
    "parse_versions",
    "read_sample",
    "sample_end",
    "subscription",
    "write_sample",
]
