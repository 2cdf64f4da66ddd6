"""One ArduRover as a robot: commands to messages. Sans-IO.

Source: "Translation" and "The gateway as HQ" of the protocol page.
"""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar

from gateways.mavlink.rover.helm import Helm
from gateways.mavlink.rover.options import RoverOptions
from gateways.mavlink.rover.session import RoverSession
from gateways.mavlink.rover.telemetry import TELEMETRY, RoverTelemetry
from zbridge.fleet.messages import Drive, FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.protocol import Metrics, NotReady, Outcome, RobotSide, State, Translate, Unsupported

_SIDEWAYS = "left: a rover does not move sideways"


class RoverRobot(RobotSide):
    """One rover on one link."""

    hands_over = True
    closing_harmless = True
    """It obeys each ground station alone; a second one of ours would feed its failsafe."""
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
        self._session.drive(command.forward, command.turn, now)
        if command.forward:
            self._telemetry.backward = command.forward < 0
        left_out = [_SIDEWAYS] if command.left else []
        left_out += ["light: a rover has none that is known"] if command.light is not None else []
        return Outcome(left_out="; ".join(left_out) or None)

    def stop(self, now: float, until: float) -> None:
        self._session.halt(now, until, ordered=True)

    def rest(self, now: float, until: float) -> None:
        """Stop in our own mode only: the rover may be its RC pilot's, or on a mission. One that holds is left so."""
        if self.helm.ours:
            self._session.halt(now, until, ordered=False)

    def stop_frames(self) -> tuple[bytes, ...]:
        """Return the frames of a stop while the rover is in our mode: a gateway that dies takes it from nobody."""
        driving = self.driving
        if driving is None or driving.state is not State.ESTABLISHED or not self.helm.ours:
            return ()
        return driving.stop_frames()

    def ask(self, topic: Topic) -> None:
        raise Unsupported(f"a rover cannot be asked for its {topic.path}")

    @property
    def _session(self) -> RoverSession:
        if self.driving is None or self.driving.state is not State.ESTABLISHED:
            raise NotReady("offline")
        return self.driving
