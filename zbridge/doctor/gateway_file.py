"""Examines a gateway by its file, on its own machine: configuration, names, address, ports, disks; then its bus.

Theory of operation. The bus is joined as the gateway would join it. On a secure bus a gateway's certificate may read
nothing but tokens; the rest is read with the certificate of a viewer, if one is given.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec

from zbridge.app.config import GatewayPlan, load
from zbridge.bus import BusSettings
from zbridge.bus.tls.files import folder_settings, folder_tls, own_role
from zbridge.doctor import bus as on_bus
from zbridge.doctor import here
from zbridge.doctor.examination import Examination, Options, examine_joined, unreachable
from zbridge.doctor.findings import Finding, Layer, Verdict, error, note, ok
from zbridge.doctor.probe import probe
from zbridge.errors import BusError, ConfigError
from zbridge.fleet.topics import KeySpace
from zbridge.host.addresses import serving
from zbridge.metrics import Metrics
from zbridge.security.member import check_member

_OF_GATEWAYS = ("gateway", "hq")


async def examine_file(examination: Examination, file: Path, tls: Path | None, options: Options) -> None:
    """Examine a gateway. tls: the folder of a viewer's certificate; or of the gateway's, for a file without one."""
    examination.of(file.stem)
    try:
        plan, viewer = _load(file, tls)
        check_member(plan)
        if plan.device is not None:
            plan.device.make_robot(Metrics())
    except ConfigError as fault:
        examination.add(error(Layer.CONFIGURATION, "configuration", str(fault), "correct what it names"))
        examination.skip([layer for layer in Layer if layer is not Layer.CONFIGURATION], Layer.CONFIGURATION)
        return
    robot = plan.config.robot
    examination.of(robot.name)
    examination.add(ok(Layer.CONFIGURATION, f"{file}: {plan.described}"))
    names = examination.add(await here.examine_names(plan))
    examination.add_all(on_bus.examine_certificate(plan.config.bus))
    if names.failed:
        examination.skip((Layer.ADDRESS,), Layer.NAMES)
    else:
        examination.add_all(await asyncio.to_thread(lambda: list(here.examine_address(plan))))
    holder = await asyncio.to_thread(serving, plan) if not names.failed else None
    pid = holder.pid if holder is not None else None
    examination.add_all(here.examine_ports(plan, runs=pid is not None or plan.device is None))
    examination.add_all(
        await asyncio.to_thread(lambda: list(here.examine_disks(plan, options.disks, runs=pid is not None)))
    )
    probed = await _probe(examination, plan, pid) if options.probe else []
    if probed and not any(each.failed for each in probed):
        return
    await _examine_its_bus(examination, plan, viewer, options, pid)
    examination.add_all(await here.examine_units(robot.name))


def _load(file: Path, tls: Path | None) -> tuple[GatewayPlan, Path | None]:
    """Read a file; return its plan, and the folder by which the bus may be read, None without one."""
    plan = load(file)
    if tls is None:
        return plan, None
    of_gateway = own_role(folder_tls(tls)) in _OF_GATEWAYS
    if plan.config.bus.tls is None and of_gateway:
        return load(file, tls=tls), None
    return plan, None if of_gateway else tls


async def _probe(examination: Examination, plan: GatewayPlan, pid: int | None) -> list[Finding]:
    """Contact the robot, unless a gateway of this machine serves it; return what was found."""
    if pid is None:
        return [examination.add(each) for each in await probe(plan)]
    text = f"not probed: process {pid} of this machine serves the robot"
    examination.add(Finding(Layer.ROBOT, Verdict.SKIPPED, "skipped", text))
    return []


async def _examine_its_bus(
    examination: Examination, plan: GatewayPlan, viewer: Path | None, options: Options, pid: int | None
) -> None:
    settings, robot = _as_observer(plan.config.bus), plan.config.robot
    if settings.tls is None and viewer is not None:
        text = "the file has no bus.tls: the gateway's certificate is not checked, the bus is read with the one given"
        examination.add(note(Layer.CERTIFICATE, "not_checked", text, "add tls to [bus] of the file to check it"))
        settings = folder_settings(viewer, settings.connect)
    elif settings.tls is not None and own_role(settings.tls) == "gateway":
        joins = await _examine_as_gateway(examination, settings, robot.realm, robot.name, pid, reads=viewer is not None)
        if not joins or viewer is None:
            return
        settings = folder_settings(viewer, settings.connect)
    await examine_joined(examination, settings, robot.realm, robot.name, options, pid)


async def _examine_as_gateway(
    examination: Examination, settings: BusSettings, realm: str, robot: str, pid: int | None, *, reads: bool
) -> bool:
    """Join the bus with a gateway's certificate; return whether that succeeded. reads: a viewer's follows."""
    try:
        async with on_bus.joined(settings, realm) as bus:
            if not reads:
                examination.add(on_bus.judge_joined(settings, len(bus.routers())))
            examination.add_all(await on_bus.examine_role(bus, settings, realm, robot))
            tokens = await bus.alive(KeySpace(realm, robot).alive("gateway"))
            if not reads:
                examination.add(on_bus.judge_token(robot, tokens, pid))
    except BusError as fault:
        await unreachable(examination, settings, fault)
        return False
    return True


def _as_observer(settings: BusSettings) -> BusSettings:
    """Return the settings by which doctor joins a gateway's bus: as a client or peer that listens nowhere."""
    mode = "client" if settings.effective_mode == "client" else "peer"
    connect = settings.connect or tuple(each for each in settings.listen if settings.mode == "router")
    return msgspec.structs.replace(settings, mode=mode, listen=(), connect=connect)
