"""What a robot showed on one leg of its way, and how it really moved; what of it contradicts what is expected."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median
from typing import Any, NamedTuple

import msgspec

from zbridge.errors import Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive
from zbridge.protocol import plugin
from zbridge.protocol.plugin import Truth
from zbridge.simulation.checks.stage import Stage

STEADY_S = 0.4
"""Seconds over which a speed is taken."""
SCALE = 0.15
"""Tolerance of a true speed against the options: robots count in whole units."""
SHOWN_SCALE = 0.1
"""Tolerance of what is shown against the truth."""
FORWARD = 0.4
"""A drive ahead, if the robot is not too fast for the room."""
MOST_M, LEAST_M, MOST_RAD = 0.4, 0.04, 2.0
"""Bounds of one leg."""
NO_TRUTH = "the simulated robot reports no truth (Simulation.report)"


class Way(NamedTuple):
    """A way in the axes at its beginning: metres ahead and to the left, radians counter-clockwise."""

    ahead_m: float
    aside_m: float
    turned_rad: float

    @classmethod
    def between(cls, begin: Any, end: Any) -> Way:
        """Measure the way from one pose to another."""
        x, y, cos, sin = end.x - begin.x, end.y - begin.y, math.cos(begin.heading), math.sin(begin.heading)
        turned_rad = math.remainder(end.heading - begin.heading, 2 * math.pi)
        return cls(x * cos + y * sin, y * cos - x * sin, turned_rad)

    @property
    def far_m(self) -> float:
        return math.hypot(self.ahead_m, self.aside_m)


class Leg(msgspec.Struct, frozen=True, kw_only=True):
    """A drive, and how it ended. shown: None where no pose is shown. true: None where the simulator does not say.

    steady_m_s, steady_rad_s: the true speed and turn rate during the drive. wheels_m_s: as of :class:`Truth`,
    then. speeds: what ``motion`` showed at the end of the drive. refused: why, if the drive was refused.
    """

    seconds: float
    shown: Way | None
    true: Way | None
    steady_m_s: float = 0.0
    steady_rad_s: float = 0.0
    wheels_m_s: tuple[float, ...] = ()
    speeds: tuple[float, ...] = ()
    written: frozenset[bytes] = frozenset()
    refused: str | None = None


async def leg(
    stage: Stage, seconds: float, stand_s: float, *, forward: float = 0.0, turn: float = 0.0, stop: bool = True
) -> Leg:
    """Drive for so long, end with a stop or with neutral, and wait until the robot stands."""
    pose, truth, begun = stage.last_pose, stage.truth, stage.now()
    stage.forget()
    refused = None
    try:
        await stage.drive(seconds, forward, turn)
    except Refused as refusal:
        refused = f"{refusal.code}: {refusal}"
    ended, speeds, written = stage.now(), tuple(stage.speeds[-3:]), frozenset(stage.written)
    steady = [entry for entry in stage.truths if begun <= entry[0] <= ended]
    if stop:
        await stage.stop(stand_s)
    else:
        stage.robot.command(topics.CMD_DRIVE, Drive(), stage.now())
        await stage.watch(stand_s)
    steady_m_s, steady_rad_s = rates(steady)
    after, true = stage.last_pose, stage.truth
    return Leg(
        seconds=ended - begun,
        shown=Way.between(pose, after) if pose is not None and after is not None else None,
        true=Way.between(truth, true) if truth is not None and true is not None else None,
        steady_m_s=steady_m_s,
        steady_rad_s=steady_rad_s,
        wheels_m_s=steady[-1][1].wheels_m_s if steady else (),
        speeds=speeds,
        written=written,
        refused=refused,
    )


def rates(truths: Sequence[tuple[float, Truth]]) -> tuple[float, float]:
    """Return the usual speed ahead, m/s, and the usual turn rate, rad/s, over :data:`STEADY_S` of the robot's time.

    truths: each with the time when it was reported, which counts only if the robot does not say its own.
    """
    times = [at if truth.lived_s is None else truth.lived_s for at, truth in truths]
    speeds: list[float] = []
    turns: list[float] = []
    first = 0
    for at, (_, truth) in zip(times, truths, strict=True):
        while times[first] < at - STEADY_S:
            first += 1
        seconds = at - times[first]
        if seconds >= STEADY_S / 2:
            way = Way.between(truths[first][1], truth)
            speeds.append(math.copysign(way.far_m, way.ahead_m) / seconds)
            turns.append(way.turned_rad / seconds)
    return _usual(speeds), _usual(turns)


def _usual(values: list[float]) -> float:
    """Return the median of the values that are no less than half of the upper quartile.

    On a busy machine a drive may come late, and the robot stops meanwhile.
    """
    if not values:
        return 0.0
    fast = sorted(map(abs, values))[3 * len(values) // 4]
    return median(value for value in values if abs(value) >= fast / 2)


def full_scale(protocol: plugin.Protocol, *names: str) -> float:
    """Return full scale according to the options, also within one of their tables; 0 if they do not state it."""
    options = msgspec.convert(protocol.simulated, protocol.options)
    tables = [options, *(getattr(options, name) for name in options.__struct_fields__)]
    found = (getattr(table, name, None) for table in tables if isinstance(table, msgspec.Struct) for name in names)
    return next((value for value in found if isinstance(value, float)), 0.0)


def fractions(protocol: plugin.Protocol, drive_s: float, turn_s: float) -> tuple[float, float]:
    """Return a drive ahead and a turn, fractions of full scale, that stay within the room and half a turn."""
    m_s = full_scale(protocol, "speed_full_m_s", "speed_full_mps")
    rad_s = full_scale(protocol, "turn_full_rad_s", "turn_full_radps")
    forward = min(FORWARD, MOST_M / (m_s * drive_s)) if m_s else FORWARD
    if m_s and m_s * drive_s * forward < LEAST_M:
        forward = 1.0
    return forward, min(1.0, MOST_RAD / (rad_s * turn_s)) if rad_s else 1.0


def unlike(seen: float, expected: float, within: float) -> bool:
    """Return whether a number differs from what is expected by more than this part of it."""
    return abs(seen - expected) > abs(expected) * within
