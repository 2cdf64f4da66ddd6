"""The judges of MAVLink before small peers written by hand; their parser before pymavlink."""

from __future__ import annotations

import random
import struct
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from gateways.mavlink.conformance import parser
from gateways.mavlink.conformance.parser import MavlinkReader, ParsedMavlinkFrame, write_frame

ROVER, STATION = (1, 1), (255, 190)
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
