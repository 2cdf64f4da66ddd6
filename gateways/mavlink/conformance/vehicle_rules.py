"""What is legal when of a gateway that plays a vehicle ("The gateway as vehicle"). Sans-IO: no channel, no clock."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec

from gateways.mavlink.conformance.machine import (
    ARM,
    ARMED,
    GUIDED,
    HOLD,
    MANUAL,
    REQUEST_MESSAGE,
    SET_INTERVAL,
    SET_MODE,
)
from gateways.mavlink.conformance.parser import NAMES, NUMBERS, ParsedMavlinkFrame, Values, target

GET_HOME, GET_INTERVAL, TERMINATE = 410, 510, 185
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
_ANSWERED = {ARM, SET_MODE, SET_INTERVAL, REQUEST_MESSAGE, GET_HOME, GET_INTERVAL, TERMINATE, 519, 520}
"""Commands that may be other than UNSUPPORTED."""
_UNASKED = {"SYS_STATUS", "ATTITUDE", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "GPS_RAW_INT", "VFR_HUD"}
_UNASKED |= {"BATTERY_STATUS"}
_STREAMED = _UNASKED | {"RC_CHANNELS", "OBSTACLE_DISTANCE", "DISTANCE_SENSOR"}
"""What REQUEST_DATA_STREAM may bring."""
_ANSWERS = {
    "PARAM_VALUE": ("PARAM_REQUEST_READ", "PARAM_REQUEST_LIST", "PARAM_SET"),
    "MISSION_COUNT": ("MISSION_REQUEST_LIST",),
    "FILE_TRANSFER_PROTOCOL": ("FILE_TRANSFER_PROTOCOL",),
    "PING": ("PING",),
    "TIMESYNC": ("TIMESYNC",),
}
"""Messages that come only after one of these."""
FTP_NAK, FTP_NOT_FOUND = 129, 10
_REAL32 = 9
_WARNING, _INFO = 4, 6
_UNASKED_HZ = 4.0
_WINDOW_S = 2.0


class VehicleTimes(msgspec.Struct, frozen=True, kw_only=True):
    """How patient the judge is, in seconds of its own clock, which stops while its process is late."""

    heartbeat_s: float = 1.7
    """Longest time between HEARTBEATs; it should be 1 s."""
    answer_s: float = 1.0
    """Longest time to an answer."""
    params_s: float = 5.0
    """Longest time from PARAM_REQUEST_LIST to the last parameter."""
    reaction_s: float = 0.5
    """How long after a refusal, or after somebody else began to drive, HEARTBEAT may still show the old state."""
    away_s: float = 5.0
    """How long after the robot is away a HEARTBEAT may still come."""


class _Asked(msgspec.Struct):
    """A command without ACK so far."""

    command: int
    first: float
    second: float
    at_s: float


class VehicleRules:
    """Judges what one gateway sends on one connection. ``source``: the ids of the judge."""

    def __init__(self, source: tuple[int, int], times: VehicleTimes, violate: Callable[[str], object]) -> None:
        self._source, self._times, self._violate = source, times, violate
        self.vehicle: tuple[int, int] | None = None
        """Ids of the vehicle, once it spoke."""
        self._awake_s = self._now = 0.0
        self._beat_s, self._away_s = 0.0, math.inf
        self._pending: list[_Asked] = []
        self._promised: dict[str, float] = {}
        self._asked: Counter[str] = Counter()
        self._rates: dict[str, float] = {}
        self._sent: dict[str, Values] = {}
        self._windows: dict[str, tuple[float, int]] = {}
        self._armed_until_s = -math.inf
        self._modes = {HOLD: math.inf}
        self._warned_s, self._refused_s = -math.inf, math.inf
        self._params: dict[int, tuple[str, float]] = {}
        self._param_count = 0
        self._listed_s = math.inf
        self._handlers: dict[str, Callable[[dict[str, Any]], None]] = {
            "HEARTBEAT": self._judge_heartbeat,
            "COMMAND_ACK": self._judge_ack,
            "PARAM_VALUE": self._judge_param,
            "MISSION_COUNT": self._judge_missions,
            "FILE_TRANSFER_PROTOCOL": self._judge_ftp,
            "STATUSTEXT": self._judge_text,
        }

    def away(self, away: bool = True) -> None:
        """Note that the robot is gone, or back: HEARTBEAT is silent while it is gone."""
        self._away_s, self._beat_s = self._awake_s if away else math.inf, self._awake_s

    def others_drive(self) -> None:
        """Note that somebody else drives or ordered a stop: HEARTBEAT must show HOLD, disarmed."""
        self._disarm()

    def _disarm(self) -> None:
        until_s = self._awake_s + self._times.reaction_s
        self._armed_until_s = min(self._armed_until_s, until_s)
        self._modes = {mode: min(one, until_s) for mode, one in self._modes.items()} | {HOLD: math.inf}

    def sent(self, name: str, fields: Values) -> None:
        """Note what the judge sends."""
        self._sent[name] = fields
        if name == "COMMAND_LONG":
            self._note_command(fields)
        elif name == "REQUEST_DATA_STREAM":
            self._note_streams(fields["req_stream_id"], fields["req_message_rate"] * fields["start_stop"])
        elif name == "PARAM_REQUEST_LIST":
            self._listed_s = min(self._listed_s, self._awake_s) if self._params else self._awake_s
        elif name == "MISSION_REQUEST_LIST":
            self._promised["MISSION_COUNT"] = self._awake_s
        elif name == "FILE_TRANSFER_PROTOCOL":
            self._promised[name] = self._awake_s

    def _note_command(self, fields: Values) -> None:
        command, first, second = fields["command"], fields.get("param1", 0.0), fields.get("param2", 0.0)
        self._pending.append(_Asked(command, first, second, self._awake_s))
        name = NAMES.get(int(first), "")
        if command == ARM and first == 1:
            self._armed_until_s = math.inf
        elif command == SET_MODE and second in (MANUAL, GUIDED):
            self._modes[int(second)] = math.inf
        elif command == SET_INTERVAL and name:
            self._rates[name] = _UNASKED_HZ if second == 0 else max(0.0, 1e6 / second)
        elif command == REQUEST_MESSAGE and name:
            self._asked[name] += 1
        elif command == GET_HOME:
            self._asked["HOME_POSITION"] += 1
        elif command == GET_INTERVAL:
            self._asked["MESSAGE_INTERVAL"] += 1

    def _note_streams(self, stream: int, rate: float) -> None:
        """Note REQUEST_DATA_STREAM ("streams as asked (4 Hz at most where all are asked)")."""
        for name in _STREAMED | {"HOME_POSITION", "EXTENDED_SYS_STATE"}:
            self._rates[name] = max(self._rates.get(name, 0.0), min(rate, _UNASKED_HZ) if stream == 0 else rate)

    def step(self, now: float, passed_s: float, late_s: float = 0.0) -> None:
        """Judge what is overdue. ``now``: monotonic seconds; ``passed_s``: how long the judge listened."""
        self._now, self._awake_s = now, self._awake_s + passed_s
        awake_s, times = self._awake_s, self._times
        if late_s > 0.05:
            self._windows.clear()
        if self._away_s == math.inf and awake_s - self._beat_s > times.heartbeat_s:
            self._violate(f"no HEARTBEAT for {awake_s - self._beat_s:.2f} s")
            self._beat_s = math.inf
        while self._pending and awake_s - self._pending[0].at_s > times.answer_s:
            late = self._pending.pop(0)
            self._violate(f"no ACK of command {late.command} ({late.first:g}, {late.second:g})")
        for name in [name for name, at_s in self._promised.items() if awake_s - at_s > times.answer_s]:
            del self._promised[name]
            self._violate(f"no {name} within {times.answer_s:g} s")
        if awake_s - self._listed_s > times.params_s:
            self._listed_s = math.inf
            self._violate(f"{len(self._params)} of {self._param_count} parameters: QGC says it did not respond")
        if awake_s - self._refused_s > times.answer_s:
            self._refused_s = math.inf
            self._violate("a refusal without STATUSTEXT")

    def receive(self, frame: ParsedMavlinkFrame) -> None:
        """Judge a message that could be read."""
        name, source = frame.name, (frame.sysid, frame.compid)
        if self.vehicle is None:
            self.vehicle = source
            if name != "HEARTBEAT":
                self._violate(f"the first frame is {name}, not HEARTBEAT")
            if not 1 <= frame.sysid <= 250 or frame.compid != 1:
                self._violate(f"a vehicle {frame.sysid}/{frame.compid}")
        elif source != self.vehicle:
            self._violate(f"{name} from {frame.sysid}/{frame.compid}, not from {self.vehicle[0]}/{self.vehicle[1]}")
        system, component = target(frame.fields)
        if system not in (None, self._source[0]) or component not in (None, self._source[1]):
            self._violate(f"{name} to {system}/{component}, who did not ask")
        if name in self._promised:
            del self._promised[name]
        self._judge_due(name)
        if handler := self._handlers.get(name):
            handler(frame.fields)

    def _judge_due(self, name: str) -> None:
        """Judge whether a message was asked for, and how often it comes."""
        if name in ("HEARTBEAT", "STATUSTEXT", "COMMAND_ACK"):
            return
        if name in _ANSWERS:
            if not any(one in self._sent for one in _ANSWERS[name]):
                self._violate(f"{name} that was not asked for")
            return
        if self._asked[name] > 0:
            self._asked[name] -= 1
            return
        rate = self._rates.get(name, _UNASKED_HZ if name in _UNASKED else 0.0)
        since, count = self._windows.get(name, (self._now, 0))
        passed_s, count = self._now - since, count + 1
        if rate == 0.0 and name not in self._rates:
            self._violate(f"{name} that was not asked for")
        elif passed_s >= _WINDOW_S:
            if (most := rate * passed_s * 1.25 + 2) < count:
                self._violate(f"{count} {name} in {passed_s:.1f} s, {most:.0f} at most")
            since, count = self._now, 0
        self._windows[name] = since, count

    def _judge_heartbeat(self, fields: dict[str, Any]) -> None:
        kind = fields["type"], fields["autopilot"], fields["mavlink_version"], fields["base_mode"] & 1
        if kind not in ((10, 3, 3, 1), (11, 3, 3, 1)):
            self._violate("HEARTBEAT of type {}, autopilot {}, version {}, custom mode {}".format(*kind))
        if self._awake_s - self._away_s > self._times.away_s:
            self._violate("HEARTBEAT of a robot that is away")
        mode = fields["custom_mode"]
        if fields["base_mode"] & ARMED and self._awake_s > self._armed_until_s:
            self._violate("armed, though this client has not armed or is not the holder")
        if self._awake_s > self._modes.get(mode, -math.inf):
            self._violate(f"mode {mode}, which this client has not asked for or not been given")
        self._beat_s = self._awake_s

    def _judge_text(self, fields: dict[str, Any]) -> None:
        text, severity = fields["text"], fields["severity"]
        if severity not in (_WARNING, _INFO) or not text.isprintable() or not (text or fields["chunk_seq"]):
            self._violate(f"STATUSTEXT of severity {severity}, {text!r}")
        if severity == _WARNING:
            self._warned_s, self._refused_s = self._awake_s, math.inf

    # Answers

    def _judge_ack(self, fields: dict[str, Any]) -> None:
        command, result = fields["command"], fields["result"]
        if command == NUMBERS["SET_MODE"] and "SET_MODE" in self._sent:
            return
        found = next((one for one in self._pending if one.command == command), None)
        if found is None:
            self._violate(f"an ACK of command {command}, which has one or was not sent")
            return
        self._pending.remove(found)
        if fields["target_system"] != self._source[0]:
            self._violate(f"an ACK of command {command} to nobody")
        self._judge_result(found, result)
        if command in (ARM, SET_MODE) and result != ACCEPTED:
            self._refuse(found)
            if self._awake_s - self._warned_s > self._times.answer_s:
                self._refused_s = self._awake_s
        elif _stops(found):
            self._disarm()
        elif command == SET_MODE:
            until_s = self._awake_s + self._times.reaction_s
            self._modes = {HOLD: math.inf, int(found.second): math.inf} | {
                mode: until_s for mode in self._modes if mode not in (HOLD, found.second)
            }

    def _refuse(self, asked: _Asked) -> None:
        """Note a refusal: what was asked for must not be shown."""
        until_s = self._awake_s + self._times.reaction_s
        if asked.command == ARM:
            self._armed_until_s = until_s
        elif asked.second in self._modes and asked.second != HOLD:
            self._modes[int(asked.second)] = until_s

    def _judge_result(self, asked: _Asked, result: int) -> None:
        """Judge the result of a command."""
        command, first, second = asked.command, asked.first, asked.second
        unknown = command in (SET_INTERVAL, REQUEST_MESSAGE) and first not in NAMES
        if unknown and result == ACCEPTED:
            self._violate(f"ACCEPTED for message {first:g}, which never comes: it hangs QGC")
        elif command == REQUEST_MESSAGE and result == ACCEPTED:
            if self._asked[NAMES[int(first)]]:
                self._promised[NAMES[int(first)]] = self._awake_s
        elif command not in _ANSWERED and result != UNSUPPORTED:
            self._violate(f"result {result} of command {command}, which is unknown")
        elif _stops(asked) and result != ACCEPTED:
            self._violate(f"result {result} of a stop, {command} ({first:g}, {second:g})")
        elif command == SET_MODE and second not in (MANUAL, HOLD, GUIDED) and result not in (DENIED, UNSUPPORTED):
            self._violate(f"result {result} of mode {second:g}")

    def _judge_param(self, fields: dict[str, Any]) -> None:
        name, value = fields["param_id"], fields["param_value"]
        count, index = fields["param_count"], fields["param_index"]
        if fields["param_type"] != _REAL32 or not name:
            self._violate(f"parameter {name!r} of type {fields['param_type']}")
        if count != (self._param_count or count) or not count or (index >= count and index != 65535):
            self._violate(f"parameter {name!r}: index {index} of {count}, {self._param_count} before")
        if index != 65535 and self._params.setdefault(index, (name, value)) != (name, value):
            self._violate(f"parameter {index} is {name!r} {value:g}, {self._params[index]} before")
        self._param_count = count
        if len(self._params) >= count:
            self._listed_s = math.inf

    def _judge_missions(self, fields: dict[str, Any]) -> None:
        kind = self._sent.get("MISSION_REQUEST_LIST", {}).get("mission_type", 0)
        if fields["count"] or fields["mission_type"] != kind:
            self._violate(f"{fields['count']} mission items of type {fields['mission_type']}")

    def _judge_ftp(self, fields: dict[str, Any]) -> None:
        asked = self._sent.get("FILE_TRANSFER_PROTOCOL", {}).get("payload", (0,) * 251)
        payload = fields["payload"]
        due = ((asked[0] + 256 * asked[1] + 1) % 65536, asked[2], FTP_NAK, 1, asked[3], FTP_NOT_FOUND)
        found = (payload[0] + 256 * payload[1], *payload[2:6], payload[12])
        if found != due:
            self._violate(f"FTP sequence, session, opcode, size, request, error {found} instead of {due}")


def _stops(asked: _Asked) -> bool:
    return (
        (asked.command == ARM and asked.first == 0)
        or (asked.command == SET_MODE and asked.second == HOLD)
        or (asked.command == TERMINATE and asked.first > 0.5)
    )
