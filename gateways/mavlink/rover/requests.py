"""What a rover is asked for: streams, its version and home, and the parameters of its failsafes. Sans-IO.

Source: "The gateway as HQ" of the protocol page. An answer to a command names the command only, so one at a time is on
the wire, :data:`TRIES` times; each time is numbered, as MAVLink has it. Parameters come last; they are never written.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Any, ClassVar

from gateways.mavlink.messages import MavlinkMessage
from gateways.mavlink.messages.control import AutopilotVersion, CommandLong, ParamRequestRead, ParamValue
from gateways.mavlink.messages.telemetry import HomePosition
from gateways.mavlink.numbers import AUTOPILOT, Command
from gateways.mavlink.rover.advice import OTHER_STATION
from gateways.mavlink.rover.options import RoverOptions
from gateways.mavlink.session import MavlinkSession
from zbridge.protocol import Kept

AGAIN_S, TRIES = 0.5, 4
STREAM_S = 5.0
"""Seconds after which a stream that stopped is asked for again."""
LOOK_S = 1.0
LONG_S = 2.0
"""A failsafe that takes longer is warned of."""
POSITION, RANGES, STATUS = (30, 32, 33, 74), (330, 132), (1, 24, 147)
"""Ids of the streams, by the option of their rate."""
PARAMETERS = (
    "FS_GCS_ENABLE",
    "FS_GCS_TIMEOUT",
    "GUID_TIMEOUT",
    "RC_OVERRIDE_TIME",
    "PILOT_STEER_TYPE",
    "MAV_GCS_SYSID",
    "SYSID_MYGCS",
)
_REQUEST = "request"
_READ = 0
"""The number of no command: read a parameter."""
_US = 1_000_000


class RoverRequests(Kept):
    """The requests of one session."""

    kept: ClassVar[dict[str, Any]] = {
        "parameters": dict[str, float],
        "heard": dict[int, float],
        "_vehicle": int,
        "_waiting": list[tuple[int, float, float]],
        "_tries": int,
        "_again_at": float,
        "_look_at": float,
    }

    def __init__(self, session: MavlinkSession[Any], options: RoverOptions) -> None:
        self._session = session
        self._vehicle = 0
        rates = ((POSITION, options.position_hz), (RANGES, options.ranges_hz), (STATUS, options.status_hz))
        self._streams = {message_id: _US / rate for ids, rate in rates for message_id in ids if rate}
        self.parameters: dict[str, float] = {}
        self.heard: dict[int, float] = {}
        """When a message of an id came last."""
        self._waiting: deque[tuple[int, float, float]] = deque()
        """Commands with two numbers, or :data:`_READ` with the place of a parameter; the first one is on the wire."""
        self._tries = 0
        self._again_at = self._look_at = math.inf

    def __repr__(self) -> str:
        return f"<RoverRequests {len(self._waiting)} wait, {len(self.parameters)} parameters>"

    @property
    def due(self) -> float:
        """When :meth:`expire` is next due; ``inf``: never."""
        return min(self._again_at, self._look_at)

    def begin(self, vehicle: int, now: float) -> None:
        """Ask a vehicle for all there is."""
        self._vehicle, self._look_at = vehicle, now + LOOK_S
        for wanted in (AutopilotVersion, HomePosition):
            self._waiting.append((Command.REQUEST_MESSAGE, float(wanted.spec.id), 0.0))
        self._waiting.extend(map(self._stream, self._streams))
        self._waiting.extend((_READ, float(place), 0.0) for place in range(len(PARAMETERS)))
        self._next(now)

    def answered(self, command: int, now: float) -> None:
        """Go on with the next request if this one is on the wire."""
        if self._waiting and self._waiting[0][0] == command:
            self._waiting.popleft()
            self._next(now)

    def take(self, message: ParamValue, now: float) -> None:
        """Note the value of a parameter."""
        name = message.param_id.partition(b"\0")[0].decode("ascii", "replace")
        if name in PARAMETERS and math.isfinite(message.param_value):
            self.parameters[name] = message.param_value
            if self._waiting and self._waiting[0][:2] == (_READ, PARAMETERS.index(name)):
                self.answered(_READ, now)

    def expire(self, now: float) -> None:
        """Ask again for what did not come."""
        if now >= self._again_at and self._tries < TRIES:
            self._send(now)
        elif now >= self._again_at:
            command, number, _ = self._waiting.popleft()
            if command != _READ:  # no vehicle has all parameters
                self._session.left_out[f"command {command} ({number:g}) without an answer"] += 1
            self._next(now)
        if now >= self._look_at:
            self._look_at = now + LOOK_S
            self._look(now)

    def _look(self, now: float) -> None:
        for message_id in self._streams:
            wanted = self._stream(message_id)
            if now - self.heard.get(message_id, now) > STREAM_S and wanted not in self._waiting:
                self.heard[message_id] = now
                self._waiting.append(wanted)
        if self._again_at == math.inf:
            self._next(now)

    def _stream(self, message_id: int) -> tuple[int, float, float]:
        return Command.SET_MESSAGE_INTERVAL, float(message_id), float(round(self._streams[message_id]))

    def _next(self, now: float) -> None:
        self._tries, self._again_at = 0, math.inf
        if self._waiting:
            self._send(now)
        else:
            self._session.outbox.clear(_REQUEST)

    def _send(self, now: float) -> None:
        command, number, more = self._waiting[0]
        request: MavlinkMessage = command_long(command, number, more, self._vehicle, self._tries)
        if command == _READ:
            request = ParamRequestRead(-1, self._vehicle, AUTOPILOT, PARAMETERS[int(number)].encode())
        self._session.outbox.set(_REQUEST, (self._session.encode(request),), now)
        self._tries, self._again_at = self._tries + 1, now + AGAIN_S


def mirrors_backward(parameters: dict[str, float]) -> bool:
    """Return whether the rover reverses its steering while its stick drives it backward; it does unless told else."""
    return parameters.get("PILOT_STEER_TYPE", 0.0) in (0.0, 2.0)


def failsafe_warnings(parameters: dict[str, float], options: RoverOptions) -> tuple[str, ...]:
    """Say where the rover would drive on if the gateway died; only of parameters that it has told."""
    if options.drive == "guided":
        return tuple(_too_long(parameters, "GUID_TIMEOUT"))
    warnings = ["FS_GCS_ENABLE is 0: no failsafe acts if the gateway dies"] if _is_off(parameters) else []
    warnings += [*_too_long(parameters, "RC_OVERRIDE_TIME"), *_too_long(parameters, "FS_GCS_TIMEOUT")]
    station = parameters.get("MAV_GCS_SYSID", parameters.get("SYSID_MYGCS", options.system_id))
    if station != options.system_id:
        warnings.append(f"{OTHER_STATION} {station:g}: the rover ignores the sticks of system {options.system_id}")
    return tuple(warnings)


def _is_off(parameters: dict[str, float]) -> bool:
    return parameters.get("FS_GCS_ENABLE") == 0.0


def _too_long(parameters: dict[str, float], name: str) -> list[str]:
    seconds = parameters.get(name, 0.0)
    if 0.0 <= seconds <= LONG_S:
        return []
    return [f"{name} is {seconds:g} s: the rover drives on for so long if the gateway dies"]


def command_long(command: int, number: float, more: float, vehicle: int, confirmation: int = 0) -> CommandLong:
    """Return a command with two numbers to the autopilot of a vehicle."""
    return CommandLong(
        number,
        more,
        command=command,
        target_system=vehicle,
        target_component=AUTOPILOT,
        confirmation=confirmation,
    )
