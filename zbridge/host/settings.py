"""A directory of robot files, one gateway each, and ``host.toml`` beside them: how their gateways run on this host.

Unknown keys are errors. Every ConfigError names file, key, value and what was expected.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import msgspec

from zbridge.app.config import GatewayPlan, LogSettings, MetricsSettings
from zbridge.blackbox import BlackBoxSettings
from zbridge.errors import ConfigError
from zbridge.host.addresses import Addresses, resolve
from zbridge.toml import FILE_BYTES, prefixed, read_struct

HOST_FILE = "host.toml"
"""The file of a directory that is no robot's."""


class HostSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[host]``.

    together: all robots in one process and one session on the bus. stagger_s: seconds between the starts of two
    gateways, with jitter. share: the part of a processor that one robot of a shared process may use for long.
    file_bytes: of the largest robot file that is read.
    """

    together: bool = False
    stagger_s: Annotated[float, msgspec.Meta(ge=0.0, le=60.0)] = 0.02
    share: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.1
    file_bytes: Annotated[int, msgspec.Meta(ge=1000, le=100_000_000)] = FILE_BYTES


class HostFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``host.toml``.

    metrics: of all gateways. log: of the supervisor, and of gateways whose files have no table. blackbox: of gateways
    whose files have no table.
    """

    host: HostSettings = HostSettings()
    log: LogSettings = LogSettings()
    metrics: MetricsSettings | None = None
    blackbox: BlackBoxSettings | None = None


def load_host(directory: Path) -> HostFile:
    """Read ``host.toml`` of a directory; the defaults where there is none. Raises ConfigError, which names the file."""
    path = directory / HOST_FILE
    found = read_struct(path, HostFile) if path.exists() else HostFile()
    if found.metrics is not None:
        with prefixed(f"{path}: "):
            found.metrics.address  # noqa: B018 - raises
    return found


def with_host(plan: GatewayPlan, host: HostFile) -> GatewayPlan:
    """Return a gateway's plan with what ``host.toml`` says, where the robot's file says nothing."""
    if plan.config.blackbox is not None or host.blackbox is None or plan.device is None:
        return plan
    return msgspec.structs.replace(plan, config=msgspec.structs.replace(plan.config, blackbox=host.blackbox))


def robot_files(directory: Path) -> list[Path]:
    """Return the robot files of a directory in the order of their names; raise ConfigError if it is none."""
    try:
        return sorted(path for path in directory.iterdir() if path.suffix == ".toml" and path.name != HOST_FILE)
    except OSError as error:
        raise ConfigError(f"{directory}: {error.strerror or error}") from error


def require_different_robots(plans: Iterable[tuple[Path, GatewayPlan]]) -> None:
    """Raise ConfigError if two files name the same robot of one realm, or of one address, or listen at one address.

    Resolves host names, which may take RESOLVE_S.
    """
    plans = list(plans)
    robots: dict[tuple[str, str], Path] = {}
    addresses: dict[object, Path] = {}
    for path, plan in plans:
        robot = plan.config.robot
        first = robots.setdefault((robot.realm, robot.name), path)
        if first is not path:
            raise ConfigError(f"{path}: robot.name = {robot.name!r}: expected another name than {first}'s")
        for number, listener in enumerate(plan.listeners):
            other = addresses.setdefault(listener.address, path) if listener.address.port else path
            if other is not path:
                listen = plan.config.hq[number].listen
                raise ConfigError(f"{path}: hq[{number}].listen = {listen!r}: expected another address than {other}'s")
    devices = [(path, plan.device) for path, plan in plans if plan.device is not None]
    forms = resolve(address for _, device in devices for address in device.addresses)
    taken = Addresses()
    for path, device in devices:
        taken.add(path, frozenset[str]().union(*(forms[address] for address in device.addresses)), device.shares)


def require_one_bus(plans: Sequence[tuple[Path, GatewayPlan]]) -> None:
    """Raise ConfigError where robots that are to share a session differ in their ``[bus]``."""
    for path, plan in plans[1:]:
        if plan.config.bus != plans[0][1].config.bus:
            raise ConfigError(f"{path}: bus: expected the same as in {plans[0][0]}: together = true shares one session")
