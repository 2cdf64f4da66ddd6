"""Judges what the gateway of one robot publishes: itself, the robot's link, the lease, listeners, disks. Sans-IO.

Whatever a gateway or a robot says is shown as it is: nothing acts on a sentence, but the protocol that wrote it.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Iterator

from zbridge.client.fleet_model import SILENT_S, RobotEntry
from zbridge.control.faults import EVENTS
from zbridge.doctor.findings import Finding, Layer, Verdict, error, note, ok, warning
from zbridge.errors import Code
from zbridge.fleet.messages import Control, Refusal, Status
from zbridge.fleet.processes import DiskSpace, ListenerStats, ProcessStats
from zbridge.protocol.networks import is_loopback
from zbridge.protocol.plugin import Advice

_LOW_BYTES, _FULL_BYTES = 200_000_000, 5_000_000
"""Free space on a disk that is little, and that is none."""
_MANY, _TOO_MANY = 0.8, 0.95
"""Parts of the open descriptors that a process may have."""
_LATE_S = 0.25
"""A loop that is later than this stops robots later than documented."""
_BUSY = 0.9
"""Part of a processor, beyond which a gateway has no reserve."""
_LARGE_BYTES = 500_000_000
_NEW_S = 10.0
_SHOWN = 8
"""Most robots that are listed."""

Advise = Iterable[Advice]


def judge_gateway(
    robot: RobotEntry, *, silent: bool, known: Collection[str], realm: str = "fleet", pid: int | None = None
) -> Finding:
    """Judge whether a gateway serves the robot.

    known: the robots of the realm. pid: the process of this machine that has the robot; None: there is none, or nobody
    looked.
    """
    layer = Layer.GATEWAY
    host = robot.status.host if robot.status is not None else None
    where = f" on {host}" if host else ""
    if not robot.alive:
        return _judge_absent(robot, where, known, realm, pid)
    if silent:
        process = f" (process {robot.stats.process.pid})" if robot.stats is not None else ""
        return error(
            layer,
            "gateway_silent",
            f"the gateway{where}{process} is on the bus, and has published nothing for {SILENT_S:g} s: it hangs, is"
            " frozen, or is cut off",
            "look at its log; under `zbridge run DIR` the supervisor restarts it by itself",
        )
    if robot.stats is None:
        return note(
            layer,
            "no_stats",
            f"the gateway{where} tells nothing of itself: an earlier version, or its messages are late",
        )
    stats = robot.stats.process
    text = f"zbridge {stats.version} on {stats.host}, process {stats.pid}, up {_duration(stats.uptime_s)}"
    if stats.uptime_s < _NEW_S:
        return note(layer, "restarted", f"{text}: it has just started, or was restarted")
    return ok(layer, text)


def _judge_absent(robot: RobotEntry, where: str, known: Collection[str], realm: str, pid: int | None) -> Finding:
    layer = Layer.GATEWAY
    if pid is not None:
        return error(
            layer,
            "not_on_the_bus",
            f"process {pid} of this machine has the robot, and is not on this bus",
            "it is frozen or hangs (see its log; `kill -CONT` it, or end it), or its file names another bus, realm or"
            " certificate than the one that was examined",
        )
    if robot.status is not None:
        return error(layer, "gateway_left", f"the gateway{where} has left the bus", "start it again: zbridge run FILE")
    return error(
        layer,
        "no_gateway",
        f"no gateway serves {robot.name}: {realm}/ has {_listed(robot.name, known)}",
        f"start it where the robot is reached: zbridge run {robot.name}.toml; if it runs, it may be on another bus or"
        " realm: run zbridge doctor FILE there",
    )


def judge_link(
    status: Status, rates: dict[str, float] | None, advice: Advise, last_reason: str | None = None
) -> Iterator[Finding]:
    """Judge the connection to the robot: whether it is established, and what the gateway says is wrong with it.

    rates: what the gateway publishes; None if it does not say. last_reason: why the connection before ended.
    """
    layer, peers = Layer.ROBOT, ", ".join(link.peer for link in status.links) or "no address"
    agreed = " ".join(filter(None, (status.protocol, status.dialect, status.version)))
    reason = status.reason or last_reason or "the gateway gives no reason"
    advised = [error(layer, each.code, f"{each.text} ({reason})", each.remedy) for each in advice]
    yield from advised
    if status.state != "established" and not advised:
        yield error(
            layer,
            f"robot_{status.state}",
            f"{status.state}: {reason}" + ("" if peers in reason else f" ({peers})"),
            f"{_REMEDIES[status.state]}. The port is not tried from here: a legacy robot gives one connection for each"
            " start of its program (--probe tries it)",
        )
    elif status.stalled is True:
        yield error(
            layer,
            "link_stalled",
            f"the link to {peers} acknowledges nothing: the robot is not driven, and a stop waits",
            "check the network to the robot; the gateway keeps the connection for 60 s",
        )
    elif status.state == "established" and not advised:
        if status.reason:
            yield warning(layer, "condition", f"established ({agreed}), but {status.reason}", "see what it names")
        elif rates is not None and not rates:
            yield note(layer, "robot_quiet", f"established ({agreed}); nothing came from {peers} in the last second")
        else:
            sends = ", ".join(f"{key} {rate:g}/s" for key, rate in sorted((rates or {}).items()))
            features = f", features {' '.join(status.features)}" if status.features else ""
            yield ok(layer, f"established ({agreed}) at {peers}{features}{f'; {sends}' if sends else ''}")


def judge_faults(status: Status) -> Iterator[Finding]:
    """Judge the events of the last minute; what lasts is told by other findings."""
    for fault in status.faults:
        if fault.code in EVENTS:
            times = "once" if fault.count == 1 else f"{fault.count} times"
            text = f"{fault.code} {times} in the last minutes: {fault.text}"
            remedy = "zbridge blackbox ls: the minutes before are kept, if the gateway has [blackbox]"
            yield warning(Layer.ROBOT, f"fault_{fault.code}", text, remedy)


def judge_driving(control: Control, robot: str) -> Iterator[Finding]:
    """Judge who drives, and what was refused since the gateway started."""
    layer = Layer.DRIVING
    if control.state == "latched":
        for latch in control.latches:
            command = "zbridge unlatch --all" if latch.fleet else f"zbridge unlatch {robot}"
            text = f"{latch.described}: nobody may drive"
            yield warning(layer, "latched", text, f"once it is safe: {command}")
        if not control.latches:
            yield warning(layer, "latched", "latched: nobody may drive", f"once it is safe: zbridge unlatch {robot}")
    elif control.holder:
        ends = f"; unless renewed the lease ends in {control.expires_in_s:.1f} s" if control.expires_in_s else ""
        yield note(
            layer,
            "held",
            f"{control.holder} drives (priority {control.priority or 0}), and others are refused{ends}",
            "wait, ask with a higher priority, or take over (on a secure bus as supervisor): zbridge drive"
            f" {robot} --takeover",
        )
    else:
        yield ok(layer, "free: any program that may drive can acquire the lease")
    yield from (_judge_refusal(each) for each in control.refusals)


def _judge_refusal(refusal: Refusal) -> Finding:
    who = refusal.who or "somebody"
    times = "once" if refusal.count == 1 else f"{refusal.count} times"
    text = f"since the gateway started {who} was refused {refusal.command} {times}: {refusal.reason}"
    return note(Layer.DRIVING, f"refused_{refusal.code}", text, REMEDIES.get(refusal.code))


def judge_listeners(listeners: Iterable[ListenerStats], host: str) -> Iterator[Finding]:
    """Judge where HQ programs connect. host: the machine of the listeners."""
    layer = Layer.LISTENERS
    for each in listeners:
        named = f"{each.name} ({each.protocol} HQ programs)"
        if not each.listening:
            yield error(
                layer, "listener_down", f"{named} does not listen at {each.address}", f"look at the log on {host}"
            )
        elif is_loopback(_host_of(each.address)):
            yield note(
                layer,
                "listener_loopback",
                f"{named} listens at {each.address}: programs of {host} alone reach it, {each.clients} do now",
                'for other machines: listen = "tcp://0.0.0.0:PORT" and allow = [...] in its [[hq]]',
            )
        else:
            yield ok(layer, f"{named} listens at {each.address} on {host}: {each.clients} connected")


def judge_process(process: ProcessStats) -> Iterator[Finding]:
    """Judge what a process uses."""
    layer = Layer.PROCESS
    memory = process.proportional_bytes or process.resident_bytes
    used = process.files / process.most_files if process.most_files else 0.0
    where = f"process {process.pid} on {process.host}"
    if used >= _MANY:
        yield Finding(
            layer,
            Verdict.ERROR if used >= _TOO_MANY else Verdict.WARNING,
            "descriptors",
            f"{where} has {process.files} of {process.most_files} descriptors open",
            "raise LimitNOFILE of its unit (ulimit -n); find out which programs connect so often",
        )
    if process.late_s >= _LATE_S:
        yield warning(
            layer,
            "late",
            f"{where}: its event loop was {process.late_s:.2f} s late: the machine is overloaded, and stops are late",
            "take load off the machine, or give the gateway a processor of its own",
        )
    if process.cpu >= _BUSY:
        yield warning(layer, "busy", f"{where} uses {100 * process.cpu:.0f} % of a processor", "see `zbridge top`")
    if memory >= _LARGE_BYTES:
        yield warning(layer, "memory", f"{where} uses {memory / 1e6:.0f} MB", "restart it: zbridge restart ROBOT")
    if used < _MANY and process.late_s < _LATE_S and process.cpu < _BUSY and memory < _LARGE_BYTES:
        together = f", {process.robots} robots" if process.robots > 1 else ""
        text = f"{100 * process.cpu:.1f} % of a processor, {memory / 1e6:.0f} MB"
        yield ok(layer, f"{text}, {process.files} of {process.most_files} descriptors{together}")


def judge_disks(disks: Iterable[DiskSpace]) -> Iterator[Finding]:
    """Judge the space on the disks that a gateway, or a recorder, writes to."""
    for each in disks:
        left = f"{each.free_bytes / 1e6:.0f} MB left for {each.use} at {each.path}"
        if each.free_bytes < _FULL_BYTES:
            yield error(Layer.DISK, "disk_full", f"the disk is full: {left}", _DISK.get(each.use, "make room"))
        elif each.free_bytes < _LOW_BYTES:
            yield warning(Layer.DISK, "disk_low", left, "make room before it is full")
        else:
            yield ok(Layer.DISK, left)


def judge_clock(host: str, offset_s: float, uncertainty_s: float) -> Finding:
    """Judge the clock of another machine against this one's. offset_s: how far it is ahead."""
    if abs(offset_s) - uncertainty_s <= 1.0:
        return ok(Layer.CLOCKS, f"{host}: the same as here, within {max(abs(offset_s), uncertainty_s):.2f} s")
    side = "ahead of" if offset_s > 0 else "behind"
    return warning(
        Layer.CLOCKS,
        "clock",
        f"the clock of {host} is {_duration(abs(offset_s))} {side} this machine's (+-{uncertainty_s:.2f} s)",
        "set the clocks (NTP, chrony). Driving does not depend on them; stamps, recordings and certificates do",
    )


def _listed(name: str, known: Collection[str]) -> str:
    """List robots; of many those whose names are like this one."""
    if len(known) <= _SHOWN:
        return ", ".join(sorted(known)) or "no robot at all"
    lower = {each.lower(): each for each in known}
    close = [lower[each] for each in difflib.get_close_matches(name.lower(), lower, _SHOWN)]
    return f"{len(known)} others" + (f"; did you mean {' or '.join(close)}?" if close else "")


def _host_of(address: str) -> str:
    return address.partition("://")[2].rpartition(":")[0].strip("[]")


def _duration(seconds: float) -> str:
    for size, unit in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.1f} s"


_REMEDIES = {
    "offline": "check that the robot's program runs, its address, and the network to it",
    "connecting": "check that the robot is switched on, its address, and the network to it",
    "handshaking": "check that the robot speaks this protocol, in a version that the gateway knows",
    "closing": "the gateway is ending the connection: look again in a second",
}
_DISK = {
    "audit": "make room: events are lost until then, robots are served all the same",
    "blackbox": "make room, or set another dir in [blackbox]: incidents are lost until then",
    "latches": "make room: a latched stop, or mode autonomous, cannot be kept through a restart",
}
REMEDIES: dict[str, str] = {
    Code.HELD: "somebody else has the lease: wait, ask with a higher priority, or take over",
    Code.NO_LEASE: "acquire the lease before driving",
    Code.LEASE_ENDED: "the lease has ended (a stop, a takeover, an expiry): acquire it anew",
    Code.NEUTRAL_FIRST: "centre the joystick, or call drive.neutral(), before moving again",
    Code.LATCHED: "a latched stop is in force: zbridge unlatch once it is safe",
    Code.STALE: "the network delays commands by more than max_age_s: look at the driver's network",
    Code.NOT_READY: "the robot accepts no commands now: status says why",
    Code.BUSY: "the robot is busy: wait",
    Code.CLOSING: "its gateway is ending: wait for the next one",
    Code.UNSUPPORTED: "this robot cannot do it, or it is switched off in its options",
    Code.MALFORMED: "the program sends what cannot be decoded: compare it with the reference of messages",
    Code.OUT_OF_ORDER: "the program repeats numbers, or two programs use one lease",
    Code.RATE: "the program sends too fast",
}
"""What to do about a refusal, by its code."""
