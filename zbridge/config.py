"""The configuration of one process: a TOML file, checked whole before anything starts.

Unknown keys are errors; ``${VAR}`` in a string is taken from the environment. Knows no protocol: the
``options`` tables are checked against what the named protocol declares.
"""

from __future__ import annotations

import ipaddress
import os
import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import inspect

from zbridge.bus import BusSettings
from zbridge.errors import ConfigError, LinkError
from zbridge.fleet.topics import is_name
from zbridge.link import Address
from zbridge.protocol import Protocol, find_protocol

T = TypeVar("T")
Seconds = Annotated[float, msgspec.Meta(gt=0, le=3600)]

LEAST_IDLE_STOP_S = 0.1

Network = ipaddress.IPv4Network | ipaddress.IPv6Network

_VARIABLE = re.compile(r"\$\{(\w+)\}")
_PATH = re.compile(r" - at `\$(?:\.(?P<path>[^`]+)|(?P<index>\[[^`]+))?`$")


METRICS_TEMPLATE = """\
# [metrics]
# listen = "127.0.0.1:9100"             # counters for Prometheus
"""
LISTENER_TEMPLATE = """\
# name = "desk"                         # of the listener on the bus; left out: made of its protocol and the process
clients = 256                           # most at a time; one more is turned away
accept_hz = 20.0                        # connections a second of one address; what is more is closed at once
handshake_s = 5.0                       # what a client has for its handshake
# idle_s = 60.0                         # close clients that say nothing for so long; left out: they may be silent
rate_hz = 1000.0                        # messages a second of one client; one that sends more is closed
allow = []                              # networks that clients may come from, ["192.168.1.0/24"]; empty: all

"""
ROBOT_TEMPLATE = """\
[robot]
name = "{name}"                         # its keys begin with fleet/{name}/
realm = "fleet"

"""
BUS_TEMPLATE = """\
[bus]
mode = "peer"                           # peer, client, router (embedded); client when only connect is given
connect = []                            # for example ["tcp/127.0.0.1:7447"]
listen = []
multicast = true                        # find peers on the local network
stream = "drop"                         # "block": lose nothing when the bus is slower than the robot

"""
COMMON_TEMPLATE = (
    """\
# [[hq]]                                # HQ programs connect here as if this were the robot, any number of them;
# protocol = "alf"                      # zbridge init --hq PROTOCOL prints all there is to set
# listen = "tcp://127.0.0.1:6667"

"""
    + BUS_TEMPLATE
    + """\
[control]
lease_s = 3.0                           # the most a holder may ask for: a lease not renewed for so long ends
deadman_s = 2.0                         # the most a holder may ask for: motion without a fresh command ends
# rate_hz = 50.0                        # drives a second that are carried out, the others are refused
# slew_per_s = 2.0                      # how fast a drive may grow, full scales a second; braking is never slowed
idle_stop_s = 1.0                       # a stop so often while nobody drives: it may lose those that end motion;
                                        # 0: only when motion ends
audit = "{name}.audit.jsonl"                # who drove, was refused, stopped it: a file in the working directory,
audit_bytes = 1000000                   # rotated at this size,
audit_files = 5                         # with so many older ones kept,
audit_days = 30.0                       # and more of them, up to 20 times as many, that are younger than this

"""
    + METRICS_TEMPLATE
)
"""The part of a commented configuration that all protocols share."""


def listener_template(hq_template: str) -> str:
    """Write the commented configuration of a process that serves HQ programs of a robot and has none of its own."""
    head = "# A listener for HQ programs of one robot. Start it with: zbridge run FILE\n\n"
    return f"{head}{ROBOT_TEMPLATE}[[hq]]\n{hq_template}\n{BUS_TEMPLATE}{METRICS_TEMPLATE}"


class RobotSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[robot]``: how the robot is named on the bus."""

    name: str
    realm: str = "fleet"


class DeviceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[device]``: the robot itself. ``connect`` has one address for each of its links."""

    protocol: str
    connect: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
    options: dict[str, Any] = {}


class HqSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One ``[[hq]]``: where HQ programs of one protocol connect as if this were the robot, and what bounds them.

    name: of the listener on the bus, the protocol's and this process's where left out. clients: most at a time.
    accept_hz: connections a second that are taken from one address. handshake_s, idle_s: seconds a client has for its
    handshake, and may be silent (None: for ever). rate_hz: messages a second of one client. allow: networks clients may
    come from, all where empty.
    """

    protocol: str
    listen: str
    name: Annotated[str, msgspec.Meta(max_length=40)] | None = None
    options: dict[str, Any] = {}
    clients: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 256
    accept_hz: Annotated[float, msgspec.Meta(ge=0.1, le=1e5)] = 20.0
    handshake_s: Seconds = 5.0
    idle_s: Seconds | None = None
    rate_hz: Annotated[float, msgspec.Meta(ge=1, le=1e6)] = 1000.0
    allow: tuple[str, ...] = ()


class ControlSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[control]``: the most a holder may ask for in seconds, limits on motion, and the audit log.

    rate_hz: drives a second that are carried out. slew_per_s: change of each part of a drive, full scales a second.
    idle_stop_s: seconds between two stops while nobody drives; 0: only when motion ends.
    audit: the file of the audit log, rotated at ``audit_bytes``, with ``audit_files`` older ones kept, and more of them
    that are younger than ``audit_days``.
    """

    lease_s: Seconds = 3.0
    deadman_s: Seconds = 2.0
    idle_stop_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 1.0
    rate_hz: Annotated[float, msgspec.Meta(gt=0)] | None = None
    slew_per_s: Annotated[float, msgspec.Meta(gt=0)] | None = None
    audit: Annotated[str, msgspec.Meta(min_length=1)] | None = None
    audit_bytes: Annotated[int, msgspec.Meta(ge=1000)] = 1_000_000
    audit_files: Annotated[int, msgspec.Meta(ge=1)] = 5
    audit_days: Annotated[float, msgspec.Meta(ge=0)] = 30.0

    def __post_init__(self) -> None:
        """Raise ValueError for a stop that would come more often than robots can take."""
        if 0 < self.idle_stop_s < LEAST_IDLE_STOP_S:
            raise ValueError(f"idle_stop_s: expected 0, or at least {LEAST_IDLE_STOP_S:g}")


class MetricsSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[metrics]``: where Prometheus finds the counters."""

    listen: str


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A whole configuration."""

    robot: RobotSettings
    device: DeviceSettings | None = None
    hq: tuple[HqSettings, ...] = ()
    bus: BusSettings = BusSettings()
    control: ControlSettings = ControlSettings()
    metrics: MetricsSettings | None = None


class DevicePlan(msgspec.Struct, frozen=True):
    """The device side: its protocol, the protocol's options, an address for each link."""

    protocol: Protocol
    options: Any
    addresses: tuple[Address, ...]


class ListenerPlan(msgspec.Struct, frozen=True):
    """One listener for HQ programs."""

    protocol: Protocol
    options: Any
    address: Address
    settings: HqSettings
    allow: tuple[Network, ...]


class Plan(msgspec.Struct, frozen=True):
    """A configuration with everything its names refer to: what a gateway is started from."""

    config: Config
    device: DevicePlan | None
    listeners: tuple[ListenerPlan, ...] = ()
    metrics: Address | None = None


def load(path: Path, environment: Mapping[str, str] = os.environ) -> Plan:
    """Read and check a configuration file; raise ConfigError naming file, key, value and what was expected."""
    try:
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from error
    try:
        return plan(raw, environment)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def plan(raw: dict[str, Any], environment: Mapping[str, str] = os.environ) -> Plan:
    """Check a configuration given as a plain map; raise ConfigError naming key, value and what was expected."""
    raw = _substituted(raw, environment, "")
    config = _convert(raw, Config, "")
    for key, name in (("robot.name", config.robot.name), ("robot.realm", config.robot.realm)):
        if not is_name(name):
            raise ConfigError(f"{key} = {name!r}: expected letters, digits, '_', '.' and '-' only")
    if config.device is None and not config.hq:
        raise ConfigError("device: missing, it is required where there is no [[hq]]")
    device = _device(config.device) if config.device is not None else None
    listeners = tuple(_listener(settings, f"hq[{number}]") for number, settings in enumerate(config.hq))
    named = Counter(settings.name for settings in config.hq if settings.name is not None)
    for number, settings in enumerate(config.hq):
        if settings.name is not None and named[settings.name] > 1:
            raise ConfigError(f"hq[{number}].name = {settings.name!r}: expected a name of its own")
    taken = Counter(listener.address for listener in listeners if listener.address.port)
    for number, listener in enumerate(listeners):
        if taken[listener.address] > 1:
            raise ConfigError(f"hq[{number}].listen = {config.hq[number].listen!r}: expected an address of its own")
    metrics = _metrics_address(config.metrics.listen) if config.metrics else None
    return Plan(config, device, listeners, metrics)


def _device(settings: DeviceSettings) -> DevicePlan:
    protocol = _protocol("device.", settings.protocol)
    options = _convert(settings.options, protocol.options, "device.options.")
    addresses = tuple(_address("device.connect", text) for text in settings.connect)
    if len(addresses) > protocol.links:
        raise ConfigError(
            f"device.connect = {list(settings.connect)}: a {protocol.name} robot has at most {protocol.links} link"
            f"{'s' if protocol.links > 1 else ''}"
        )
    return DevicePlan(protocol, options, addresses)


def _listener(settings: HqSettings, key: str) -> ListenerPlan:
    protocol = _protocol(f"{key}.", settings.protocol)
    if protocol.hq is None:
        raise ConfigError(f"{key}.protocol = {settings.protocol!r}: serves no HQ programs")
    if settings.name is not None and not is_name(settings.name):
        raise ConfigError(f"{key}.name = {settings.name!r}: expected letters, digits, '_', '.' and '-' only")
    options = _convert(settings.options, protocol.hq_options, f"{key}.options.")
    allow = tuple(_network(f"{key}.allow[{number}]", text) for number, text in enumerate(settings.allow))
    return ListenerPlan(protocol, options, _address(f"{key}.listen", settings.listen), settings, allow)


def _protocol(prefix: str, name: str) -> Protocol:
    try:
        return find_protocol(name)
    except ConfigError as error:
        raise ConfigError(f"{prefix}{error}") from error


def _network(key: str, text: str) -> Network:
    try:
        return ipaddress.ip_network(text)
    except ValueError as error:
        raise ConfigError(f"{key} = {text!r}: expected a network like '192.168.1.0/24': {error}") from error


def _address(key: str, text: str) -> Address:
    try:
        return Address.parse(text)
    except LinkError as error:
        raise ConfigError(f"{key} = {error}") from error


def _metrics_address(text: str) -> Address:
    try:
        return Address.parse(f"tcp://{text}")
    except LinkError as error:
        raise ConfigError(f"metrics.listen = {text!r}: expected host:port") from error


def _substituted(value: Any, environment: Mapping[str, str], key: str) -> Any:
    if isinstance(value, dict):
        return {name: _substituted(item, environment, f"{key}.{name}" if key else name) for name, item in value.items()}
    if isinstance(value, list):
        return [_substituted(item, environment, f"{key}[{index}]") for index, item in enumerate(value)]
    if isinstance(value, str):
        return _VARIABLE.sub(lambda match: _variable(match.group(1), environment, key, value), value)
    return value


def _variable(name: str, environment: Mapping[str, str], key: str, text: str) -> str:
    if name not in environment:
        raise ConfigError(f"{key} = {text!r}: expected the environment variable {name} to be set")
    return environment[name]


def _convert(raw: Any, kind: type[T], prefix: str) -> T:
    try:
        return msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        raise ConfigError(prefix + _explain(raw, kind, str(error))) from error
    except ConfigError as error:  # what cannot go together
        raise ConfigError(f"{prefix}{error}") from error


def _explain(raw: Any, kind: type[Any], text: str) -> str:
    """Turn msgspec's message into ``key = value: what was expected``."""
    match = _PATH.search(text)
    path = (match["path"] or match["index"] or "") if match else ""
    what = text[: match.start()] if match else text
    if unknown := re.match(r"Object contains unknown field `(.+)`", what):
        known = ", ".join(_field_names(_type_at(kind, path)))
        key = f"{path}.{unknown[1]}" if path else unknown[1]
        return f"{key} = {_value(raw, key)!r}: unknown key; expected one of {known}"
    if missing := re.match(r"Object missing required field `(.+)`", what):
        return f"{path}.{missing[1]}: missing, it is required" if path else f"{missing[1]}: missing, it is required"
    if what.startswith("Invalid enum value"):
        at = _type_at(kind, path)
        members = at.types if isinstance(at, inspect.UnionType) else (at,)
        literals = [value for member in members if isinstance(member, inspect.LiteralType) for value in member.values]
        what = f"expected one of {', '.join(map(repr, literals))}"
    return f"{path} = {_value(raw, path)!r}: {what[:1].lower()}{what[1:]}"


def _parts(path: str) -> list[str]:
    return re.findall(r"[^.\[\]]+", path)


def _value(raw: Any, path: str) -> Any:
    for part in _parts(path):
        try:
            raw = raw[int(part)] if isinstance(raw, list) else raw[part]
        except (KeyError, IndexError, TypeError, ValueError):
            return None
    return raw


def _type_at(kind: type[Any], path: str) -> inspect.Type:
    """Find the type that a path of a configuration is declared with."""
    at = _plain_type(inspect.type_info(kind))
    for part in _parts(path):
        if isinstance(at, inspect.StructType):
            fields = {field.encode_name: field.type for field in at.fields}
            at = _plain_type(fields.get(part, inspect.AnyType()))
        elif isinstance(at, inspect.VarTupleType | inspect.ListType):
            at = _plain_type(at.item_type)
    return at


def _plain_type(at: inspect.Type) -> inspect.Type:
    """Look through ``X | None``."""
    if isinstance(at, inspect.UnionType):
        types = [member for member in at.types if not isinstance(member, inspect.NoneType)]
        return types[0] if len(types) == 1 else at
    return at


def _field_names(at: inspect.Type) -> list[str]:
    return [field.encode_name for field in at.fields] if isinstance(at, inspect.StructType) else []
