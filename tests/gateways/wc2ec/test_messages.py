"""The messages and their framing in both dialects. Bytes are written by hand from the protocol page."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from gateways.wc2ec.messages import (
    MESSAGES,
    ChangeSensor,
    Dialect,
    DisableSensor,
    EnableSensor,
    Error,
    RegisterSensor,
    Sender,
    SensorData,
    SetSensor,
    SetValue,
    Wc2EcMessage,
    frame_end,
    read,
    write,
)
from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import FrameBuffer

DRAFT, DEPLOYED = Dialect.DRAFT, Dialect.DEPLOYED
WC, EC = Sender.WC, Sender.EC
VALUES = 3
LONG = bytes(range(1, 256))
"""A name of 255 bytes that is not UTF-8."""

GOLDEN: list[tuple[Dialect, Sender, Wc2EcMessage, bytes]] = [
    (DEPLOYED, WC, RegisterSensor(53, 0, b"wheel1"), bytes.fromhex("00 35 00 06 77 68 65 65 6c 31")),
    (DEPLOYED, WC, RegisterSensor(255, 254, b""), bytes.fromhex("00 ff fe 00")),
    (DEPLOYED, WC, RegisterSensor(37, 6, LONG), bytes.fromhex("00 25 06 ff") + LONG),
    (DEPLOYED, WC, RegisterSensor(37, 1, b"a/*#@%"), bytes.fromhex("00 25 01 06 61 2f 2a 23 40 25")),
    (DEPLOYED, WC, RegisterSensor(37, 2, b"\xff\x00\xc3"), bytes.fromhex("00 25 02 03 ff 00 c3")),
    (DEPLOYED, WC, RegisterSensor(37, 3, "größe".encode()), bytes.fromhex("00 25 03 07 67 72 c3b6 c39f 65")),
    (DEPLOYED, WC, SensorData(37, 7, 750.5), bytes.fromhex("01 25 07 0000000000748740")),
    (DEPLOYED, WC, SensorData(38, 0, -1.0), bytes.fromhex("01 26 00 000000000000f0bf")),
    (DEPLOYED, WC, SensorData(37, 0, math.inf), bytes.fromhex("01 25 00 000000000000f07f")),
    (DEPLOYED, WC, Error(37, 9), bytes.fromhex("7f 25 09")),
    (DEPLOYED, EC, SetValue(53, 1, 1.5), bytes.fromhex("82 35 01 000000000000f83f")),
    (DEPLOYED, EC, SetValue(46, 4, -2.0), bytes.fromhex("82 2e 04 00000000000000c0")),
    (DRAFT, WC, SensorData(0, 3, 0.25), bytes.fromhex("00 00 03 000000000000d03f")),
    (DRAFT, EC, EnableSensor(0, 3), bytes.fromhex("80 00 03")),
    (DRAFT, EC, DisableSensor(0, 255), bytes.fromhex("81 00 ff")),
    (DRAFT, EC, ChangeSensor(0, 2, 255, 0.25), bytes.fromhex("82 00 02 ff 000000000000d03f")),
    (
        DRAFT,
        EC,
        SetSensor(0, 1, np.array([1.5, -2.0, 0.25])),
        bytes.fromhex("83 00 01 000000000000f83f 00000000000000c0 000000000000d03f"),
    ),
]
HALVES = {(DEPLOYED, WC): {0, 1, 127}, (DEPLOYED, EC): {130}, (DRAFT, WC): {0}, (DRAFT, EC): {128, 129, 130, 131}}
"""The commands each side sends, by the page."""


def plain(message: Wc2EcMessage) -> list[Any]:
    """A message for comparing: its class and its values, an array as a list."""
    values = (getattr(message, name) for name in message.__struct_fields__)
    return [type(message), *(value.tolist() if isinstance(value, np.ndarray) else value for value in values)]


def buffer(dialect: Dialect, sender: Sender) -> FrameBuffer:
    return FrameBuffer(frame_end(dialect, sender, values=VALUES), 4096)


def joined(dialect: Dialect, sender: Sender) -> tuple[bytes, list[bytes]]:
    """Every golden message of one side behind each other, and each of them."""
    frames = [golden for of, by, _, golden in GOLDEN if (of, by) == (dialect, sender)]
    return b"".join(frames), frames


# The tables


def test_the_tables_are_those_of_the_page() -> None:
    assert {(spec.command, spec.name, spec.sender.name) for spec in MESSAGES[DRAFT].values()} == {
        (0, "sensorData", "WC"),
        (128, "enableSensor", "EC"),
        (129, "disableSensor", "EC"),
        (130, "changeSensor", "EC"),
        (131, "setSensor", "EC"),
    }
    assert {(spec.command, spec.name, spec.sender.name) for spec in MESSAGES[DEPLOYED].values()} == {
        (0, "registerSensor", "WC"),
        (1, "sensorData", "WC"),
        (127, "error", "WC"),
        (130, "setValue", "EC"),
    }


@pytest.mark.parametrize(("dialect", "sender", "message", "golden"), GOLDEN)
def test_a_message_and_its_bytes_are_made_from_each_other(
    dialect: Dialect, sender: Sender, message: Wc2EcMessage, golden: bytes
) -> None:
    assert write(message, dialect) == golden
    assert plain(read(golden, dialect)) == plain(message)
    assert frame_end(dialect, sender, values=VALUES)(golden, 0) == len(golden)


def test_a_value_that_is_not_a_number_stays_what_it_is() -> None:
    message = read(bytes.fromhex("01 25 00 000000000000f87f"), DEPLOYED)
    assert isinstance(message, SensorData)
    assert math.isnan(message.value)


def test_a_message_is_what_the_dialect_says_it_is() -> None:
    change = bytes.fromhex("82 00 02 ff 000000000000d03f")
    assert plain(read(change, DRAFT)) == [ChangeSensor, 0, 2, 255, 0.25]
    value = bytes.fromhex("82 00 02 000000000000d03f")
    assert plain(read(value, DEPLOYED)) == [SetValue, 0, 2, 0.25]


@pytest.mark.parametrize(
    "message",
    [
        RegisterSensor(53, 0, b"n" * 256),
        RegisterSensor(256, 0, b"n"),
        RegisterSensor(53, -1, b"n"),
        SetValue(53, 256, 1.0),
        SensorData(-1, 0, 1.0),
    ],
)
def test_what_has_no_form_is_an_encode_error(message: Wc2EcMessage) -> None:
    with pytest.raises(EncodeError):
        write(message, DEPLOYED)


@pytest.mark.parametrize("message", [RegisterSensor(0, 0, b"n"), SetValue(0, 0, 1.0), Error(0, 0)])
def test_a_message_of_the_other_dialect_is_never_written(message: Wc2EcMessage) -> None:
    with pytest.raises((EncodeError, KeyError)):
        write(message, DRAFT)


# Framing


@pytest.mark.parametrize(("dialect", "sender"), HALVES)
def test_a_stream_is_cut_the_same_whatever_arrives_together(dialect: Dialect, sender: Sender) -> None:
    stream, frames = joined(dialect, sender)
    assert list(buffer(dialect, sender).feed(stream)) == frames
    for cut in range(len(stream) + 1):
        split = buffer(dialect, sender)
        assert [*split.feed(stream[:cut]), *split.feed(stream[cut:])] == frames


@pytest.mark.parametrize(("dialect", "sender"), HALVES)
def test_a_stream_is_cut_the_same_byte_by_byte(dialect: Dialect, sender: Sender) -> None:
    stream, frames = joined(dialect, sender)
    single = buffer(dialect, sender)
    assert [frame for byte in stream for frame in single.feed(bytes((byte,)))] == frames
    assert len(single) == 0


def test_a_command_comes_in_pieces_of_1_1_1_and_8_bytes() -> None:
    frames = buffer(DEPLOYED, EC)
    pieces = [bytes.fromhex(piece) for piece in ("82", "35", "01", "000000000000f83f")]
    assert [list(frames.feed(piece)) for piece in pieces] == [[], [], [], [b"".join(pieces)]]


@pytest.mark.parametrize(("dialect", "sender", "message", "golden"), GOLDEN)
def test_the_part_of_a_message_is_none_whatever_its_length(
    dialect: Dialect, sender: Sender, message: Wc2EcMessage, golden: bytes
) -> None:
    for size in range(len(golden)):
        part = buffer(dialect, sender)
        assert list(part.feed(golden[:size])) == []
        assert len(part) == size


@pytest.mark.parametrize(("values", "size"), [(0, 3), (1, 11), (3, 27), (255, 2043)])
def test_the_number_of_configuration_values_gives_the_length_of_set_sensor(values: int, size: int) -> None:
    data = b"\x83\x00\x01" + struct.pack(f"<{values}d", *range(values))
    assert frame_end(DRAFT, EC, values=values)(data, 0) == size == len(data)
    assert plain(read(data, DRAFT)) == [SetSensor, 0, 1, [float(value) for value in range(values)]]


@pytest.mark.parametrize("kind", [0, 37, 38, 46, 53, 99, 255])
def test_nothing_is_refused_for_its_type_alone(kind: int) -> None:
    for data in (bytes((1, kind, 5)) + bytes(8), bytes((0, kind, 5, 2)) + b"ab"):
        assert list(buffer(DEPLOYED, WC).feed(data)) == [data]


# The range check


@pytest.mark.parametrize(("dialect", "sender"), HALVES)
def test_every_command_that_is_not_of_this_side_breaks_the_stream_and_is_quoted(
    dialect: Dialect, sender: Sender
) -> None:
    for command in sorted(set(range(256)) - HALVES[dialect, sender]):
        data = bytes((command, 0x25, 0x0B, 0xAB, 0xCD))
        with pytest.raises(ProtocolError) as caught:
            list(buffer(dialect, sender).feed(data))
        assert f"command {command}" in str(caught.value)
        assert data.hex(" ") in str(caught.value)
        assert len(str(caught.value)) < 300
        wrong_half = (command < 128) is not (sender is WC)
        assert ("half" in str(caught.value)) == wrong_half


def test_a_broken_stream_is_quoted_shortened() -> None:
    with pytest.raises(ProtocolError) as caught:
        list(buffer(DEPLOYED, WC).feed(b"\x05" + b"\xee" * 3000))
    assert "05 ee ee ee" in str(caught.value)
    assert len(str(caught.value)) < 300


def test_the_messages_before_a_broken_one_are_given_first() -> None:
    good = bytes.fromhex("01 25 07 0000000000748740")
    frames = buffer(DEPLOYED, WC)
    got: list[bytes] = []
    with pytest.raises(ProtocolError, match="command 130"):
        got.extend(frames.feed(good + bytes.fromhex("82 35 01 000000000000f83f")))
    # a generator that raises within extend keeps what it gave
    assert got == [good]


# Random bytes


def everything(dialect: Dialect, sender: Sender, pieces: list[bytes]) -> tuple[list[Wc2EcMessage], str]:
    """Every message of a stream, and how it broke."""
    frames = buffer(dialect, sender)
    messages: list[Wc2EcMessage] = []
    try:
        for piece in pieces:
            for frame in frames.feed(piece):
                messages.append(read(frame, dialect))  # noqa: PERF401 - kept when it breaks
    except ProtocolError as error:
        return messages, str(error)
    return messages, ""


@given(st.sampled_from(list(HALVES)), st.lists(st.binary(max_size=60), max_size=8))
@example((DEPLOYED, WC), [b"\x00\x00\x00\xff" + b"\xff" * 255])
@example((DRAFT, EC), [b"\x83\x00\x00" + b"\xff" * 24])
def test_random_bytes_give_messages_or_a_protocol_error(side: tuple[Dialect, Sender], pieces: list[bytes]) -> None:
    dialect, sender = side
    messages, broke = everything(dialect, sender, pieces)
    whole, broke_whole = everything(dialect, sender, [b"".join(pieces)])
    assert [repr(plain(message)) for message in messages] == [repr(plain(message)) for message in whole]
    assert bool(broke) == bool(broke_whole)
    written = b"".join(write(message, dialect) for message in messages)
    if "nan" not in repr(messages):
        assert b"".join(pieces).startswith(written)


@given(st.binary(max_size=255), st.integers(0, 255), st.integers(0, 255))
def test_any_name_survives(name: bytes, kind: int, number: int) -> None:
    message = RegisterSensor(kind, number, name)
    assert read(write(message, DEPLOYED), DEPLOYED) == message


@given(st.floats(allow_nan=False), st.integers(0, 255), st.integers(0, 255))
def test_any_value_survives_bit_for_bit(value: float, kind: int, number: int) -> None:
    for message in (SensorData(kind, number, value), SetValue(kind, number, value)):
        data = write(message, DEPLOYED)
        assert data[3:] == struct.pack("<d", value)
        assert read(data, DEPLOYED) == message
