"""One ArduRover as a robot: commands to messages. Sans-IO.

Source: "Translation" and "The gateway as HQ" of the protocol page.
"""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

from gateways.mavlink.messages import MavlinkMessage
from gateways.mavlink.messages.control import ManualControl, SetPositionTargetLocalNed
from gateways.mavlink.numbers import AUTOPILOT, BODY_NED, VELOCITY_AND_YAW_RATE
from gateways.mavlink.rover.helm import Helm, HelmState
from gateways.mavlink.rover.options import RoverOptions
from gateways.mavlink.rover.requests import mirrors_backward
from gateways.mavlink.rover.session import RoverSession
from gateways.mavlink.rover.telemetry import TELEMETRY, RoverTelemetry
from zbridge.fleet.messages import Drive, FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.protocol import Metrics, NotReady, Outcome, RobotSide, State, Translate, Unsupported

FULL_STICK = 1000
_SIDEWAYS = "left: a rover does not move sideways"


class RoverRobot(RobotSide):
    """One rover on one link."""

    hands_over = True
    link_names = ("vehicle",)
    driving: RoverSession | None = None
    kept: ClassVar[dict[str, Any]] = {"helm": Helm, "_telemetry": RoverTelemetry}

    def __init__(self, options: RoverOptions, links: int = 1, metrics: Metrics | None = None) -> None:
        self.options = options
        self.helm = Helm(options.mode, arms=options.arm == "drive")
        """Whose mode the rover is in; a new connection does not change that."""
        self._telemetry = RoverTelemetry(options, self.helm)

    def session(self, link: str, peer: str) -> RoverSession:
        self.driving = RoverSession(self.options, self.helm)
        return self.driving

    def translator(self, kind: type) -> Translate:
        translate = TELEMETRY.get(kind)
        return partial(translate, self._telemetry) if translate is not None else lambda message, stamp_ns: ()

    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        if not isinstance(command, Drive):
            raise Unsupported("a rover takes drives only")
        if command.left and not (command.forward or command.turn):
            raise Unsupported(_SIDEWAYS)
        moving = bool(command.forward or command.turn)
        self._session.drive(self._motion(command.forward, command.turn), now, moving=moving)
        if command.forward:
            self._telemetry.backward = command.forward < 0
        left_out = [_SIDEWAYS] if command.left else []
        left_out += ["light: a rover has none that is known"] if command.light is not None else []
        return Outcome(left_out="; ".join(left_out) or None)

    def stop(self, now: float, until: float) -> None:
        self._session.halt(self._stop(), now, until, ordered=True)

    def rest(self, now: float, until: float) -> None:
        """Stop in our own mode only: the rover may be its RC pilot's, or on a mission. One that holds is left so."""
        if self.helm.ours and self.helm.state is not HelmState.HELD:
            self._session.halt(self._stop(), now, until, ordered=False)

    def stop_frames(self) -> tuple[bytes, ...]:
        """Return the frames of a stop while the rover is in our mode: a gateway that dies takes it from nobody."""
        ours = self.helm.ours and self.helm.state is not HelmState.HELD
        return self._stop() if ours and self.driving is not None and self.driving.vehicle else ()

    def ask(self, topic: Topic) -> None:
        raise Unsupported(f"a rover cannot be asked for its {topic.path}")

    @property
    def _session(self) -> RoverSession:
        if self.driving is None or self.driving.state is not State.ESTABLISHED:
            raise NotReady("offline")
        return self.driving

    def _motion(self, forward: float, turn: float) -> MavlinkMessage:
        """Make a setpoint, or a stick. Both turn clockwise; a zero has no sign."""
        session, options = self._session, self.options
        if options.drive == "manual":
            mirrored = forward < 0 and mirrors_backward(session.requests.parameters)
            right = turn if mirrored else -turn
            return ManualControl(y=round(right * FULL_STICK), z=round(forward * FULL_STICK), target=session.vehicle)
        return SetPositionTargetLocalNed(
            vx=forward * options.speed_full_m_s + 0.0,
            yaw_rate=-turn * options.turn_full_rad_s + 0.0,
            type_mask=VELOCITY_AND_YAW_RATE,
            target_system=session.vehicle,
            target_component=AUTOPILOT,
            coordinate_frame=BODY_NED,
        )

    def _stop(self) -> tuple[bytes, ...]:
        """Return neutral, then HOLD. A stick in somebody else's mode would outlive the stop there: HOLD alone."""
        session = self._session
        if self.options.drive == "manual" and not self.helm.ours:
            return (session.hold(),)
        return session.encode(self._motion(0.0, 0.0)), session.hold()
