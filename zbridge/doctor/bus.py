"""Asks the bus: whether it can be joined, as whom, and what gateways, listeners and clocks say there."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import msgspec

from zbridge.bus import Bus, BusSettings, Tls
from zbridge.bus.tls.files import (
    ANOTHER_AUTHORITY,
    ends_soon,
    not_strict,
    out_of_date,
    own_certificate,
    unusable,
    utc_now,
)
from zbridge.bus.tls.membership import Right, may, membership
from zbridge.client import joined as joined
from zbridge.client.fleet_model import FleetModel, RobotEntry
from zbridge.client.health import same_addresses
from zbridge.doctor import robot as judge
from zbridge.doctor.findings import Finding, Layer, error, note, ok, warning
from zbridge.errors import BusError, BusRefused, ConfigError, PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet.processes import Membership, Sessions
from zbridge.fleet.topics import split_key
from zbridge.protocol.plugin import Advice, find_protocol
from zbridge.security.files import read_secret
from zbridge.tasks import occurs

_ASK_S = 1.0
_LISTEN_S = 3.2
"""Longest time in which a gateway must publish something: it does so once a second."""
_CLOSED = "closed"


class ProcessTable(msgspec.Struct, frozen=True):
    """What one process answered. offset_s: its clock against ours; uncertainty_s: half of the time of the question."""

    who: str
    table: Sessions
    offset_s: float | None
    uncertainty_s: float


def examine_certificate(settings: BusSettings) -> Iterator[Finding]:
    """Examine the files of this program's certificate."""
    layer, tls = Layer.CERTIFICATE, settings.tls
    if tls is None:
        yield ok(layer, "none given", "open_bus")
        return
    try:
        certificate, fault = own_certificate(tls), unusable(tls)
    except ConfigError as failure:
        certificate, fault = None, str(failure)
    if fault is not None:
        yield error(layer, "unusable", fault, "copy the folder of `zbridge certs bundle` again")
    elif (readable := _readable(tls)) is not None:
        yield error(layer, "key_readable", readable, f"chmod 600 {tls.key}")
    elif certificate is None:
        yield error(layer, "no_certificate", "bus.tls has no certificate and key", "add both, or use --tls FOLDER")
    elif (date := out_of_date(certificate, utc_now())) is not None:
        yield error(layer, "out_of_date", date, "renew it, or set this machine's clock")
    elif (date := ends_soon(certificate, utc_now())) is not None:
        yield warning(layer, "ends_soon", date, "renew it in time")
    elif (strict := not_strict(tls)) is not None:
        yield warning(layer, "not_strict", strict, ANOTHER_AUTHORITY)
    else:
        yield ok(layer, f"{certificate.common_name}, until {certificate.ends:%Y-%m-%d}")


def _readable(tls: Tls) -> str | None:
    """Return why others may use the private key; None if they may not."""
    try:
        if tls.key is not None:
            read_secret(Path(tls.key))
    except ConfigError as fault:
        return str(fault)
    return None


def judge_unreachable(settings: BusSettings, fault: BusError) -> Finding:
    """Judge why the bus could not be joined."""
    where = ", ".join(settings.connect) or "any peer"
    if isinstance(fault, BusRefused):
        return error(Layer.BUS, "bus_refused", str(fault), 'see docs/how-to/troubleshoot.md, "Why a connection fails"')
    return error(
        Layer.BUS, "bus_unreachable", f"no bus at {where}: {fault}", "start the router; check its address and firewalls"
    )


def judge_joined(settings: BusSettings, routers: int) -> Finding:
    """Describe the bus that was joined."""
    if routers:
        return ok(Layer.BUS, f"connected to {routers} router{'s' if routers > 1 else ''}")
    if settings.connect:
        return note(
            Layer.BUS,
            "no_router",
            f"no router answers at {', '.join(settings.connect)}: only peers of this network are seen",
            "if robots are missing, give --connect tcp/HOST:7447",
        )
    return ok(Layer.BUS, "peers of this network, without a router")


async def examine_role(bus: Bus, settings: BusSettings, realm: str, robot: str | None) -> Iterator[Finding]:
    """Ask the router who we are there, and judge what that permits, and its clock."""
    layer = Layer.ROLE
    certificate = own_certificate(settings.tls)
    if certificate is None:
        return iter([ok(layer, "none on an open bus: any program may drive, take over and stop", "open_bus")])
    asked = _Asked()
    member = await membership(bus.ask, realm, certificate.name, 1)
    if member is None:
        unknown = note(
            layer,
            "no_whoami",
            f"no router says what {certificate.common_name} may do: one of Zenoh's own does not answer",
            "compare its access rules with docs/reference/roles.md: what they deny looks like silence",
        )
        return iter([unknown])
    offset_s, uncertainty_s = asked.offset_s(member.stamp_ns)
    clocks = [judge.judge_clock("the router's machine", offset_s, uncertainty_s)] if offset_s is not None else []
    return iter([_judge_member(member, robot), *clocks])


class _Asked:
    """When a question was asked: how far the clock of who answers is ahead of ours."""

    def __init__(self) -> None:
        self._at_ns, self._begun_s = time.time_ns(), time.monotonic()

    def offset_s(self, stamp_ns: object) -> tuple[float | None, float]:
        """Return the offset, None for an answer without a stamp, and half of the time of the question."""
        half_s = (time.monotonic() - self._begun_s) / 2
        return ((stamp_ns - self._at_ns) / 1e9 - half_s if isinstance(stamp_ns, int) else None), half_s


def _judge_member(member: Membership, robot: str | None) -> Finding:
    layer, who = Layer.ROLE, f"{member.role}.{member.name}"
    if robot is not None and member.robots and robot not in member.robots:
        return error(
            layer,
            "other_robot",
            f"{who} is for {', '.join(member.robots)}, not for {robot}",
            "zbridge certs issue with this --robot, and restart the router",
        )
    if member.role == "gateway":
        return ok(layer, f"{who} serves {', '.join(member.robots)}")
    if may(member.role, Right.DRIVE):
        return ok(layer, f"{who} may drive" + (" and take over" if may(member.role, Right.TAKE_OVER) else ""))
    return note(
        layer,
        "may_not_drive",
        f"{who} may watch and stop, and not drive",
        f"to drive, use a certificate of the role {' or '.join(Right.DRIVE.value[1])}",
    )


def judge_token(robot: str, tokens: list[str], pid: int | None) -> Finding:
    """Judge what a gateway's certificate may see of its robot. pid: the process of this machine that has it."""
    hint = "a gateway's certificate may read no more: give --tls FOLDER of a viewer's for the rest"
    if tokens:
        return note(Layer.GATEWAY, "gateway_token", f"a gateway of {robot} is on the bus", hint)
    return judge.judge_gateway(RobotEntry(robot), silent=True, known=(), pid=pid)


async def tables_of(bus: Bus, realm: str, robot: str) -> list[ProcessTable]:
    """Ask the processes of a robot for their sessions, listeners and clocks."""
    asked, found = _Asked(), []
    for answer in await bus.ask(f"{realm}/{robot}/@rpc/sessions/*", timeout_s=_ASK_S):
        if answer.error is None and (split := split_key(answer.key)) is not None:
            with suppress(PayloadError):
                table = payloads.decode(Sessions, answer.payload)
                found.append(ProcessTable(split[2].rpartition("/")[2], table, *asked.offset_s(table.stamp_ns)))
    return found


async def heard(changed: asyncio.Event, robots: Callable[[], list[RobotEntry]]) -> None:
    """Wait until all of these robots' gateways that live have published something, _LISTEN_S at most.

    changed: set when one of them does.
    """
    loop = asyncio.get_running_loop()
    until = loop.time() + _LISTEN_S
    while any(each.alive and (each.published_at is None or each.stats is None) for each in robots()):
        changed.clear()
        if not await occurs(changed, until - loop.time()):
            return


def examine_robot(
    entry: RobotEntry, model: FleetModel, tables: list[ProcessTable], realm: str, pid: int | None
) -> Iterator[Finding]:
    """Judge one robot by what its processes published and answered. pid: see :func:`judge_gateway`."""
    silent = model.silent(entry)
    known = [name for name, each in model.robots.items() if name != entry.name and (each.alive or each.status)]
    first = judge.judge_gateway(entry, silent=silent, known=known, realm=realm, pid=pid)
    yield first
    if entry.status is not None and not first.failed:
        rates = entry.stats.rates if entry.stats is not None else None
        yield from judge.judge_link(entry.status, rates, _advice(entry, tables), _last_reason(tables))
        yield from judge.judge_faults(entry.status)
        yield from _judge_same_address(entry, model)
        if entry.control is not None and entry.status.state == "established":
            yield from judge.judge_driving(entry.control, entry.name)
    yield from _judge_processes(entry, tables, failed=first.failed)


def _judge_processes(entry: RobotEntry, tables: list[ProcessTable], *, failed: bool) -> Iterator[Finding]:
    stats = entry.stats if not failed else None
    if stats is not None:
        yield from judge.judge_listeners(stats.listeners, stats.process.host)
        yield from judge.judge_disks(stats.disks)
        yield from judge.judge_process(stats.process)
    for each in tables:
        process = each.table.process if isinstance(each.table.process, msgspec.Struct) else None
        host = process.host if process is not None else stats.process.host if stats is not None else each.who
        if process is not None:
            yield from judge.judge_listeners(each.table.listeners, host)
            yield from judge.judge_process(process)
        if each.offset_s is not None:
            yield judge.judge_clock(f"{host} ({each.who})", each.offset_s, each.uncertainty_s)


def _judge_same_address(entry: RobotEntry, model: FleetModel) -> Iterator[Finding]:
    statuses = {name: each.status for name, each in model.robots.items() if each.status is not None and each.alive}
    text = same_addresses(statuses).get(entry.name)
    if text is not None:
        yield warning(
            Layer.ROBOT,
            "same_address",
            f"{text}: two gateways for one robot",
            "end one of them; if the robot accepts several clients: device.allow_shared_address = true in both",
        )


def _advice(entry: RobotEntry, tables: list[ProcessTable]) -> tuple[Advice, ...]:
    """Ask the robot's protocol what it knows of these reasons, if it is installed here."""
    status = entry.status
    if status is None or status.protocol is None:
        return ()
    reasons = [status.reason or ""] + [link.reason or "" for link in status.links]
    if status.state != "established":
        reasons.append(_last_reason(tables) or "")
    try:
        return find_protocol(status.protocol).advise(reasons)
    except ConfigError:
        return ()


def _last_reason(tables: list[ProcessTable]) -> str | None:
    """Return why the gateway's last session with the robot ended."""
    entries = [entry for each in tables if each.who == "gateway" for entry in each.table.sessions]
    ended = [entry.reason for entry in entries if entry.role == "hq" and entry.state == _CLOSED and entry.reason]
    return ended[-1] if ended else None
