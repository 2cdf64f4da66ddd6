"""The frames of both judges, sans-IO: streams cut into frames, frames judged and written ("Frames")."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from zbridge.simulation.judge import MessageReader

Values = Mapping[str, Any]
"""The fields of a message by name; arrays are tuples, texts end before their first NUL."""

V1, V2 = 0xFE, 0xFD
SIGNED = 1
"""The only bit of incompat flags with a meaning."""
_SIGNATURE_BYTES = 13
_OUTSIDE = {V1: 8, V2: 12}
"""Bytes of a frame around its payload."""

_MESSAGES = """
HEARTBEAT 0 50 custom_mode:I type:B autopilot:B base_mode:B system_status:B mavlink_version:B
SYS_STATUS 1 124 onboard_control_sensors_present:I onboard_control_sensors_enabled:I onboard_control_sensors_health:I
    load:H voltage_battery:H current_battery:h drop_rate_comm:H errors_comm:H errors_count1-4:H battery_remaining:b
    + onboard_control_sensors_present_extended:I onboard_control_sensors_enabled_extended:I
    onboard_control_sensors_health_extended:I
PING 4 237 time_usec:Q seq:I target_system:B target_component:B
SET_MODE 11 89 custom_mode:I target_system:B base_mode:B
PARAM_REQUEST_READ 20 214 param_index:h target_system:B target_component:B param_id:16s
PARAM_REQUEST_LIST 21 159 target_system:B target_component:B
PARAM_VALUE 22 220 param_value:f param_count:H param_index:H param_id:16s param_type:B
PARAM_SET 23 168 param_value:f target_system:B target_component:B param_id:16s param_type:B
GPS_RAW_INT 24 24 time_usec:Q lat:i lon:i alt:i eph:H epv:H vel:H cog:H fix_type:B satellites_visible:B
    + alt_ellipsoid:i h_acc:I v_acc:I vel_acc:I hdg_acc:I yaw:H
ATTITUDE 30 39 time_boot_ms:I roll:f pitch:f yaw:f rollspeed:f pitchspeed:f yawspeed:f
LOCAL_POSITION_NED 32 185 time_boot_ms:I x:f y:f z:f vx:f vy:f vz:f
GLOBAL_POSITION_INT 33 104 time_boot_ms:I lat:i lon:i alt:i relative_alt:i vx:h vy:h vz:h hdg:H
MISSION_REQUEST_LIST 43 132 target_system:B target_component:B + mission_type:B
MISSION_COUNT 44 221 count:H target_system:B target_component:B + mission_type:B
RC_CHANNELS 65 118 time_boot_ms:I chan1-18_raw:H chancount:B rssi:B
REQUEST_DATA_STREAM 66 148 req_message_rate:H target_system:B target_component:B req_stream_id:B start_stop:B
MANUAL_CONTROL 69 243 x:h y:h z:h r:h buttons:H target:B + buttons2:H enabled_extensions:B s:h t:h aux1-6:h
RC_CHANNELS_OVERRIDE 70 124 chan1-8_raw:H target_system:B target_component:B + chan9-18_raw:H
VFR_HUD 74 20 airspeed:f groundspeed:f alt:f climb:f heading:h throttle:H
COMMAND_INT 75 158 param1-4:f x:i y:i z:f command:H target_system:B target_component:B frame:B current:B
    autocontinue:B
COMMAND_LONG 76 152 param1-7:f command:H target_system:B target_component:B confirmation:B
COMMAND_ACK 77 143 command:H result:B + progress:B result_param2:i target_system:B target_component:B
SET_ATTITUDE_TARGET 82 49 time_boot_ms:I q:4f body_roll_rate:f body_pitch_rate:f body_yaw_rate:f thrust:f
    target_system:B target_component:B type_mask:B
SET_POSITION_TARGET_LOCAL_NED 84 143 time_boot_ms:I x:f y:f z:f vx:f vy:f vz:f afx:f afy:f afz:f yaw:f yaw_rate:f
    type_mask:H target_system:B target_component:B coordinate_frame:B
RADIO_STATUS 109 185 rxerrors:H fixed:H rssi:B remrssi:B txbuf:B noise:B remnoise:B
FILE_TRANSFER_PROTOCOL 110 84 target_network:B target_system:B target_component:B payload:251B
TIMESYNC 111 34 tc1:q ts1:q
DISTANCE_SENSOR 132 85 time_boot_ms:I min_distance:H max_distance:H current_distance:H type:B id:B orientation:B
    covariance:B + horizontal_fov:f vertical_fov:f quaternion:4f signal_quality:B
BATTERY_STATUS 147 154 current_consumed:i energy_consumed:i temperature:h voltages:10H current_battery:h id:B
    battery_function:B type:B battery_remaining:b + time_remaining:i charge_state:B voltages_ext:4H mode:B
    fault_bitmask:I
AUTOPILOT_VERSION 148 178 capabilities:Q uid:Q flight_sw_version:I middleware_sw_version:I os_sw_version:I
    board_version:I vendor_id:H product_id:H flight_custom_version:8B middleware_custom_version:8B
    os_custom_version:8B + uid2:18B
HOME_POSITION 242 104 latitude:i longitude:i altitude:i x:f y:f z:f q:4f approach_x:f approach_y:f approach_z:f
    + time_usec:Q
MESSAGE_INTERVAL 244 95 interval_us:i message_id:H
EXTENDED_SYS_STATE 245 130 vtol_state:B landed_state:B
STATUSTEXT 253 83 severity:B text:50s + id:H chunk_seq:B
OBSTACLE_DISTANCE 330 23 time_usec:Q distances:72H min_distance:H max_distance:H sensor_type:B increment:B
    + increment_f:f angle_offset:f frame:B
"""
"""Name, id, CRC_EXTRA, and the fields as they lie on the wire; ``a1-3`` is three fields, ``+`` begins extensions."""


class _Layout:
    """How the payload of one message lies."""

    def __init__(self, text: str) -> None:
        self.name, number, extra, *fields = text.split()
        self.number, self.crc_extra = int(number), int(extra)
        base = fields.index("+") if "+" in fields else len(fields)
        self._fields = [one for field in fields if field != "+" for one in _expand(field)]
        self.names = {name for name, _ in self._fields}
        self._struct = struct.Struct("<" + "".join(code for _, code in self._fields))
        self.size = self._struct.size
        self.base_size = struct.calcsize("<" + "".join(code for one in fields[:base] for _, code in _expand(one)))

    def unpack(self, payload: bytes) -> dict[str, Any]:
        values = list(self._struct.unpack(payload[: self.size].ljust(self.size, b"\0")))
        fields: dict[str, Any] = {}
        for name, code in self._fields:
            if code.endswith("s"):
                fields[name] = values.pop(0).split(b"\0")[0].decode("utf-8", "replace")
            elif len(code) > 1:
                count = int(code[:-1])
                fields[name], values = tuple(values[:count]), values[count:]
            else:
                fields[name] = values.pop(0)
        return fields

    def pack(self, fields: Values) -> bytes:
        if unknown := set(fields) - self.names:
            raise ValueError(f"{self.name} has no {sorted(unknown)}")
        values: list[Any] = []
        for name, code in self._fields:
            if code.endswith("s"):
                values.append(str(fields.get(name, "")).encode())
            elif len(code) > 1:
                values.extend(fields.get(name, (0,) * int(code[:-1])))
            else:
                values.append(fields.get(name, 0))
        return self._struct.pack(*values)


def _expand(field: str) -> list[tuple[str, str]]:
    """Return the names and widths of ``name:code`` or of a group ``name1-3_end:code``."""
    name, code = field.split(":")
    if found := re.fullmatch(r"(\w+?)(\d+)-(\d+)(\w*)", name):
        first, last = int(found[2]), int(found[3])
        return [(f"{found[1]}{number}{found[4]}", code) for number in range(first, last + 1)]
    return [(name, code)]


_LAYOUTS = {layout.name: layout for layout in map(_Layout, re.sub(r"\n +", " ", _MESSAGES).strip().splitlines())}
_BY_NUMBER = {layout.number: layout for layout in _LAYOUTS.values()}
NUMBERS = {name: layout.number for name, layout in _LAYOUTS.items()}
NAMES = {number: name for name, number in NUMBERS.items()}


def _crc_of_byte(value: int) -> int:
    for _ in range(8):
        value = value >> 1 ^ (0x8408 if value & 1 else 0)
    return value


_CRC = [_crc_of_byte(value) for value in range(256)]


def crc(data: Iterable[int]) -> int:
    """Return the CRC-16/MCRF4XX of ``data``."""
    value = 0xFFFF
    for byte in data:
        value = value >> 8 ^ _CRC[(value ^ byte) & 0xFF]
    return value


class ParsedMavlinkFrame(msgspec.Struct, frozen=True):
    """One frame of the peer, and what is wrong with it. ``fields`` are empty where they cannot be trusted."""

    raw: bytes
    name: str = ""
    fields: dict[str, Any] = {}
    sysid: int = 0
    compid: int = 0
    seq: int = 0
    problem: str = ""


class MavlinkReader(MessageReader[ParsedMavlinkFrame]):
    """Cuts and judges the stream of one connection of a gateway, which writes MAVLink 2 only.

    ``v1``: MAVLink 1 is no problem, nor are sequence numbers: several peers may be behind the link. ``numbered``:
    whether sequence numbers must have no gap.
    """

    def __init__(self, *, v1: bool = False, numbered: bool = True) -> None:
        super().__init__()
        self._v1, self._numbered = v1, numbered and not v1
        self._seq: int | None = None

    def _lost(self, data: bytes) -> str:
        return "" if data[0] in _OUTSIDE else "bytes outside of a frame"

    def _lose(self, problem: str, after: int) -> ParsedMavlinkFrame:
        found = re.search(b"[\xfd\xfe]", self.rest)
        end = found.start() if found else len(self.rest)
        raw, self.rest = self.rest[:end], self.rest[end:]
        return ParsedMavlinkFrame(raw, problem=problem)

    def _size(self, data: bytes) -> int:
        if len(data) < 3:
            return 3
        return data[1] + _OUTSIDE[data[0]] + _SIGNATURE_BYTES * (data[0] == V2 and bool(data[2] & SIGNED))

    def _read(self, raw: bytes) -> ParsedMavlinkFrame:
        head = 10 if raw[0] == V2 else 6
        seq, sysid, compid = raw[4:7] if head == 10 else raw[2:5]
        number = int.from_bytes(raw[7:10], "little") if head == 10 else raw[5]
        payload, crc_at = raw[head : head + raw[1]], head + raw[1]
        layout = _BY_NUMBER.get(number)
        problems = self._problems(raw, layout, payload) if layout else [f"unknown message id {number}"]
        if self._numbered and self._seq is not None and seq != self._seq:
            problems.append(f"sequence number {seq} instead of {self._seq}")
        self._seq = (seq + 1) % 256
        fields: dict[str, Any] = {}
        if layout is not None:
            due = crc(raw[1:crc_at] + bytes([layout.crc_extra]))
            if (found := int.from_bytes(raw[crc_at : crc_at + 2], "little")) == due:
                fields = layout.unpack(payload)
            else:
                problems.insert(0, f"CRC {found:04x} instead of {due:04x}")
        name = layout.name if layout else str(number)
        return ParsedMavlinkFrame(raw, name, fields, sysid, compid, seq, "; ".join(problems))

    def _problems(self, raw: bytes, layout: _Layout, payload: bytes) -> list[str]:
        """Return what is wrong with the form of a frame of a known message."""
        if raw[0] == V1:
            problems = [] if self._v1 else ["MAVLink 1"]
            if len(payload) != layout.base_size:
                problems.append(f"payload of {len(payload)} bytes instead of {layout.base_size}")
            return problems
        problems = []
        if raw[2] or raw[3]:
            problems.append(f"incompat flags {raw[2]}, compat flags {raw[3]}")
        if not payload:
            problems.append("no payload: its first byte stays")
        if len(payload) > layout.size:
            problems.append(f"payload of {len(payload)} bytes, at most {layout.size}")
        elif len(payload) > 1 and not payload[-1]:
            problems.append("payload with trailing zeros")
        return problems


def write_frame(name: str, fields: Values, source: tuple[int, int], seq: int, *, v1: bool = False) -> bytes:
    """Write a message of ``source`` (sysid, compid) in MAVLink 2 or 1; fields that are left out are 0.

    Raise ValueError for a field that the message has not, struct.error for a value that does not fit.
    """
    layout = _LAYOUTS[name]
    payload = layout.pack(fields)
    if v1:
        payload = payload[: layout.base_size]
        body = bytes([len(payload), seq, *source, layout.number]) + payload
    else:
        payload = payload[:1] + payload[1:].rstrip(b"\0")
        body = bytes([len(payload), 0, 0, seq, *source]) + layout.number.to_bytes(3, "little") + payload
    marker = bytes([V1 if v1 else V2])
    return marker + body + crc(body + bytes([layout.crc_extra])).to_bytes(2, "little")


def target(fields: Values) -> tuple[int | None, int | None]:
    """Return the system and the component that a message is for; None where it has no such field."""
    return fields.get("target_system", fields.get("target")), fields.get("target_component")
