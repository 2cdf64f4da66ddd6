"""One listener for ground stations: what they are shown of any robot, and what they order. Sans-IO.

Source: "The gateway as vehicle" and "Translation" of the protocol page.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from gateways.mavlink.frames import MavlinkFrame
from gateways.mavlink.messages import MavlinkMessage, control
from gateways.mavlink.numbers import AUTOPILOT, RoverMode, Severity
from gateways.mavlink.station import answers, commands, driving
from gateways.mavlink.station.driving import RELEASE, VELOCITY_ONLY
from gateways.mavlink.station.options import MavlinkHqOptions
from gateways.mavlink.station.parameters import Parameters
from gateways.mavlink.station.session import Station, StopNews
from gateways.mavlink.station.vehicle import ShownRover
from zbridge.fleet.messages import Control, FleetMessage, Text
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.protocol import HqSide, Limits, Metrics, Send, Telemetry

DEADMAN_S = 0.5
_CENTRE = ": centre the joystick first"
"""How the core asks for a neutral."""
UNKNOWN = "messages of unknown ids"
NOT_OURS = "messages to another vehicle"


class MavlinkHq(HqSide):
    """One listener."""

    name = "mavlink"
    hands_over = True
    kept: ClassVar[dict[str, Any]] = {"vehicle": ShownRover}
    deadman_s = DEADMAN_S
    follows = ("pose", "motion", "scan", "battery", "text", "control")

    def __init__(self, options: MavlinkHqOptions, view: RobotView, metrics: Metrics | None = None) -> None:
        self.options = options
        self.view = view
        self.vehicle = ShownRover(options, view)
        self.parameters = Parameters(options, DEADMAN_S)
        self._shown: Control | None = None

    def session(self, number: int, bounds: Limits) -> Station:
        return Station(self.options, self.vehicle, self.parameters, bounds)

    def begin(self, session: Station, now: float) -> None:
        session.now = now
        session.appear(now, there=self.view.missing is None)

    # What they are shown

    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        if isinstance(message, Control):
            return self._control(message)
        if isinstance(message, Text):
            text = message.text
            return None if message.kind == "request" else lambda session, now: session.text(text, Severity.INFO)
        ids = self.vehicle.note(message)
        return self._news(ids) if ids else None

    def _news(self, ids: tuple[int, ...]) -> Send:
        """Send messages to the clients for which they are due; each is encoded once."""
        frames: dict[int, tuple[bytes, ...]] = {}

        def send(session: Station, now: float) -> None:
            for message_id in ids:
                if session.there and session.streams.take(message_id, now):
                    if message_id not in frames:
                        message = self.vehicle.message(message_id)
                        frames[message_id] = () if message is None else (session.encode(message),)
                    if frame := frames[message_id]:
                        session.outbox.set(str(message_id), frame, now)

        return send

    def _control(self, news: Control) -> Send | None:
        """Let nobody seem to drive who does not: after a stop, or while somebody else holds the robot."""
        before, self._shown = self._shown, news
        told = (before.state, before.stops, before.latches) if before is not None else None
        stopped = news.state in commands.STOPPED and told != (news.state, news.stops, news.latches)
        if not stopped and news.holder is None:
            return None

        def send(session: Station, now: float) -> None:
            if stopped or commands.is_held(news, session.who):
                session.rest(now)
            if stopped:
                session.awaits.discard(StopNews.SHOWN)

        return send

    def presence(self, there: bool) -> Send | None:
        return lambda session, now: session.appear(now, there=there)

    def tell(self, session: Station, text: str, now: float) -> None:
        if commands.is_stopping(session, now):  # its own stop, of which it knows
            return
        for prefix in ("not driving: ", "drive: "):
            text = text.removeprefix(prefix)
        if text.endswith(_CENTRE):
            again = f"{text.removesuffix(_CENTRE)}: choose GUIDED again"
            text = again if session.mode == RoverMode.GUIDED else RELEASE
        session.text(text)

    def not_driving(self, session: Station, now: float) -> None:
        session.rest(now)
        session.awaits.discard(StopNews.LEASE_ENDED)

    # What they order, and ask for

    def take(self, session: Station, message: MavlinkFrame) -> tuple[Telemetry, ...]:
        said = message.message
        if said is None:
            session.left_out[UNKNOWN] += 1
            return ()
        handler = _TAKEN.get(type(said))
        if handler is None:  # as heartbeats, whose mode and arming are those of the station
            return ()
        if not self._is_ours(said):
            session.left_out[NOT_OURS] += 1
            return ()
        return handler(session, said, message) or ()

    def _is_ours(self, said: Any) -> bool:
        system = said.target if isinstance(said, control.ManualControl) else getattr(said, "target_system", 0)
        return system in (0, self.options.system_id) and getattr(said, "target_component", 0) in (0, AUTOPILOT)


def _refuse_attitude(station: Station, message: control.SetAttitudeTarget, asker: MavlinkFrame) -> None:
    station.warn(VELOCITY_ONLY)


_TAKEN: dict[type[MavlinkMessage], Callable[[Station, Any, MavlinkFrame], tuple[Telemetry, ...] | None]] = {
    control.CommandLong: commands.command,
    control.CommandInt: commands.command,
    control.MavlinkSetMode: commands.set_mode,
    control.ManualControl: driving.manual_control,
    control.RcChannelsOverride: driving.rc_override,
    control.SetPositionTargetLocalNed: driving.setpoint,
    control.SetAttitudeTarget: _refuse_attitude,
    control.ParamRequestList: answers.parameters,
    control.ParamRequestRead: answers.parameter,
    control.ParamSet: answers.parameter,
    control.RequestDataStream: answers.streams,
    control.MissionRequestList: answers.missions,
    control.FileTransferProtocol: answers.files,
    control.Ping: answers.ping,
    control.Timesync: answers.timesync,
}
