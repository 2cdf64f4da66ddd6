"""A simulated ArduRover in the simulated room. It starts in HOLD, disarmed, as a real one.

Source: "What an ArduRover does" of the protocol page. It obeys what is sent to its own system or to all, sticks only
from ``MAV_GCS_SYSID``. A ground station that is wrong is ignored in silence where a real rover does so.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gateways.mavlink import numbers
from gateways.mavlink.frames import LIMIT_BYTES, MavlinkFrame, frame_end, read_frame, write_frame
from gateways.mavlink.messages import MavlinkMessage, control, telemetry
from gateways.mavlink.numbers import FORCE_ARM, STATION, Command, Result, RoverMode, Severity
from gateways.mavlink.station.options import MavlinkHqOptions, Origin
from gateways.mavlink.station.vehicle import ShownRover
from gateways.mavlink.texts import chunks_of
from zbridge.fleet.messages import Battery, Motion, Pose, Scan
from zbridge.fleet.view import RobotView
from zbridge.protocol import ProtocolError, Simulation, Truth
from zbridge.simulation import SimulatedRobot, serve
from zbridge.simulation.world import Body, cast
from zbridge.wire import FrameBuffer

FASTEST_M_S, FASTEST_RAD_S = 1.0, 1.0
"""At full stick."""
MOST_M_S = 2.0
GIVEN_BACK = 32767
"""An axis of a stick that is the RC receiver's again."""
ACCELERATION_M_S2, COAST_M_S2 = 4.0, 1.5
RADIUS_M = 0.25
POINTS, RANGE_CM, NEAR_CM = 72, 800, 20
HOME = Origin(47.397742, 8.545594, 488.0)
FULL_V, EMPTY_V, EMPTY_S = 12.6, 10.5, 7200.0
STEADY_HZ = 20.0
"""Most often that a stream is sent."""
IGNORED = 0x1C0 | 0x07
"""Bits of ``type_mask`` that must be set: acceleration and position are not followed."""
_VELOCITY, _YAW_RATE, _YAW = 0x08 | 0x10, 0x800, 0x400
_STEERED = (RoverMode.MANUAL, RoverMode.ACRO, RoverMode.STEERING)
PARAMETERS = {
    "FS_GCS_ENABLE": 0.0,
    "FS_GCS_TIMEOUT": 5.0,
    "FS_TIMEOUT": 1.5,
    "GUID_TIMEOUT": 3.0,
    "RC_OVERRIDE_TIME": 3.0,
    "PILOT_STEER_TYPE": 0.0,
    "MAV_GCS_SYSID": 255.0,
}


class ArduRover(SimulatedRobot):
    """One rover, without a link. stick: forward and turn of its RC pilot. arming_fault: why it cannot be armed."""

    def __init__(
        self, place: tuple[float, float, float] | None = None, *, system: int = 1, **parameters: float
    ) -> None:
        self.body = Body.placed(place, radius=RADIUS_M)
        self.system = system
        self.parameters = PARAMETERS | parameters
        self.mode, self.armed = RoverMode.HOLD, False
        self.stick = (0.0, 0.0)
        self.arming_fault: str | None = None
        self.received: list[MavlinkFrame] = []
        """All that was sent to it."""
        self._frames = FrameBuffer(frame_end, LIMIT_BYTES)
        self._out = b""
        self._seq = self._texts = 0
        self._now = 0.0
        self._beat_at = 0.0
        self._target: tuple[float, float] | None = None
        self._target_at = self._override_at = -math.inf
        self._override = (0.0, 0.0)
        self._gcs_at: float | None = None
        self._intervals: dict[int, float] = {}
        self._due: dict[int, float] = {}
        self.speed_m_s = self.turn_rad_s = 0.0
        self._silent = False
        self._view = RobotView()
        told = MavlinkHqOptions(system, speed_full_m_s=FASTEST_M_S, turn_full_rad_s=FASTEST_RAD_S, origin=HOME)
        self._told = ShownRover(told, self._view)

    # As its pilot, and its failures

    def switch_mode(self, mode: RoverMode) -> None:
        """Change the mode, as the switch of the RC transmitter does; HEARTBEAT shows it at once."""
        if mode is not self.mode:
            self.mode, self._target, self._silent = mode, None, False
            self._beat()

    def switch_arming(self, armed: bool) -> None:
        """Arm or disarm, as the RC transmitter does."""
        self.armed = armed
        self._beat()

    def say(self, text: str, severity: int = Severity.INFO) -> None:
        """Send a STATUSTEXT."""
        self._texts += 1
        self.send(*chunks_of(text, severity, self._texts))

    def send(self, *messages: MavlinkMessage) -> None:
        """Send messages with the next answer, or step."""
        for message in messages:
            self._out += write_frame(message, self._seq, self.system, numbers.AUTOPILOT)
            self._seq = (self._seq + 1) % 256

    # As a simulated robot

    def connected(self) -> bytes:
        self._frames = FrameBuffer(frame_end, LIMIT_BYTES)
        self._out, self._intervals = b"", {}
        return b""

    def receive(self, data: bytes) -> bytes:
        for piece in self._frames.feed(data):
            try:
                frame = read_frame(piece)
            except ProtocolError:
                continue
            self.received.append(frame)
            target = getattr(frame.message, "target_system", getattr(frame.message, "target", 0))
            if frame.message is not None and target in (0, self.system):
                self._obey(frame.message, frame.system)
        del self.received[:-1000]
        return self._flush()

    def step(self, dt: float) -> bytes:
        self._now += dt
        self._fail_safe()
        self._move(dt)
        for message_id, interval_s in self._intervals.items():
            if self._now >= self._due[message_id]:
                self._due[message_id] = self._now + interval_s - 1e-6
                self._tell(message_id)
        if self._now >= self._beat_at:
            self._beat()
            self._beat_at = self._now + 1.0 - 1e-6
        return self._flush()

    def truth(self) -> Truth:
        neutral = self._wanted() == (0.0, 0.0)
        return Truth(self.body.x, self.body.y, self.body.heading, neutral=neutral, watchdog=self._silent)

    def _flush(self) -> bytes:
        out, self._out = self._out, b""
        return out

    def _beat(self) -> None:
        base = numbers.CUSTOM_MODE | (numbers.ARMED if self.armed else 0)
        self.send(telemetry.MavlinkHeartbeat(int(self.mode), numbers.ROVER, numbers.ARDUPILOT, base, 4, 3))

    # What it is sent

    def _obey(self, message: MavlinkMessage, sender: int) -> None:
        is_station = sender == self.parameters["MAV_GCS_SYSID"]
        match message:
            case telemetry.MavlinkHeartbeat(kind=kind) if kind == STATION and is_station:
                self._gcs_at = self._now
            case control.ManualControl() if is_station:
                self._gcs_at = self._now
                self._override_at = -math.inf if GIVEN_BACK in (message.y, message.z) else self._now
                self._override = (message.z / 1000, -message.y / 1000)
            case control.SetPositionTargetLocalNed() if self.mode is RoverMode.GUIDED:
                self._follow(message)
            case control.ParamRequestRead():
                self._tell_parameter(message.param_id.partition(b"\0")[0].decode("ascii", "replace"))
            case control.ParamRequestList():
                for name in self.parameters:
                    self._tell_parameter(name)
            case control.CommandLong():
                result = self._command(message)
                self.send(control.CommandAck(message.command, result, target_system=sender))

    def _tell_parameter(self, name: str) -> None:
        if name in self.parameters:
            index, count = list(self.parameters).index(name), len(self.parameters)
            self.send(control.ParamValue(self.parameters[name], count, index, name.encode(), 9))

    def _follow(self, message: control.SetPositionTargetLocalNed) -> None:
        """Drive at a velocity. Backward only with a yaw or a yaw rate: else it would turn round, and drive ahead."""
        mask = message.type_mask
        if (
            message.coordinate_frame not in (numbers.BODY_NED, numbers.BODY_OFFSET_NED)
            or mask & IGNORED != IGNORED
            or mask & _VELOCITY
        ):
            return
        turns = not mask & _YAW_RATE
        forward = message.vx if turns or not mask & _YAW else abs(message.vx)
        self._target = (max(-MOST_M_S, min(MOST_M_S, forward)), -message.yaw_rate if turns else 0.0)
        self._target_at, self._silent = self._now, False

    def _command(self, message: control.CommandLong) -> Result:
        match message.command:
            case Command.DO_SET_MODE:
                mode = int(message.param2)
                if mode not in set(RoverMode) or mode == RoverMode.INITIALISING:
                    return Result.FAILED
                self.switch_mode(RoverMode(mode))
            case Command.ARM:
                return self._arm(message.param1 == 1.0, forced=message.param2 == FORCE_ARM)
            case Command.SET_MESSAGE_INTERVAL:
                return self._set_interval(int(message.param1), message.param2)
            case Command.REQUEST_MESSAGE:
                return Result.ACCEPTED if self._tell(int(message.param1)) else Result.UNSUPPORTED
            case Command.GET_HOME_POSITION:
                self._tell(telemetry.HomePosition.spec.id)
            case _:
                return Result.UNSUPPORTED
        return Result.ACCEPTED

    def _arm(self, wanted: bool, *, forced: bool) -> Result:
        if wanted and not self.armed and not forced and self.arming_fault:
            self.say(f"Arm: {self.arming_fault}", Severity.WARNING)
            return Result.FAILED
        if wanted is not self.armed:
            self.say("Throttle armed" if wanted else "Throttle disarmed")
        self.switch_arming(wanted)
        return Result.ACCEPTED

    def _set_interval(self, message_id: int, interval_us: float) -> Result:
        if self.measure(message_id) is None:
            return Result.FAILED
        if interval_us > 0:
            self._intervals[message_id] = max(1 / STEADY_HZ, interval_us / 1e6)
            self._due[message_id] = self._now
        else:
            self._intervals.pop(message_id, None)
        return Result.ACCEPTED

    # How it moves

    def _fail_safe(self) -> None:
        """Carry out the failsafe of the ground station, and the time limit of targets."""
        if self._gcs_at is not None and self.parameters["FS_GCS_ENABLE"] and self.mode is not RoverMode.HOLD:
            limit_s = self.parameters["FS_GCS_TIMEOUT"] + self.parameters["FS_TIMEOUT"]
            if self._now - self._gcs_at > limit_s:
                self.say("GCS Failsafe", Severity.WARNING)
                self.switch_mode(RoverMode.HOLD)
                self._override_at, self._silent = -math.inf, True
        limit_s = self.parameters["GUID_TIMEOUT"]
        if self._target is not None and self._now - self._target_at > limit_s:
            self._silent = self._target != (0.0, 0.0)
            self._target = None
            self.say(f"target not received last {limit_s:.1f}secs, stopping", Severity.WARNING)

    def _wanted(self) -> tuple[float, float]:
        """Return the speed, m/s, and the turn rate, rad/s, that its mode wants; the throttle is off while disarmed."""
        if not self.armed:
            return 0.0, 0.0
        if self.mode is RoverMode.GUIDED:
            return self._target or (0.0, 0.0)
        if self.mode in _STEERED:
            overridden = self._now - self._override_at <= self.parameters["RC_OVERRIDE_TIME"]
            forward, turn = self._override if overridden else self.stick
            if forward < 0 and self.parameters["PILOT_STEER_TYPE"] in (0.0, 2.0):
                turn = -turn
            return forward * FASTEST_M_S, turn * FASTEST_RAD_S
        return (0.3, 0.2) if self.mode is RoverMode.AUTO else (0.0, 0.0)

    def _move(self, dt: float) -> None:
        """Accelerate, brake in GUIDED, coast where the throttle is off."""
        speed, self.turn_rad_s = self._wanted()
        coasts = not self.armed or self.mode is RoverMode.HOLD
        most = (COAST_M_S2 if coasts else ACCELERATION_M_S2) * dt
        self.speed_m_s += max(-most, min(most, speed - self.speed_m_s))
        self.body.step(self.speed_m_s, 0.0, self.turn_rad_s, dt)
        if self.body.blocked:
            self.speed_m_s = 0.0

    # What it measures

    def measure(self, message_id: int) -> MavlinkMessage | None:
        """Return what it measures, or knows of itself, as the message of an id; None: it has no such message."""
        body, stamp_ns = self.body, round(self._now * 1e9)
        if message_id == telemetry.DistanceSensor.spec.id:
            ahead_cm = round(float(self._ranges(np.zeros(1))[0]) * 100)
            return telemetry.DistanceSensor(round(self._now * 1000), NEAR_CM, RANGE_CM, ahead_cm)
        view, gyro = self._view, (0.0, 0.0, self.turn_rad_s)
        view.pose = Pose(body.x, body.y, body.heading, stamp_ns=stamp_ns)
        view.motion = Motion(speed=self.speed_m_s / FASTEST_M_S, gyro=gyro, stamp_ns=stamp_ns)
        if message_id == telemetry.ObstacleDistance.spec.id:
            step, limits = 2 * math.pi / POINTS, (NEAR_CM / 100, RANGE_CM / 100)
            ranges = self._ranges(-math.pi + np.arange(POINTS) * step).astype(np.float32)
            view.scan = Scan(-math.pi, step, *limits, ranges, stamp_ns=stamp_ns)
        level = 1 - min(1.0, self._now / EMPTY_S)
        self._told.note(Battery(level, EMPTY_V + (FULL_V - EMPTY_V) * level, -1.5))
        return self._told.message(message_id)

    def _tell(self, message_id: int) -> bool:
        message = self.measure(message_id)
        self.send(*([message] if message is not None else []))
        return message is not None

    def _ranges(self, angles: Any) -> Any:
        """Measure along angles from ahead, rad; m, more than the range where there is nothing."""
        return cast(self.body.x, self.body.y, self.body.heading + angles, RANGE_CM / 100 + 0.01)


async def simulate(simulation: Simulation) -> None:
    """Serve one rover on a TCP port until cancelled."""
    await serve(simulation, ArduRover(simulation.place))
