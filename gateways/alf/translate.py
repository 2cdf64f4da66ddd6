"""Translates between ALF messages and fleet messages, both ways: one vehicle. Sans-IO.

Source: "Translation from the robot" and "Translation of commands" of the protocol page.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from gateways.alf import messages
from gateways.alf.session import AlfHqRole, points_of
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Floats, Motion, Scan, Scanner, Switch
from zbridge.fleet.topics import Topic
from zbridge.protocol import (
    DeviceClock,
    Metrics,
    NotReady,
    Outcome,
    Positive,
    ProtocolError,
    RobotSide,
    Telemetry,
    Translate,
    Unsupported,
)

NAME = "alf"
VEHICLE = "vehicle"
"""The name of the link of a vehicle with one."""
DRIVE, LASER = "drive", "laser"
"""The names of the links of a vehicle with two."""
STANDARD_GRAVITY = 9.80665
FULL_LOCK_DEG = 90
"""The steering angle at ``turn`` = -1 or 1."""

_M_PER_MM = 1e-3
_MM_PER_M = 1000
_MOST_TABLE_MM = 100_000
_FORWARD, _BACKWARD = 0, 1
_COUNTER_ENDS = 2**32
UNITS = {
    messages.AlfDialect.TEXT: (STANDARD_GRAVITY, math.radians(1.0)),
    messages.AlfDialect.BINARY: (STANDARD_GRAVITY / 1000, math.radians(0.1)),
}
"""One unit of acceleration (m/s2) and of gyro (rad/s), unless the options set another."""

Ints = npt.NDArray[np.int64]


class AlfOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[device.options]``; the template of ``zbridge init`` explains each."""

    dialect: Literal["text", "binary"] = "text"
    points: Annotated[int, msgspec.Meta(ge=1, le=messages.MOST_POINTS)] = messages.POINTS
    points_from_scanner: bool = False
    speed_full: Annotated[int, msgspec.Meta(ge=1, le=255)] = 100
    acceleration_m_s2: Positive | None = None
    gyro_rad_s: Positive | None = None
    gap_s: Annotated[float, msgspec.Meta(ge=0, le=0.02)] = 0.0


class AlfRobot(RobotSide):
    """One vehicle, with one link or two; the first link drives."""

    hands_over = True
    accepts = ("drive", "light")
    driving: AlfHqRole | None = None
    kept: ClassVar[dict[str, Any]] = {
        "_scanner": messages.ScannerInit | None,
        "_clock": DeviceClock,
        "_sequence": int | None,
        "_light": bool,
        "_backward": bool,
        "_command": messages.DriveCommand,
    }

    def __init__(self, options: AlfOptions, links: int = 1, metrics: Metrics | None = None) -> None:
        metrics = metrics or Metrics()
        self.options = options
        self.link_names = (VEHICLE,) if links == 1 else (DRIVE, LASER)
        self.dialect = options.dialect  # type: ignore[misc]
        self._dialect = messages.AlfDialect(options.dialect)
        acceleration, gyro = UNITS[self._dialect]
        self._acceleration = options.acceleration_m_s2 or acceleration
        self._gyro = options.gyro_rad_s or gyro
        self._scanner: messages.ScannerInit | None = None
        self._clock = DeviceClock(_COUNTER_ENDS if self._dialect is messages.AlfDialect.BINARY else None)
        self._sequence: int | None = None
        self._gaps = metrics.count("sequence_gaps", help="Sequence numbers of ALF that are missing.")
        self._duplicates = metrics.count("sequence_duplicates", help="Sequence numbers of ALF that came twice.")
        self._light = False
        self._backward = False
        self._command = self._neutral()

    def session(self, link: str, peer: str) -> AlfHqRole:
        session = AlfHqRole(
            self._dialect,
            points=self.options.points,
            points_from_scanner=self.options.points_from_scanner,
            gap_s=self.options.gap_s,
        )
        if link == self.link_names[0]:
            self._backward = False
            session.at_first = self._command = self._neutral()
            self.driving = session
        return session

    # Messages to telemetry

    def translator(self, kind: type) -> Translate:
        return partial(_TELEMETRY[kind], self)

    def _scan(self, message: messages.Measurement, stamp_ns: int) -> tuple[Telemetry, ...]:
        scanner = self._scanner
        if scanner is None:
            raise ProtocolError("measurement before scanner init")
        self._count(message.sequence)
        scan = Scan(
            math.radians(scanner.angle_min_deg),
            math.radians(scanner.angle_increment_deg),
            scanner.range_min_mm * _M_PER_MM,
            scanner.range_max_mm * _M_PER_MM,
            ranges_m(message, scanner),
            stamp_ns=self._clock.stamp_ns(message.timestamp_ms, stamp_ns),
            seq=message.sequence,
            device_ms=message.timestamp_ms,
        )
        return ((topics.SCAN, scan),)

    def _count(self, sequence: int) -> None:
        """Count the measurements that were lost, and those that came twice, by their sequence numbers."""
        before, self._sequence = self._sequence, sequence
        if before is None or sequence < before:  # the first, or a vehicle that was started anew
            return
        if sequence == before:
            self._duplicates.value += 1
        else:
            self._gaps.value += sequence - before - 1

    def _geometry(self, message: messages.ScannerInit, stamp_ns: int) -> tuple[Telemetry, ...]:
        points = points_of(message) if self.options.points_from_scanner else self.options.points
        self._scanner = message
        scanner = Scanner(
            math.radians(message.angle_min_deg),
            math.radians(message.angle_max_deg),
            math.radians(message.angle_increment_deg),
            message.time_increment_ms / 1000,
            message.range_min_mm * _M_PER_MM,
            message.range_max_mm * _M_PER_MM,
            points,
            stamp_ns=stamp_ns,
        )
        return ((topics.SCANNER, scanner),)

    def _motion(self, message: messages.DriveInfo, stamp_ns: int) -> tuple[Telemetry, ...]:
        speed = min(1.0, message.speed / self.options.speed_full)
        a, g = self._acceleration, self._gyro
        motion = Motion(
            -speed if self._backward and speed else speed,
            (message.longitudinal * a, -message.lateral * a, message.vertical * a),
            (message.gyro_x * g, message.gyro_y * g, message.gyro_z * g),
            message.temperature,
            stamp_ns=stamp_ns,
        )
        return ((topics.MOTION, motion),)

    # Commands to messages

    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        if isinstance(command, Drive):
            return self._drive(command, now)
        if topic is topics.CMD_LIGHT and isinstance(command, Switch):
            self._light = command.on
            self._send(msgspec.structs.replace(self._command, light=command.on), now)
            return Outcome()
        raise Unsupported("an ALF vehicle has no such command")

    def stop(self, now: float, until: float) -> None:
        self._send(self._neutral(), now, urgent=True)

    def stop_frames(self) -> tuple[bytes, ...]:
        return (self.driving.encode(self._neutral()),) if self.driving is not None else ()

    def ask(self, topic: Topic) -> None:
        raise Unsupported(f"an ALF vehicle cannot be asked for its {topic.path}")

    def _drive(self, command: Drive, now: float) -> Outcome:
        if command.left and not (command.forward or command.turn):
            raise Unsupported("left: an ALF vehicle steers, it does not move sideways")
        if command.light is not None:
            self._light = command.light
        backward = command.forward < 0 or (self._backward and not command.forward)
        steering_deg = round((command.turn if command.forward < 0 else -command.turn) * FULL_LOCK_DEG)
        speed = round(abs(command.forward) * self.options.speed_full)
        self._send(self._written(speed, backward=backward, steering_deg=steering_deg), now)
        return Outcome(left_out="left: an ALF vehicle steers, it does not move sideways" if command.left else None)

    def _neutral(self) -> messages.DriveCommand:
        """Speed 0, wheels straight. The direction is kept: the vehicle may still roll."""
        return self._written(0, backward=self._backward, steering_deg=0)

    def _written(self, speed: int, *, backward: bool, steering_deg: int) -> messages.DriveCommand:
        """Make a command. ``steering_deg``: positive to the right."""
        straight = FULL_LOCK_DEG if self._dialect is messages.AlfDialect.BINARY else 0
        return messages.DriveCommand(speed, _BACKWARD if backward else _FORWARD, straight + steering_deg, self._light)

    def _send(self, command: messages.DriveCommand, now: float, *, urgent: bool = False) -> None:
        if self.driving is None:
            raise NotReady("offline")
        self.driving.drive(command, now, urgent=urgent)
        self._command = command
        self._backward = command.direction == _BACKWARD


def ranges_m(message: messages.Measurement, scanner: messages.ScannerInit) -> Floats:
    """Return the ranges, metres, float32[n]: NaN outside the valid indices (inclusive) and outside the range."""
    least, most = max(1, scanner.range_min_mm), max(0, scanner.range_max_mm)
    if most <= _MOST_TABLE_MM:
        ranges: Floats = _metres(least, most).take(message.points, mode="clip")
    else:
        ranges = _in_metres(message.points, least, most)
    ranges[: message.first_valid] = np.nan
    ranges[message.last_valid + 1 :] = np.nan
    return ranges


@lru_cache(maxsize=8)
def _metres(least: int, most: int) -> Floats:
    """Tabulate the metres of each mm up to ``most``, then NaN: takes half the time of comparing each point."""
    return _in_metres(np.arange(most + 2), least, most)


def _in_metres(points: Ints, least: int, most: int) -> Floats:
    metres: Floats = np.divide(points, _MM_PER_M, dtype=np.float32, casting="unsafe")
    metres[(points < least) | (points > most)] = np.nan
    return metres


_TELEMETRY: dict[type[messages.AlfMessage], Callable[[AlfRobot, Any, int], tuple[Telemetry, ...]]] = {
    messages.Measurement: AlfRobot._scan,
    messages.ScannerInit: AlfRobot._geometry,
    messages.DriveInfo: AlfRobot._motion,
}
