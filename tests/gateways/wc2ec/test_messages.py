"""What the golden tables do not show of the messages and their framing. Bytes are by hand from the protocol page."""

import struct

import pytest

from gateways.wc2ec.messages import Error, RegisterSensor, SensorData, SetSensor, SetValue, frame_end, read, write
from tests.conformance.side import plain
from tests.gateways.wc2ec.golden import DEPLOYED, DRAFT, EC, VALUES, WC
from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import FrameBuffer

HALVES = {(DEPLOYED, WC): {0, 1, 127}, (DEPLOYED, EC): {130}, (DRAFT, WC): {0}, (DRAFT, EC): {128, 129, 130, 131}}
"""The commands each side sends, by the page."""


@pytest.mark.parametrize(
    ("dialect", "message"),
    [
        (DEPLOYED, RegisterSensor(53, 0, b"n" * 256)),
        (DEPLOYED, SetValue(53, 256, 1.0)),
        (DEPLOYED, SensorData(-1, 0, 1.0)),
        (DRAFT, SetValue(0, 0, 1.0)),
        (DRAFT, Error(0, 0)),
    ],
    ids=repr,
)
def test_what_has_no_form_or_is_of_the_other_dialect_is_never_written(dialect, message) -> None:
    with pytest.raises((EncodeError, KeyError)):
        write(message, dialect)


@pytest.mark.parametrize(("values", "size"), [(0, 3), (1, 11), (3, 27), (255, 2043)])
def test_the_number_of_configuration_values_gives_the_length_of_set_sensor(values: int, size: int) -> None:
    data = b"\x83\x00\x01" + struct.pack(f"<{values}d", *range(values))
    assert frame_end(DRAFT, EC, values=values)(data, 0) == size == len(data)
    assert plain(read(data, DRAFT)) == [SetSensor, 0, 1, [float(value) for value in range(values)]]


@pytest.mark.parametrize(("dialect", "sender"), HALVES)
def test_every_command_that_is_not_of_this_side_breaks_the_stream_and_is_quoted_shortened(dialect, sender) -> None:
    for command in sorted(set(range(256)) - HALVES[dialect, sender]):
        data = bytes((command, 0x25, 0x0B, 0xAB, 0xCD))
        with pytest.raises(ProtocolError) as caught:
            list(FrameBuffer(frame_end(dialect, sender, values=VALUES), 4096).feed(data + b"\xee" * 3000))
        reason = str(caught.value)
        assert f"command {command}" in reason
        assert data.hex(" ") in reason
        assert len(reason) < 300
        assert ("half" in reason) == ((command < 128) is not (sender is WC))
