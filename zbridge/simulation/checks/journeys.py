"""Conformance over time: long drives, a connection that is lost, counters that begin anew."""

from __future__ import annotations

import asyncio
import math

from zbridge.errors import Refused
from zbridge.protocol.plugin import Protocol
from zbridge.protocol.session import Session
from zbridge.simulation.checks.finding import CheckFinding
from zbridge.simulation.checks.stage import HANG_UP_S, Stage
from zbridge.simulation.checks.truth import NO_TRUTH, Way, fractions, leg

BACK_S = 0.5
LEAST_S, MOST_S = 2.5, 9.0
"""How long the robot is left alone, and driven: longer than every period that the protocol declares, within these."""
MARGIN_S = 0.6
STAND_S = 0.6
DRIVE_S = 0.8
WRAP_S = 2.0
JUMP_M, JUMP_RAD = 0.03, 0.1
LONG = "a session lasts, and drives the robot, for longer than every period it declares"
OFF_AND_ON = "its pose does not jump when it was switched off and on"
CONNECTED_AGAIN, WRAPS = (
    "its pose does not jump when it is connected again",
    "its pose does not jump when a counter wraps",
)
_STREAMING, _ODOMETRY = "4. A robot that sends by itself", "5. Telemetry: Odometry"


def longest_s(session: Session[object]) -> tuple[float, float]:
    """Return a time that is longer than every period that a session declares: as far as the kit waits, and in all."""
    watchdog_s = session.keep_alive.watchdog_s if session.keep_alive is not None else 0.0
    periods = (watchdog_s, session.silent_s or 0.0, session.lost_s or 0.0)
    wanted_s = max(LEAST_S, *(period for period in periods if period < math.inf)) + MARGIN_S
    return min(MOST_S, wanted_s), wanted_s


async def check_long(protocol: Protocol, stage: Stage) -> list[CheckFinding]:
    """Leave the robot alone, then drive it to and fro, for longer than every period that its session declares."""
    session, (forward, _) = stage.sessions[0], fractions(protocol, DRIVE_S, DRIVE_S)
    seconds, wanted_s = longest_s(session)
    stage.prepare()
    moved = (await leg(stage, BACK_S, STAND_S, forward=forward)).true
    await stage.watch(seconds)
    problems, way = _ended(stage, f"it is left alone for {seconds:g} s"), -forward
    begun = stage.now()
    while not problems and stage.now() < begun + seconds:
        try:
            await stage.drive(BACK_S, forward=way)
        except Refused as refusal:
            problems.append(f"a drive is refused after {stage.now() - begun:.1f} s: {refusal}")
        problems, way = problems or _ended(stage, f"it is driven for {stage.now() - begun:.1f} s"), -way
    last = await leg(stage, BACK_S, STAND_S, forward=way) if not problems else None
    if last is not None and moved is not None and last.true is not None and last.true.far_m < moved.far_m / 2:
        problems.append(f"it moved {moved.far_m:.2f} m at first, and {last.true.far_m:.2f} m after that")
    if not problems and session.keep_alive is not None:
        problems += await _by_setpoint(stage, forward, min(MOST_S, session.keep_alive.watchdog_s + MARGIN_S))
    if not problems and wanted_s > seconds:
        why = f"it declares a period that needs {wanted_s:g} s, and the kit waits for {seconds:g} s at most"
        return [CheckFinding.not_checked(LONG, why, _STREAMING)]
    return [CheckFinding.of(LONG, problems, f"{seconds:g} s", guide=_STREAMING)]


def _ended(stage: Stage, when: str) -> list[str]:
    """Return why the session ended, is busy, or the robot's watchdog has stopped it."""
    problems = []
    for session in stage.sessions:
        kind = type(session).__qualname__
        if session.over or session.busy is not None:
            problems.append(
                f"{kind} {'ended' if session.over else 'is busy'} while {when}: {session.reason or session.busy}"
            )
    if any(truth.watchdog for _, truth in stage.truths):
        problems.append(f"the robot's watchdog acted while {when}: the keep-alive is missing, or too slow")
    return problems


async def _by_setpoint(stage: Stage, forward: float, seconds: float) -> list[str]:
    """Command one drive only: the keep-alive alone must keep the robot's watchdog from acting."""
    await stage.drive(0.05, forward=-forward)
    await stage.watch(seconds)
    await stage.stop(STAND_S)
    return _ended(stage, f"one drive lasts for {seconds:g} s")


async def check_reconnect(protocol: Protocol, stage: Stage, establish_s: float) -> list[CheckFinding]:
    """Drive away from where it began; lose the connection and connect again; switch the robot off and on."""
    forward, left = fractions(protocol, DRIVE_S, DRIVE_S)
    stage.prepare()
    for ahead, turn in ((forward, 0.0), (0.0, left), (forward, 0.0)):
        await leg(stage, DRIVE_S, STAND_S, forward=ahead, turn=turn)
    if stage.last_pose is None:
        return [
            CheckFinding.not_checked(claim, "it shows no pose", _ODOMETRY) for claim in (CONNECTED_AGAIN, OFF_AND_ON)
        ]
    await stage.close()
    first = await _without_a_jump(stage, CONNECTED_AGAIN, forward, establish_s)
    truth = stage.truth
    if first.problem is not None or truth is None:
        why = NO_TRUTH if truth is None else "the claim before does not hold"
        return [first, CheckFinding.not_checked(OFF_AND_ON, why, _ODOMETRY)]
    await stage.close()
    await stage.device.switch_off()
    stage.device.switch_on((truth.x, truth.y, truth.heading))
    await stage.device.listens()
    await asyncio.sleep(HANG_UP_S)
    if Way.between(truth, stage.truth).far_m > JUMP_M:
        why = "the simulated robot does not begin at Simulation.place"
        return [first, CheckFinding.not_checked(OFF_AND_ON, why, _ODOMETRY)]
    return [first, await _without_a_jump(stage, OFF_AND_ON, forward, establish_s)]


async def _without_a_jump(stage: Stage, claim: str, forward: float, establish_s: float) -> CheckFinding:
    """Connect to a robot that stands where it stood; find a pose that changes, or does not continue."""
    before = stage.last_pose
    assert before is not None
    await asyncio.sleep(HANG_UP_S)
    stage.forget()
    await stage.connect()
    if not await stage.established(establish_s):
        problem = "; ".join(stage.lacking(establish_s))
        return CheckFinding(claim, f"a second session is not established: {problem}", guide="3. The session")
    stage.prepare()
    await stage.watch(STAND_S)
    ways = [Way.between(before, pose) for pose in stage.poses]  # none: it shows its pose when that changes
    jump = max(ways, key=lambda way: way.far_m + abs(way.turned_rad), default=Way(0.0, 0.0, 0.0))
    if jump.far_m > JUMP_M or abs(jump.turned_rad) > JUMP_RAD:
        problem = f"it stood still, and its pose changed by {jump.far_m:.3f} m and {jump.turned_rad:.3f} rad"
        return CheckFinding(claim, problem, guide=_ODOMETRY)
    again = await leg(stage, DRIVE_S, STAND_S, forward=forward)
    if again.refused:
        return CheckFinding(claim, f"then a drive is refused: {again.refused}", guide="3. The session")
    moved = Way.between(before, stage.last_pose)
    if moved.ahead_m < JUMP_M or abs(moved.aside_m) > moved.ahead_m / 2:
        problem = f"then it moved {moved.ahead_m:.3f} m along its heading, {moved.aside_m:.3f} m beside it"
        return CheckFinding(claim, problem, guide=_ODOMETRY)
    return CheckFinding(claim)


async def check_wrap(protocol: Protocol, stage: Stage) -> list[CheckFinding]:
    """Drive until a counter of the robot begins anew."""
    stage.prepare()
    await stage.watch(STAND_S)
    if stage.truth is None or stage.last_pose is None:
        why = NO_TRUTH if stage.truth is None else "it shows no pose"
        return [CheckFinding.not_checked(WRAPS, why, _ODOMETRY)]
    wraps = stage.truth.wraps
    forward, _ = fractions(protocol, WRAP_S, WRAP_S)
    driven = await leg(stage, WRAP_S, STAND_S, forward=forward)
    if stage.truth.wraps == wraps:
        why = f"no counter wrapped around within {WRAP_S:g} s (Simulation.at_wrap, Truth.wraps)"
        return [CheckFinding.not_checked(WRAPS, why, _ODOMETRY)]
    assert driven.true is not None
    off = None
    if driven.shown is None or abs(driven.shown.ahead_m - driven.true.ahead_m) > JUMP_M + driven.true.ahead_m / 4:
        shown = f"{driven.shown.ahead_m:.3f}" if driven.shown is not None else "nothing"
        off = f"the pose shows {shown} m ahead, it was {driven.true.ahead_m:.3f} m"
    return [CheckFinding(WRAPS, off, guide=_ODOMETRY)]
