"""Between Khepera lines and fleet messages, and one Khepera as a robot. Sans-IO."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import msgspec
import numpy as np

from khepera.messages import Positions, Proximity, SetLed, SetSpeeds, Speeds
from khepera.session import KheperaSession
from zbridge.errors import NotReady, Unsupported
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Motion, Pose, Reading, Scan, Switch
from zbridge.fleet.topics import Topic
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import Outcome, Robot, Telemetry, Translate

UNIT_M_S = 0.008
"""One unit of a wheel's speed."""
PULSE_M = 0.00008
"""One pulse of a wheel's counter."""
MOST_UNITS = 127
DRIVE_AGAIN_S = 0.5
STOP_AGAIN_S = 0.1
BEARINGS_DEG = np.array([-150, -85, -45, -15, 15, 45, 85, 150])
"""Where the sensors look, counter-clockwise from straight ahead; in the order of :class:`Proximity`."""
STEP_DEG = 5
RANGE_M = (0.005, 0.06)
"""What the sensors see: nothing farther than 6 cm."""
LIGHT = np.array([20.0, 60.0, 150.0, 350.0, 700.0, 1023.0])
DISTANCE_M = np.array([0.06, 0.05, 0.035, 0.02, 0.01, 0.005])
"""The distance of an obstacle at each value of LIGHT."""

Positive = Annotated[float, msgspec.Meta(gt=0, le=100)]


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[device.options]``; the template of ``zbridge init`` explains each."""

    speed_full_m_s: Positive = 0.5
    turn_full_rad_s: Positive = 3.0
    track_m: Positive = 0.053


class KheperaRobot(Robot):
    """One Khepera on one link."""

    link_names = ("robot",)

    def __init__(self, options: Options, links: int = 1, metrics: Metrics | None = None) -> None:
        self.options = options
        self._session: KheperaSession | None = None
        self._x = self._y = self._heading = 0.0
        self._pulses: tuple[int, int] | None = None

    @property
    def driving(self) -> KheperaSession | None:
        return self._session

    def session(self, link: str, peer: str) -> KheperaSession:
        self._session = KheperaSession()
        self._pulses = None
        return self._session

    # Messages to telemetry

    def translator(self, kind: type) -> Translate:
        return partial(_TELEMETRY.get(kind, _nothing), self)

    def _pose(self, message: Positions, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Add what the wheels have turned since the last answer to the pose."""
        before, self._pulses = self._pulses or (message.left, message.right), (message.left, message.right)
        left_m, right_m = ((new - old) * PULSE_M for new, old in zip(self._pulses, before, strict=True))
        way_m, turned = (left_m + right_m) / 2, (right_m - left_m) / self.options.track_m
        self._x += way_m * math.cos(self._heading + turned / 2)
        self._y += way_m * math.sin(self._heading + turned / 2)
        self._heading = math.remainder(self._heading + turned, 2 * math.pi)
        return ((topics.POSE, Pose(self._x, self._y, self._heading, stamp_ns=stamp_ns)),)

    def _motion(self, message: Speeds, stamp_ns: int) -> tuple[Telemetry, ...]:
        speed = (message.left + message.right) / 2 * UNIT_M_S / self.options.speed_full_m_s
        turn_rad_s = (message.right - message.left) * UNIT_M_S / self.options.track_m
        motion = Motion(speed=max(-1.0, min(1.0, speed)), gyro=(0.0, 0.0, turn_rad_s), stamp_ns=stamp_ns)
        return ((topics.MOTION, motion),)

    def _scan(self, message: Proximity, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Show the sensors one by one and, as metres at their bearings, as a scan."""
        values = msgspec.structs.asdict(message)
        metres = np.interp(list(values.values()), LIGHT, DISTANCE_M, left=np.nan)
        ranges = np.full((BEARINGS_DEG[-1] - BEARINGS_DEG[0]) // STEP_DEG + 1, np.nan, np.float32)
        ranges[(BEARINGS_DEG - BEARINGS_DEG[0]) // STEP_DEG] = metres
        scan = Scan(math.radians(BEARINGS_DEG[0]), math.radians(STEP_DEG), *RANGE_M, ranges, stamp_ns=stamp_ns)
        readings = (
            (topics.SENSOR(name), Reading(float(value), kind="proximity", stamp_ns=stamp_ns))
            for name, value in values.items()
        )
        return ((topics.SCAN, scan), *readings)

    # Commands to messages

    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        if isinstance(command, Drive):
            return self._drive(command, now)
        if topic is topics.CMD_LIGHT and isinstance(command, Switch):
            self._connected().send(SetLed(0, int(command.on)))
            return Outcome()
        raise Unsupported("a Khepera has no such command")

    def _drive(self, command: Drive, now: float) -> Outcome:
        if command.left and not (command.forward or command.turn):
            raise Unsupported("left: a robot with two wheels does not move sideways")
        session, options = self._connected(), self.options
        along = command.forward * options.speed_full_m_s
        across = command.turn * options.turn_full_rad_s * options.track_m / 2
        speeds = SetSpeeds(_units(along - across), _units(along + across))
        session.outbox.stand("drive", (session.encode(speeds),), now, period_s=DRIVE_AGAIN_S)
        if command.light is not None:
            session.send(SetLed(0, int(command.light)))
        return Outcome(left_out="left: a robot with two wheels does not move sideways" if command.left else None)

    def stop(self, now: float, until: float) -> None:
        session = self._connected()
        frames = (session.encode(SetSpeeds(0, 0)),)
        session.outbox.stand("drive", frames, now, period_s=STOP_AGAIN_S, until=until, urgent=True)

    def ask(self, topic: Topic) -> None:
        raise Unsupported(f"a Khepera cannot be asked for its {topic.path}: it shows what it has")

    def _connected(self) -> KheperaSession:
        if self._session is None or self._session.over:
            raise NotReady("offline")
        return self._session


def _units(speed_m_s: float) -> int:
    return max(-MOST_UNITS, min(MOST_UNITS, round(speed_m_s / UNIT_M_S)))


def _nothing(robot: KheperaRobot, message: Line, stamp_ns: int) -> tuple[Telemetry, ...]:
    return ()


_TELEMETRY: dict[type, Callable[[KheperaRobot, Any, int], tuple[Telemetry, ...]]] = {
    Positions: KheperaRobot._pose,
    Speeds: KheperaRobot._motion,
    Proximity: KheperaRobot._scan,
}
