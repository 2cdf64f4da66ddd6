"""Translates Khepera lines to fleet messages and commands to lines; one Khepera as a robot. Sans-IO."""

from typing import Any

import msgspec
import numpy as np
from zbridge import protocol
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Motion, Switch
from zbridge.fleet.topics import Topic

from khepera.messages import LINES, Positions, Proximity, SetLed, SetSpeeds, Speeds
from khepera.session import KheperaSession

UNIT_M_S, MOST_UNITS, PULSE_M, WRAP = 0.008, 127, 0.00008, 2**32
AGAIN_S, STOP_AGAIN_S = 0.5, 0.1
STILL = SetSpeeds(0, 0)
BEARINGS_DEG = dict(zip(Proximity.__struct_fields__, (-150, -85, -45, -15, 15, 45, 85, 150), strict=True))
RANGE_M = (0.005, 0.06)
LIGHT, DISTANCE_M = [20, 60, 150, 350, 700, 1023], [0.06, 0.05, 0.035, 0.02, 0.01, 0.005]
"""Values of a sensor, and the distance of an obstacle at each."""


class Options(protocol.Differential, frozen=True, kw_only=True):
    """``[device.options]``; the template of ``zbridge init`` explains each."""

    track_m: protocol.Positive = 0.053


class KheperaRobot(protocol.RobotSide):
    """One Khepera on one link."""

    link_names = ("robot",)
    driving: KheperaSession | None = None
    accepts = ("drive", "light")

    def __init__(self, options: Options, links: int = 1, metrics: protocol.Metrics | None = None) -> None:
        self.options = options
        self._scan = protocol.BearingScan(BEARINGS_DEG, RANGE_M)
        self._odometry = protocol.Odometry(options.track_m, unit_m=PULSE_M, wrap=WRAP)

    def session(self, link: str, peer: str) -> KheperaSession:
        self.driving = KheperaSession(protocol.Limits(frame_bytes=128, handshake_s=5.0))
        self._odometry.restart()
        return self.driving

    # What the robot sends

    def translator(self, kind: type) -> protocol.Translate:
        found: dict[type, protocol.Translate] = {Positions: self._pose, Speeds: self._motion, Proximity: self._ring}
        return found.get(kind, lambda message, stamp_ns: ())

    def _pose(self, message: Positions, stamp_ns: int) -> tuple[protocol.Telemetry, ...]:
        return ((topics.POSE, self._odometry.sides(message.left, message.right, stamp_ns)),)

    def _motion(self, message: Speeds, stamp_ns: int) -> tuple[protocol.Telemetry, ...]:
        speed = self.options.drive(message.left * UNIT_M_S, message.right * UNIT_M_S).forward
        return ((topics.MOTION, Motion(speed=speed, stamp_ns=stamp_ns)),)

    def _ring(self, message: Proximity, stamp_ns: int) -> tuple[protocol.Telemetry, ...]:
        scan = None
        for name, light in msgspec.structs.asdict(message).items():
            scan = self._scan.take(name, float(np.interp(light, LIGHT, DISTANCE_M, left=np.nan)), stamp_ns)
        return ((topics.SCAN, scan),) if scan is not None else ()

    # What the robot is sent

    def command(self, topic: Topic, command: FleetMessage, now: float) -> protocol.Outcome:
        if isinstance(command, Drive):
            self._drive(_speeds(*self.options.sides_m_s(command)), now, period_s=AGAIN_S)
            light, left_out = command.light, "left: it does not move sideways" if command.left else None
        elif topic is topics.CMD_LIGHT and isinstance(command, Switch):
            light, left_out = command.on, None
        else:
            raise protocol.Unsupported(f"a Khepera has no {topic.path}")
        if light is not None:
            self.connected().send(SetLed(0, int(light)))
        return protocol.Outcome(left_out=left_out)

    def stop(self, now: float, until: float) -> None:
        self._drive(STILL, now, period_s=STOP_AGAIN_S, until=until, urgent=True)

    def stop_frames(self) -> tuple[bytes, ...]:
        return (LINES.write(STILL),)

    def ask(self, topic: Topic) -> None:
        raise protocol.Unsupported(f"a Khepera cannot be queried for its {topic.path}")

    def _drive(self, speeds: SetSpeeds, now: float, **how: Any) -> None:
        session = self.connected()
        session.outbox.set("drive", (session.encode(speeds),), now, **how)


def _speeds(left_m_s: float, right_m_s: float) -> SetSpeeds:
    unit_m_s = max(UNIT_M_S, abs(left_m_s) / MOST_UNITS, abs(right_m_s) / MOST_UNITS)  # scale both: keeps the curve
    return SetSpeeds(round(left_m_s / unit_m_s), round(right_m_s / unit_m_s))
