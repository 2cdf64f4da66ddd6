"""Runs the checks of an examination in order; what depends on a failed check is skipped, and says so.

Theory of operation. A robot's name, or nothing, is examined from anywhere: certificate, bus, role, then the robots.
``gateway_file`` examines a gateway by its file, on its own machine. The robot itself is contacted by a probe only.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec

from zbridge.bus import Bus, BusSettings
from zbridge.client.fleet_model import RobotEntry, watch
from zbridge.doctor import bus as on_bus
from zbridge.doctor.findings import Finding, Layer, Verdict, error, ok
from zbridge.doctor.refused import why_router_refuses
from zbridge.errors import BusError, BusRefused
from zbridge.protocol.address import Address

_REACH_S = 5.0
"""Longest time to connect to a listener."""


class Options(msgspec.Struct, frozen=True):
    """What else is examined. probe: contact robots that no gateway serves. disks: where recordings are written.

    from_here: addresses of listeners that a connection is opened to.
    """

    probe: bool = False
    disks: tuple[Path, ...] = ()
    from_here: tuple[str, ...] = ()


class Examination:
    """The findings so far. report: called with each."""

    def __init__(self, report: Callable[[Finding], None] = lambda finding: None) -> None:
        self.findings: list[Finding] = []
        self._report = report
        self._robot: str | None = None

    def __repr__(self) -> str:
        return f"<Examination {len(self.findings)} findings>"

    def add(self, finding: Finding) -> Finding:
        """Enter a finding, of the robot that is examined."""
        finding = msgspec.structs.replace(finding, robot=finding.robot or self._robot)
        self.findings.append(finding)
        self._report(finding)
        return finding

    def add_all(self, findings: Iterable[Finding]) -> None:
        """Enter findings."""
        for finding in findings:
            self.add(finding)

    def failed(self, layer: Layer) -> bool:
        """Return whether a layer has failed for the robot that is examined."""
        return any(each.failed for each in self.findings if each.layer is layer and each.robot in (None, self._robot))

    def skip(self, layers: Iterable[Layer], because: Layer) -> None:
        """Enter for each layer that it is not checked."""
        for layer in layers:
            self.add(Finding(layer, Verdict.SKIPPED, "skipped", f"not checked: {because} failed"))

    def of(self, robot: str | None) -> None:
        """Turn to a robot; None: to all."""
        self._robot = robot


async def examine_bus(
    examination: Examination, settings: BusSettings, realm: str, robot: str | None, options: Options
) -> None:
    """Examine one robot from anywhere, or all of the realm."""
    examination.of(robot)
    examination.add_all(on_bus.examine_certificate(settings))
    await examine_joined(examination, settings, realm, robot, options)


async def unreachable(examination: Examination, settings: BusSettings, fault: BusError) -> None:
    """Enter why the bus could not be joined; skip what is on it."""
    limit = await why_router_refuses(settings) if not _is_known(fault) else None
    examination.add(limit or on_bus.judge_unreachable(settings, fault))
    examination.skip(_AFTER_BUS, Layer.BUS)


_AFTER_BUS = (Layer.ROLE, Layer.GATEWAY, Layer.ROBOT, Layer.DRIVING, Layer.LISTENERS, Layer.CLOCKS, Layer.PROCESS)


async def examine_joined(
    examination: Examination,
    settings: BusSettings,
    realm: str,
    robot: str | None,
    options: Options,
    pid: int | None = None,
) -> None:
    """Join the bus, and examine what is there. pid: the process of this machine that has the robot."""
    if examination.failed(Layer.CERTIFICATE):
        examination.skip((Layer.BUS, *_AFTER_BUS), Layer.CERTIFICATE)
        return
    try:
        async with on_bus.joined(settings, realm) as bus:
            examination.add(on_bus.judge_joined(settings, len(bus.routers())))
            examination.add_all(await on_bus.examine_role(bus, settings, realm, robot))
            if examination.failed(Layer.ROLE):
                examination.skip(_AFTER_BUS[1:], Layer.ROLE)
                return
            await _examine_robots(examination, bus, realm, robot, options, pid)
    except BusError as fault:
        await unreachable(examination, settings, fault)


def _is_known(fault: BusError) -> bool:
    """Return whether the cause of a failed connection was found."""
    return isinstance(fault, BusRefused) or "nobody listens" in str(fault)


async def _examine_robots(
    examination: Examination, bus: Bus, realm: str, robot: str | None, options: Options, pid: int | None
) -> None:
    changed = asyncio.Event()
    async with watch(bus, realm, lambda name: changed.set(), asyncio.get_running_loop().time) as model:
        if robot is not None:
            model.robots.setdefault(robot, RobotEntry(robot))

        def examined() -> list[RobotEntry]:
            return [model.robots[robot]] if robot is not None else list(model.robots.values())

        await on_bus.heard(changed, examined)
        if not examined():
            examination.add(
                error(
                    Layer.GATEWAY,
                    "no_robots",
                    f"no robots on {realm}/",
                    "start a gateway, or give its router: --connect tcp/HOST:7447, and its --realm",
                )
            )
        for entry in sorted(examined(), key=lambda each: each.name):
            examination.of(entry.name)
            tables = await on_bus.tables_of(bus, realm, entry.name)
            examination.add_all(on_bus.examine_robot(entry, model, tables, realm, pid))
            if examination.failed(Layer.GATEWAY):
                examination.skip((Layer.ROBOT, Layer.DRIVING, Layer.PROCESS), Layer.GATEWAY)
            elif entry.status is not None and entry.status.state != "established":
                examination.skip((Layer.DRIVING,), Layer.ROBOT)
        examination.of(robot)
        for address in options.from_here:
            examination.add(await _reach(address))


async def _reach(address: str) -> Finding:
    """Open a connection to a listener, and close it; raise LinkError if its address is none."""
    layer = Layer.LISTENERS
    at = Address.parse(address)
    try:
        async with asyncio.timeout(_REACH_S):
            _, writer = await asyncio.open_connection(at.host, at.port)
        writer.close()
    except ConnectionRefusedError:
        return error(
            layer,
            "not_reached",
            f"nobody listens at {address}, as seen from here",
            'a listener at 127.0.0.1 serves its own machine only: listen = "tcp://0.0.0.0:PORT" in its [[hq]]',
        )
    except (OSError, TimeoutError) as fault:
        why = getattr(fault, "strerror", None) or "no answer"
        return error(layer, "not_reached", f"{address} is not reached from here: {why}", "check firewalls and routes")
    return ok(layer, f"{address} accepts connections from here")
