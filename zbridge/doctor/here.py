"""Examines this machine: a configuration, host names, who holds the robot's address, ports, disks, units of systemd.

Listening ports are read from the kernel's table: no connection is made, neither to a robot nor to a listener.
"""

from __future__ import annotations

import asyncio
import os
import shutil
import socket
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from zbridge.app.config import GatewayPlan
from zbridge.app.process_usage import free_bytes
from zbridge.app.stats import disks_of
from zbridge.doctor.findings import Finding, Layer, error, note, ok, warning
from zbridge.doctor.robot import judge_disks
from zbridge.fleet.processes import DiskSpace
from zbridge.host.addresses import forms_of, holders, rival
from zbridge.protocol.address import Address, DatagramAddress

_LISTENING = {"tcp": "0A", "udp": "07"}
"""The state of a listening socket in ``/proc/net/tcp`` (LISTEN) and ``udp`` (unconnected)."""
_RESOLVE_S = 2.0
_UNIT_S = 2.0
_UNITS = ("zbridge.service", "zbridge@{robot}.service")


async def examine_names(plan: GatewayPlan) -> Finding:
    """Resolve the host names of the robot and the routers."""
    hosts = [each.host for each in plan.device.addresses if isinstance(each, Address)] if plan.device else []
    hosts += [_endpoint_host(each) for each in plan.config.bus.connect]
    loop, unknown = asyncio.get_running_loop(), []
    for host in dict.fromkeys(filter(None, hosts)):
        try:
            async with asyncio.timeout(_RESOLVE_S):
                await loop.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError, TimeoutError):
            unknown.append(host)
    if unknown:
        names = ", ".join(unknown)
        return error(Layer.NAMES, "unknown_host", f"no address for {names}", "correct the name, or the name server")
    return ok(Layer.NAMES, f"resolved: {', '.join(dict.fromkeys(filter(None, hosts))) or 'none is named'}")


def examine_address(plan: GatewayPlan) -> Iterator[Finding]:
    """Find the process of this machine that serves the robot's address. Resolves names: may take two seconds."""
    layer = Layer.ADDRESS
    if plan.device is None:
        return
    robot = plan.config.robot
    peers, name = ", ".join(map(str, plan.device.addresses)), f"{robot.realm}/{robot.name}"
    forms = sorted(forms_of(plan.device))
    other = rival(forms, name, shares=plan.device.shares)
    own = sorted({each.pid for form in forms for each in holders(form) if each.robot == (other or each).robot})
    if other is not None:
        yield error(
            layer,
            "address_taken",
            f"{peers} has a gateway on this machine already: {other.robot}, process {other.pid}",
            "end one of the two; if the robot accepts several clients: device.allow_shared_address = true in both",
        )
    elif len(own) > 1:
        yield warning(
            layer,
            "two_gateways",
            f"{len(own)} gateways of {name} run on this machine: processes {', '.join(map(str, own))}; one serves the"
            " robot, the others wait",
            "end all but one",
        )
    elif own:
        yield ok(layer, f"{peers} is served by process {own[0]} of this machine, as {name}")
    else:
        yield note(
            layer,
            "not_here",
            f"no process of this machine serves {peers} as {name}. The port is not tried: a legacy"
            " robot gives one connection for each start of its program",
            "start it here (zbridge run FILE), or look on the host where it runs; --probe tries the port",
        )


def examine_ports(plan: GatewayPlan, *, runs: bool) -> Iterator[Finding]:
    """Read from the kernel's table whether somebody listens for HQ programs. runs: whether the gateway should."""
    tables = [listening_ports(kind) for kind in _LISTENING]
    for number, listener in enumerate(plan.listeners):
        ports = tables[isinstance(listener.address, DatagramAddress)]
        address, named = listener.address, f"hq[{number}].listen = {plan.config.hq[number].listen!r}"
        if ports is None or not address.port:
            yield note(Layer.LISTENERS, "unknown_port", f"{named}: which ports are open cannot be read here")
        elif address.port in ports and not runs:
            yield error(
                Layer.LISTENERS,
                "port_taken",
                f"{named}: another program has port {address.port}: the gateway does not start",
                "choose another port, or end the other program (ss -ltunp shows it)",
            )
        elif address.port not in ports and runs:
            yield error(
                Layer.LISTENERS,
                "port_closed",
                f"{named}: nobody listens at port {address.port}: HQ programs are refused",
                "a listener opens once the gateway has joined the bus: see the layer bus, and the gateway's log",
            )
        elif runs:
            bound = ", ".join(sorted(ports[address.port]))
            yield ok(Layer.LISTENERS, f"{named}: open at {bound}")


def listening_ports(kind: str = "tcp") -> dict[int, set[str]] | None:
    """Return the ports at which processes of this machine listen, with their addresses; None if that is not known."""
    found: dict[int, set[str]] = {}
    read = False
    for table, family in ((f"/proc/net/{kind}", socket.AF_INET), (f"/proc/net/{kind}6", socket.AF_INET6)):
        with suppress(OSError, ValueError):
            for line in Path(table).read_text().splitlines()[1:]:
                _, local, _, state, *_ = line.split()
                if state == _LISTENING[kind]:
                    host, _, port = local.rpartition(":")
                    found.setdefault(int(port, 16), set()).add(_written(host, family))
            read = True
    return found if read else None


def _written(host: str, family: socket.AddressFamily) -> str:
    """Write an address of the kernel's table: words of four bytes in the machine's order."""
    words = [int(host[at : at + 8], 16).to_bytes(4, "little") for at in range(0, len(host), 8)]
    return socket.inet_ntop(family, b"".join(words))


def examine_disks(plan: GatewayPlan, more: tuple[Path, ...], *, runs: bool) -> Iterator[Finding]:
    """Measure the disks that a gateway writes, unless it runs and tells so itself, and those of recordings."""
    own = () if runs else disks_of(plan, None)
    paths = [*((use, path.absolute()) for use, path in own), *(("recordings", path) for path in more)]
    spaces = [DiskSpace(use, str(path), free) for use, path in paths if (free := free_bytes(path)) is not None]
    yield from judge_disks(spaces)
    for use, path in paths:
        folder = next((each for each in (path, *path.absolute().parents) if each.is_dir()), None)
        if folder is not None and not os.access(folder, os.W_OK):
            yield warning(
                Layer.DISK,
                "not_writable",
                f"{use}: {folder} cannot be written by this user",
                "run doctor as the user of the gateway, or give it the directory",
            )


async def examine_units(robot: str) -> list[Finding]:
    """Ask systemd for the units that may run this robot."""
    if not _has_systemd():
        return [ok(Layer.SUPERVISOR, "no systemd on this machine")]
    shown = [(unit, await _shown(unit)) for unit in (each.format(robot=robot) for each in _UNITS)]
    found = [_judge_unit(unit, fields) for unit, fields in shown if fields.get("LoadState") == "loaded"]
    return found or [note(Layer.SUPERVISOR, "no_unit", "no unit of systemd runs gateways here")]


def _has_systemd() -> bool:
    return shutil.which("systemctl") is not None and Path("/run/systemd/system").exists()


def _judge_unit(unit: str, fields: dict[str, str]) -> Finding:
    state = f"{unit}: {fields.get('ActiveState')} ({fields.get('SubState')})"
    if fields.get("ActiveState") == "failed":
        text = f"{state}: {fields.get('Result')}"
        return error(Layer.SUPERVISOR, "unit_failed", text, f"journalctl -u {unit}; then systemctl restart {unit}")
    if (restarts := fields.get("NRestarts", "0")) not in ("", "0"):
        return note(Layer.SUPERVISOR, "unit_restarts", f"{state}, restarted {restarts} times")
    return ok(Layer.SUPERVISOR, state)


async def _shown(unit: str) -> dict[str, str]:
    command = ("systemctl", "show", unit, "-p", "LoadState,ActiveState,SubState,Result,NRestarts")
    with suppress(OSError, TimeoutError):
        process = await asyncio.create_subprocess_exec(
            *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL
        )
        try:
            async with asyncio.timeout(_UNIT_S):
                output, _ = await process.communicate()
            lines = output.decode(errors="replace").splitlines()
            return dict(line.partition("=")[::2] for line in lines)
        finally:
            with suppress(ProcessLookupError):
                process.kill()
    return {}


def _endpoint_host(endpoint: str) -> str:
    kind, _, address = endpoint.partition("/")
    return address.partition("#")[0].partition("?")[0].rpartition(":")[0].strip("[]") if kind != "serial" else ""
