"""Translates packets to fleet messages and commands to packets; one ARCOS robot. Sans-IO."""

import math
from collections.abc import Iterator
from typing import Any, ClassVar, Literal

from zbridge import protocol
from zbridge.fleet import topics
from zbridge.fleet.messages import Battery, Drive, FleetMessage, Motion, Reading
from zbridge.fleet.topics import Topic

from arcos.messages import PACKETS, Do, Report, Setting, write
from arcos.session import ArcosSession

MM_PER_M, WRAP, FULL_TURN = 1000, 2**16, 4096
AGAIN_S, STOP_AGAIN_S = 0.5, 0.1
BEARINGS_DEG = (90, 50, 30, 10, -10, -30, -50, -90, -90, -130, -150, -170, 170, 150, 130, 90)
SECOND = (8, 15)  # sonars at the bearing of another one: a scan has one range for each bearing, so it leaves them out
RANGE_M = (0.1, 4.999)  # from the ring of sensors, about 0.2 m from the robot's centre; 5 m means nothing
BUMPERS = {f"bumper-{side}{n}": 1 << bit + n for side, bit in (("rear", 0), ("front", 8)) for n in range(1, 6)}


class Options(protocol.Differential, frozen=True, kw_only=True):
    """``[device.options]``; the template of ``zbridge init`` explains each."""

    track_m: protocol.Positive = 0.33
    sonars: Literal[8, 16] = 16


class ArcosRobot(protocol.RobotSide):
    """One robot on one link."""

    link_names = ("robot",)
    driving: ArcosSession | None = None
    hands_over = True
    kept: ClassVar[dict[str, Any]] = {"_odometry": protocol.Odometry, "_scan": protocol.BearingScan}

    def __init__(self, options: Options, links: int = 1, metrics: protocol.Metrics | None = None) -> None:
        self.options = options
        self._odometry = protocol.Odometry(unit_m=1 / MM_PER_M, wrap=WRAP)
        ring = {f"sonar{n}": deg for n, deg in enumerate(BEARINGS_DEG[: options.sonars]) if n not in SECOND}
        self._scan = protocol.BearingScan(ring, RANGE_M)

    def session(self, link: str, peer: str) -> ArcosSession:
        self.driving = ArcosSession(protocol.Limits(frame_bytes=PACKETS.most, handshake_s=5.0))
        self._odometry.restart()  # the robot counts from 0 once it is opened
        return self.driving

    # What the robot sends

    def translator(self, kind: type) -> protocol.Translate:
        return self._report if kind is Report else lambda message, stamp_ns: ()

    def _report(self, report: Report, stamp_ns: int) -> Iterator[protocol.Telemetry]:
        heading_rad = report.heading * 2 * math.pi / FULL_TURN
        yield topics.POSE, self._odometry.placed(report.x_mm, report.y_mm, heading_rad, stamp_ns)
        speed = self.options.drive(report.left_mm_s / MM_PER_M, report.right_mm_s / MM_PER_M).forward
        yield topics.MOTION, Motion(speed=speed, stamp_ns=stamp_ns)
        yield topics.BATTERY, Battery(voltage=report.battery / 10, stamp_ns=stamp_ns)
        for name, bit in BUMPERS.items():
            yield topics.SENSOR(name), Reading(value=float(bool(report.bumpers & bit)), stamp_ns=stamp_ns)
        for sonar in report.sonars:
            name, range_m = f"sonar{sonar.number}", sonar.range_mm / MM_PER_M
            yield topics.SENSOR(name), Reading(value=range_m, stamp_ns=stamp_ns)
            if (scan := self._scan.take(name, range_m, stamp_ns)) is not None:
                yield topics.SCAN, scan

    # What the robot is sent

    def command(self, topic: Topic, command: FleetMessage, now: float) -> protocol.Outcome:
        if not isinstance(command, Drive):
            raise protocol.Unsupported(f"an ARCOS robot has no {topic.path}")
        m_s, rad_s = self.options.velocity(command)
        self._drive(_motion(round(m_s * MM_PER_M), round(math.degrees(rad_s))), now, period_s=AGAIN_S)
        left_out = ["left: it does not move sideways"] if command.left else []
        left_out += ["light: it has none"] if command.light is not None else []
        return protocol.Outcome(left_out="; ".join(left_out) or None)

    def stop(self, now: float, until: float) -> None:
        self._drive(self.stop_frames(), now, period_s=STOP_AGAIN_S, until=until, urgent=True)

    def stop_frames(self) -> tuple[bytes, ...]:
        return _motion(0, 0)

    def leased(self, on: bool, now: float) -> None:
        enable = write(Setting.of(Do.ENABLE, int(on)))
        self.connected().outbox.set(
            "motors", (enable,), -math.inf
        )  # before the drive, behind a stop; the newest counts

    def ask(self, topic: Topic) -> None:
        raise protocol.Unsupported(f"an ARCOS robot cannot be queried for its {topic.path}")

    def _drive(self, frames: tuple[bytes, ...], now: float, **how: Any) -> None:
        self.connected().outbox.set("drive", frames, now, **how)


def _motion(mm_s: int, deg_s: int) -> tuple[bytes, ...]:
    return write(Setting.of(Do.VEL, mm_s)), write(Setting.of(Do.RVEL, deg_s))
