"""Conformance over time: long drives, a connection that is lost, counters that begin anew."""

from __future__ import annotations

import asyncio
import math

from zbridge.errors import Refused
from zbridge.protocol.plugin import Protocol
from zbridge.protocol.session import Session
from zbridge.simulation.checks.finding import CheckFinding
from zbridge.simulation.checks.stage import HANG_UP_S, Stage
from zbridge.simulation.checks.truth import NO_TRUTH, Way, leg

FORWARD, TURN, BACK_S = 0.4, 1.0, 0.5
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


def longest_s(session: Session[object]) -> float:
    """Return a time that is longer than every period that a session declares, as far as the kit waits for it."""
    watchdog_s = session.keep_alive.watchdog_s if session.keep_alive is not None else 0.0
    periods = (watchdog_s, session.silent_s or 0.0, session.lost_s or 0.0)
    return min(MOST_S, max(LEAST_S, *(period for period in periods if period < math.inf)) + MARGIN_S)


async def check_long(protocol: Protocol, stage: Stage) -> list[CheckFinding]:
    """Leave the robot alone, then drive it to and fro, for longer than every period that its session declares."""
    session = stage.sessions[0]
    seconds = longest_s(session)
    stage.prepare()
    moved = (await leg(stage, BACK_S, STAND_S, forward=FORWARD)).true
    await stage.watch(seconds)
    problems = _ended(stage, f"it is left alone for {seconds:g} s")
    begun, forward = stage.now(), -FORWARD
    while not problems and stage.now() < begun + seconds:
        try:
            await stage.drive(BACK_S, forward=forward)
        except Refused as refusal:
            problems.append(f"a drive is refused after {stage.now() - begun:.1f} s: {refusal}")
        problems, forward = problems or _ended(stage, f"it is driven for {stage.now() - begun:.1f} s"), -forward
    last = await leg(stage, BACK_S, STAND_S, forward=forward) if not problems else None
    if last is not None and moved is not None and last.true is not None and last.true.far_m < moved.far_m / 2:
        problems.append(f"it moved {moved.far_m:.2f} m at first, and {last.true.far_m:.2f} m after that")
    if not problems and session.keep_alive is not None:
        problems += await _by_setpoint(stage, session.keep_alive.watchdog_s + MARGIN_S)
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


async def _by_setpoint(stage: Stage, seconds: float) -> list[str]:
    """Command one drive only: the keep-alive alone keeps the robot moving."""
    await stage.drive(0.05, turn=TURN)
    await stage.watch(seconds)
    truth = stage.truth
    still = truth is not None and truth.neutral
    problems = [f"one drive lasts for less than {seconds:g} s: the robot has become neutral"] if still else []
    await stage.stop(STAND_S)
    return problems + _ended(stage, f"one drive lasts for {seconds:g} s")


async def check_reconnect(protocol: Protocol, stage: Stage, establish_s: float) -> list[CheckFinding]:
    """Drive away from where it began; lose the connection and connect again; switch the robot off and on."""
    stage.prepare()
    for forward, turn in ((FORWARD, 0.0), (0.0, TURN), (FORWARD, 0.0)):
        await leg(stage, DRIVE_S, STAND_S, forward=forward, turn=turn)
    if not stage.poses:
        return [
            CheckFinding.not_checked(claim, "it shows no pose", _ODOMETRY) for claim in (CONNECTED_AGAIN, OFF_AND_ON)
        ]
    findings = [await _without_a_jump(stage, CONNECTED_AGAIN, establish_s)]
    if stage.truth is None:
        return [*findings, CheckFinding.not_checked(OFF_AND_ON, NO_TRUTH, _ODOMETRY)]
    truth = stage.truth
    stage.close()
    await stage.device.switch_off()
    stage.device.switch_on((truth.x, truth.y, truth.heading))
    return [*findings, await _without_a_jump(stage, OFF_AND_ON, establish_s)]


async def _without_a_jump(stage: Stage, claim: str, establish_s: float) -> CheckFinding:
    """Connect again to a robot that stands where it stood; find a pose that changes, or does not go on."""
    before = stage.poses[-1]
    stage.close()
    await asyncio.sleep(HANG_UP_S)
    stage.forget()
    await stage.connect()
    if not await stage.established(establish_s):
        problem = "; ".join(stage.lacking(establish_s))
        return CheckFinding(claim, f"a second session is not established: {problem}", guide="3. The session")
    stage.prepare()
    await stage.watch(STAND_S)
    if not stage.poses:
        return CheckFinding(claim, "it shows no pose after it", guide=_ODOMETRY)
    jump = max((Way.between(before, pose) for pose in stage.poses), key=lambda way: way.far_m + abs(way.turned_rad))
    if jump.far_m > JUMP_M or abs(jump.turned_rad) > JUMP_RAD:
        problem = f"it stood still, and its pose changed by {jump.far_m:.3f} m and {jump.turned_rad:.3f} rad"
        return CheckFinding(claim, problem, guide=_ODOMETRY)
    again = await leg(stage, DRIVE_S, STAND_S, forward=FORWARD)
    if again.refused:
        return CheckFinding(claim, f"then a drive is refused: {again.refused}", guide="3. The session")
    if again.shown is not None and (again.shown.ahead_m < JUMP_M or abs(again.shown.aside_m) > again.shown.ahead_m / 2):
        problem = f"then it moved {again.shown.ahead_m:.3f} m along its heading, {again.shown.aside_m:.3f} m beside it"
        return CheckFinding(claim, problem, guide=_ODOMETRY)
    return CheckFinding(claim)


async def check_wrap(protocol: Protocol, stage: Stage) -> list[CheckFinding]:
    """Drive until a counter of the robot begins anew."""
    stage.prepare()
    await stage.watch(STAND_S)
    if stage.truth is None or not stage.poses:
        why = NO_TRUTH if stage.truth is None else "it shows no pose"
        return [CheckFinding.not_checked(WRAPS, why, _ODOMETRY)]
    wraps = stage.truth.wraps
    driven = await leg(stage, WRAP_S, STAND_S, forward=FORWARD)
    if stage.truth.wraps == wraps:
        why = f"no counter began anew within {WRAP_S:g} s (Simulation.at_wrap, Truth.wraps)"
        return [CheckFinding.not_checked(WRAPS, why, _ODOMETRY)]
    assert driven.true is not None
    off = None
    if driven.shown is None or abs(driven.shown.ahead_m - driven.true.ahead_m) > JUMP_M + driven.true.ahead_m / 4:
        shown = f"{driven.shown.ahead_m:.3f}" if driven.shown is not None else "nothing"
        off = f"the pose shows {shown} m ahead, it was {driven.true.ahead_m:.3f} m"
    return [CheckFinding(WRAPS, off, guide=_ODOMETRY)]
