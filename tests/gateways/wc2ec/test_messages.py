"""The messages and their framing in both dialects. Bytes are written by hand from the protocol page."""

import math
import struct

import pytest

from gateways.wc2ec.messages import (
    MESSAGES,
    ChangeSensor,
    Dialect,
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
from tests.conformance.side import plain
from tests.gateways.wc2ec.golden import DEPLOYED, DRAFT, EC, VALUES, WC
from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import FrameBuffer

HALVES = {(DEPLOYED, WC): {0, 1, 127}, (DEPLOYED, EC): {130}, (DRAFT, WC): {0}, (DRAFT, EC): {128, 129, 130, 131}}
"""The commands each side sends, by the page."""


def buffer(dialect: Dialect, sender: Sender) -> FrameBuffer:
    return FrameBuffer(frame_end(dialect, sender, values=VALUES), 4096)


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
def test_every_command_that_is_not_of_this_side_breaks_the_stream_and_is_quoted(dialect, sender) -> None:
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
