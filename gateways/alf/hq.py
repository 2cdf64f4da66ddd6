"""ALF towards HQ programs: what they are shown of any robot, and what they command. Sans-IO.

Source: "Towards HQ programs", "Translation from the robot", "Translation of commands" and "Versions and dialects" of
the protocol page.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from gateways.alf import messages
from gateways.alf.session import VehicleRole
from gateways.alf.translate import FULL_LOCK_DEG, NAME, UNITS
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Motion, Motor, Scan, Scanner
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.protocol import EncodeError, Exported, HqSide, Limits, Metrics, Positive, ProtocolError, Send, Telemetry

DEADMAN_S = 0.3
"""Legacy HQ programs repeat their command every 20 ms."""
COUNTER_ENDS = 2**31
"""One more than the largest integer that legacy receivers can read."""
FULL_INFO = 100
"""The speed of drive info at full scale."""
_FULL_SPEED = {messages.AlfDialect.TEXT: 255, messages.AlfDialect.BINARY: 100}
"""The speed that HQ programs send at full scale."""
_MM_PER_M = 1000
_RAW_16 = 32767

Ints = npt.NDArray[np.int64]


class AlfHqOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[hq]] options`` of this protocol; the template of ``zbridge init`` explains each."""

    dialect: Literal["text", "binary"] = "text"
    serve: Literal["auto", "drive", "laser", "both"] = "auto"
    points: Annotated[int, msgspec.Meta(ge=2, le=messages.MOST_POINTS)] = messages.POINTS
    acceleration_m_s2: Positive | None = None
    gyro_rad_s: Positive | None = None
    gap_s: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.0


class AlfClient(VehicleRole):
    """The session of one client.

    scanner: the scanner init that it was sent last, encoded. laser: whether it is shown measurements and scanner init.
    drive: whether it is shown drive info.
    """

    kept: ClassVar[dict[str, Any]] = {"scanner": bytes | None, "laser": bool, "drive": bool}
    scanner: bytes | None = None
    laser = True
    drive = True

    def restore(self, state: Exported) -> None:
        super().restore(state)
        self.scanner = self.outbox.found(self.scanner)

    def show_drive(self) -> None:
        """Show drive info instead of measurements from now on; drop the measurements that are queued."""
        self.laser, self.drive = False, True
        self.outbox.clear("scan")
        if self.scanner is not None:
            self.outbox.withdraw(self.scanner)

    def send_scanner(self, scanner: bytes) -> None:
        """Send a scanner init that the client does not have yet, before any measurement that needs it."""
        if scanner != self.scanner and self.laser:
            self.outbox.clear("scan")
            self.outbox.put_exempt(scanner)
            self.scanner = scanner

    def close(self, reason: str, now: float) -> None:
        """Send END as the last message: drop the telemetry that is queued."""
        self.outbox.clear("scan")
        self.outbox.clear("info")
        super().close(reason, now)


class Sweep:
    """Turns scans of one geometry into measurements of ``points`` points; ``init`` is the scanner init to send before.

    Scans of another number of points are resampled by angle. Raises EncodeError for a geometry that is not finite.
    """

    def __init__(
        self, scan: Scan | Scanner, points: int, scanner: Scanner | None, write: Callable[[Any], bytes]
    ) -> None:
        self.source, self.scanner = _geometry(scan), scanner
        angle_min, increment, count, range_min, range_max = self.source
        self._points = points
        self._places: npt.NDArray[np.intp] | None = None
        angle_max = angle_min + increment * (count - 1)
        if count == points:
            if scanner is not None and (scanner.angle_min, scanner.angle_increment) == (angle_min, increment):
                angle_max = scanner.angle_max
        else:
            self._places = np.rint(np.linspace(0, max(0, count - 1), points)).astype(np.intp)
            increment = increment * (count - 1) / (points - 1) or math.radians(1.0)
        time_s = scanner.time_increment_s if scanner is not None else 0.0
        angles = (angle_min, angle_max, increment)
        if not all(map(math.isfinite, map(math.degrees, angles))):  # receivers cannot read NaN
            raise EncodeError(f"scanner with angles {angles}")
        self.init = write(
            messages.ScannerInit(
                math.degrees(angle_min),
                math.degrees(angle_max),
                math.degrees(increment),
                _whole(time_s * 1000),
                _whole(range_min * _MM_PER_M),
                _whole(range_max * _MM_PER_M),
            )
        )

    def measurement(self, scan: Scan, sequence: int) -> messages.Measurement:
        """Return a measurement: ranges in mm, 0 = not measured; valid indices: of the first and last range."""
        ranges = scan.ranges if self._places is None else scan.ranges[self._places]
        with np.errstate(invalid="ignore"):
            points_mm = np.rint(ranges.astype(np.float64) * _MM_PER_M)
        valid = np.flatnonzero((points_mm >= 0) & (points_mm < COUNTER_ENDS))
        points: Ints = np.zeros(self._points, np.int64)
        points[valid] = points_mm[valid]
        first, last = (int(valid[0]), int(valid[-1])) if valid.size else (0, 0)
        stamp_ms = scan.device_ms if isinstance(scan.device_ms, int) else _stamp_ms(scan)
        return messages.Measurement(sequence % COUNTER_ENDS, stamp_ms % COUNTER_ENDS, points, first, last)


class AlfHq(HqSide):
    """One listener."""

    name = NAME
    hands_over = True
    kept: ClassVar[dict[str, Any]] = {"_sequence": int}
    deadman_s = DEADMAN_S

    def __init__(self, options: AlfHqOptions, view: RobotView, metrics: Metrics | None = None) -> None:
        self.options = options
        self.view = view
        self._dialect = messages.AlfDialect(options.dialect)
        self._write = messages.write_text if self._dialect is messages.AlfDialect.TEXT else messages.write_binary
        self._auto = options.serve == "auto"
        self._laser, self._drive = options.serve != "drive", options.serve != "laser"
        self.follows = (("scan", "scanner") if self._laser else ()) + (("motion",) if self._drive else ())
        acceleration, gyro = UNITS[self._dialect]
        self._acceleration = options.acceleration_m_s2 or acceleration
        self._gyro = options.gyro_rad_s or gyro
        self._full_speed = _FULL_SPEED[self._dialect]
        self._sweep: Sweep | None = None
        self._sequence = 0

    def session(self, number: int, bounds: Limits) -> AlfClient:
        session = AlfClient(self._dialect, points=self.options.points, gap_s=self.options.gap_s, bounds=bounds)
        session.laser, session.drive = self._laser, self._drive and not self._auto
        return session

    def begin(self, session: AlfClient, now: float) -> None:
        scan = self.view.scan
        known = scan if scan is not None and len(scan.ranges) else self.view.scanner
        if session.laser and known is not None:
            session.send_scanner(self._sweep_of(known).init)

    # What is shown

    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        if isinstance(message, Scan):
            return self._measurement(message) if len(message.ranges) else None
        if isinstance(message, Scanner):
            init = self._sweep_of(message).init
            return lambda session, now: session.send_scanner(init)
        return self._info(message) if isinstance(message, Motion) else None

    def _sweep_of(self, known: Scan | Scanner) -> Sweep:
        sweep, scanner = self._sweep, self.view.scanner
        if sweep is None or sweep.source != _geometry(known) or sweep.scanner is not scanner:
            sweep = self._sweep = Sweep(known, self.options.points, scanner, self._write)
        return sweep

    def _measurement(self, scan: Scan) -> Send:
        sweep = self._sweep_of(scan)
        self._sequence = scan.seq if isinstance(scan.seq, int) else self._sequence + 1
        frame = self._write(sweep.measurement(scan, self._sequence))

        def send(session: AlfClient, now: float) -> None:
            if session.laser:
                session.send_scanner(sweep.init)
                session.outbox.set("scan", (frame,), now)

        return send

    def _info(self, motion: Motion) -> Send:
        x, y, z = motion.acceleration or (0.0, 0.0, 0.0)
        turning = motion.gyro or (0.0, 0.0, 0.0)
        a, b, c = (self._measured(value / self._acceleration) for value in (x, 0.0 - y, z))
        d, e, f = (self._measured(value / self._gyro) for value in turning)
        speed = round(min(1.0, abs(_finite(motion.speed or 0.0))) * FULL_INFO)
        message = messages.DriveInfo(speed, a, b, c, d, e, f, _finite(motion.temperature or 0.0))
        frame = self._write(message)
        return lambda session, now: session.outbox.set("info", (frame,), now) if session.drive else None

    def _measured(self, value: float) -> float:
        value = _finite(value)
        return value if self._dialect is messages.AlfDialect.TEXT else round(max(-_RAW_16, min(_RAW_16, value)))

    # What is understood

    def is_motion(self, command: Drive | Motor) -> bool:
        """Return whether a command moves the robot: a turn without speed only sets the wheels, and so is neutral."""
        return command.moving and not (isinstance(command, Drive) and not command.forward and not command.left)

    def take(self, session: AlfClient, message: messages.AlfMessage) -> tuple[Telemetry, ...]:
        if not isinstance(message, messages.DriveCommand):
            raise ProtocolError(f"{message.spec.name} from an HQ program")
        if not self._drive:
            session.left_out["drive command"] += 1
            return ()
        # No legacy program can read both kinds ("What crashes a peer" in ``fragile-robots.md``).
        if self._auto and not session.drive:
            session.show_drive()
        straight = FULL_LOCK_DEG if self._dialect is messages.AlfDialect.BINARY else 0
        right = max(-1.0, min(1.0, (message.steering - straight) / FULL_LOCK_DEG))
        speed = min(1.0, message.speed / self._full_speed)
        if not speed and self.view.protocol != NAME:  # it only sets wheels; other robots would turn on the spot
            right = 0.0
        backward = bool(message.direction) and speed > 0
        turn = right if backward else 0.0 - right
        return ((topics.CMD_DRIVE, Drive(forward=-speed if backward else speed, turn=turn, light=message.light)),)


def _geometry(known: Scan | Scanner) -> tuple[float, float, int, float, float]:
    count = len(known.ranges) if isinstance(known, Scan) else known.points
    return (known.angle_min, known.angle_increment, count, known.range_min, known.range_max)


def _stamp_ms(scan: Scan) -> int:
    return scan.stamp_ns // 1_000_000 if isinstance(scan.stamp_ns, int) else 0


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _whole(value: float) -> int:
    """Return a value as an integer that every receiver can read."""
    return round(max(0.0, min(value, COUNTER_ENDS - 1))) if math.isfinite(value) else 0
