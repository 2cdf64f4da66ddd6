"""The judges of MAVLink before small peers written by hand; their parser before pymavlink."""

from __future__ import annotations

import asyncio
import random
import re
import struct
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from gateways.mavlink.conformance import parser
from gateways.mavlink.conformance.fragile_hq import FragileStation
from gateways.mavlink.conformance.fragile_robot import FragileRover
from gateways.mavlink.conformance.machine import GatewayAsStation
from gateways.mavlink.conformance.parser import MavlinkReader, ParsedMavlinkFrame, write_frame
from gateways.mavlink.conformance.programs import Program
from gateways.mavlink.conformance.rover import RoverQuirks
from tests.conformance.scene import until
from tests.gateways.mavlink.judged_peers import ROVER, STATION, Ground, Vehicle

VECTORS = {
    "HEARTBEAT": "fd0900000001010000000f0000000a03c10403ac7c",
    "MANUAL_CONTROL": "fd0b000000ffbe450000000006fff401000000000146e7",
    "COMMAND_LONG": "fd20000000ffbe4c00000000803f000080400000000000000000000000000000000000000000b00001010e93",
}
"""Those of the protocol page."""


def read_one(data: bytes, **options: Any) -> ParsedMavlinkFrame:
    (frame,) = MavlinkReader(**options).take(data)
    return frame


# Frames


def test_the_vectors_of_the_page_are_read_and_written() -> None:
    frames = {name: read_one(bytes.fromhex(text)) for name, text in VECTORS.items()}
    assert [frame.problem for frame in frames.values()] == ["", "", ""]
    assert (frames["HEARTBEAT"].sysid, frames["HEARTBEAT"].compid) == ROVER
    assert frames["HEARTBEAT"].fields == {
        "custom_mode": 15, "type": 10, "autopilot": 3, "base_mode": 0xC1, "system_status": 4, "mavlink_version": 3,
    }  # fmt: skip
    stick = {name: value for name, value in frames["MANUAL_CONTROL"].fields.items() if value}
    assert stick == {"y": -250, "z": 500, "target": 1}
    hold = {name: value for name, value in frames["COMMAND_LONG"].fields.items() if value}
    assert hold == {"command": 176, "param1": 1.0, "param2": 4.0, "target_system": 1, "target_component": 1}
    for name, frame in frames.items():
        assert write_frame(name, frame.fields, (frame.sysid, frame.compid), frame.seq).hex() == VECTORS[name]


def value_of(rng: random.Random, code: str) -> Any:
    if code == "f":
        return struct.unpack("<f", struct.pack("<f", rng.uniform(-1e6, 1e6)))[0]
    size = struct.calcsize("<" + code)
    return rng.choice([0, 0, int.from_bytes(rng.randbytes(size), "little", signed=code.islower())])


@pytest.mark.parametrize("name", parser.NUMBERS)
def test_pymavlink_reads_what_the_parser_writes_and_the_parser_what_pymavlink_writes(name: str) -> None:
    kind, rng = ardupilotmega.mavlink_map[parser.NUMBERS[name]], random.Random(name)
    codes = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    short = {"uint8_t": "B", "int8_t": "b", "uint16_t": "H", "int16_t": "h", "uint32_t": "I", "int32_t": "i"}
    short |= {"uint64_t": "Q", "int64_t": "q", "float": "f"}
    counts = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    for _ in range(20):
        fields: dict[str, Any] = {}
        for field, code in codes.items():
            if code == "char":
                fields[field] = "".join(rng.choices("ABC_09", k=rng.randrange(1, counts[field])))
            elif counts[field]:
                fields[field] = tuple(value_of(rng, short[code]) for _ in range(counts[field]))
            else:
                fields[field] = value_of(rng, short[code])
        link = ardupilotmega.MAVLink(None, srcSystem=7, srcComponent=9)
        link.seq = 200
        sent = {key: value.encode() if isinstance(value, str) else value for key, value in fields.items()}
        theirs = kind(**sent).pack(link)
        assert read_one(theirs) == ParsedMavlinkFrame(theirs, name, fields, 7, 9, 200)
        ours = write_frame(name, fields, (7, 9), 200)
        assert ours == theirs
        (parsed,) = ardupilotmega.MAVLink(None).parse_buffer(ours)
        assert {field: getattr(parsed, field) for field in codes}.items() >= {
            key: list(value) if isinstance(value, tuple) else value for key, value in fields.items()
        }.items()


def test_mavlink_1_is_read_and_written_as_pymavlink_does_it() -> None:
    fields = {"text": "Arm: Throttle (RC3) is not neutral", "severity": 2}
    frame = write_frame("STATUSTEXT", fields, ROVER, 9, v1=True)
    parsed = ardupilotmega.MAVLink(None).parse_buffer(frame)
    assert [(one.text, one.severity, one.get_seq()) for one in parsed] == [(fields["text"], 2, 9)]
    assert read_one(frame, v1=True).problem == ""
    assert read_one(frame).problem == "MAVLink 1"


GOOD = bytes.fromhex(VECTORS["HEARTBEAT"])


@pytest.mark.parametrize(
    ("data", "problems"),
    [
        (GOOD + GOOD, ["", "sequence number 0 instead of 1"]),
        (GOOD[:-1] + b"\0", ["CRC 00ac instead of 7cac"]),
        (b"\x01\x02" + GOOD, ["bytes outside of a frame", ""]),
        (GOOD[:-1], []),
        (bytes.fromhex("fd01000000010100010000") + bytes(2), ["unknown message id 256"]),
    ],
)
def test_what_is_wrong_with_a_frame_is_told(data: bytes, problems: list[str]) -> None:
    reader = MavlinkReader()
    assert [frame.problem for frame in reader.take(data)] == problems


def framed(head: str, payload: bytes, extra: int) -> bytes:
    body = bytes([len(payload)]) + bytes.fromhex(head) + payload
    return b"\xfd" + body + parser.crc(body + bytes([extra])).to_bytes(2, "little")


def test_a_payload_is_cut_as_mavlink_2_demands_and_no_flag_is_set() -> None:
    assert read_one(framed("0000000101000000", bytes(9), 50)).problem == "payload with trailing zeros"
    assert read_one(framed("0000000101000000", b"", 50)).problem == "no payload: its first byte stays"
    assert read_one(framed("0000000101000000", bytes(9) + b"\1", 50)).problem == "payload of 10 bytes, at most 9"
    assert read_one(framed("0200000101000000", b"\1", 50)).problem == "incompat flags 2, compat flags 0"


def test_reads_do_not_matter_and_noise_never_makes_the_parser_raise() -> None:
    frames = [write_frame("HEARTBEAT", {"type": 10}, ROVER, seq) for seq in range(254, 256)]
    frames += [write_frame("ATTITUDE", {"yaw": 1.0}, ROVER, 0)]
    data = b"".join(frames)
    for size in range(1, len(data)):
        reader = MavlinkReader()
        read = [one for at in range(0, len(data), size) for one in reader.take(data[at : at + size])]
        assert [one.raw for one in read] == frames
        assert not any(one.problem for one in read)
    rng = random.Random(5)
    for _ in range(300):
        assert all(
            one.problem for one in MavlinkReader(v1=True).take(bytes(rng.choices(b"\xfd\xfe\x00\x03\x09", k=60)))
        )


# The gateway as ground station


def test_a_gateway_that_behaves_drives_the_rover_and_is_not_reproached() -> None:
    ground = Ground(quirks=RoverQuirks(foreign=True, lacks=frozenset({132})))
    ground.wait(2.1)
    for number in (148, 242):
        ground.command(512, number)
    for number in (30, 33, 32, 330, 132):
        ground.command(511, number, 200_000)
    ground.send("PARAM_REQUEST_READ", param_id="FS_GCS_ENABLE", param_index=-1, target_system=1, target_component=1)
    ground.rover.arm()
    ground.command(176, 1, 15)
    ground.wait(0.1)
    ground.drive(2.0, 0.5)
    assert ground.rover.x_north == pytest.approx(0.95, abs=0.06)
    assert ground.rover.y_east == pytest.approx(0.0, abs=0.01)
    ground.drive(1.57, 0.0, 1.0)
    assert ground.rover.yaw == pytest.approx(1.5, abs=0.1), "clockwise"
    ground.drive(1.0, -0.5)
    assert ground.rover.y_east == pytest.approx(-0.45, abs=0.1), "backward to the west"
    assert ground.rover.moving
    ground.stop()
    ground.wait(2.0)
    assert (ground.rover.mode, ground.rover.armed, ground.rover.moving) == (4, True, False)
    assert ground.violations == []
    assert {fields["command"] for fields in ground.shown("COMMAND_ACK") if fields["result"] == 4} == {511}
    assert len(ground.shown("ATTITUDE")) == pytest.approx(33, abs=1), "5 Hz"
    assert ground.shown("PARAM_VALUE")[0]["param_id"] == "FS_GCS_ENABLE"
    assert {source for source, _, _ in ground.heard} == {ROVER, (51, 68), (1, 154), (7, 1), (254, 190)}


def test_a_gateway_that_drives_by_stick_is_not_reproached() -> None:
    ground = Ground(GatewayAsStation(drive="manual", arms=True))
    ground.wait(2.1)
    ground.command(176, 1, 0)
    ground.command(400, 1)
    ground.wait(0.1)
    ground.wait(1.0, lambda: ground.stick(-500, 500), 0.1)
    assert ground.rover.x_north < -0.3
    assert ground.rover.turn < -0.4, "backward the steering is reversed"
    ground.stick(0)
    ground.command(176, 1, 4)
    ground.wait(0.5)
    assert not ground.rover.moving
    assert ground.violations == []


def lost_beats(ground: Ground) -> None:
    ground.beats = False
    ground.wait(2.0)


def many_beats(ground: Ground) -> None:
    ground.wait(1.0, lambda: ground.send("HEARTBEAT", type=6, autopilot=8, mavlink_version=3), 0.2)


def dead_vehicle(ground: Ground) -> None:
    ground.rover.heartbeats = False
    ground.wait(5.5)


def drives_on(ground: Ground) -> None:
    ground.stop()
    ground.setpoint(0.5)


def drives_in_hold(ground: Ground) -> None:
    ground.rover.choose(4)
    ground.wait(0.6)
    ground.setpoint(0.5)


def drives_disarmed(ground: Ground) -> None:
    ground.rover.arm(False)
    ground.wait(0.6)
    ground.setpoint(0.5)


def takes_the_mode_back(ground: Ground) -> None:
    ground.rover.choose(0)
    ground.rules.piloted()
    ground.wait(0.6)
    ground.command(176, 1, 15)


def stops_the_pilot(ground: Ground) -> None:
    ground.rover.choose(10)
    ground.rules.piloted()
    ground.wait(0.6)
    ground.stop()


def holds_for_ever(ground: Ground) -> None:
    ground.stop()
    ground.wait(1.5)
    ground.stop()


def falls_silent(ground: Ground) -> None:
    ground.drive(0.2)
    ground.wait(1.0)


def holds_without_zero(ground: Ground) -> None:
    ground.drive(0.2)
    ground.command(176, 1, 4)


def deaf_rover(*params: float, times: int, period_s: float = 0.5) -> Callable[[Ground], None]:
    def act(ground: Ground) -> None:
        ground.rover.quirks = RoverQuirks(deaf=9, hold_at=9)
        if params[0] == 176:
            ground.setpoint(0.0)
        ground.wait(times * period_s, lambda: ground.command(int(params[0]), *params[1:]), period_s)
        ground.wait(1.0)

    return act


WRONG: list[tuple[Callable[[Ground], None], str]] = [
    (lost_beats, "no HEARTBEAT for"),
    (many_beats, "HEARTBEATs in"),
    (dead_vehicle, "after the vehicle's last one"),
    (drives_on, "a setpoint with motion after a stop, before the mode was asked for again"),
    (drives_in_hold, "a setpoint with motion in mode 4"),
    (drives_disarmed, "a setpoint with motion in mode 15, disarmed"),
    (takes_the_mode_back, "mode 15 while somebody else drives, in mode 0"),
    (stops_the_pilot, "HOLD while somebody else drives, in mode 10"),
    (holds_for_ever, "s after HEARTBEAT showed it"),
    (deaf_rover(511, 30, 200_000, times=2), "command 511 (30) without ACK was sent 2 times only"),
    (deaf_rover(511, 30, 200_000, times=5), "command 511 (30) was sent 5 times"),
    (deaf_rover(511, 30, 200_000, times=4, period_s=0.1), "command 511 (30) was sent 4 times within 0.30 s"),
    (deaf_rover(176, 1, 4, times=1), "command 176 (4) without ACK was sent 1 times only"),
    (falls_silent, "neither motion nor a stop for"),
    (holds_without_zero, "HOLD without a zero setpoint or a neutral stick before it"),
    (lambda ground: ground.command(176, 1, 10), "mode 10, neither HOLD nor the mode to drive in"),
    (lambda ground: ground.command(176, 0, 15), "DO_SET_MODE without the custom mode's bit"),
    (lambda ground: ground.command(400, 0), "DISARM"),
    (lambda ground: ground.command(400, 1), "ARM, which is the operator's"),
    (lambda ground: ground.command(400, 1, 2989), "forced arming, 2989"),
    (lambda ground: ground.command(400, 1, 21196), "forced arming, 21196"),
    (lambda ground: ground.command(185, 1), "command 185, which no gateway sends to a vehicle"),
    (lambda ground: ground.command(511, 65, 200_000), "message 65 every 200000 us"),
    (lambda ground: ground.command(511, 30, 20_000), "message 30 every 20000 us"),
    (lambda ground: ground.command(512, 30), "message 30 requested"),
    (lambda ground: ground.command(176, 1, 15, target_system=0), "COMMAND_LONG to 0/1"),
    (lambda ground: ground.command(176, 1, 15, target_system=7), "COMMAND_LONG to 7/1"),
    (lambda ground: ground.setpoint(0.0, target_component=0), "SET_POSITION_TARGET_LOCAL_NED to 1/0"),
    (lambda ground: ground.setpoint(0.1, coordinate_frame=1), "a setpoint in frame 1 with type_mask 0x5c7"),
    (lambda ground: ground.setpoint(0.1, type_mask=0xDC7), "a setpoint in frame 8 with type_mask 0xdc7"),
    (lambda ground: ground.setpoint(float("nan")), "a setpoint of [nan, 0.0, 0.0]"),
    (lambda ground: ground.stick(100), "a stick to a vehicle that is driven by setpoints"),
    (lambda ground: ground.send("PARAM_SET", target_system=1, target_component=1), "PARAM_SET, which no gateway sends"),
    (lambda ground: ground.send("MISSION_REQUEST_LIST"), "MISSION_REQUEST_LIST, which no gateway sends"),
    (lambda ground: ground.send("REQUEST_DATA_STREAM"), "REQUEST_DATA_STREAM, which no gateway sends"),
    (lambda ground: ground.send("PARAM_REQUEST_READ", param_id="SYSID"), "PARAM_REQUEST_READ of 'SYSID'"),
    (lambda ground: ground.send("HEARTBEAT", type=6, autopilot=8, base_mode=128, mavlink_version=3), "armed 128"),
]


@pytest.mark.parametrize(("act", "text"), WRONG, ids=[text for _, text in WRONG])
def test_each_wrong_act_of_a_ground_station_is_a_violation(act: Callable[[Ground], None], text: str) -> None:
    ground = Ground()
    ground.guided()
    assert ground.violations == []
    act(ground)
    assert any(text in violation for violation in ground.violations), ground.violations


BY_STICK: list[tuple[Callable[[Ground], None], str]] = [
    (lambda ground: ground.setpoint(0.0), "a setpoint to a vehicle that is driven by stick"),
    (lambda ground: ground.stick(32767), "a stick of y 0, z 32767"),
    (lambda ground: ground.stick(100), "a stick with motion in mode 4"),
    (lambda ground: ground.command(176, 1, 15), "mode 15, neither HOLD nor the mode to drive in"),
    (lambda ground: ground.send("RC_CHANNELS_OVERRIDE", chan1_raw=900, target_system=1), "an override of 900 and 0"),
]


@pytest.mark.parametrize(("act", "text"), BY_STICK, ids=[text for _, text in BY_STICK])
def test_each_wrong_act_of_a_ground_station_that_drives_by_stick_is_a_violation(
    act: Callable[[Ground], None], text: str
) -> None:
    ground = Ground(GatewayAsStation(drive="manual"))
    ground.wait(2.1)
    assert ground.violations == []
    act(ground)
    assert any(text in violation for violation in ground.violations), ground.violations


def test_nothing_is_sent_before_two_heartbeats_and_only_from_the_configured_ids() -> None:
    ground = Ground()
    ground.wait(0.5)
    ground.command(512, 148)
    assert ground.violations == ["COMMAND_LONG before 2 HEARTBEATs of the vehicle"]
    ground.wait(2.0)
    ground.source = (254, 190)
    ground.command(512, 148)
    assert ground.violations[1:] == ["COMMAND_LONG from 254/190"]


def test_a_stop_is_repeated_until_heartbeat_shows_hold_and_may_take_the_pilot_s_rover_when_it_is_ordered() -> None:
    ground = Ground(quirks=RoverQuirks(hold_at=3))
    ground.guided()
    ground.drive(0.4)
    ground.wait(0.9, ground.stop, 0.3)
    assert (ground.rover.mode, ground.rover.obeyed[176]) == (4, 2)
    ground.rules.piloted()
    ground.rover.choose(10)
    ground.wait(1.0)
    assert ground.rover.moving, "a mission drives by itself"
    ground.rules.expect_stop()
    ground.wait(0.9, ground.stop, 0.3)
    ground.wait(3.5)
    ground.rules.expect_stop()
    ground.stop()
    assert ground.violations == [], "who orders a stop may have it in HOLD too"
    assert not ground.rover.moving


def test_a_rover_that_hears_no_setpoint_stops_after_three_seconds_and_its_failsafe_holds_where_it_is_on() -> None:
    ground = Ground(FS_GCS_ENABLE=1.0)
    ground.guided()
    ground.setpoint(0.5)
    ground.wait(2.9)
    assert ground.rover.moving
    ground.wait(1.0)
    assert not ground.rover.moving
    assert ground.shown("STATUSTEXT")[-1]["text"] == "target not received last 3.0secs, stopping"
    assert ground.rover.mode == 15
    ground.beats = False
    ground.wait(6.6)
    assert ground.rover.mode == 4


def test_a_rover_refuses_arming_with_its_text() -> None:
    ground = Ground(GatewayAsStation(arms=True), RoverQuirks(refuses_arming="Arm: Throttle (RC3) is not neutral"))
    ground.wait(2.1)
    ground.command(400, 1)
    ground.wait(0.1)
    assert ground.shown("COMMAND_ACK")[-1]["result"] == 4
    assert [fields["text"] for fields in ground.shown("STATUSTEXT")] == ["Arm: Throttle (RC3) is not neutral"]
    assert not ground.rover.armed


# The gateway as vehicle


@pytest.mark.parametrize("program", ["mavsdk", "mavproxy", "qgc"])
def test_a_vehicle_that_behaves_is_driven_by_each_program_and_not_reproached(program: Program) -> None:
    vehicle = Vehicle(program, ftp=program == "mavproxy")
    vehicle.wait(6.0)
    sent = Counter(name for _, name, _ in vehicle.heard)
    if program == "mavsdk":
        first = [(at, fields["command"], fields["param1"]) for at, name, fields in vehicle.heard if "LONG" in name]
        assert [one[1:] for one in first] == [(512, 148.0), (512, 242.0), (511, 245.0)]
        assert next(at for at, name, _ in vehicle.heard if name == "HEARTBEAT") == pytest.approx(0.7, abs=0.03)
        assert vehicle.station.healthy
    else:
        assert sent["PARAM_REQUEST_LIST"] == 1
        assert vehicle.station.params.keys() == {"P0", "P1", "P2"}
        assert sent["FILE_TRANSFER_PROTOCOL"] == (program == "mavproxy")
        assert sent["REQUEST_DATA_STREAM"] == {"mavproxy": 1, "qgc": 7}[program]
    mode = 15 if program == "mavsdk" else 0
    vehicle.station.command(176, 1, mode)
    vehicle.station.command(400, 1)
    vehicle.station.motion = (0.5, -0.2)
    vehicle.heard.clear()
    vehicle.wait(1.0)
    moved = [(name, fields) for _, name, fields in vehicle.heard if name[:3] in ("SET", "MAN", "RC_")]
    assert len(moved) == pytest.approx({"mavsdk": 20, "mavproxy": 10, "qgc": 25}[program], abs=1)
    name, fields = moved[0]
    if program == "mavsdk":
        assert (fields["coordinate_frame"], fields["vx"], fields["yaw_rate"]) == (8, 0.5, pytest.approx(0.2))
    elif program == "qgc":
        assert (fields["z"], fields["y"], fields["target"]) == (500, 200, 1)
    else:
        assert (name, fields["chan1_raw"], fields["chan3_raw"]) == ("RC_CHANNELS_OVERRIDE", 1600, 1750)
    assert vehicle.armed
    hold = vehicle.station.command(176, 1, 4)
    vehicle.wait(1.0)
    assert (hold.result, vehicle.station.armed) == (0, False)
    vehicle.held_by = "desk"
    refused = vehicle.station.command(400, 1)
    vehicle.wait(1.5)
    assert refused.result == 1
    assert vehicle.violations == []


def test_programs_repeat_what_is_not_answered_as_they_were_seen_to() -> None:
    vehicle = Vehicle()
    vehicle.deaf = True
    vehicle.wait(3.0)
    commands = Counter((fields["command"], fields["param1"]) for _, name, fields in vehicle.heard if "LONG" in name)
    assert set(commands.values()) == {4}
    assert sum("timeout" in event for event in vehicle.station.events) == 3
    proxy = Vehicle("mavproxy", ftp=True)
    proxy.deaf = True
    proxy.wait(16.0)
    sent = Counter(name for _, name, _ in proxy.heard)
    assert (sent["COMMAND_LONG"], sent["FILE_TRANSFER_PROTOCOL"], sent["PARAM_REQUEST_LIST"]) == (1, 12, 3)


def test_a_station_misses_the_vehicle_after_three_seconds_and_asks_for_all_again() -> None:
    vehicle = Vehicle()
    vehicle.wait(1.5)
    vehicle.rules.away()
    vehicle.beats = False
    vehicle.wait(4.0)
    assert vehicle.station.lost
    vehicle.rules.away(False)
    vehicle.beats = True
    vehicle.heard.clear()
    vehicle.wait(1.0)
    assert sum(name == "COMMAND_LONG" for _, name, _ in vehicle.heard) == 3
    assert not vehicle.station.lost
    assert vehicle.violations == []


def arms(vehicle: Vehicle) -> None:
    vehicle.armed = True
    vehicle.wait(1.1)


def stays_armed(vehicle: Vehicle) -> None:
    vehicle.station.command(176, 1, 15)
    vehicle.station.command(400, 1)
    vehicle.wait(0.5)
    vehicle.rules.others_drive()
    vehicle.wait(2.0)


def answering(result: int, command: int, *params: float, text: bool = True) -> Callable[[Vehicle], None]:
    """Make an act: whatever the command, this is the answer."""

    def act(vehicle: Vehicle) -> None:
        vehicle.result = lambda *_: result  # type: ignore[method-assign]
        vehicle.acknowledge = lambda fields: vehicle.answer(  # type: ignore[method-assign]
            "COMMAND_ACK", command=command, result=result
        )
        if text:
            vehicle.send("STATUSTEXT", severity=4, text="desk drives")
        vehicle.station.command(command, *params)
        vehicle.wait(1.5)

    return act


def deafens(name: str) -> Callable[[Vehicle], None]:
    def act(vehicle: Vehicle) -> None:
        vehicle.deaf = True
        fields = {"target_system": 1, "target_component": 1}
        if name == "COMMAND_LONG":
            vehicle.station.command(410)
        else:
            vehicle.rules.sent(name, fields)
        vehicle.wait(6.0)

    return act


def floods(vehicle: Vehicle) -> None:
    vehicle.unasked_hz = 20.0
    vehicle.wait(3.0)


def silent(vehicle: Vehicle) -> None:
    vehicle.beats = False
    vehicle.wait(2.0)


def away(vehicle: Vehicle) -> None:
    vehicle.rules.away()
    vehicle.wait(6.0)


def other_source(vehicle: Vehicle) -> None:
    vehicle.source = (2, 1)
    vehicle.send("ATTITUDE")


def bad_file(vehicle: Vehicle) -> None:
    vehicle.rules.sent("FILE_TRANSFER_PROTOCOL", {"payload": (7, 0, 5, 4, *[0] * 247)})
    vehicle.refuse_file((7, 0, 0, 4, *[0] * 247))


def asks_missions(vehicle: Vehicle) -> None:
    vehicle.rules.sent("MISSION_REQUEST_LIST", {"mission_type": 1})
    vehicle.answer("MISSION_COUNT", count=2, mission_type=1)


def tells(*parameters: dict[str, Any]) -> Callable[[Vehicle], None]:
    def act(vehicle: Vehicle) -> None:
        vehicle.rules.sent("PARAM_REQUEST_LIST", {})
        for index, fields in enumerate(parameters):
            vehicle.tell_parameter(index, **fields)

    return act


BAD: list[tuple[Callable[[Vehicle], None], str]] = [
    (silent, "no HEARTBEAT for"),
    (away, "HEARTBEAT of a robot that is away"),
    (other_source, "ATTITUDE from 2/1, not from 1/1"),
    (floods, "ATTITUDE in 2"),
    (arms, "armed, though this client has not armed or is not the holder"),
    (stays_armed, "armed, though this client has not armed or is not the holder"),
    (stays_armed, "mode 15, which this client has not asked for or not been given"),
    (answering(0, 512, 435), "ACCEPTED for message 435, which never comes: it hangs QGC"),
    (answering(0, 512, 148), "no AUTOPILOT_VERSION within 1 s"),
    (answering(0, 32100), "result 0 of command 32100, which is unknown"),
    (answering(1, 176, 1, 4), "result 1 of a stop, 176 (1, 4)"),
    (answering(1, 400, 0), "result 1 of a stop, 400 (0, 0)"),
    (answering(1, 185, 1), "result 1 of a stop, 185 (1, 0)"),
    (answering(0, 176, 1, 10), "result 0 of mode 10"),
    (answering(1, 400, 1, text=False), "a refusal without STATUSTEXT"),
    (deafens("COMMAND_LONG"), "no ACK of command 410 (0, 0)"),
    (deafens("MISSION_REQUEST_LIST"), "no MISSION_COUNT within 1 s"),
    (deafens("PARAM_REQUEST_LIST"), "0 of 0 parameters"),
    (bad_file, "FTP sequence, session, opcode, size, request, error (8, 0, 129, 1, 4, 10) instead of (8, 5,"),
    (asks_missions, "2 mission items of type 1"),
    (tells({"param_type": 6}), "parameter 'P0' of type 6"),
    (tells({}, {"param_count": 4}), "parameter 'P1': index 1 of 4, 3 before"),
    (tells({}, {"param_index": 3}), "parameter 'P1': index 3 of 3, 3 before"),
    (tells({}, {"param_index": 0}), "parameter 0 is 'P1' 0, ('P0', 0.0) before"),
    (lambda vehicle: vehicle.tell_parameter(0), "PARAM_VALUE that was not asked for"),
    (lambda vehicle: vehicle.send("OBSTACLE_DISTANCE"), "OBSTACLE_DISTANCE that was not asked for"),
    (lambda vehicle: vehicle.send("HOME_POSITION"), "HOME_POSITION that was not asked for"),
    (
        lambda vehicle: vehicle.answer("COMMAND_ACK", command=512),
        "an ACK of command 512, which has one or was not sent",
    ),
    (lambda vehicle: vehicle.send("COMMAND_ACK", command=511, target_system=9), "COMMAND_ACK to 9/0, who did not ask"),
    (lambda vehicle: vehicle.send("STATUSTEXT", severity=2, text="no"), "STATUSTEXT of severity 2, 'no'"),
    (lambda vehicle: vehicle.send("STATUSTEXT", severity=4), "STATUSTEXT of severity 4, ''"),
    (lambda vehicle: vehicle.send("HEARTBEAT", type=2, autopilot=12), "HEARTBEAT of type 2, autopilot 12"),
]


@pytest.mark.parametrize(("act", "text"), BAD, ids=[text for _, text in BAD])
def test_each_wrong_act_of_a_vehicle_is_a_violation(act: Callable[[Vehicle], None], text: str) -> None:
    vehicle = Vehicle()
    vehicle.wait(1.5)
    assert vehicle.violations == []
    act(vehicle)
    assert any(text in violation for violation in vehicle.violations), vehicle.violations


def test_the_first_frame_is_a_heartbeat_of_an_autopilot() -> None:
    vehicle = Vehicle()
    vehicle.source = (255, 2)
    vehicle.send("ATTITUDE")
    assert vehicle.violations == ["the first frame is ATTITUDE, not HEARTBEAT", "a vehicle 255/2"]


# Sockets


async def test_a_fragile_rover_cuts_its_frames_sends_garbage_and_serves_again_after_a_cut() -> None:
    port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    rover = FragileRover(quirks=RoverQuirks(garbage=True, cuts=True, foreign=True))
    serving = asyncio.create_task(rover.serve("127.0.0.1", 0, port.set_result))
    reader, writer = await asyncio.open_connection("127.0.0.1", await port)
    heard = b""
    while not (re.search(rb"\xfd\x09\0\0.\x01\x01\0\0\0", heard, re.DOTALL) and b"\xfd\xff\0" in heard):
        heard += await reader.read(4096)
    writer.write(write_frame("COMMAND_LONG", {"command": 400, "target_system": 7}, STATION, 0))
    writer.write(write_frame("HEARTBEAT", {"type": 6, "autopilot": 8, "mavlink_version": 3}, STATION, 9)[:-3])
    await until(lambda: len(rover.received) > 0)
    writer.close()
    await until(lambda: "at rest" in "".join(rover.events))
    first, *_, last = rover.violations
    assert first == "COMMAND_LONG to 7/0"
    assert last.startswith("the connection ended within a frame")
    reader, writer = await asyncio.open_connection("127.0.0.1", await port)
    assert await reader.read(1)
    rover.cut()
    with pytest.raises(ConnectionResetError):
        await reader.read(-1)
    writer.close()
    serving.cancel()
    await asyncio.wait([serving])


async def test_a_fragile_station_drives_a_vehicle_by_tcp() -> None:
    station, stations = FragileStation("mavsdk"), list[bytes]()
    vehicle = Vehicle()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        seq = 0
        frames = MavlinkReader()

        def send(name: str, **fields: Any) -> None:
            nonlocal seq
            writer.write(write_frame(name, fields, ROVER, seq))
            seq += 1

        vehicle.send = send  # type: ignore[method-assign]
        vehicle.beat()
        while data := await reader.read(4096):
            stations.append(data)
            for frame in frames.take(data):
                assert frame.problem == ""
                vehicle.obey(frame.name, frame.fields)
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    running = asyncio.create_task(station.run("127.0.0.1", server.sockets[0].getsockname()[1]))
    await until(lambda: station.agreed != "")
    assert await station.set_mode(15) == 0
    assert await station.arm() == 0
    station.drive(0.5)
    await until(lambda: any(b"\x00\x00\x00\x3f" in data for data in stations))
    assert (station.armed, station.mode) == (True, 15)
    assert await station.hold() == 0
    assert station.results == [(176, 0), (400, 0), (176, 0)]
    assert (station.violations, station.events) == ([], ["connected"])
    running.cancel()
    await asyncio.wait([running])
    server.close()
