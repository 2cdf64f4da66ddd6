"""The messages of both dialects, by hand from the tables of the protocol page."""

import math
import struct
from typing import Any

import numpy as np

from gateways.wc2ec.messages import (
    ChangeSensor,
    DisableSensor,
    EnableSensor,
    Error,
    RegisterSensor,
    SensorData,
    SetSensor,
    SetValue,
    Wc2EcDialect,
    frame_end,
    read,
    write,
)
from tests.conformance.side import Side, framed
from zbridge.protocol.session import Role

DRAFT, DEPLOYED = Wc2EcDialect.DRAFT, Wc2EcDialect.DEPLOYED
WC, EC = Role.ROBOT, Role.HQ
VALUES = 3
"""Configuration values of a sensor: a setting."""
LONG = bytes(range(1, 256))
"""A name of 255 bytes that is not UTF-8."""

GOLDEN: dict[tuple[Wc2EcDialect, Role], list[tuple[Any, bytes]]] = {
    (DEPLOYED, WC): [
        (RegisterSensor(53, 0, b"wheel1"), bytes.fromhex("00 35 00 06 77 68 65 65 6c 31")),
        (RegisterSensor(255, 254, b""), bytes.fromhex("00 ff fe 00")),
        (RegisterSensor(37, 6, LONG), bytes.fromhex("00 25 06 ff") + LONG),
        (RegisterSensor(37, 1, b"a/*#@%"), bytes.fromhex("00 25 01 06 61 2f 2a 23 40 25")),
        (RegisterSensor(37, 2, b"\xff\x00\xc3"), bytes.fromhex("00 25 02 03 ff 00 c3")),
        (RegisterSensor(37, 3, "größe".encode()), bytes.fromhex("00 25 03 07 67 72 c3b6 c39f 65")),
        (SensorData(37, 7, 750.5), bytes.fromhex("01 25 07 0000000000748740")),
        (SensorData(38, 0, -1.0), bytes.fromhex("01 26 00 000000000000f0bf")),
        (SensorData(37, 0, math.inf), bytes.fromhex("01 25 00 000000000000f07f")),
        (Error(37, 9), bytes.fromhex("7f 25 09")),
    ],
    (DEPLOYED, EC): [
        (SetValue(53, 1, 1.5), bytes.fromhex("82 35 01 000000000000f83f")),
        (SetValue(46, 4, -2.0), bytes.fromhex("82 2e 04 00000000000000c0")),
    ],
    (DRAFT, WC): [(SensorData(0, 3, 0.25), bytes.fromhex("00 00 03 000000000000d03f"))],
    (DRAFT, EC): [
        (EnableSensor(0, 3), bytes.fromhex("80 00 03")),
        (DisableSensor(0, 255), bytes.fromhex("81 00 ff")),
        (ChangeSensor(0, 2, 255, 0.25), bytes.fromhex("82 00 02 ff 000000000000d03f")),
        (
            SetSensor(0, 1, np.array([1.5, -2.0, 0.25])),
            bytes.fromhex("83 00 01 000000000000f83f 00000000000000c0 000000000000d03f"),
        ),
    ],
}


def _side(dialect: Wc2EcDialect, sender: Role) -> Side:
    golden = GOLDEN[dialect, sender]
    end = frame_end(dialect, sender, values=VALUES)

    def of_dialect(frame: bytes) -> Any:
        end(frame, 0)  # the framing checks the command
        return read(frame, dialect)

    return Side(
        f"wc2ec-{dialect.value}-{'wc' if sender is WC else 'ec'}",
        golden,
        of_dialect,
        lambda message: write(message, dialect),
        framed(end, 4096, of_dialect),
        {type(message) for message, _ in golden},
        # settings of another number of values: the framing knows how many there must be
        lambda message, frame: isinstance(message, SetSensor) and len(frame) >= 3 and (len(frame) - 3) % 8 == 0,
    )


SIDES = [_side(*side) for side in GOLDEN]

DISTANCE, LINEAR, ROTATIONAL = 37, 46, 53


def registration(kind: int, number: int, name: bytes) -> bytes:
    return bytes((0, kind, number, len(name))) + name


def data(number: int, value: float, kind: int = DISTANCE, command: int = 1) -> bytes:
    return struct.pack("<BBBd", command, kind, number, value)


def light(number: int, value: float) -> bytes:
    return data(number, value, 0, 0)
