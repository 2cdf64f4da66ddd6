"""The five messages in both dialects, by hand from "Versions and dialects" of the protocol page."""

from typing import Any

import numpy as np

from gateways.alf.messages import (
    AlfDialect,
    AlfMessage,
    DriveCommand,
    DriveInfo,
    End,
    Measurement,
    ScannerInit,
    read_binary,
    read_text,
    write_binary,
    write_text,
)
from gateways.alf.session import AlfHqRole, AlfSession, VehicleRole
from tests.conformance.side import Receive, Side, plain

TEXT, BINARY = AlfDialect.TEXT, AlfDialect.BINARY
OF_VEHICLE, OF_HQ = frozenset({1, 2, 4, 255}), frozenset({3, 255})
ALL = OF_VEHICLE | OF_HQ

INIT = {
    TEXT: b"2|-135.000000|119.882812|0.351562|100|20|5600;",
    BINARY: bytes.fromhex("02 000007c3 00c4ef42 0000b43e 64000000 14000000 e0150000"),
}
"""In binary 119.8828125 and 0.3515625 degrees."""
NEUTRAL = {TEXT: b"3|0|0|0|0;", BINARY: bytes.fromhex("03 00 00 5a 00")}
DRIVE = {TEXT: b"3|80|0|30|1;", BINARY: bytes.fromhex("03 50 00 78 01")}
INFO = {
    TEXT: b"4|10|0.250000|-0.500000|0.987654|1.500000|-2.750000|123.456001|36.529999;",
    BINARY: bytes.fromhex("04 0a fa00 0cfe e803 0f00 e5ff d204 00001242"),
}
END = {TEXT: b"255|1;", BINARY: bytes.fromhex("ff 01")}

STANDS = {TEXT: DriveCommand(0, 0, 0, False), BINARY: DriveCommand(0, 0, 90, False)}
DRIVES = {TEXT: DriveCommand(80, 0, 30, True), BINARY: DriveCommand(80, 0, 120, True)}
MOVES = {
    TEXT: DriveInfo(10, 0.25, -0.5, 0.987654, 1.5, -2.75, 123.456001, 36.529999),
    BINARY: DriveInfo(10, 250, -500, 1000, 15, -27, 1234, 36.5),
}
GOLDEN: dict[AlfDialect, list[tuple[AlfMessage, bytes]]] = {
    TEXT: [
        (Measurement(7, 5000, np.array([1000, 0, 2147483647]), 1, 2), b"1|7|5000|1000|0|2147483647|1|2;"),
        (ScannerInit(-135.0, 119.882812, 0.351562, 100, 20, 5600), INIT[TEXT]),
        (DRIVES[TEXT], DRIVE[TEXT]),
        (DriveCommand(255, 1, -90, False), b"3|255|1|-90|0;"),
        (MOVES[TEXT], INFO[TEXT]),
        (End(), END[TEXT]),
    ],
    BINARY: [
        (
            Measurement(7, 5000, np.array([1000, 0, -3]), 1, 2),
            bytes.fromhex("01 07000000 88130000 e803000000000000 0000000000000000 fdffffffffffffff 01000000 02000000"),
        ),
        (ScannerInit(-135.0, 119.8828125, 0.3515625, 100, 20, 5600), INIT[BINARY]),
        (DRIVES[BINARY], DRIVE[BINARY]),
        (DriveCommand(255, 1, 0, False), bytes.fromhex("03 ff 01 00 00")),
        (MOVES[BINARY], INFO[BINARY]),
        (End(), END[BINARY]),
    ],
}


def session(kind: type[AlfSession], dialect: AlfDialect, *, points: int = 3, **options: Any) -> Any:
    made = kind(dialect, points=points, **options)
    made.open(0.0)
    return made


def heard(by: AlfSession, *reads: bytes) -> list[list[Any]]:
    return [plain(message) for read in reads for message in by.receive(read, 0.0)]


def _side(kind: type[AlfSession], dialect: AlfDialect) -> Side:
    """What ``kind`` is sent."""
    sender, ids = ("vehicle", OF_VEHICLE) if kind is AlfHqRole else ("hq", OF_HQ)
    read, write = (read_text, write_text) if dialect is TEXT else (read_binary, write_binary)

    def receiver() -> Receive:
        by = session(kind, dialect)
        return lambda data: list(by.receive(data, 0.0))

    return Side(
        f"alf-{dialect.value}-{sender}",
        [(message, frame) for message, frame in GOLDEN[dialect] if message.spec.id in ids],
        lambda frame: read(frame, ids),
        write,
        receiver,
        {Measurement, ScannerInit, DriveInfo, End} if kind is AlfHqRole else {DriveCommand, End},
        # a binary measurement of another number of points: the session knows how many there must be
        lambda _, frame: dialect is BINARY and frame[0] == 1 and len(frame) >= 17 and (len(frame) - 17) % 8 == 0,
        ends=(End(),),
    )


SIDES = [_side(kind, dialect) for dialect in AlfDialect for kind in (AlfHqRole, VehicleRole)]
