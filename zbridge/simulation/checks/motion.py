"""Conformance of motion: the simulated robot drives ahead, turns to the left, and stands after neutral and stops.

What it shows is compared with its options, and with the truth where the simulator reports it: a fault that the
commands and the telemetry share, such as turns of the wrong sign, shows a sound way.
"""

from __future__ import annotations

from collections.abc import Iterator

from zbridge.protocol.plugin import Protocol
from zbridge.simulation.checks.finding import CheckFinding
from zbridge.simulation.checks.handover import check_handover
from zbridge.simulation.checks.stage import Stage
from zbridge.simulation.checks.truth import NO_TRUTH, SCALE, SHOWN_SCALE, Leg, Way, fractions, full_scale, leg, unlike

DRIVE_S = 1.2
IDLE_S = 0.3
STAND_S = 0.7
"""Seconds after a stop, or neutral, within which the robot must halt."""
WATCHED_S = 0.8
TURN_S = 0.8
FACTOR = 3.0
"""Tolerance of what is shown against the options, where the truth is not known."""
TURNED_RAD, MOVED_M = 0.02, 0.02
MOVING = 0.05
"""The speed, of full scale, at which a robot moves."""
AXIS_RAD = 0.35
"""Tolerance of the direction of a way ahead."""
_UNITS, _STOPS = "5. Telemetry: Units and axes", "6. Commands: Stops"
DRIVES, STANDS = "the simulated robot drives", "the simulated robot stands after its stop"
NEUTRAL, TURNS = "the simulated robot stands after neutral", "a turn of the simulated robot is counter-clockwise"
AHEAD, WHOLE = "it drives ahead after a turn", "a stop ends a drive and a turn alike"
SPEED, RATE = "it drives as fast as the options say", "it turns as fast as the options say"
SHOWN = "what is shown of its way is true"


async def check_motion(protocol: Protocol, stage: Stage) -> list[CheckFinding]:
    """Drive the simulated robot forward and to the left, and stop it in each of the ways there are."""
    forward, left = fractions(protocol, DRIVE_S, TURN_S)
    stage.prepare()
    await stage.watch(IDLE_S)
    idle = stage.written
    ahead = await leg(stage, DRIVE_S, STAND_S, stop=False, forward=forward)
    findings = [_drives(ahead, idle), _speed(ahead, protocol, forward), await _stands(stage, NEUTRAL)]
    turn = await leg(stage, TURN_S, STAND_S, turn=left)
    findings.append(await _stands(stage, STANDS))
    after = await leg(stage, DRIVE_S, STAND_S, forward=forward)
    curve = await leg(stage, TURN_S, STAND_S, forward=forward, turn=left)
    findings.append(await _stands(stage, WHOLE))
    findings += [_turns(turn, curve, protocol), _rate(turn, protocol, left), _ahead(after)]
    findings.append(_shown((ahead, turn, after, curve), protocol))
    return [*findings, check_handover(protocol, stage.received)]


def _drives(ahead: Leg, idle: set[bytes]) -> CheckFinding:
    if ahead.refused:
        return CheckFinding(DRIVES, f"a drive ahead is refused: {ahead.refused}", guide=_UNITS)
    if ahead.true is not None and ahead.true.ahead_m < MOVED_M:
        return CheckFinding(DRIVES, f"it truly moved {ahead.true.ahead_m:.3f} m ahead in {DRIVE_S:g} s", guide=_UNITS)
    if ahead.shown is None and not ahead.speeds:
        commanded = bool(ahead.written - idle) or ahead.true is not None
        problem = None if commanded else "nothing is written for a drive"
        return CheckFinding(DRIVES, problem, "seen on the wire only", guide=_UNITS)
    if ahead.shown is not None and ahead.shown.ahead_m < MOVED_M:
        return CheckFinding(DRIVES, f"it moved {ahead.shown.ahead_m:.3f} m ahead in {DRIVE_S:g} s", guide=_UNITS)
    if ahead.speeds and max(ahead.speeds) < MOVING:
        return CheckFinding(DRIVES, f"motion shows a speed of {max(ahead.speeds):g}", guide=_UNITS)
    return CheckFinding(DRIVES, None, f"{ahead.shown.ahead_m:.2f} m" if ahead.shown else "by its speed")


def _speed(ahead: Leg, protocol: Protocol, forward: float) -> CheckFinding:
    expected = full_scale(protocol, "speed_full_m_s", "speed_full_mps") * forward
    return _as_fast(SPEED, expected, "m/s", ahead, ahead.steady_m_s, ahead.shown and ahead.shown.ahead_m)


def _rate(turn: Leg, protocol: Protocol, left: float) -> CheckFinding:
    if turn.refused:
        return CheckFinding.not_checked(RATE, f"a turn on the spot is refused: {turn.refused}", _UNITS)
    expected = full_scale(protocol, "turn_full_rad_s", "turn_full_radps") * left
    return _as_fast(RATE, expected, "rad/s", turn, turn.steady_rad_s, turn.shown and turn.shown.turned_rad)


def _as_fast(claim: str, expected: float, unit: str, driven: Leg, steady: float, shown: float | None) -> CheckFinding:
    if not expected:
        return CheckFinding.not_checked(claim, "the options state no full scale in SI units", _UNITS)
    if driven.true is not None:
        problem = f"it truly has {steady:.3f} {unit}, the options say {expected:.3f} {unit}"
        return CheckFinding(claim, problem if unlike(steady, expected, SCALE) else None, guide=_UNITS)
    if shown is not None and not expected / FACTOR <= shown / driven.seconds <= expected * FACTOR:
        problem = f"it shows {shown / driven.seconds:.3f} {unit}, the options say {expected:.3f} {unit}"
        return CheckFinding(claim, problem, guide=_UNITS)
    within = f"; what it shows is within a factor of {FACTOR:g}" if shown is not None else ""
    return CheckFinding.not_checked(claim, NO_TRUTH + within, _UNITS)


async def _stands(stage: Stage, claim: str) -> CheckFinding:
    """Watch a robot that must stand."""
    stage.forget()
    begun = stage.now()
    await stage.watch(WATCHED_S)
    truths, problems = [truth for at, truth in stage.truths if at >= begun], []
    if truths and not truths[-1].neutral and any(truths[-1].wheels_m_s):
        problems.append(f"its motors are not neutral: wheels_m_s is {truths[-1].wheels_m_s}")
    for what, poses in (("truly", truths), ("as it shows", stage.poses)):
        if len(poses) > 1:
            way = Way.between(poses[0], poses[-1])
            if way.far_m > MOVED_M / 2 or abs(way.turned_rad) > TURNED_RAD:
                problems.append(f"{what} it moves on: {way.far_m:.3f} m, {way.turned_rad:.3f} rad in {WATCHED_S:g} s")
    if stage.speeds and abs(stage.speeds[-1]) > MOVING:
        problems.append(f"motion shows a speed of {stage.speeds[-1]:g}")
    seen = bool(truths or stage.poses or stage.speeds)
    return CheckFinding.of(claim, problems, "" if seen else "seen on the wire only", guide=_STOPS)


def _turns(turn: Leg, curve: Leg, protocol: Protocol) -> CheckFinding:
    """Judge the turn on the spot; of a robot that steers, a curve ahead."""
    turned = [abs(way.turned_rad) for way in (turn.true, turn.shown) if way is not None]
    stated = bool(full_scale(protocol, "turn_full_rad_s", "turn_full_radps"))
    judged = turn if not turn.refused and (stated or any(rad > TURNED_RAD for rad in turned)) else curve
    if judged.refused:
        return CheckFinding.not_checked(TURNS, f"turns are refused: {judged.refused}", _UNITS)
    if judged.true is None and judged.shown is None:
        return CheckFinding.not_checked(TURNS, f"it shows no pose, and {NO_TRUTH}", _UNITS)
    for what, way in (("truly", judged.true), ("as it shows", judged.shown)):
        if way is not None and way.turned_rad < TURNED_RAD:
            return CheckFinding(TURNS, f"{what} its heading changed by {way.turned_rad:.3f} rad", guide=_UNITS)
    wheels = judged.wheels_m_s
    if len(wheels) > 1 and wheels[0] >= wheels[-1]:
        return CheckFinding(
            TURNS, f"its left side is not slower than its right one: wheels_m_s is {wheels}", guide=_UNITS
        )
    return CheckFinding(TURNS)


def _ahead(after: Leg) -> CheckFinding:
    ways = [way for way in (after.true, after.shown) if way is not None and not after.refused]
    if not ways:
        return CheckFinding.not_checked(AHEAD, f"it shows no pose, and {NO_TRUTH}", _UNITS)
    for way in ways:
        if way.ahead_m < MOVED_M or abs(way.aside_m) > way.ahead_m * AXIS_RAD:
            problem = f"it moved {way.ahead_m:.3f} m along its heading and {way.aside_m:.3f} m to the left of it"
            return CheckFinding(AHEAD, problem, guide=_UNITS)
    return CheckFinding(AHEAD)


def _shown(legs: tuple[Leg, ...], protocol: Protocol) -> CheckFinding:
    """Compare what is shown of each leg with the truth."""
    if all(driven.true is None for driven in legs):
        return CheckFinding.not_checked(SHOWN, NO_TRUTH, _UNITS)
    if all(driven.shown is None and not driven.speeds for driven in legs):
        return CheckFinding.not_checked(SHOWN, "it shows neither pose nor motion", _UNITS)
    return CheckFinding.of(SHOWN, [problem for driven in legs for problem in _untrue(driven, protocol)], guide=_UNITS)


def _untrue(driven: Leg, protocol: Protocol) -> Iterator[str]:
    true, shown = driven.true, driven.shown
    if true is None or driven.refused:
        return
    if shown is not None:
        for what, seen, so, least in (
            ("m ahead", shown.ahead_m, true.ahead_m, MOVED_M),
            ("rad", shown.turned_rad, true.turned_rad, TURNED_RAD),
        ):
            if abs(seen - so) > least and unlike(seen, so, SHOWN_SCALE):
                yield f"the pose shows {seen:.3f} {what}, it was {so:.3f} {what}"
    full = full_scale(protocol, "speed_full_m_s", "speed_full_mps")
    if driven.speeds and full and abs(driven.speeds[-1] - driven.steady_m_s / full) > MOVING:
        yield f"motion shows a speed of {driven.speeds[-1]:.2f}, it was {driven.steady_m_s / full:.2f}"
