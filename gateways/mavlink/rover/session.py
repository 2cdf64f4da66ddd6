"""The conversation with one ArduRover, as its ground station. Sans-IO.

Source: "The gateway as HQ" of the protocol page. The rover is established when it was found, and lost when its
HEARTBEAT did not come for 3 s; other messages are no sign of life. It may hear us still, and motion may be on its way,
so the last words are a stop. What others on the link send is counted.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, ClassVar

from gateways.mavlink.frames import MavlinkFrame, read_frame
from gateways.mavlink.messages import MavlinkMessage
from gateways.mavlink.messages.control import (
    AutopilotVersion,
    CommandAck,
    CommandLong,
    ManualControl,
    ParamValue,
    SetPositionTargetLocalNed,
)
from gateways.mavlink.messages.telemetry import MavlinkHeartbeat
from gateways.mavlink.numbers import (
    ARDUPILOT,
    ARMED,
    AUTOPILOT,
    BOAT,
    BODY_NED,
    CUSTOM_MODE,
    NO_AUTOPILOT,
    PX4,
    ROVER,
    STATION,
    VELOCITY_AND_YAW_RATE,
    Command,
    Result,
    RoverMode,
)
from gateways.mavlink.rover.advice import NO_BEAT, NO_ROVER, ONLY_OTHERS, TWO_VEHICLES, WITH_PX4
from gateways.mavlink.rover.helm import ASK_S, STOP_S, Helm, HelmAction, HelmState
from gateways.mavlink.rover.options import RoverOptions
from gateways.mavlink.rover.requests import (
    AGAIN_S,
    TRIES,
    RoverRequests,
    command_long,
    failsafe_warnings,
    mirrors_backward,
)
from gateways.mavlink.session import MavlinkSession
from zbridge.protocol import KEEP_ALIVE, KeepAlive, Limits, Role, State

HANDSHAKE_S = 10.0
BEATS = 2
"""HEARTBEATs of a vehicle that was not configured: an ArduPilot may send its first one with a wrong id."""
REPEAT_S = {"guided": 0.2, "manual": 0.1}
"""Seconds after which motion is repeated."""
STOP_AGAIN_S = 0.2
ABANDON_S = 0.5
"""Seconds for which zero setpoints follow a request for our mode that may still arrive; also of giving sticks back."""
FULL_STICK = 1000
GIVE_BACK = 32767
"""The value of an axis that gives it back to the RC receiver: else the last stick would count for 3 s more."""
MOTION = "motion"
"""The slot of motion and stops."""
_MODE = "mode"
_OTHERS, _UNDECLARED = "frames of other systems", "messages that are not known"
_ALIVE = MavlinkHeartbeat(kind=STATION, autopilot=NO_AUTOPILOT, system_status=4, mavlink_version=3)


class RoverSession(MavlinkSession[Any]):
    """We play a ground station. vehicle: the system that is obeyed and driven; 0: not found yet."""

    role = Role.HQ
    lost_s = 3.0
    keep_alive = KeepAlive(_ALIVE, period_s=1.0, watchdog_s=5.0)
    handled = frozenset({MavlinkFrame, MavlinkHeartbeat, CommandAck, ParamValue, AutopilotVersion})
    kept: ClassVar[dict[str, Any]] = {
        "vehicle": int,
        "warnings": tuple[str, ...],
        "requests": RoverRequests,
        "_beats": dict[int, int],
        "_foreign": str,
        "_uid": tuple[int, bytes] | None,
        "_motion": bytes,
        "_asks": int,
    }

    def __init__(self, options: RoverOptions, helm: Helm) -> None:
        super().__init__(options.system_id, options.component_id, Limits(frame_bytes=1, handshake_s=HANDSHAKE_S))
        self.options, self.helm = options, helm
        self.vehicle = 0
        self.requests = RoverRequests(self, options)
        self._wanted = options.vehicle_id or helm.vehicle
        """The only system that is taken; 0: any rover. A process drives the one that it found first."""
        self._beats: Counter[int] = Counter()
        self._foreign = ""
        """What was found that is no ArduRover."""
        self._uid: tuple[int, bytes] | None = None
        self._motion = b""
        """The motion that is wanted; a stick is sent once the rover shows our mode."""
        self._asks = 0
        """The command that is repeated until our mode is shown."""
        self._now = -math.inf
        self._lives = False
        """Whether the rover's HEARTBEAT is among what was just read."""

    def opened(self, now: float) -> None:
        """Say that we are there where we speak first by datagrams: the vehicle does not know yet."""
        if self.speaks_first:
            self.outbox.set(KEEP_ALIVE, (self.encode(_ALIVE),), now, period_s=self.keep_alive.period_s)

    # Messages

    def receive(self, data: bytes, now: float) -> list[Any]:
        self._now = now
        return super().receive(data, now)

    def decode(self, frame: bytes) -> MavlinkFrame | MavlinkMessage:
        """Return the message of a frame of the rover, and all other frames as they are."""
        found = read_frame(frame)
        of_rover = self.vehicle and (found.system, found.component) == (self.vehicle, AUTOPILOT)
        if found.message is None or not of_rover:
            return found
        self.requests.heard[found.message_id] = self._now
        return found.message

    def accept(self, message: Any, now: float) -> bool:
        match message:
            case MavlinkFrame(message=MavlinkHeartbeat() as beat, component=1, system=system) if not self.vehicle:
                self._find(system, beat, now)
                return False
            case MavlinkFrame():
                self.left_out[_OTHERS if message.message is not None else _UNDECLARED] += 1
                return False
            case MavlinkHeartbeat():
                self._lives = True
                self._show(message, now)
            case CommandAck(target_system=target) if target in (0, self.system):
                self._answered(message, now)
            case ParamValue():
                self.requests.take(message, now)
                self._warn()
            case AutopilotVersion():
                self._identify(message)
        return True

    def _heard(self, now: float) -> None:
        if self._lives:
            self._lives = False
            super()._heard(now)

    def overdue(self) -> str:
        wanted = f"system {self._wanted}" if self._wanted else "a rover or boat"
        if self._foreign:
            return self._foreign
        if others := self.left_out[_OTHERS]:
            return f"{ONLY_OTHERS} {others} frames of others within {HANDSHAKE_S:g} s: expected {wanted}"
        return f"{NO_BEAT} {HANDSHAKE_S:g} s: expected {wanted}"

    def _find(self, system: int, beat: MavlinkHeartbeat, now: float) -> None:
        """Establish the session once it is sure which system is the rover."""
        is_rover = beat.kind in (ROVER, BOAT)
        if not system or (system != self._wanted if self._wanted else not is_rover):
            self.left_out[_OTHERS] += 1
        elif beat.autopilot != ARDUPILOT or not is_rover:
            kind = f"is of type {beat.kind}, autopilot {beat.autopilot}: {NO_ROVER}"
            px4 = f"{WITH_PX4} (autopilot {PX4}): only ArduPilot is supported"
            self._foreign = f"vehicle {system} {px4 if beat.autopilot == PX4 else kind}"
            self.left_out[_OTHERS] += 1
            if self._wanted:
                self.fail(self._foreign)
        else:
            self._beats[system] += 1
            if self._wanted or self._beats[system] >= BEATS:
                self.vehicle = system
                self.helm.found(system)
                self.establish("", ())
                self.requests.begin(system, now)
                self._show(beat, now)

    def _show(self, beat: MavlinkHeartbeat, now: float) -> None:
        self._do(self.helm.show(beat.custom_mode, armed=bool(beat.base_mode & ARMED), now=now), now)
        if beat.custom_mode == self.helm.driving:
            self._go_on(Command.DO_SET_MODE, now)

    def _identify(self, message: AutopilotVersion) -> None:
        number = message.flight_sw_version
        self.version = f"{number >> 24}.{number >> 16 & 0xFF}.{number >> 8 & 0xFF}" if number else ""
        uid = (message.uid, message.uid2)
        if self._uid not in (None, uid):
            self.busy = f"{TWO_VEHICLES} {self.vehicle}"
        self._uid = uid

    def _answered(self, message: CommandAck, now: float) -> None:
        if message.result == Result.IN_PROGRESS:
            return
        self.requests.answered(message.command, now)
        if message.command in (Command.DO_SET_MODE, Command.ARM):
            what = "arming" if message.command == Command.ARM else f"mode {self.helm.driving.name}"
            accepted = message.result == Result.ACCEPTED
            self._do(self.helm.answer(what, now, accepted=accepted), now)
            if accepted:
                self._go_on(message.command, now)

    # Time

    def timers(self) -> float:
        due = min(self.requests.due, self.helm.due, self.silence.due)
        return due if self.state is State.ESTABLISHED else math.inf

    def on_timer(self, now: float) -> None:
        if now >= self.silence.due and (lost := self.silence.judge(now, None)[1]):
            self._leave(lost, now)
            return
        self.requests.expire(now)
        self._do(self.helm.expire(now), now)

    def _leave(self, reason: str, now: float) -> None:
        """End with a stop, behind motion that the link may still hold: the rover may hear us."""
        self.outbox.clear(_MODE)
        self.outbox.clear(MOTION)
        if self.helm.ours:
            self.halt(now, now, ordered=False)
        self.close(reason, now)

    def _warn(self) -> None:
        if not self.over:
            now = filter(None, (self.helm.hindrance, self.helm.warning))
            self.warnings = (*now, *failsafe_warnings(self.requests.parameters, self.options))

    # Commands

    def drive(self, forward: float, turn: float, now: float) -> None:
        """Send motion and repeat it, behind a request for our mode where needed; raise NotReady."""
        action = self.helm.move(now) if forward or turn else self.helm.neutral(now)
        self._motion = self._steer(forward, turn)
        self._do(action, now)

    def halt(self, now: float, until: float, *, ordered: bool) -> None:
        """Send a stop, and repeat it until it is confirmed."""
        self._do(self.helm.stop(now, ordered=ordered), now, until)

    def stop_frames(self) -> tuple[bytes, ...]:
        """Return neutral, then HOLD; HOLD alone where no stick of ours is to be made neutral."""
        hold = self.encode(_set_mode(RoverMode.HOLD, self.vehicle))
        return (hold,) if self._sticks and not self.helm.overrides else (self._steer(0.0, 0.0), hold)

    @property
    def _sticks(self) -> bool:
        return self.options.drive == "manual"

    def _do(self, action: HelmAction, now: float, until: float = math.inf) -> None:
        """Carry out what the helm wants: nothing more goes into a mode that is not ours."""
        if action is not HelmAction.NOTHING and self.helm.state is not HelmState.ASKED:
            self.outbox.clear(_MODE)
        match action:
            case HelmAction.ASK:
                self.outbox.clear(MOTION)  # a stop that is repeated
                self._repeat(_set_mode(self.helm.driving, self.vehicle), -math.inf)  # goes first
                self._move(now)
            case HelmAction.SEND:
                self._move(now)
            case HelmAction.STOP:
                until = min(until, now + STOP_S)
                self.outbox.set(MOTION, self.stop_frames(), now, period_s=STOP_AGAIN_S, until=until, urgent=True)
            case HelmAction.LEAVE | HelmAction.ABANDON:
                self.outbox.clear(MOTION)
                if action is HelmAction.ABANDON and not self._sticks:
                    zero = (self._steer(0.0, 0.0),)
                    self.outbox.set(MOTION, zero, now, period_s=STOP_AGAIN_S, until=now + ABANDON_S)
                if self.helm.overrides and not self.over:
                    self.helm.overrides = False
                    back = (self.encode(ManualControl(y=GIVE_BACK, z=GIVE_BACK, target=self.vehicle)),)
                    # Repeated: without it, our last stick would move a pilot's rover for 3 s.
                    until = now + ABANDON_S
                    self.outbox.set(MOTION, back, now, period_s=STOP_AGAIN_S, until=until, urgent=True)
        self._warn()

    def _go_on(self, done: int, now: float) -> None:
        """Ask no more for what the rover has done: it may be undone by its pilot. Behind our mode, ask to arm.

        Never before: in the mode of a mission, arming begins it.
        """
        if self.helm.state is not HelmState.ASKED or done != self._asks or not self.helm.counts(now):
            return
        self.outbox.clear(_MODE)
        self._asks = 0
        self.helm.wait(now)
        if done == Command.DO_SET_MODE and self.helm.arms and not self.helm.armed:
            self._repeat(command_long(Command.ARM, 1.0, 0.0, self.vehicle), now)

    def _repeat(self, command: CommandLong, now: float) -> None:
        """Repeat a request while the helm waits for it."""
        self._asks = command.command
        until = self.helm.due - ASK_S + AGAIN_S * (TRIES - 0.5)
        self.outbox.set(_MODE, (self.encode(command),), now, period_s=AGAIN_S, until=until)

    def _move(self, now: float) -> None:
        """Send the newest motion, and repeat it.

        A stick waits until the rover shows our mode: in the mode of its RC pilot it would be obeyed too. A setpoint is
        ignored outside GUIDED.
        """
        if self._motion and not (self._sticks and self.helm.state is HelmState.ASKED):
            self.helm.overrides = self._sticks
            self.outbox.set(MOTION, (self._motion,), now, period_s=REPEAT_S[self.options.drive])

    def _steer(self, forward: float, turn: float) -> bytes:
        """Make a setpoint, or a stick. Both turn clockwise; a zero has no sign."""
        if self._sticks:
            right = turn if forward < 0 and mirrors_backward(self.requests.parameters) else -turn
            stick = ManualControl(y=round(right * FULL_STICK), z=round(forward * FULL_STICK), target=self.vehicle)
            return self.encode(stick)
        setpoint = SetPositionTargetLocalNed(
            vx=forward * self.options.speed_full_m_s + 0.0,
            yaw_rate=-turn * self.options.turn_full_rad_s + 0.0,
            type_mask=VELOCITY_AND_YAW_RATE,
            target_system=self.vehicle,
            target_component=AUTOPILOT,
            coordinate_frame=BODY_NED,
        )
        return self.encode(setpoint)


def _set_mode(mode: RoverMode, vehicle: int) -> CommandLong:
    return command_long(Command.DO_SET_MODE, float(CUSTOM_MODE), float(mode), vehicle)
