"""What ground stations send by themselves, as it was seen ("The gateway as vehicle"). Sans-IO: no channel, no clock."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Literal

import msgspec

from gateways.mavlink.conformance.machine import ARMED, BODY_FRAME, HOLD, REQUEST_MESSAGE, SET_INTERVAL
from gateways.mavlink.conformance.parser import ParsedMavlinkFrame, Values
from gateways.mavlink.conformance.vehicle_rules import FTP_NAK, GET_HOME, VehicleRules

Program = Literal["mavsdk", "mavproxy", "qgc"]
Drives = Literal["setpoint", "stick", "override"]
"""By SET_POSITION_TARGET_LOCAL_NED, MANUAL_CONTROL or RC_CHANNELS_OVERRIDE."""

_VELOCITY_MASK, _NO_CHANGE = 0x5C7, 65535
_AGAIN_S, _LOST_S = 0.5, 3.0
_FTP_S, _MOST_FTP, _FTP_SESSION, _FTP_OPEN = 0.9, 12, 5, 4
_FTP_FILE = b"@PARAM/param.pck"
_PARAMS_S, _STREAMS_S = 2.0, 10.0
_PREARM = 1 << 28
Step = tuple[float, str, Values]
"""Seconds after the begin, a message and its fields; the target is added."""


def _command(number: int, first: float = 0.0, second: float = 0.0) -> dict[str, Any]:
    return {"command": number, "param1": float(first), "param2": float(second)}


def _streams(at_s: float) -> list[Step]:
    """Return what QGC asks for: seven streams, HOME_POSITION and EXTENDED_SYS_STATE."""
    rates = {1: 2, 2: 2, 3: 2, 6: 3, 10: 10, 11: 10, 12: 3}
    asked: list[Step] = [
        (at_s, "REQUEST_DATA_STREAM", {"req_stream_id": stream, "req_message_rate": rate, "start_stop": 1})
        for stream, rate in rates.items()
    ]
    return [*asked, *((at_s, "COMMAND_LONG", _command(SET_INTERVAL, number, 1e6)) for number in (242, 245))]


class GroundStation(msgspec.Struct, frozen=True, kw_only=True):
    """The habits of one program; seconds."""

    source: tuple[int, int]
    first: tuple[Step, ...]
    """What it sends after the vehicle's first HEARTBEAT."""
    greets: bool
    """Whether it sends HEARTBEAT before it heard one."""
    base_mode: int = 0
    beat_s: float = 0.0
    """When its first HEARTBEAT comes."""
    sends: int = 1
    """How often it sends a command without ACK, 0.5 s apart."""
    params_s: float = math.inf
    """When it asks for all parameters."""
    repeats_streams: bool = False
    by: Drives
    period_s: Mapping[str, float]
    """From one setpoint or stick to the next."""


PROGRAMS: dict[str, GroundStation] = {
    "mavsdk": GroundStation(
        source=(245, 190), greets=False, beat_s=0.7, sends=4, by="setpoint",
        period_s={"setpoint": 0.05, "stick": 0.05, "override": 0.05},
        first=tuple(
            (0.0, "COMMAND_LONG", _command(*one))
            for one in ((REQUEST_MESSAGE, 148), (REQUEST_MESSAGE, 242), (SET_INTERVAL, 245, 1e6))
        ),
    ),
    "mavproxy": GroundStation(
        source=(255, 230), greets=True, params_s=3.0, by="override",
        period_s={"setpoint": 0.1, "stick": 0.1, "override": 0.1},
        first=(
            (0.0, "COMMAND_LONG", _command(GET_HOME)),
            (0.0, "REQUEST_DATA_STREAM", {"req_stream_id": 0, "req_message_rate": 4, "start_stop": 1}),
        ),
    ),
    "qgc": GroundStation(
        source=(255, 190), greets=True, base_mode=ARMED, params_s=0.5, repeats_streams=True, by="stick",
        period_s={"setpoint": 0.05, "stick": 0.04, "override": 0.04},
        first=(
            (0.0, "COMMAND_LONG", _command(REQUEST_MESSAGE, 148)),
            (0.1, "COMMAND_LONG", _command(REQUEST_MESSAGE, 435)),
            (0.2, "COMMAND_LONG", _command(REQUEST_MESSAGE, 397)),
            (0.6, "MISSION_REQUEST_LIST", {"mission_type": 0}),
            *_streams(0.8),
        ),
    ),
}  # fmt: skip


class SentCommand(msgspec.Struct):
    """A command of the program; ``result`` is None until its ACK, and after a timeout."""

    command: int
    fields: dict[str, Any]
    last: float
    times: int = 1
    over: bool = False
    result: int | None = None


class JudgedStation:
    """One program on one connection. ``rules`` learn what it sends; ``ftp``: MAVProxy's module is loaded."""

    def __init__(
        self,
        program: GroundStation,
        rules: VehicleRules,
        *,
        by: Drives | None = None,
        ftp: bool = False,
        full: tuple[float, float] = (1.0, 1.0),
        rest_z: int = 0,
    ) -> None:
        self.program, self.by = program, by or program.by
        self.out: deque[tuple[str, Values]] = deque(maxlen=1000)
        """What is to be written, in order."""
        self.events: list[str] = []
        self.armed, self.mode = False, HOLD
        """As HEARTBEAT shows them."""
        self.heard = self.lost = False
        """Whether a HEARTBEAT came, and whether none comes any more."""
        self.healthy = False
        self.params: dict[str, float] = {}
        self.seen: set[str] = set()
        """Names of the messages that came."""
        self.motion: tuple[float, float] | None = None
        """Forward and turn (counter-clockwise) that it repeats by itself; None: it sends none."""
        self._rules, self._ftp, self._full, self._rest_z = rules, ftp, full, rest_z
        self._system = 0
        self._now = 0.0
        self._steps: list[tuple[float, str, Values]] = []
        self._commands: list[SentCommand] = []
        self._beat_due = 0.0 if program.greets else math.inf
        self._motion_due = 0.0
        self._heard_at = -math.inf
        self._ftp_due, self._ftp_times = math.inf, 0
        self._params_due = self._streams_due = math.inf
        self._indexes: set[int] = set()
        self._param_count = 0
        self._handlers: dict[str, Callable[[dict[str, Any]], None]] = {
            "HEARTBEAT": self._hear,
            "COMMAND_ACK": self._acknowledge,
            "PARAM_VALUE": self._store,
            "FILE_TRANSFER_PROTOCOL": self._end_ftp,
            "SYS_STATUS": self._check_health,
        }

    def command(self, number: int, *params: float) -> SentCommand:
        """Send COMMAND_LONG, and again as the program does; its result comes later."""
        fields = {"command": number} | {f"param{at}": value for at, value in enumerate(params, 1)}
        sent = SentCommand(number, fields, self._now)
        self._commands.append(sent)
        self._send("COMMAND_LONG", fields)
        return sent

    def receive(self, frame: ParsedMavlinkFrame) -> None:
        """Take a message of the vehicle."""
        self.seen.add(frame.name)
        if frame.name == "HEARTBEAT":
            self._system = frame.sysid
        if handler := self._handlers.get(frame.name):
            handler(frame.fields)

    def _send(self, name: str, fields: Values) -> None:
        """Send a message to the vehicle; ``confirmation`` stays 0."""
        if name == "MANUAL_CONTROL":
            fields = {**fields, "target": self._system}
        elif name not in ("HEARTBEAT", "TIMESYNC"):
            fields = {**fields, "target_system": self._system, "target_component": 1}
        self._rules.sent(name, fields)
        self.out.append((name, fields))

    # What it receives

    def _hear(self, fields: dict[str, Any]) -> None:
        self.armed, self.mode = bool(fields["base_mode"] & ARMED), fields["custom_mode"]
        self._heard_at = self._now
        if not self.heard or self.lost:  # after a gap it asks for all again
            self.events.append("found again" if self.lost else "connected")
            self._begin()
        self.heard, self.lost = True, False

    def _begin(self) -> None:
        now = self._now
        self._steps = [(now + at_s, name, fields) for at_s, name, fields in self.program.first]
        self._beat_due = min(self._beat_due, now + self.program.beat_s)
        self._ftp_due = now if self._ftp else math.inf
        self._params_due = math.inf if self._ftp else now + self.program.params_s
        self._streams_due = now + _STREAMS_S if self.program.repeats_streams else math.inf

    def _acknowledge(self, fields: dict[str, Any]) -> None:
        for sent in self._commands:
            if sent.command == fields["command"] and not sent.over:
                sent.over, sent.result = True, fields["result"]
                return

    def _store(self, fields: dict[str, Any]) -> None:
        """Take a parameter; wait a while for the rest before asking for it by index."""
        self.params[fields["param_id"]] = fields["param_value"]
        self._indexes.add(fields["param_index"])
        self._param_count = fields["param_count"]
        self._params_due = self._now + _PARAMS_S if len(self._indexes) < self._param_count else math.inf

    def _end_ftp(self, fields: dict[str, Any]) -> None:
        """Take an answer of FTP, but only with the session of the request; then ask for parameters one by one."""
        if fields["payload"][2:4] == (_FTP_SESSION, FTP_NAK):
            self._ftp_due, self._params_due = math.inf, min(self._params_due, self._now)

    def _check_health(self, fields: dict[str, Any]) -> None:
        self.healthy = bool(fields["onboard_control_sensors_health"] & _PREARM)

    # What it sends by itself

    def step(self, now: float) -> None:
        """Put what is due into ``out``. ``now``: monotonic seconds."""
        self._now = now
        if self.heard and not self.lost and now - self._heard_at > _LOST_S:
            self.lost = True
            self.events.append("lost: no HEARTBEAT for 3 s")
        if now >= self._beat_due:
            self._beat_due = max(self._beat_due + 1.0, now + 0.5)
            beat = {"type": 6, "autopilot": 8, "base_mode": self.program.base_mode, "mavlink_version": 3}
            self._send("HEARTBEAT", {**beat, "system_status": 4})
        due = [step for step in self._steps if now >= step[0]]
        self._steps = [step for step in self._steps if now < step[0]]
        for _, name, fields in due:
            if name == "COMMAND_LONG":
                self.command(fields["command"], fields["param1"], fields["param2"])
            else:
                self._send(name, fields)
        self._repeat_commands()
        self._ask()
        self._drive()

    def _repeat_commands(self) -> None:
        for sent in self._commands:
            if sent.over or self._now - sent.last < _AGAIN_S:
                continue
            if sent.times < self.program.sends:
                sent.times, sent.last = sent.times + 1, self._now
                self._send("COMMAND_LONG", sent.fields)
            elif self.program.sends > 1 or self._now - sent.last > _LOST_S:
                sent.over = True
                self.events.append(f"timeout of command {sent.command}")
        self._commands = [sent for sent in self._commands if not sent.over]

    def _ask(self) -> None:
        """Ask for parameters, for files and, while something is missing, for the streams again."""
        now = self._now
        if now >= self._ftp_due:
            self._ftp_due, self._ftp_times = now + _FTP_S, self._ftp_times + 1
            if self._ftp_times > _MOST_FTP:
                self.events.append("timeout of FTP")
                self._ftp_due, self._params_due = math.inf, now
            else:
                head = bytes([self._ftp_times, 0, _FTP_SESSION, _FTP_OPEN, len(_FTP_FILE)])
                payload = (head.ljust(12, b"\0") + _FTP_FILE).ljust(251, b"\0")
                self._send("FILE_TRANSFER_PROTOCOL", {"payload": tuple(payload)})
        if now >= self._params_due:
            self._params_due = now + _PARAMS_S
            missing = sorted(set(range(self._param_count)) - self._indexes)
            for index in missing[:10]:
                self._send("PARAM_REQUEST_READ", {"param_index": index})
            if not missing:
                self._send("PARAM_REQUEST_LIST", {})
        if now >= self._streams_due and self.heard:
            missing_some = not {"BATTERY_STATUS", "HOME_POSITION"} <= self.seen
            self._streams_due = now + _STREAMS_S if missing_some else math.inf
            if missing_some:
                self._steps += [(now, name, fields) for _, name, fields in _streams(0.0)]

    def _drive(self) -> None:
        """Repeat setpoint or stick, whether or not the program behind it still lives."""
        if self.motion is None or self._now < self._motion_due:
            return
        self._motion_due = max(self._motion_due + self.program.period_s[self.by], self._now)
        forward, turn = self.motion
        if self.by == "setpoint":
            velocities = {"vx": forward * self._full[0], "yaw_rate": -turn * self._full[1]}
            fields = {"coordinate_frame": BODY_FRAME, "type_mask": _VELOCITY_MASK, **velocities}
            self._send("SET_POSITION_TARGET_LOCAL_NED", fields)
        elif self.by == "stick":
            z = round(1000 * forward) if (forward, turn) != (0.0, 0.0) else self._rest_z
            self._send("MANUAL_CONTROL", {"z": z, "y": round(-1000 * turn)})
        else:
            channels = {f"chan{number}_raw": _NO_CHANGE for number in (2, 4, 5, 6, 7, 8)}
            channels |= {"chan1_raw": round(1500 - 500 * turn), "chan3_raw": round(1500 + 500 * forward)}
            self._send("RC_CHANNELS_OVERRIDE", channels)
