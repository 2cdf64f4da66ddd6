"""What a ground station may order by COMMAND_LONG, COMMAND_INT and SET_MODE: each is answered once. Sans-IO.

Source: "The gateway as vehicle" of the protocol page.
"""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable

from gateways.mavlink.frames import MavlinkFrame
from gateways.mavlink.messages.control import AutopilotVersion, CommandAck, CommandInt, CommandLong, MavlinkSetMode
from gateways.mavlink.messages.telemetry import HomePosition
from gateways.mavlink.numbers import CUSTOM_MODE, Command, Result, RoverMode
from gateways.mavlink.station.driving import RELEASE, enter, is_deflected
from gateways.mavlink.station.session import Station, StopNews
from gateways.mavlink.station.streams import STREAMED
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Stop
from zbridge.fleet.view import RobotView
from zbridge.protocol import Telemetry

Ordered = tuple[Result, tuple[Telemetry, ...]]
STOPPED = ("stopped", "latched")
"""The states of ``control`` after a stop."""
STOPPING_S = 1.0
"""Longest wait until a stop is shown, seconds."""
_US_PER_S = 1e6
_VERSION, _HOME = AutopilotVersion.spec.id, HomePosition.spec.id
_REQUESTABLE = STREAMED | {_VERSION}
"""Ids that are sent once where they are asked for."""
_ACCEPTED: Ordered = (Result.ACCEPTED, ())
_FAILED: Ordered = (Result.FAILED, ())


def command(station: Station, message: CommandLong | CommandInt, asker: MavlinkFrame) -> tuple[Telemetry, ...]:
    """Carry out and acknowledge a command; return what the robot is ordered."""
    handler = _HANDLERS.get(message.command)
    ordered = handler(station, message) if handler is not None else (Result.UNSUPPORTED, ())
    return _acknowledge(station, message.command, ordered, asker)


def set_mode(station: Station, message: MavlinkSetMode, asker: MavlinkFrame) -> tuple[Telemetry, ...]:
    """Carry out and acknowledge SET_MODE, as an ArduRover does."""
    ordered = _choose(station, message.base_mode, message.custom_mode)
    return _acknowledge(station, MavlinkSetMode.spec.id, ordered, asker)


def _acknowledge(station: Station, number: int, ordered: Ordered, asker: MavlinkFrame) -> tuple[Telemetry, ...]:
    result, telemetry = ordered
    if result is not Result.ACCEPTED:
        station.traffic.refused += 1
    station.answer(CommandAck(number, result, target_system=asker.system, target_component=asker.component))
    return telemetry


def hindrance(station: Station, view: RobotView) -> str | None:
    """Return why a client may not drive now; None if it may."""
    if view.missing is not None:
        return view.missing
    control = view.control
    if control is None:
        return None
    if control.latches:
        return f"stop {control.latches[-1].described}"
    if is_stopping(station, station.now):
        return "stopping"
    return f"held by {control.holder}" if is_held(control, station.who) else None


def is_stopping(station: Station, now: float) -> bool:
    """Return whether news of the station's own stop is still to come; some may be lost."""
    return bool(station.awaits) and now - station.stop_asked_at < STOPPING_S


def is_held(control: Control, who: str) -> bool:
    """Return whether somebody else holds the robot from whom a listener's client cannot take it."""
    return control.holder not in (None, who) and (control.priority or 0) >= 0


def _arm(station: Station, message: CommandLong | CommandInt) -> Ordered:
    if message.param1 != 1:
        return _stop(station)
    if refused := _refused(station):
        return refused
    if is_deflected(station):
        station.text(RELEASE)
        return _FAILED
    station.armed = True
    station.beat(station.now)
    return _ACCEPTED


def _set_mode(station: Station, message: CommandLong | CommandInt) -> Ordered:
    base, custom = message.param1, message.param2
    if not (0 <= base < 256 and 0 <= custom < 2**32):
        return Result.DENIED, ()
    return _choose(station, int(base), int(custom))


def _choose(station: Station, base: int, custom: int) -> Ordered:
    if not base & CUSTOM_MODE or custom not in (RoverMode.HOLD, RoverMode.MANUAL, RoverMode.GUIDED):
        station.text("only MANUAL, GUIDED and HOLD")
        return Result.DENIED, ()
    mode = RoverMode(custom)
    if mode is RoverMode.HOLD:
        return _stop(station)
    if refused := _refused(station):
        return refused
    station.mode = mode
    station.beat(station.now)
    return Result.ACCEPTED, enter(station, mode)


def _terminate(station: Station, message: CommandLong | CommandInt) -> Ordered:
    return _stop(station) if message.param1 > 0.5 else _ACCEPTED


def _stop(station: Station) -> Ordered:
    """Stop the robot, whoever drives it. Until all news of that came, nobody arms: it would disarm them again."""
    control = station.vehicle.view.control
    station.rest(station.now)
    station.stop_asked_at, station.awaits = station.now, {StopNews.SHOWN}
    if control is not None and control.holder == station.who:
        station.awaits.add(StopNews.LEASE_ENDED)  # that takes a question to the robot's gateway
    return Result.ACCEPTED, ((topics.CMD_STOP, Stop(id=secrets.token_bytes(16), who=station.who)),)


def _refused(station: Station) -> Ordered | None:
    """Refuse to prepare for motion that would be refused; None if it would not."""
    why = hindrance(station, station.vehicle.view)
    if why is None:
        return None
    station.text(why)
    station.rest(station.now)
    return Result.TEMPORARILY_REJECTED, ()


def _set_interval(station: Station, message: CommandLong | CommandInt) -> Ordered:
    message_id, interval_us = message.param1, message.param2
    if message_id not in STREAMED or not math.isfinite(interval_us):
        return _FAILED
    station.streams.set(int(message_id), interval_us / _US_PER_S)
    return _ACCEPTED


def _send(station: Station, message_id: float) -> Ordered:
    known = station.vehicle.message(int(message_id)) if message_id in _REQUESTABLE else None
    if known is None or not station.there:
        return _FAILED
    station.answer(known)
    return _ACCEPTED


_HANDLERS: dict[int, Callable[[Station, CommandLong | CommandInt], Ordered]] = {
    Command.DO_SET_MODE: _set_mode,
    Command.FLIGHT_TERMINATION: _terminate,
    Command.ARM: _arm,
    Command.GET_HOME_POSITION: lambda station, message: _send(station, _HOME),
    Command.SET_MESSAGE_INTERVAL: _set_interval,
    Command.REQUEST_MESSAGE: lambda station, message: _send(station, message.param1),
    Command.REQUEST_AUTOPILOT_CAPABILITIES: lambda station, message: _send(station, _VERSION),
}
