"""What is legal when of a gateway as ground station ("The gateway as HQ"). Sans-IO: no channel, no clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import msgspec

from gateways.mavlink.conformance.parser import ParsedMavlinkFrame, target

MANUAL, HOLD, AUTO, GUIDED = 0, 4, 10, 15
"""Modes of an ArduRover."""
ARMED = 128
"""The bit of base_mode."""
ARM, SET_MODE, SET_INTERVAL, REQUEST_MESSAGE = 400, 176, 511, 512
BODY_FRAME, VELOCITY_MASKS = 8, (0x5C7, 0x5E7)
_COMMANDS = {ARM, SET_MODE, SET_INTERVAL, REQUEST_MESSAGE}
_LEAST_US = {30: 200_000, 32: 200_000, 33: 200_000, 132: 200_000, 330: 200_000, 1: 1_000_000, 147: 1_000_000}
"""The streams that are asked for, and their shortest intervals."""
_ONCE = {148, 242}
_PARAMETERS = {
    "FS_GCS_ENABLE",
    "FS_GCS_TIMEOUT",
    "GUID_TIMEOUT",
    "RC_OVERRIDE_TIME",
    "PILOT_STEER_TYPE",
    "MAV_GCS_SYSID",
    "SYSID_MYGCS",
}
_MOST_SENDS, _QUICKEST_S = 4, 0.9
"""Of a command without ACK: how often it is sent, and the least time for that many (0.5 s apart: 1.5 s)."""
_UNKNOWN_BEATS = 2
"""HEARTBEATs of a vehicle that was never found before, until it is spoken to."""
_GIVEN_BACK = 32767
_ASKED_S = 2.0
"""How long after a request for the mode to drive in a setpoint may come before HEARTBEAT shows it."""
_EPISODE_S = 3.0
"""A command that was last sent longer ago begins anew."""


class GatewayAsStation(msgspec.Struct, frozen=True, kw_only=True):
    """What the gateway is configured to be, and how patient the judge is; seconds.

    What the judge waits for is timed by its own clock, which stops while its process is late.
    """

    source: tuple[int, int] = (255, 190)
    vehicle_id: int = 1
    drive: Literal["guided", "manual"] = "guided"
    arms: bool = False
    """Whether the first motion arms (``arm = "drive"``)."""
    numbered: bool = True
    """Whether its frames are numbered without a gap; the stop that a supervisor writes in its place is not."""
    streams: frozenset[int] = frozenset()
    """More messages that its options ask for."""
    reaction_s: float = 0.5
    """How long after a HEARTBEAT showed another mode what contradicts it may still come."""
    hold_s: float = 1.0
    """How long after a HEARTBEAT showed HOLD it may still be asked for."""
    again_s: float = 0.9
    """Longest time from one sending of a command to the next; it should be 0.5 s."""
    heartbeat_s: float = 1.7
    """Longest time between HEARTBEATs; it should be 1 s."""
    motion_s: float = 0.7
    """Longest time between two setpoints or sticks of one motion; it should be 0.2 s."""
    ordered_s: float = 3.0
    """How long :meth:`StationRules.expect_stop` counts."""


class _Request:
    """The sendings of one command."""

    def __init__(self, awake_s: float, now: float) -> None:
        self.first, self.last_s = now, awake_s
        self.times, self.over = 0, False


class StationRules:
    """Judges what one gateway sends on one connection after the other. ``violate`` is called with each violation."""

    def __init__(self, expected: GatewayAsStation, violate: Callable[[str], object]) -> None:
        self._expected, self._violate = expected, violate
        self._mode = GUIDED if expected.drive == "guided" else MANUAL
        self._awake_s, self._now = 0.0, 0.0
        self._ordered_s = -math.inf
        self._piloted_s: float | None = None
        self._handlers: dict[str, Callable[[dict[str, Any]], None]] = {
            "HEARTBEAT": self._judge_heartbeat,
            "COMMAND_LONG": self._judge_command,
            "SET_POSITION_TARGET_LOCAL_NED": self._judge_setpoint,
            "MANUAL_CONTROL": self._judge_stick,
            "RC_CHANNELS_OVERRIDE": self._judge_override,
            "PARAM_REQUEST_READ": self._judge_parameter,
        }
        self._shown, self._shown_s = (-1, False), 0.0
        self._found = False
        self.connected()

    @property
    def vehicle_id(self) -> int:
        return self._expected.vehicle_id

    def connected(self) -> None:
        """Begin with another connection; modes and what was ordered outlast it, and so does which vehicle it is."""
        self._wanted_beats = 1 if self._found else _UNKNOWN_BEATS
        self._vehicle_beats, self._vehicle_beat_s = 0, -math.inf
        self._beats, self._first_beat, self._beat_s = 0, 0.0, -math.inf
        self._requests: dict[tuple[int, int], _Request] = {}
        self._stopped, self._zeroed = False, True
        self._motion_s: float | None = None

    def heartbeat_sent(self, mode: int, armed: bool) -> None:
        """Note what the vehicle's HEARTBEAT shows, before it is sent."""
        self._vehicle_beats, self._vehicle_beat_s = self._vehicle_beats + 1, self._awake_s
        self._found = self._found or self._vehicle_beats >= self._wanted_beats
        if self._vehicle_beats == self._wanted_beats:
            self._beat_s = self._awake_s
        if (mode, armed) != self._shown:
            self._shown, self._shown_s = (mode, armed), self._awake_s

    def acknowledged(self, command: int, number: int) -> None:
        """Note that the vehicle answered a command; ``number``: what tells it from others of its kind."""
        if (command, number) in self._requests:
            self._requests[command, number].over = True

    def expect_stop(self) -> None:
        """Note that somebody ordered a stop: it may act in any mode."""
        self._ordered_s = self._awake_s

    def piloted(self, piloted: bool = True) -> None:
        """Note that somebody else drives: motion ends, and from now on only an ordered stop may change the mode."""
        self._piloted_s = self._awake_s if piloted else None
        self._motion_s = None

    def step(self, now: float, passed_s: float) -> None:
        """Judge what is overdue. ``now``: monotonic seconds; ``passed_s``: how long the judge listened."""
        self._now, self._awake_s = now, self._awake_s + passed_s
        expected, awake_s = self._expected, self._awake_s
        alive = self._vehicle_beats >= self._wanted_beats and awake_s - self._vehicle_beat_s < 2.0
        if alive and awake_s - self._beat_s > expected.heartbeat_s:
            self._violate(f"no HEARTBEAT for {awake_s - self._beat_s:.2f} s")
            self._beat_s = math.inf
        if self._motion_s is not None and awake_s - self._motion_s > expected.motion_s:
            self._violate(f"neither motion nor a stop for {awake_s - self._motion_s:.2f} s after motion")
            self._motion_s = None
        for (command, number), request in self._requests.items():
            if not request.over and awake_s - request.last_s > expected.again_s:
                request.over = True
                if request.times < self._due(command, number):
                    self._violate(f"command {command} ({number}) without ACK was sent {request.times} times only")

    def _due(self, command: int, number: int) -> int:
        """Return how often a command without ACK must be sent: a request of motion may be given up."""
        if (command, number) == (SET_MODE, HOLD):
            return 1 if self._shown[0] == HOLD else 2
        return _MOST_SENDS if command in (SET_INTERVAL, REQUEST_MESSAGE) else 1

    def receive(self, frame: ParsedMavlinkFrame) -> None:
        """Judge a message that could be read."""
        expected = self._expected
        if (frame.sysid, frame.compid) != expected.source:
            self._violate(f"{frame.name} from {frame.sysid}/{frame.compid}")
        system, component = target(frame.fields)
        if system not in (None, expected.vehicle_id) or component not in (None, 1):
            self._violate(f"{frame.name} to {system}/{component}")
        if self._vehicle_beats < self._wanted_beats and not self._ordered():
            self._violate(f"{frame.name} before {self._wanted_beats} HEARTBEATs of the vehicle")
        if handler := self._handlers.get(frame.name):
            handler(frame.fields)
        else:
            self._violate(f"{frame.name}, which no gateway sends to a vehicle")

    def _ordered(self) -> bool:
        return self._awake_s - self._ordered_s < self._expected.ordered_s

    def _judge_heartbeat(self, fields: dict[str, Any]) -> None:
        kind = fields["type"], fields["autopilot"], fields["mavlink_version"], fields["base_mode"] & ARMED
        if kind != (6, 8, 3, 0):
            self._violate("HEARTBEAT of type {}, autopilot {}, version {}, armed {}".format(*kind))
        silent_s = self._awake_s - self._vehicle_beat_s
        if silent_s > 3.0 + self._expected.heartbeat_s:
            self._violate(f"HEARTBEAT {silent_s:.1f} s after the vehicle's last one")
        self._beats, self._beat_s = self._beats + 1, self._awake_s
        if self._beats == 1:
            self._first_beat = self._now
        elif (took_s := self._now - self._first_beat) < self._beats - 1 - self._expected.heartbeat_s:
            self._violate(f"{self._beats} HEARTBEATs in {took_s:.1f} s")

    def _judge_parameter(self, fields: dict[str, Any]) -> None:
        if fields["param_id"] not in _PARAMETERS:
            self._violate(f"PARAM_REQUEST_READ of {fields['param_id']!r}")

    # Commands

    def _judge_command(self, fields: dict[str, Any]) -> None:
        command, number = fields["command"], fields["param1"]
        if command not in _COMMANDS or not math.isfinite(number):
            self._violate(f"command {command}, which no gateway sends to a vehicle")
            return
        if command == SET_MODE:
            number = fields["param2"]
            self._judge_mode(fields)
        elif command == ARM:
            self._judge_arming(fields)
        elif command == SET_INTERVAL:
            least_us = dict.fromkeys(self._expected.streams, 0) | _LEAST_US
            if number not in least_us or fields["param2"] < least_us[number]:
                self._violate(f"message {number:g} every {fields['param2']:g} us")
        elif number not in _ONCE:
            self._violate(f"message {number:g} requested")
        self._count(command, int(number))

    def _count(self, command: int, number: int) -> None:
        """Count the sendings of a command: four times, 0.5 s apart; a stop more often."""
        key, now = (command, number), self._now
        request = self._requests.get(key)
        if request is None or request.over or self._awake_s - request.last_s > _EPISODE_S:
            request = self._requests[key] = _Request(self._awake_s, now)
        request.times, request.last_s = request.times + 1, self._awake_s
        if key == (SET_MODE, HOLD):
            return
        if request.times > _MOST_SENDS:
            self._violate(f"command {command} ({number}) was sent {request.times} times")
        elif request.times == _MOST_SENDS and now - request.first < _QUICKEST_S:
            self._violate(f"command {command} ({number}) was sent 4 times within {now - request.first:.2f} s")

    def _judge_mode(self, fields: dict[str, Any]) -> None:
        """Judge DO_SET_MODE, and whether it arms."""
        mode, held_s = fields["param2"], self._awake_s - self._shown_s
        if not int(fields["param1"]) & 1:
            self._violate("DO_SET_MODE without the custom mode's bit")
        if mode == HOLD:
            if not self._zeroed:
                self._violate("HOLD without a zero setpoint or a neutral stick before it")
            if self._shown[0] == HOLD and held_s > self._expected.hold_s and not (self._ordered() or self._asking()):
                self._violate(f"HOLD {held_s:.1f} s after HEARTBEAT showed it")
            self._judge_pilot("HOLD", stops=True)
            self._stopped = True
        elif mode == self._mode:
            self._judge_pilot(f"mode {mode:g}")
            self._stopped = False
            self._zeroed = self._zeroed and self._expected.drive == "manual"  # where a stick waits for the mode
        else:
            self._violate(f"mode {mode:g}, neither HOLD nor the mode to drive in")
        for (command, number), request in self._requests.items():
            superseded = command == SET_MODE and number != mode
            request.over = request.over or superseded or (command == ARM and mode == HOLD)

    def _judge_arming(self, fields: dict[str, Any]) -> None:
        if fields["param1"] != 1:
            self._violate("DISARM")
        elif fields["param2"]:
            self._violate(f"forced arming, {fields['param2']:g}")
        elif not self._expected.arms:
            self._violate("ARM, which is the operator's")
        self._judge_pilot("ARM")

    def _judge_pilot(self, what: str, *, stops: bool = False) -> None:
        """Judge what would take the vehicle from who drives it."""
        if self._piloted_s is None:
            return
        if stops and self._ordered():
            if what == "HOLD":
                self._piloted_s = None
        elif self._awake_s - self._piloted_s > self._expected.reaction_s:
            self._violate(f"{what} while somebody else drives, in mode {self._shown[0]}")

    # Motion

    def _judge_setpoint(self, fields: dict[str, Any]) -> None:
        if self._expected.drive != "guided":
            self._violate("a setpoint to a vehicle that is driven by stick")
        frame, mask = fields["coordinate_frame"], fields["type_mask"]
        if frame != BODY_FRAME or mask not in VELOCITY_MASKS:
            self._violate(f"a setpoint in frame {frame} with type_mask {mask:#x}")
        values = [fields[name] for name in ("vx", "vy", "yaw_rate")]
        if not all(map(math.isfinite, values)):
            self._violate(f"a setpoint of {values}")
        self._move("a setpoint", any(values))

    def _asking(self) -> bool:
        """Whether the mode to drive in was asked for a moment ago, and HEARTBEAT has shown nothing new since."""
        request = self._requests.get((SET_MODE, int(self._mode)))
        return request is not None and self._shown_s < request.last_s and self._awake_s - request.last_s <= _ASKED_S

    def _judge_stick(self, fields: dict[str, Any]) -> None:
        values = fields["y"], fields["z"]
        if values == (_GIVEN_BACK, _GIVEN_BACK) and self._expected.drive == "manual":
            self._zeroed, self._motion_s = True, None  # to the RC receiver
            return
        if not all(-1000 <= value <= 1000 for value in values):
            self._violate(f"a stick of y {values[0]}, z {values[1]}")
        self._stick(any(values))

    def _judge_override(self, fields: dict[str, Any]) -> None:
        values = fields["chan1_raw"], fields["chan3_raw"]
        if not all(value in (0, 65535) or 1000 <= value <= 2000 for value in values):
            self._violate(f"an override of {values[0]} and {values[1]}")
        self._stick(any(value not in (0, 1500, 65535) for value in values))

    def _stick(self, moves: bool) -> None:
        if self._expected.drive != "manual":
            self._violate("a stick to a vehicle that is driven by setpoints")
        self._move("a stick", moves)

    def _move(self, what: str, moves: bool) -> None:
        """Judge a setpoint or a stick."""
        self._judge_pilot(what, stops=not moves)
        watched = moves and self._piloted_s is None  # else it was on its way when somebody took the vehicle
        self._zeroed, self._motion_s = not moves, self._awake_s if watched else None
        if not moves:
            return
        mode, armed = self._shown
        if self._stopped:
            self._violate(f"{what} with motion after a stop, before the mode was asked for again")
        elif what == "a setpoint" and self._asking():  # it is ignored until the mode is shown
            return
        elif self._awake_s - self._shown_s > self._expected.reaction_s and (mode != self._mode or not armed):
            self._violate(f"{what} with motion in mode {mode}{'' if armed else ', disarmed'}")
