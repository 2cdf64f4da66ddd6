"""From a rover's messages to fleet messages. Sans-IO. Source: "Translation" of the protocol page."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from gateways.mavlink.messages import MavlinkMessage, telemetry
from gateways.mavlink.numbers import ARMED, BODY_FRD, M_PER_E7, Severity
from gateways.mavlink.rover.helm import Helm, name_of_mode
from gateways.mavlink.rover.options import RoverOptions
from gateways.mavlink.texts import TextJoiner
from zbridge.fleet import topics
from zbridge.fleet.messages import Battery, Motion, Pose, Reading, Scan, Text
from zbridge.protocol import Kept, ProtocolError, Telemetry

LOCAL_WITHIN_NS = 2_000_000_000
"""How long a local position is awaited before global ones show the pose."""
UNKNOWN = 65535
ORIENTATIONS = {
    0: "forward",
    1: "forward_right",
    2: "right",
    3: "back_right",
    4: "back",
    5: "back_left",
    6: "left",
    7: "forward_left",
    24: "up",
    25: "down",
}
_M_PER_CM, _V_PER_MV, _A_PER_CA = 0.01, 0.001, 0.01


class RoverTelemetry(Kept):
    """What is known of one rover. backward: the last drive was."""

    kept: ClassVar[dict[str, Any]] = {
        "backward": bool,
        "texts": TextJoiner,
        "_shown": tuple[int, bool] | None,
        "_yaw": float | None,
        "_speed": float | None,
        "_local": bool,
        "_global_since_ns": int | None,
        "_home": tuple[int, int] | None,
        "_told_home": bool,
        "_battery": bool,
    }

    def __init__(self, options: RoverOptions, helm: Helm) -> None:
        self._options, self._helm = options, helm
        self.backward = False
        self.texts = TextJoiner()
        self._shown: tuple[int, bool] | None = None
        """The mode and whether it is armed, as the last text told."""
        self._yaw: float | None = None
        self._speed: float | None = None
        self._local = False
        """Whether local positions come: global ones would be on other axes."""
        self._global_since_ns: int | None = None
        self._home: tuple[int, int] | None = None
        self._told_home = False
        """Whether the home is the rover's own, not its first fix."""
        self._battery = False
        """Whether BATTERY_STATUS comes: SYS_STATUS says less."""

    def __repr__(self) -> str:
        return f"<RoverTelemetry of {self._helm!r}>"

    def heartbeat(self, message: telemetry.MavlinkHeartbeat, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Show whether it is armed, and tell of a new mode."""
        armed = bool(message.base_mode & ARMED)
        reading = (topics.SENSOR("armed"), Reading(float(armed), stamp_ns=stamp_ns))
        before, self._shown = self._shown, (message.custom_mode, armed)
        if before == self._shown:
            return (reading,)
        text = f"mode {name_of_mode(message.custom_mode)}, {'armed' if armed else 'disarmed'}"
        return reading, (topics.TEXT, Text(text, stamp_ns=stamp_ns))

    def attitude(self, message: telemetry.Attitude, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Show how it moves, with the speed of the last VFR_HUD."""
        _require_finite(message.yaw, message.rollspeed, message.pitchspeed, message.yawspeed)
        self._yaw = message.yaw
        gyro = (message.rollspeed, -message.pitchspeed, -message.yawspeed)
        return ((topics.MOTION, Motion(speed=self._speed, gyro=gyro, stamp_ns=stamp_ns)),)

    def hud(self, message: telemetry.VfrHud, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Note the speed, whose sign is that of the last drive."""
        _require_finite(message.groundspeed)
        speed = min(1.0, abs(message.groundspeed) / self._options.speed_full_m_s)
        self._speed = -speed if self.backward and speed else speed
        return ()

    def local_position(self, message: telemetry.LocalPositionNed, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Show the pose: x east, y north."""
        _require_finite(message.x, message.y)
        self._local = True
        return self._pose(message.y, message.x, self._yaw, stamp_ns)

    def global_position(self, message: telemetry.GlobalPositionInt, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Show latitude, longitude and altitude; the pose where no local position comes. 0, 0 is no position."""
        lat, lon = message.lat, message.lon
        if not (lat or lon):  # no fix yet
            return ()
        readings = [_gps("lat", lat / 1e7, stamp_ns), _gps("lon", lon / 1e7, stamp_ns)]
        readings.append(_gps("alt", message.alt / 1000, stamp_ns))
        if self._global_since_ns is None:
            self._global_since_ns = stamp_ns
        if self._local or stamp_ns < self._global_since_ns + LOCAL_WITHIN_NS:
            return tuple(readings)
        home_lat, home_lon = self._home = self._home or (lat, lon)
        east = math.remainder(lon - home_lon, 3.6e9) * M_PER_E7 * math.cos(math.radians(home_lat / 1e7))
        yaw = math.radians(message.hdg / 100) if message.hdg != UNKNOWN else self._yaw
        return (*readings, *self._pose(east, (lat - home_lat) * M_PER_E7, yaw, stamp_ns))

    def home(self, message: telemetry.HomePosition, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Note where global positions are measured from: the first home that is told, not a later one."""
        if (message.latitude or message.longitude) and not self._told_home:
            self._home, self._told_home = (message.latitude, message.longitude), True
        return ()

    def fix(self, message: telemetry.GpsRawInt, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Show the kind of the fix: 3 and more are positions in space."""
        return (_gps("fix", float(message.fix_type), stamp_ns),)

    def obstacles(self, message: telemetry.ObstacleDistance, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Show a scan. It is measured clockwise, in the frame of the body, or it is not translated."""
        increment = message.increment_f or float(message.increment)
        if message.frame != BODY_FRD or not (math.isfinite(message.angle_offset) and 0 < abs(increment) < 360):
            raise ProtocolError(f"obstacles in frame {message.frame}, {increment:g} degrees apart")
        measured = np.frombuffer(message.distances, np.dtype("<u2"))[: max(1, round(360 / abs(increment)))]
        nothing = (measured > message.max_distance) | (measured == UNKNOWN)
        ranges = np.where(nothing, np.nan, measured * _M_PER_CM).astype(np.float32)
        if increment > 0:
            ranges = ranges[::-1].copy()
            angle_min = -message.angle_offset - increment * (len(ranges) - 1)
        else:
            angle_min = -message.angle_offset
        limits = message.min_distance * _M_PER_CM, message.max_distance * _M_PER_CM
        step = math.radians(abs(increment))
        return ((topics.SCAN, Scan(math.radians(angle_min), step, *limits, ranges, stamp_ns=stamp_ns)),)

    def distance(self, message: telemetry.DistanceSensor, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Show a distance, by where it is measured; beyond its range it is a fault."""
        name = ORIENTATIONS.get(message.orientation, str(message.orientation))
        fault = not message.min_distance <= message.current_distance <= message.max_distance
        value = message.current_distance * _M_PER_CM
        return ((topics.SENSOR(f"distance_{name}"), Reading(value, fault=fault, stamp_ns=stamp_ns)),)

    def battery(self, message: telemetry.BatteryStatus, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Show the first battery: the sum of its cells."""
        if message.battery_id:
            return ()
        self._battery = True
        cells = np.frombuffer(message.voltages, np.dtype("<u2"))
        known = cells[(cells != UNKNOWN) & (cells > 0)]
        mv = float(known.sum()) if known.size else None
        return _battery(mv, message.current_battery, message.battery_remaining, stamp_ns)

    def system(self, message: telemetry.SysStatus, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Show the battery where no BATTERY_STATUS comes."""
        if self._battery:
            return ()
        mv = message.voltage_battery if message.voltage_battery not in (0, UNKNOWN) else None
        return _battery(mv, message.current_battery, message.battery_remaining, stamp_ns)

    def text(self, message: telemetry.Statustext, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Show a text once it is whole. A warning may be why the rover refuses."""
        joined = self.texts.take(message)
        for each in joined:
            if each.severity <= Severity.WARNING:
                self._helm.say(each.text)
        return tuple((topics.TEXT, Text(each.text, stamp_ns=stamp_ns)) for each in joined)

    def _pose(self, east: float, north: float, yaw: float | None, stamp_ns: int) -> tuple[Telemetry, ...]:
        if yaw is None:
            return ()
        heading = math.remainder(math.pi / 2 - yaw, 2 * math.pi)
        return ((topics.POSE, Pose(east, north, heading, stamp_ns=stamp_ns)),)


def _gps(name: str, value: float, stamp_ns: int) -> Telemetry:
    return topics.SENSOR(f"gps_{name}"), Reading(value, stamp_ns=stamp_ns)


def _battery(mv: float | None, current_ca: int, percent: int, stamp_ns: int) -> tuple[Telemetry, ...]:
    battery = Battery(
        min(1.0, percent / 100) if percent >= 0 else None,
        mv * _V_PER_MV if mv is not None else None,
        -current_ca * _A_PER_CA if current_ca != -1 else None,
        stamp_ns=stamp_ns,
    )
    return ((topics.BATTERY, battery),)


def _require_finite(*numbers: float) -> None:
    if not all(map(math.isfinite, numbers)):
        raise ProtocolError(f"{numbers}: expected finite numbers")


TELEMETRY: dict[type[MavlinkMessage], Callable[[RoverTelemetry, Any, int], tuple[Telemetry, ...]]] = {
    telemetry.MavlinkHeartbeat: RoverTelemetry.heartbeat,
    telemetry.Attitude: RoverTelemetry.attitude,
    telemetry.VfrHud: RoverTelemetry.hud,
    telemetry.LocalPositionNed: RoverTelemetry.local_position,
    telemetry.GlobalPositionInt: RoverTelemetry.global_position,
    telemetry.HomePosition: RoverTelemetry.home,
    telemetry.GpsRawInt: RoverTelemetry.fix,
    telemetry.ObstacleDistance: RoverTelemetry.obstacles,
    telemetry.DistanceSensor: RoverTelemetry.distance,
    telemetry.BatteryStatus: RoverTelemetry.battery,
    telemetry.SysStatus: RoverTelemetry.system,
    telemetry.Statustext: RoverTelemetry.text,
}
