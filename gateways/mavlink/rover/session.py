"""The conversation with one ArduRover, as its ground station. Sans-IO.

Source: "The gateway as HQ" of the protocol page. The rover is established when it was found, and lost when its
HEARTBEAT did not come for 3 s; other messages are no sign of life. What others on the link send is counted.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Any, ClassVar

from gateways.mavlink.frames import MavlinkFrame, read_frame
from gateways.mavlink.messages import MavlinkMessage
from gateways.mavlink.messages.control import AutopilotVersion, CommandAck, CommandLong, ManualControl, ParamValue
from gateways.mavlink.messages.telemetry import MavlinkHeartbeat
from gateways.mavlink.numbers import (
    ARDUPILOT,
    ARMED,
    AUTOPILOT,
    BOAT,
    CUSTOM_MODE,
    NO_AUTOPILOT,
    PX4,
    ROVER,
    STATION,
    Command,
    Result,
    RoverMode,
)
from gateways.mavlink.rover.advice import NO_BEAT, NO_ROVER, ONLY_OTHERS, TWO_VEHICLES, WITH_PX4
from gateways.mavlink.rover.helm import STOP_S, Helm, HelmState
from gateways.mavlink.rover.options import RoverOptions
from gateways.mavlink.rover.requests import AGAIN_S, TRIES, RoverRequests, command_long, failsafe_warnings
from gateways.mavlink.session import MavlinkSession
from zbridge.protocol import KEEP_ALIVE, KeepAlive, Limits, Role, State

HANDSHAKE_S = 10.0
BEATS = 2
"""HEARTBEATs of a vehicle that was not configured: an ArduPilot may send its first one with a wrong id."""
REPEAT_S = {"guided": 0.2, "manual": 0.1}
"""Seconds after which motion is repeated."""
STOP_AGAIN_S = 0.2
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
        "_uid": tuple[int, bytes] | None,
        "_overrides": bool,
        "_motion": bytes,
    }

    def __init__(self, options: RoverOptions, helm: Helm) -> None:
        super().__init__(options.system_id, options.component_id, Limits(frame_bytes=1, handshake_s=HANDSHAKE_S))
        self.options, self.helm = options, helm
        self.vehicle = 0
        self.requests = RoverRequests(self, options)
        self._beats: Counter[int] = Counter()
        self._uid: tuple[int, bytes] | None = None
        self._motion = b""
        """The motion that is wanted; it is sent once the rover shows our mode."""
        self._overrides = False
        """Whether a stick of ours may hold the RC receiver's off."""
        self._now = -math.inf
        self._lives = False
        """Whether the rover's HEARTBEAT is among what was just read."""

    def opened(self, now: float) -> None:
        """Speak first by datagrams: a vehicle does not know yet that we are there."""
        if self.transport == "udp":
            self.outbox.set(KEEP_ALIVE, (self.encode(_ALIVE),), now, period_s=self.keep_alive.period_s)

    # Messages

    def receive(self, data: bytes, now: float) -> list[Any]:
        self._now = now
        return super().receive(data, now)

    def decode(self, frame: bytes) -> MavlinkFrame | MavlinkMessage:
        """Return the message of a frame of the rover, and all other frames as they are."""
        found = read_frame(frame)
        if found.message is None or found.component != AUTOPILOT or found.system != self.vehicle:
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
                self.helm.show(message.custom_mode, armed=bool(message.base_mode & ARMED), now=now)
                self._follow_helm()
            case CommandAck(target_system=target) if target in (0, self.system):
                self._answered(message, now)
            case ParamValue():
                self.requests.take(message)
                self._warn()
            case AutopilotVersion():
                self._identify(message)
        return True

    def _heard(self, now: float) -> None:
        if self._lives:
            self._lives = False
            super()._heard(now)

    def overdue(self) -> str:
        wanted = f"system {self.options.vehicle_id}" if self.options.vehicle_id else "a rover or boat"
        if others := self.left_out[_OTHERS]:
            return f"{ONLY_OTHERS} {others} frames of others within {HANDSHAKE_S:g} s: expected {wanted}"
        return f"{NO_BEAT} {HANDSHAKE_S:g} s: expected {wanted}"

    def _find(self, system: int, beat: MavlinkHeartbeat, now: float) -> None:
        """Establish the session once it is sure which system is the rover."""
        wanted, is_rover = self.options.vehicle_id, beat.kind in (ROVER, BOAT)
        if system != wanted if wanted is not None else not is_rover:
            self.left_out[_OTHERS] += 1
        elif beat.autopilot == PX4:
            self.fail(f"vehicle {system} {WITH_PX4} (autopilot 12): only ArduPilot is supported")
        elif not is_rover or beat.autopilot != ARDUPILOT:
            self.fail(f"vehicle {system} is of type {beat.kind}, autopilot {beat.autopilot}: {NO_ROVER}")
        else:
            self._beats[system] += 1
            if wanted is not None or self._beats[system] >= BEATS:
                self.vehicle = system
                self.helm.show(beat.custom_mode, armed=bool(beat.base_mode & ARMED), now=now)
                self.establish("", ())
                self.requests.begin(system, now)
                self._follow_helm()

    def _identify(self, message: AutopilotVersion) -> None:
        number = message.flight_sw_version
        self.version = f"{number >> 24}.{number >> 16 & 0xFF}.{number >> 8 & 0xFF}" if number else ""
        uid = (message.uid, message.uid2)
        if self._uid not in (None, uid):
            self.busy = f"{TWO_VEHICLES} {self.vehicle}"
        self._uid = uid

    def _answered(self, message: CommandAck, now: float) -> None:
        self.requests.answered(message.command, now)
        if message.command in (Command.DO_SET_MODE, Command.ARM):
            what = "arming" if message.command == Command.ARM else f"mode {self.helm.driving.name}"
            self.helm.answer(what, accepted=message.result == Result.ACCEPTED)
            self._follow_helm()

    # Time

    def timers(self) -> float:
        return min(self.requests.due, self.helm.due) if self.state is State.ESTABLISHED else math.inf

    def on_timer(self, now: float) -> None:
        self.requests.expire(now)
        self.helm.expire(now)
        self._follow_helm()

    def _follow_helm(self) -> None:
        """Send nothing more into a mode that is not ours, and nothing that has been confirmed."""
        state = self.helm.state
        if state is not HelmState.ASKED:
            self.outbox.clear(_MODE)
        if state is HelmState.DRIVING and self._motion and not self.outbox.is_set(MOTION):
            self._send_motion(self._now)
        if not self.helm.ours or state is HelmState.HELD:
            self.outbox.clear(MOTION)
            if self._overrides and not self.over:
                self._overrides = False
                self.send_first(ManualControl(y=GIVE_BACK, z=GIVE_BACK, target=self.vehicle))
        self._warn()

    def _warn(self) -> None:
        if not self.over:
            stops = (self.helm.warning,) if self.helm.warning else ()
            self.warnings = (*failsafe_warnings(self.requests.parameters, self.options), *stops)

    # Commands

    def drive(self, message: MavlinkMessage, now: float, *, moving: bool) -> None:
        """Send motion and repeat it, behind a request for our mode where needed; raise NotReady.

        Neutral goes only into a mode that is ours.
        """
        if not moving:
            self._motion = b""
            if self.helm.release():
                self.outbox.set(MOTION, (self.encode(message),), now, period_s=REPEAT_S[self.options.drive])
            return
        if self.helm.engage(now):
            asks = [self._mode(self.helm.driving)]
            if self.helm.arms and not self.helm.armed:
                asks.append(command_long(Command.ARM, 1.0, 0.0, self.vehicle))
            until = now + AGAIN_S * (TRIES - 0.5)
            frames = tuple(map(self.encode, asks))
            self.outbox.set(_MODE, frames, -math.inf, period_s=AGAIN_S, until=until)  # before the motion
            self.outbox.clear(MOTION)  # a stop that is repeated
        self._motion = self.encode(message)
        if self.helm.state is HelmState.DRIVING or self.options.drive == "guided":
            self._send_motion(now)

    def _send_motion(self, now: float) -> None:
        """Send the newest motion, and repeat it.

        A stick waits until the rover shows our mode: in the mode of its RC pilot it would be obeyed too. A setpoint is
        ignored outside GUIDED.
        """
        self._overrides = self.options.drive == "manual"
        self.outbox.set(MOTION, (self._motion,), now, period_s=REPEAT_S[self.options.drive])

    def halt(self, frames: tuple[bytes, ...], now: float, until: float, *, ordered: bool) -> None:
        """Send a stop, and repeat it until it is confirmed."""
        self.helm.stop(now, ordered=ordered)
        self._motion = b""
        self.outbox.clear(_MODE)
        until = min(until, now + STOP_S)
        self.outbox.set(MOTION, frames, now, period_s=STOP_AGAIN_S, until=until, urgent=True)

    def hold(self) -> bytes:
        """Return the frame that asks for HOLD."""
        return self.encode(self._mode(RoverMode.HOLD))

    def _mode(self, mode: RoverMode) -> CommandLong:
        return command_long(Command.DO_SET_MODE, float(CUSTOM_MODE), float(mode), self.vehicle)
