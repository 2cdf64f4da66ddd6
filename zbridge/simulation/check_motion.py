"""Conformance of the simulated robot: it drives ahead, halts after its stop, and turns to the left."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Iterator

import msgspec

from zbridge.errors import Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Mode, Motion, Pose
from zbridge.protocol.plugin import Protocol
from zbridge.simulation.check_stage import CheckFinding, Stage, live, raised

DRIVE_S = 1.0
AGAIN_S = 0.1
IDLE_S = 0.3
STAND_S = 0.7
"""Seconds after a stop within which the robot must halt."""
WATCHED_S = 1.2
TURN_S = 0.6
FORWARD, TURN = 0.4, 0.5
FACTOR = 3.0
"""Tolerance of a distance or a turn against the options."""
TURNED_RAD = 0.02
MOVED_M = 0.02
MOVING = 0.05
"""The speed, of full scale, at which a robot moves."""


def check_motion(protocol: Protocol, establish_s: float) -> Iterator[CheckFinding]:
    """Drive the simulated robot forward, then stop it, and check what it shows or what is written."""
    try:
        yield from asyncio.run(_drive_and_stop(protocol, establish_s))
    except Exception as error:  # whatever the protocol's own code raises is a finding
        yield CheckFinding("the simulated robot drives and stands", raised(error))


async def _drive_and_stop(protocol: Protocol, establish_s: float) -> list[CheckFinding]:
    async with live(protocol) as scene:
        if not await scene.established(establish_s):
            return [CheckFinding("the simulated robot drives and stands", "a second session is not established")]
        clock = asyncio.get_running_loop().time
        scene.robot.begun(1)
        with contextlib.suppress(Refused):  # where a mode is needed or known
            scene.robot.command(topics.CMD_MODE, Mode(mode="manual"), clock())
        idle = await _watch(scene, IDLE_S)
        begun = clock()
        for _ in range(round(DRIVE_S / AGAIN_S)):
            scene.robot.command(topics.CMD_DRIVE, Drive(forward=FORWARD), clock())
            await _watch(scene, AGAIN_S, keep=True)
        drive = _Seen(scene)
        expected_m = _full(protocol, "speed_full_m_s") * FORWARD * (clock() - begun)
        scene.robot.stop(clock(), clock() + STAND_S / 2)
        stop = await _watch(scene, STAND_S)
        stand = await _watch(scene, WATCHED_S)
        return [
            drive.moves(idle, expected_m),
            stand.stands(stop, drive),
            await _turn(scene, clock, _full(protocol, "turn_full_rad_s")),
        ]


async def _turn(scene: Stage, clock: Callable[[], float], full_rad_s: float) -> CheckFinding:
    """Turn to the left, if the robot shows its heading; ``full_rad_s`` as in the options, 0 if unknown."""
    claim = "a turn of the simulated robot is counter-clockwise"
    before = _Seen(scene).poses
    if not before:
        return CheckFinding(claim, None, "not checked: it shows no pose")
    begun = clock()
    for _ in range(round(TURN_S / AGAIN_S)):
        try:
            scene.robot.command(topics.CMD_DRIVE, Drive(turn=TURN), clock())
        except Refused as refusal:
            return CheckFinding(claim, None, refusal.code)
        await _watch(scene, AGAIN_S)
    after = _Seen(scene).poses
    expected_rad = full_rad_s * TURN * (clock() - begun)
    scene.robot.stop(clock(), clock() + STAND_S / 2)
    await _watch(scene, STAND_S / 2)
    turned = math.remainder(after[-1].heading - before[-1].heading, 2 * math.pi) if after else 0.0
    if turned < TURNED_RAD:
        return CheckFinding(claim, f"its heading changed by {turned:.3f} rad")
    return CheckFinding(claim, _unlike(turned, expected_rad, "rad"))


def _full(protocol: Protocol, option: str) -> float:
    """Return full scale according to the options; 0 if they do not state it."""
    value = getattr(msgspec.convert(protocol.simulated, protocol.options), option, 0.0)
    return value if isinstance(value, float) else 0.0


def _unlike(seen: float, expected: float, unit: str) -> str | None:
    """Return whether a distance or a turn contradicts the options; ``expected`` 0: they do not state it."""
    if not expected or expected / FACTOR <= seen <= expected * FACTOR:
        return None
    return f"{seen:.3f} {unit}, but the options say {expected:.3f} {unit}"


async def _watch(scene: Stage, seconds: float, *, keep: bool = False) -> _Seen:
    """Run the robot; return what it showed. ``keep``: what it showed before counts too."""
    if not keep:
        scene.shown.clear()
        scene.frames.clear()
    scene.pump()
    await asyncio.sleep(seconds)
    return _Seen(scene)


class _Seen:
    """What a robot showed of its motion, and what was written."""

    def __init__(self, scene: Stage) -> None:
        self.poses: list[Pose] = []
        self.speeds: list[float] = []
        self.written = {frame for direction, frame in scene.frames if direction == "out"}
        for _, shown in scene.shown:
            self.poses += [shown] if isinstance(shown, Pose) else []
            self.speeds += [shown.speed] if isinstance(shown, Motion) and shown.speed is not None else []

    @property
    def way_m(self) -> float:
        """Distance from the first position along the first heading; negative: behind."""
        first, last = self.poses[0], self.poses[-1]
        return (last.x - first.x) * math.cos(first.heading) + (last.y - first.y) * math.sin(first.heading)

    def moves(self, idle: _Seen, expected_m: float) -> CheckFinding:
        """Return whether it moved, or at least was commanded to."""
        claim = "the simulated robot drives"
        if not self.poses and not self.speeds:
            commanded = bool(self.written - idle.written)
            return CheckFinding(claim, None if commanded else "nothing is written for a drive", "seen on the wire only")
        if self.poses and self.way_m < MOVED_M:
            return CheckFinding(claim, f"it moved {self.way_m:.3f} m ahead in {DRIVE_S:g} s")
        if self.poses and (unlike := _unlike(self.way_m, expected_m, "m")):
            return CheckFinding(claim, unlike)
        if self.speeds and max(map(abs, self.speeds)) < MOVING:
            return CheckFinding(claim, f"it shows a speed of {max(map(abs, self.speeds)):g}")
        return CheckFinding(claim, None, f"{self.way_m:.2f} m" if self.poses else "by its speed")

    def stands(self, stop: _Seen, drive: _Seen) -> CheckFinding:
        """Return whether it halted after the stop, or at least was commanded to."""
        claim = "the simulated robot stands after its stop"
        if not self.poses and not self.speeds:
            commanded = bool(stop.written - drive.written)
            return CheckFinding(claim, None if commanded else "nothing is written for a stop", "seen on the wire only")
        if self.poses and abs(self.way_m) > MOVED_M:
            return CheckFinding(claim, f"it moves on: {self.way_m:.3f} m in {WATCHED_S:g} s")
        if self.speeds and abs(self.speeds[-1]) > MOVING:
            return CheckFinding(claim, f"it shows a speed of {self.speeds[-1]:g}")
        return CheckFinding(claim)
