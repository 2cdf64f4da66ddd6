"""The simulated ArduRover of the judge: it drives, measures and answers ("What an ArduRover does"). Sans-IO."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import msgspec

from gateways.mavlink.conformance import machine
from gateways.mavlink.conformance.machine import ARMED, AUTO, GUIDED, HOLD, MANUAL, StationRules
from gateways.mavlink.conformance.parser import NAMES, ParsedMavlinkFrame, target

_MODES = {0, 1, 3, 4, 5, 10, 11, 15}
_FULL_M_S, _FULL_RAD_S, _LAG_S, _MOST_STEP_S = 1.0, 1.0, 0.1, 0.1
_MISSION_M_S = 0.5
_FAILSAFE_S = 1.5
_BEAT_S = 1.0
_ACCEPTED, _UNSUPPORTED, _FAILED = 0, 3, 4
_WARNING, _CRITICAL = 4, 2
_DEPLOYED = {
    "FS_GCS_ENABLE": 0.0,
    "FS_GCS_TIMEOUT": 5.0,
    "GUID_TIMEOUT": 3.0,
    "RC_OVERRIDE_TIME": 3.0,
    "PILOT_STEER_TYPE": 0.0,
    "MAV_GCS_SYSID": 255.0,
}


class RoverQuirks(msgspec.Struct, frozen=True, kw_only=True):
    """What deployed vehicles and their links do."""

    hold_at: int = 1
    """The request for HOLD that it obeys; it says nothing to those before."""
    deaf: int = 0
    """How many sendings of each command are lost."""
    refuses_arming: str = ""
    """The STATUSTEXT with which it does not arm."""
    prompt: bool = True
    """Whether a HEARTBEAT shows another mode at once; else the next one does."""
    lacks: frozenset[int] = frozenset({132, 330})
    """Messages that it has not."""
    foreign: bool = False
    """Whether a radio, a gimbal, another vehicle and a GCS are on the link, from the vehicle's third HEARTBEAT on."""
    first_id: int = 0
    """Its id in the first HEARTBEAT, if that is another one (ArduPilot 3.7)."""
    garbage: bool = False
    """Whether there are bytes outside of frames, and frames with a wrong length."""
    cuts: bool = False
    """Whether frames are cut and joined in any way."""
    v1: bool = False
    """Whether it speaks MAVLink 1, where a message allows it."""


class SentMessage(NamedTuple):
    """A message of the vehicle or of somebody behind it, not yet written."""

    source: tuple[int, int]
    name: str
    fields: Mapping[str, Any]


class JudgedRover:
    """One vehicle. ``rules`` learn what it shows and answers; ``params``: what differs from the deployed ones."""

    def __init__(
        self, rules: StationRules, *, quirks: RoverQuirks, system_id: int = 1, params: Mapping[str, float] | None = None
    ) -> None:
        self.quirks, self.params = quirks, {**_DEPLOYED, **(params or {})}
        self.mode, self.armed = HOLD, False
        self.x_north = self.y_east = 0.0
        """Metres."""
        self.yaw = 0.0
        """Radians, clockwise from north."""
        self.speed = self.turn = 0.0
        """As it moves now: m/s, negative backward; rad/s clockwise."""
        self.heartbeats = self.telemetry = True
        """Whether it sends HEARTBEATs, and what was asked for."""
        self.obeyed: Counter[int] = Counter()
        """How many commands it obeyed, by number."""
        self.out: deque[SentMessage] = deque(maxlen=1000)
        """What is to be written, in order."""
        self._rules, self._id = rules, system_id
        self._now = self._booted = 0.0
        self._wanted = (0.0, 0.0)
        self._wanted_at, self._gcs_at = -math.inf, math.inf
        self._handlers: dict[str, Callable[[ParsedMavlinkFrame], None]] = {
            "HEARTBEAT": self._hear_station,
            "COMMAND_LONG": self._obey,
            "SET_POSITION_TARGET_LOCAL_NED": self._follow,
            "MANUAL_CONTROL": self._steer,
            "RC_CHANNELS_OVERRIDE": self._steer,
            "PARAM_REQUEST_READ": self._tell_parameter,
        }
        self.connected(0.0)

    def connected(self, now: float) -> None:
        """Begin with another connection: nothing was asked for on it."""
        self.out.clear()
        self._intervals: dict[int, float] = {}
        self._due: dict[int, float] = {}
        self._lost: Counter[tuple[int, float]] = Counter()
        self._beats, self._beat_due = 0, now
        self._holds = 0

    @property
    def moving(self) -> bool:
        """Whether it moves or is commanded to."""
        return any(self.commanded) or abs(self.speed) > 0.02 or abs(self.turn) > 0.02

    @property
    def commanded(self) -> tuple[float, float]:
        """The speed and the turn that it is to reach: m/s; rad/s clockwise."""
        if not self.armed or self.mode not in (GUIDED, MANUAL, AUTO):
            return 0.0, 0.0
        return (_MISSION_M_S, 0.0) if self.mode == AUTO else self._wanted

    def choose(self, mode: int) -> None:
        """Change the mode; HEARTBEAT shows it."""
        self.mode, self._wanted, self._holds = mode, (0.0, 0.0), 0
        self._show_soon()

    def arm(self, armed: bool = True) -> None:
        """Arm or disarm, as an operator does."""
        self.armed = armed
        self._show_soon()

    def _show_soon(self) -> None:
        if self.quirks.prompt:
            self._beat_due = min(self._beat_due, self._now)

    # What it receives

    def receive(self, frame: ParsedMavlinkFrame) -> None:
        """Obey a message, legal or not, as an ArduRover does."""
        if target(frame.fields)[0] in (None, 0, self._id) and frame.name in self._handlers:
            self._handlers[frame.name](frame)

    def _hear_station(self, frame: ParsedMavlinkFrame) -> None:
        if frame.sysid == self.params["MAV_GCS_SYSID"]:
            self._gcs_at = self._now

    def _obey(self, frame: ParsedMavlinkFrame) -> None:
        command, first, second = (frame.fields[name] for name in ("command", "param1", "param2"))
        key = command, second if command == machine.SET_MODE else first
        self._lost[key] += 1
        if self._lost[key] <= self.quirks.deaf:
            return
        if key == (machine.SET_MODE, HOLD) and self.mode != HOLD:
            self._holds += 1
            if self._holds < self.quirks.hold_at:
                return
        result = self._result(command, first, second)
        self.obeyed[command] += result == _ACCEPTED
        self._rules.acknowledged(command, int(key[1]))
        self._answer("COMMAND_ACK", frame, command=command, result=result)
        if command == machine.REQUEST_MESSAGE and result == _ACCEPTED:
            self._send(int(first))

    def _result(self, command: int, first: float, second: float) -> int:
        """Obey a command, and return the result."""
        if command == machine.SET_MODE:
            if second not in _MODES:
                return _FAILED
            if second != self.mode:
                self.choose(int(second))
        elif command == machine.ARM:
            if first == 1 and self.quirks.refuses_arming:
                self.tell(self.quirks.refuses_arming, _CRITICAL)
                return _FAILED
            self.arm(first == 1)
        elif command == machine.SET_INTERVAL:
            if first not in _TELEMETRY or first in self.quirks.lacks:
                return _FAILED
            self._intervals[int(first)] = second * 1e-6 if second > 0 else math.inf if second < 0 else 0.25
            self._due[int(first)] = self._now
        elif command == machine.REQUEST_MESSAGE:
            return _ACCEPTED if first in _TELEMETRY and first not in self.quirks.lacks else _FAILED
        else:
            return _UNSUPPORTED
        return _ACCEPTED

    def _follow(self, frame: ParsedMavlinkFrame) -> None:
        """Take a setpoint in GUIDED; with velocity alone it turns round instead of reversing."""
        fields = frame.fields
        if self.mode == GUIDED and self.armed and not fields["type_mask"] & 0x18:
            forward = fields["vx"] if not fields["type_mask"] & 0x800 else abs(fields["vx"])
            self._wanted = max(-_FULL_M_S, min(forward, _FULL_M_S)), fields["yaw_rate"]
            self._wanted_at = self._now

    def _steer(self, frame: ParsedMavlinkFrame) -> None:
        """Take a stick in MANUAL, from its own GCS only; backward, steering is reversed."""
        if frame.sysid != self.params["MAV_GCS_SYSID"] or self.mode != MANUAL:
            return
        fields = frame.fields
        if frame.name == "MANUAL_CONTROL":
            throttle, steering = fields["z"] / 1000, fields["y"] / 1000
        else:
            throttle, steering = ((fields[name] or 1500) / 500 - 3 for name in ("chan3_raw", "chan1_raw"))
        if throttle < 0 and self.params["PILOT_STEER_TYPE"] in (0, 2):
            steering = -steering
        self._wanted = throttle * _FULL_M_S, steering * _FULL_RAD_S
        self._wanted_at = self._gcs_at = self._now

    def _tell_parameter(self, frame: ParsedMavlinkFrame) -> None:
        names, name = sorted(self.params), frame.fields["param_id"]
        if name in self.params:
            values = {"param_value": self.params[name], "param_count": len(names), "param_index": names.index(name)}
            self._put("PARAM_VALUE", param_id=name, param_type=9, **values)

    # How it moves

    def step(self, now: float) -> None:
        """Move, and put what is due into ``out``. ``now``: monotonic seconds."""
        passed_s, self._now = min(now - self._now, _MOST_STEP_S) if self._now else 0.0, now
        self._booted = self._booted or now
        self._fail_safe()
        wanted = self.commanded
        gain = min(passed_s / _LAG_S, 1.0)
        self.speed += (wanted[0] - self.speed) * gain
        self.turn += (wanted[1] - self.turn) * gain
        self.yaw = math.remainder(self.yaw + self.turn * passed_s, math.tau)
        self.x_north += self.speed * math.cos(self.yaw) * passed_s
        self.y_east += self.speed * math.sin(self.yaw) * passed_s
        self._beat()
        if self.telemetry:
            for number, due in self._due.items():
                if now >= due:
                    self._due[number] = max(due + self._intervals[number], now)
                    self._send(number)

    def _fail_safe(self) -> None:
        """End motion of which no more is heard: a target, a stick, the ground station."""
        silent_s = self._now - self._wanted_at
        if self.mode == GUIDED and self.armed and silent_s > self.params["GUID_TIMEOUT"]:
            self._wanted, self._wanted_at = (0.0, 0.0), math.inf
            self.tell(f"target not received last {self.params['GUID_TIMEOUT']:.1f}secs, stopping", _WARNING)
        if self.mode == MANUAL and silent_s > self.params["RC_OVERRIDE_TIME"]:
            self._wanted = 0.0, 0.0
        lost_s = self._now - self._gcs_at
        if self.params["FS_GCS_ENABLE"] and self.mode != HOLD and lost_s > self.params["FS_GCS_TIMEOUT"] + _FAILSAFE_S:
            self.tell("GCS Failsafe", _WARNING)
            self.choose(HOLD)

    # What it sends

    def tell(self, text: str, severity: int = 6) -> None:
        """Send a STATUSTEXT of at most 50 bytes."""
        self._put("STATUSTEXT", severity=severity, text=text)

    def _put(self, name: str, **fields: Any) -> None:
        self.out.append(SentMessage((self._id, 1), name, fields))

    def _answer(self, name: str, frame: ParsedMavlinkFrame, **fields: Any) -> None:
        self._put(name, target_system=frame.sysid, target_component=frame.compid, **fields)

    def _send(self, number: int) -> None:
        self._put(NAMES[number], **_TELEMETRY[number](self))

    def _beat(self) -> None:
        if self._now < self._beat_due:
            return
        self._beat_due = max(self._beat_due + _BEAT_S, self._now + _BEAT_S / 2)
        if not self.heartbeats:
            return
        self._beats += 1
        beat = {"custom_mode": self.mode, "type": 10, "autopilot": 3, "mavlink_version": 3}
        beat |= {"base_mode": 0x41 | ARMED * self.armed, "system_status": 4 if self.armed else 3}
        if self._beats == 1 and self.quirks.first_id:
            self.out.append(SentMessage((self.quirks.first_id, 1), "HEARTBEAT", beat))
            return
        self._rules.heartbeat_sent(self.mode, self.armed)
        self._put("HEARTBEAT", **beat)
        if self.quirks.foreign and self._beats >= 3:
            self.out.extend(_foreign(self._id))

    @property
    def boot_ms(self) -> int:
        return int(1000 * (self._now - self._booted))


def _foreign(system_id: int) -> list[SentMessage]:
    """Return what others on the link say, which is counted and never obeyed."""

    def beat(source: tuple[int, int], kind: int, autopilot: int, mode: int) -> SentMessage:
        fields = {"type": kind, "autopilot": autopilot, "base_mode": 0x41 | ARMED, "custom_mode": mode}
        return SentMessage(source, "HEARTBEAT", {**fields, "system_status": 4, "mavlink_version": 3})

    other = 7 if system_id != 7 else 8
    accepted = {"command": machine.SET_MODE, "target_system": 255, "target_component": 190}
    return [
        beat((51, 68), 18, 8, 0),
        SentMessage((51, 68), "RADIO_STATUS", {"rssi": 200, "remrssi": 190, "txbuf": 100}),
        beat((system_id, 154), 26, 8, GUIDED),
        beat((other, 1), 10, 3, GUIDED),
        SentMessage((other, 1), "LOCAL_POSITION_NED", {"x": 1000.0, "y": 1000.0}),
        SentMessage((other, 1), "ATTITUDE", {"yaw": 3.0}),
        SentMessage((other, 1), "COMMAND_ACK", accepted),
        beat((254, 190), 6, 8, 0),
    ]


def _position(rover: JudgedRover) -> dict[str, Any]:
    lat, lon = rover.x_north / 111_320.0, rover.y_east / 111_320.0  # at the equator both degrees are as long
    course = round(math.degrees(rover.yaw) * 100) % 36000
    return {"time_boot_ms": rover.boot_ms, "lat": round(lat * 1e7), "lon": round(lon * 1e7), "hdg": course}


def _local(rover: JudgedRover) -> dict[str, Any]:
    north, east = rover.speed * math.cos(rover.yaw), rover.speed * math.sin(rover.yaw)
    return {"time_boot_ms": rover.boot_ms, "x": rover.x_north, "y": rover.y_east, "vx": north, "vy": east}


def _obstacles(rover: JudgedRover) -> dict[str, Any]:
    """Return a wall 2 m ahead and 5 m to the right, nothing elsewhere; 5 degrees each, clockwise."""
    distances = [65535] * 72
    distances[0], distances[18] = 200, 500
    return {"distances": tuple(distances), "min_distance": 20, "max_distance": 3000, "increment": 5, "frame": 12}


_TELEMETRY: dict[int, Callable[[JudgedRover], dict[str, Any]]] = {
    1: lambda rover: {"onboard_control_sensors_health": 1 << 28, "voltage_battery": 12600, "battery_remaining": 80},
    24: lambda rover: {"fix_type": 3, "satellites_visible": 9},
    30: lambda rover: {"time_boot_ms": rover.boot_ms, "yaw": rover.yaw, "yawspeed": rover.turn},
    32: _local,
    33: _position,
    74: lambda rover: {"groundspeed": abs(rover.speed), "heading": round(math.degrees(rover.yaw)) % 360},
    132: lambda rover: {"current_distance": 200, "min_distance": 20, "max_distance": 3000},
    147: lambda rover: {"voltages": (12600, *[65535] * 9), "current_battery": 150, "battery_remaining": 80},
    148: lambda rover: {"capabilities": 0x4 | 0x2000, "uid": 1, "flight_sw_version": 0x040500FF},
    242: lambda rover: {"q": (1.0, 0.0, 0.0, 0.0)},
    330: _obstacles,
}
