"""The messages and their framing in both dialects. Bytes are written by hand from the protocol page."""

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


def test_a_message_is_what_the_dialect_says_it_is() -> None:
    assert plain(read(bytes.fromhex("82 00 02 ff 000000000000d03f"), DRAFT)) == [ChangeSensor, 0, 2, 255, 0.25]
    assert plain(read(bytes.fromhex("82 00 02 000000000000d03f"), DEPLOYED)) == [SetValue, 0, 2, 0.25]


@pytest.mark.parametrize(
    ("dialect", "message"),
    [
        (DEPLOYED, RegisterSensor(53, 0, b"n" * 256)),
        (DEPLOYED, RegisterSensor(256, 0, b"n")),
        (DEPLOYED, RegisterSensor(53, -1, b"n")),
        (DEPLOYED, SetValue(53, 256, 1.0)),
        (DEPLOYED, SensorData(-1, 0, 1.0)),
        (DRAFT, RegisterSensor(0, 0, b"n")),
        (DRAFT, SetValue(0, 0, 1.0)),
        (DRAFT, Error(0, 0)),
    ],
)
def test_what_has_no_form_or_is_of_the_other_dialect_is_never_written(dialect: Dialect, message: Wc2EcMessage) -> None:
    with pytest.raises((EncodeError, KeyError)):
        write(message, dialect)


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
def test_every_command_that_is_not_of_this_side_breaks_the_stream_and_is_quoted_shortened(dialect, sender) -> None:
    for command in sorted(set(range(256)) - HALVES[dialect, sender]):
        data = bytes((command, 0x25, 0x0B, 0xAB, 0xCD))
        with pytest.raises(ProtocolError) as caught:
            list(buffer(dialect, sender).feed(data + b"\xee" * 3000))
        assert f"command {command}" in str(caught.value)
        assert data.hex(" ") in str(caught.value)
        assert len(str(caught.value)) < 300
        wrong_half = (command < 128) is not (sender is WC)
        assert ("half" in str(caught.value)) == wrong_half
