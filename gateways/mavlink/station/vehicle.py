"""What ground stations are told of a robot: each message from the last that it published. Sans-IO.

Source: "Translation" and "The gateway as vehicle" of the protocol page. North and east come from the map's +x, whose
compass direction the origin gives; without an origin it is east, and there are no degrees.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from gateways.mavlink.messages import MavlinkMessage, control, telemetry
from gateways.mavlink.numbers import BODY_FRD, M_PER_E7
from gateways.mavlink.station.options import MavlinkHqOptions
from zbridge.fleet.messages import Battery, FleetMessage, Motion, Pose, Scan
from zbridge.fleet.view import RobotView
from zbridge.protocol import Kept

UNKNOWN_16 = 65535
_POINTS = 72
_MOST_CM = 65534
_FIX_3D, _NO_FIX = 3, 1
_LANDED = 1
_E7, _MM, _CDEG, _CM = 1e7, 1000, 100, 100
_INT32 = 2**31 - 1
_GYRO, _ACCELEROMETER, _COMPASS, _GPS = 1, 2, 4, 32
_MOTORS, _PREARM = 1 << 15, 1 << 28
HEALTHY = _GYRO | _ACCELEROMETER | _COMPASS | _MOTORS | _PREARM
_COMMAND_INT, _PARAM_FLOAT, _VELOCITY_SETPOINTS, _MAVLINK2 = 8, 2, 128, 8192
CAPABILITIES = _COMMAND_INT | _PARAM_FLOAT | _VELOCITY_SETPOINTS | _MAVLINK2
"""No missions, fences, files: a program that believes in them asks for them."""
FIRMWARE = 4 << 24 | 5 << 16 | 255
"""ArduRover 4.5, official: what its programs expect of a rover holds for it."""


class ShownRover(Kept):
    """The robot of one listener as a rover."""

    kept: ClassVar[dict[str, Any]] = {"_begun_ns": int | None}

    def __init__(self, options: MavlinkHqOptions, view: RobotView) -> None:
        self.options = options
        self.view = view
        self._battery: Battery | None = None
        self._begun_ns: int | None = None

    def __repr__(self) -> str:
        return f"<ShownRover {self.options.system_id} {self.view!r}>"

    def note(self, message: FleetMessage) -> tuple[int, ...]:
        """Keep what the view does not; return the ids of the messages that tell something new now."""
        if isinstance(message, Battery):
            self._battery = message
        return _NEWS.get(type(message), ())

    def message(self, message_id: int) -> MavlinkMessage | None:
        """Write what is known now as the message of an id; None if it is not known, or no such message is told."""
        maker = _MAKERS.get(message_id)
        return maker(self) if maker is not None else None

    # The messages

    def _attitude(self) -> MavlinkMessage | None:
        pose, motion = self.view.pose, self.view.motion
        if pose is None:
            return None
        yawspeed = -motion.gyro[2] if motion is not None and motion.gyro is not None else 0.0
        yaw = math.remainder(self._compass(pose), 2 * math.pi)
        return telemetry.Attitude(self._boot_ms(pose), 0.0, 0.0, yaw, yawspeed=_finite(yawspeed))

    def _local(self) -> MavlinkMessage | None:
        pose = self.view.pose
        if pose is None:
            return None
        north, east = self._north_east(pose)
        north_m_s, east_m_s = self._velocity(pose)
        return telemetry.LocalPositionNed(self._boot_ms(pose), north, east, 0.0, north_m_s, east_m_s, 0.0)

    def _global(self) -> MavlinkMessage | None:
        pose, origin = self.view.pose, self.options.origin
        if pose is None or origin is None:
            return None
        latitude, longitude = self._degrees(pose)
        north_cm_s, east_cm_s = (round(_bounded(speed * _CM, 32767)) for speed in self._velocity(pose))
        heading = round(math.degrees(self._compass(pose)) % 360 * _CDEG) % 36000
        altitude = round(origin.altitude * _MM)
        return telemetry.GlobalPositionInt(
            self._boot_ms(pose), latitude, longitude, altitude, 0, north_cm_s, east_cm_s, 0, heading
        )

    def _gps(self) -> MavlinkMessage:
        pose, origin = self.view.pose, self.options.origin
        if pose is None or origin is None:
            return telemetry.GpsRawInt(
                eph=UNKNOWN_16, epv=UNKNOWN_16, vel=UNKNOWN_16, cog=UNKNOWN_16, fix_type=_NO_FIX, satellites_visible=255
            )
        latitude, longitude = self._degrees(pose)
        speed = round(_bounded(math.hypot(*self._velocity(pose)) * _CM, 65534))
        usec = self._boot_ms(pose) * 1000
        return telemetry.GpsRawInt(
            usec, latitude, longitude, round(origin.altitude * _MM), 100, 100, speed, UNKNOWN_16, _FIX_3D, 10
        )

    def _hud(self) -> MavlinkMessage | None:
        pose, motion, origin = self.view.pose, self.view.motion, self.options.origin
        if pose is None and motion is None:
            return None
        heading = round(math.degrees(self._compass(pose)) % 360) % 360 if pose is not None else 0
        altitude = origin.altitude if origin is not None else 0.0
        fraction = abs(self._fraction())
        speed, throttle = fraction * self.options.speed_full_m_s, round(100 * min(1.0, fraction))
        return telemetry.VfrHud(speed, speed, altitude, 0.0, heading, throttle)

    def _obstacles(self) -> MavlinkMessage | None:
        scan = self.view.scan
        if scan is None or not len(scan.ranges):
            return None
        if not math.isfinite(scan.angle_min + scan.angle_increment):
            return None
        least_cm = round(_bounded(max(0.0, scan.range_min) * _CM, _MOST_CM))
        most_cm = round(_bounded(scan.range_max * _CM, _MOST_CM)) if 0 < scan.range_max < math.inf else _MOST_CM
        cm = nearest_cm(scan, most_cm)
        increment = 360 / _POINTS
        return telemetry.ObstacleDistance(
            self._boot_ms(scan) * 1000, cm.tobytes(), least_cm, most_cm, 0, int(increment), increment, 0.0, BODY_FRD
        )

    def _status(self) -> MavlinkMessage:
        sensors = HEALTHY | (_GPS if self.options.origin is not None else 0)
        voltage, current, left = self._power()
        return telemetry.SysStatus(
            sensors, sensors, sensors, voltage_battery=voltage, current_battery=current, battery_remaining=left
        )

    def _battery_status(self) -> MavlinkMessage | None:
        if self._battery is None:
            return None
        millivolts, centiamperes, percent = self._power()
        voltages = struct.pack("<10H", millivolts, *[UNKNOWN_16] * 9)
        return telemetry.BatteryStatus(
            -1, -1, 32767, voltages, centiamperes, kind=0, battery_function=1, battery_remaining=percent
        )

    def _version(self) -> MavlinkMessage:
        return control.AutopilotVersion(CAPABILITIES, self.options.system_id, FIRMWARE)

    def _home(self) -> MavlinkMessage | None:
        origin = self.options.origin
        if origin is None:
            return None
        latitude, longitude = round(origin.latitude * _E7), round(origin.longitude * _E7)
        upright = struct.pack("<4f", 1.0, 0.0, 0.0, 0.0)
        return telemetry.HomePosition(latitude, longitude, round(origin.altitude * _MM), q=upright)

    def _landed(self) -> MavlinkMessage:
        return telemetry.ExtendedSysState(0, _LANDED)

    # The numbers in them

    def _boot_ms(self, message: FleetMessage) -> int:
        """Return when something was measured, ms since the first that was."""
        stamp_ns = message.stamp_ns
        if not isinstance(stamp_ns, int):
            return 0
        if self._begun_ns is None:
            self._begun_ns = stamp_ns
        return max(0, stamp_ns - self._begun_ns) // 1_000_000 & 0xFFFFFFFF

    def _compass(self, pose: Pose) -> float:
        """Return where the robot looks, rad clockwise from north."""
        return self.options.compass_rad - _finite(pose.heading)

    def _north_east(self, pose: Pose) -> tuple[float, float]:
        cos, sin = math.cos(self.options.compass_rad), math.sin(self.options.compass_rad)
        x, y = _finite(pose.x), _finite(pose.y)
        return x * cos + y * sin, x * sin - y * cos

    def _degrees(self, pose: Pose) -> tuple[int, int]:
        """Return latitude and longitude, 1e-7 degrees: the earth is flat around the origin."""
        origin = self.options.origin
        assert origin is not None
        north, east = self._north_east(pose)
        latitude = origin.latitude * _E7 + north / M_PER_E7
        longitude = origin.longitude * _E7 + east / (M_PER_E7 * math.cos(math.radians(origin.latitude)))
        return round(_bounded(latitude, _INT32)), round(_bounded(longitude, _INT32))

    def _fraction(self) -> float:
        """Return the speed ahead, of full scale."""
        motion = self.view.motion
        return _finite(motion.speed or 0.0) if motion is not None else 0.0

    def _velocity(self, pose: Pose) -> tuple[float, float]:
        """Return the speed over ground to the north and to the east, m/s."""
        speed, compass = self._fraction() * self.options.speed_full_m_s, self._compass(pose)
        return speed * math.cos(compass), speed * math.sin(compass)

    def _power(self) -> tuple[int, int, int]:
        """Return mV, cA that are taken, and %; unknown as the messages say it."""
        battery = self._battery
        if battery is None:
            return UNKNOWN_16, -1, -1
        volts, amperes, level = map(_known, (battery.voltage, battery.current, battery.level))
        return (
            UNKNOWN_16 if volts is None else round(_bounded(max(0.0, volts) * 1000, 65534)),
            -1 if amperes is None else round(_bounded(max(0.0, -amperes) * 100, 32767)),
            -1 if level is None else round(_bounded(max(0.0, level), 1.0) * 100),
        )


def nearest_cm(scan: Scan, most_cm: int) -> npt.NDArray[np.uint16]:
    """Return the nearest range in each 5 degrees, cm, uint16[72], clockwise from ahead; 65535: none was measured.

    Beyond ``most_cm`` is nothing: ``most_cm`` + 1.
    """
    angles = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    sectors = np.rint(-angles / (2 * math.pi / _POINTS)).astype(np.int64) % _POINTS
    ranges = np.asarray(scan.ranges, np.float64) * _CM
    measured = np.isfinite(ranges) & (ranges >= 0)
    nearest = np.full(_POINTS, np.inf)
    np.minimum.at(nearest, sectors[measured], ranges[measured])
    cm = np.where(nearest <= most_cm, np.rint(np.minimum(nearest, most_cm)), most_cm + 1)
    return np.where(np.isfinite(nearest), cm, UNKNOWN_16).astype("<u2")


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _known(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _bounded(value: float, most: float) -> float:
    return max(-most, min(most, _finite(value)))


_MAKERS: dict[int, Callable[[ShownRover], MavlinkMessage | None]] = {
    telemetry.SysStatus.spec.id: ShownRover._status,
    telemetry.GpsRawInt.spec.id: ShownRover._gps,
    telemetry.Attitude.spec.id: ShownRover._attitude,
    telemetry.LocalPositionNed.spec.id: ShownRover._local,
    telemetry.GlobalPositionInt.spec.id: ShownRover._global,
    telemetry.VfrHud.spec.id: ShownRover._hud,
    telemetry.BatteryStatus.spec.id: ShownRover._battery_status,
    telemetry.HomePosition.spec.id: ShownRover._home,
    telemetry.ExtendedSysState.spec.id: ShownRover._landed,
    telemetry.ObstacleDistance.spec.id: ShownRover._obstacles,
    control.AutopilotVersion.spec.id: ShownRover._version,
}
_OF_POSE = (telemetry.Attitude, telemetry.LocalPositionNed, telemetry.GlobalPositionInt, telemetry.VfrHud)
_NEWS: dict[type[FleetMessage], tuple[int, ...]] = {
    Pose: tuple(message.spec.id for message in _OF_POSE),
    Motion: (telemetry.VfrHud.spec.id,),
    Scan: (telemetry.ObstacleDistance.spec.id,),
    Battery: (telemetry.BatteryStatus.spec.id,),
}
