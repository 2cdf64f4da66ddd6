"""Reads the configuration of one process: a TOML file, checked as a whole before anything starts.

Unknown keys are errors; ``${VAR}`` in a string is replaced from the environment. Knows no protocol: an ``options``
table is checked against the options that the named protocol declares. Every ConfigError names key, value and what was
expected.
"""

from __future__ import annotations

import ipaddress
import os
import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from zbridge.bus import BusSettings
from zbridge.control.settings import ControlSettings
from zbridge.errors import ConfigError, LinkError
from zbridge.fleet.topics import is_name
from zbridge.hq import HqSettings, ListenerPlan
from zbridge.hq.settings import Network
from zbridge.protocol.address import Address, DeviceAddress, parse_device_address
from zbridge.protocol.plugin import Protocol, find_protocol
from zbridge.robot.settings import DevicePlan, DeviceSettings

T = TypeVar("T")

_VARIABLE = re.compile(r"\$\{(\w+)\}")
_PATH = re.compile(r" - at `\$(?:\.(?P<path>[^`]+)|(?P<index>\[[^`]+))?`$")


class RobotSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[robot]``: the robot's name on the bus, and the first chunk of its keys."""

    name: str
    realm: str = "fleet"


class MetricsSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[metrics]``: host:port at which Prometheus reads the counters."""

    listen: str


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A whole configuration."""

    robot: RobotSettings
    device: DeviceSettings | None = None
    hq: tuple[HqSettings, ...] = ()
    bus: BusSettings = BusSettings()
    control: ControlSettings = ControlSettings()
    metrics: MetricsSettings | None = None


class Plan(msgspec.Struct, frozen=True):
    """A configuration with the protocols, options and addresses that it names: what a gateway starts from."""

    config: Config
    device: DevicePlan | None
    listeners: tuple[ListenerPlan, ...] = ()
    metrics: Address | None = None


def load(path: Path, environment: Mapping[str, str] = os.environ) -> Plan:
    """Read and check a configuration file; raise ConfigError, which names the file as well."""
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
    """Check a configuration given as a dict; raise ConfigError."""
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
    addresses = tuple(_device_address("device.connect", text) for text in settings.connect)
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


def _device_address(key: str, text: str) -> DeviceAddress:
    try:
        return parse_device_address(text)
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
    except ConfigError as error:  # options that contradict each other
        raise ConfigError(f"{prefix}{error}") from error


def _explain(raw: Any, kind: type[Any], text: str) -> str:
    """Rewrite msgspec's message as ``key = value: what was expected``."""
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
    """Return the declared type at a path of a configuration."""
    at = _plain_type(inspect.type_info(kind))
    for part in _parts(path):
        if isinstance(at, inspect.StructType):
            fields = {field.encode_name: field.type for field in at.fields}
            at = _plain_type(fields.get(part, inspect.AnyType()))
        elif isinstance(at, inspect.VarTupleType | inspect.ListType):
            at = _plain_type(at.item_type)
    return at


def _plain_type(at: inspect.Type) -> inspect.Type:
    """Return X for ``X | None``."""
    if isinstance(at, inspect.UnionType):
        types = [member for member in at.types if not isinstance(member, inspect.NoneType)]
        return types[0] if len(types) == 1 else at
    return at


def _field_names(at: inspect.Type) -> list[str]:
    return [field.encode_name for field in at.fields] if isinstance(at, inspect.StructType) else []
