"""Reads the configuration of one process: a TOML file, checked as a whole before anything starts.

Unknown keys are errors; ``${VAR}`` in a string is replaced from the environment. Knows no protocol: an ``options``
table is checked against the options that the named protocol declares. Every ConfigError names key, value and what was
expected.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from ssl import SSLContext
from typing import Any, Literal

import msgspec

from zbridge.blackbox.settings import BlackBoxSettings
from zbridge.bus import BusSettings
from zbridge.bus.tls.files import TLS_VARIABLE, folder_settings, tls_beside
from zbridge.camera.settings import CameraPlan, CameraSettings, plan_camera
from zbridge.control.settings import ControlSettings
from zbridge.errors import ConfigError, LinkError
from zbridge.fleet.topics import is_name
from zbridge.hq import HqSettings, ListenerPlan
from zbridge.protocol.address import Address, DatagramAddress, parse_port
from zbridge.protocol.networks import parse_networks
from zbridge.protocol.plugin import find_protocol
from zbridge.robot.settings import DevicePlan, DeviceSettings
from zbridge.toml import convert, parse_toml, prefixed, read_file, without_secrets
from zbridge.transport import server_context

_VARIABLE = re.compile(r"\$\{(\w+)\}")


class RobotSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[robot]``: the robot on the bus.

    name: of the robot. realm: the first chunk of its keys.
    """

    name: str
    realm: str = "fleet"


class MetricsSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[metrics]``: host:port at which Prometheus reads the metrics."""

    listen: str

    @property
    def address(self) -> Address:
        """The address; raise ConfigError if it is none."""
        try:
            return Address.parse(f"tcp://{self.listen}")
        except LinkError as error:
            raise ConfigError(f"metrics.listen = {self.listen!r}: expected host:port") from error


class LogSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[log]``: what the process writes to stderr.

    format: lines for people, or a JSON object a line. level: the least that is written.
    """

    format: Literal["console", "json"] | None = None
    level: Literal["debug", "info", "warning", "error"] | None = None

    def over(self, other: LogSettings | None) -> LogSettings:
        """Return these settings; where they say nothing, the other's."""
        return LogSettings(self.format or other.format, self.level or other.level) if other is not None else self


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A whole configuration."""

    robot: RobotSettings
    device: DeviceSettings | None = None
    hq: tuple[HqSettings, ...] = ()
    bus: BusSettings = BusSettings()
    control: ControlSettings = ControlSettings()
    metrics: MetricsSettings | None = None
    log: LogSettings = LogSettings()
    camera: CameraSettings | None = None
    blackbox: BlackBoxSettings | None = None


class GatewayPlan(msgspec.Struct, frozen=True):
    """A configuration with the protocols, options and addresses that it names: what a gateway starts from.

    written: the configuration as it was written, without secrets: ``${VAR}`` is not replaced.
    """

    config: Config
    device: DevicePlan | None
    listeners: tuple[ListenerPlan, ...] = ()
    metrics: Address | None = None
    camera: CameraPlan | None = None
    written: dict[str, Any] = {}

    @property
    def described(self) -> str:
        """What it would run, for people: robot, its address, camera, listeners, part on the bus."""
        robot, parts = self.config.robot, list[str]()
        if self.device is not None:
            parts.append(f"{self.device.protocol.name} at {', '.join(map(str, self.device.addresses))}")
        if self.camera is not None:
            relayed = f", relayed at {self.camera.relay}" if self.camera.relay is not None else ""
            parts.append(f"camera at {self.camera.source}{relayed}")
        parts += [f"{listener.protocol.name} HQ programs at {listener.address}" for listener in self.listeners]
        return ", ".join([f"{robot.realm}/{robot.name}", *parts, f"bus as {self.config.bus.effective_mode}"])

    @property
    def setup(self) -> dict[str, Any]:
        """What a gateway and its successor must have in common, by key, as MessagePack reads it back."""
        config = self.config
        parts: dict[str, Any] = {"robot": config.robot, "device": config.device}
        parts |= {f"hq[{number}]": [each.protocol, each.listen, each.options] for number, each in enumerate(config.hq)}
        common: dict[str, Any] = msgspec.msgpack.decode(msgspec.msgpack.encode(parts))
        return common


def load(
    path: Path,
    environment: Mapping[str, str] = os.environ,
    *,
    tls: Path | None = None,
    content: bytes | None = None,
) -> GatewayPlan:
    """Read and check a configuration file; raise ConfigError, which names the file as well.

    tls, or ``ZBRIDGE_TLS``: a folder made by ``zbridge certs bundle``, for a file without ``bus.tls``. Paths
    in ``bus.tls`` are relative to the file. content: of the file, if it was read already.
    """
    raw = parse_toml(path, read_file(path, waits=True) if content is None else content)
    try:
        with prefixed(f"{path}: "):
            planned = plan(raw, environment)
            bus = _secured(planned.config.bus, path.absolute().parent, tls, environment.get(TLS_VARIABLE))
    except RecursionError as error:
        raise ConfigError(f"{path}: nested too deeply") from error
    return msgspec.structs.replace(planned, config=msgspec.structs.replace(planned.config, bus=bus))


def _secured(bus: BusSettings, beside: Path, tls: Path | None, variable: str | None) -> BusSettings:
    """Return the settings with the files of TLS, if there are any."""
    if bus.tls is not None:
        if tls is not None:
            raise ConfigError(f"--tls {tls}: expected only for a file without bus.tls")
        return msgspec.structs.replace(bus, tls=tls_beside(bus.tls, beside))
    folder = tls or (Path(variable) if variable else None)
    if folder is None:
        return bus
    given = folder_settings(folder, bus.connect)
    return msgspec.structs.replace(bus, connect=given.connect, tls=given.tls)


def plan(raw: dict[str, Any], environment: Mapping[str, str] = os.environ) -> GatewayPlan:
    """Check a configuration given as a dict; raise ConfigError."""
    written = without_secrets(raw)
    raw = _substituted(raw, environment, "")
    config = convert(raw, Config, "")
    for key, name in (("robot.name", config.robot.name), ("robot.realm", config.robot.realm)):
        if not is_name(name):
            raise ConfigError(f"{key} = {name!r}: expected letters, digits, '_', '.' and '-' only")
    if config.device is None and not config.hq:
        raise ConfigError("device: missing, it is required without [[hq]]")
    device = _device(config.device) if config.device is not None else None
    listeners = tuple(_listener(settings, f"hq[{number}]") for number, settings in enumerate(config.hq))
    names = [settings.name for settings in config.hq]
    for number, own in enumerate(names):
        if own is not None and names.count(own) > 1:
            raise ConfigError(f"hq[{number}].name = {own!r}: expected a name of its own")
    ports = [msgspec.structs.replace(listener.address, tls=False) for listener in listeners]
    for number, at in enumerate(ports):
        if at.port and ports.count(at) > 1:
            raise ConfigError(f"hq[{number}].listen = {config.hq[number].listen!r}: expected an address of its own")
    metrics = config.metrics.address if config.metrics is not None else None
    camera = plan_camera(config.camera) if config.camera is not None else None
    if camera is not None and device is None:
        raise ConfigError("camera: expected only with a table device")
    if config.blackbox is not None and device is None:
        raise ConfigError("blackbox: expected only with a table device")
    return GatewayPlan(config, device, listeners, metrics, camera, written)


def _device(settings: DeviceSettings) -> DevicePlan:
    with prefixed("device."):
        protocol = find_protocol(settings.protocol)
    options = convert(settings.options, protocol.options, "device.options.")
    with prefixed("device.connect = ", LinkError):
        addresses = tuple(map(protocol.device_address, settings.connect))
    if len(addresses) > protocol.links:
        raise ConfigError(
            f"device.connect = {list(settings.connect)}: a {protocol.name} robot has at most {protocol.links} link"
            f"{'s' if protocol.links > 1 else ''}"
        )
    return DevicePlan(protocol, options, addresses, settings.allow_shared_address or protocol.keyed)


def _listener(settings: HqSettings, key: str) -> ListenerPlan:
    with prefixed(f"{key}."):
        protocol = find_protocol(settings.protocol)
    if protocol.hq is None:
        raise ConfigError(f"{key}.protocol = {settings.protocol!r}: serves no HQ programs")
    if settings.name is not None and not is_name(settings.name):
        raise ConfigError(f"{key}.name = {settings.name!r}: expected letters, digits, '_', '.' and '-' only")
    options = convert(settings.options, protocol.hq_options, f"{key}.options.")
    allow = parse_networks(f"{key}.allow", settings.allow)
    with prefixed(f"{key}.listen = ", LinkError):
        tls = settings.listen.startswith("tls://")
        address = Address.parse_listener(settings.listen) if tls else protocol.port(settings.listen)
    if settings.to and not isinstance(address, DatagramAddress):
        raise ConfigError(f"{key}.to = {list(settings.to)}: expected only with listen = 'udp://host:port'")
    with prefixed(f"{key}.to = ", LinkError):
        to = tuple(parse_port(each, ("udp",)) for each in settings.to)
    return ListenerPlan(protocol, options, address, settings, allow, _listener_tls(key, settings, address), to)


def _listener_tls(key: str, settings: HqSettings, address: Address) -> SSLContext | None:
    """Read the files of a listener at ``tls://``."""
    tls = settings.tls
    if tls is None and address.tls:
        raise ConfigError(f"{key}.tls: missing, it is required with listen = {settings.listen!r}")
    if tls is None:
        return None
    if not address.tls:
        raise ConfigError(f"{key}.listen = {settings.listen!r}: expected tls://host:port, because there is a table tls")
    with prefixed(f"{key}.tls: ", LinkError):
        return server_context(tls.certificate, tls.key, tls.ca)


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
