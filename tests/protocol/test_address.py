"""Addresses as configurations write them."""

import pytest

from zbridge.errors import LinkError
from zbridge.protocol.address import Address, DeviceAddress, SerialAddress, parse_device_address


@pytest.mark.parametrize(
    ("text", "host", "port", "shown"),
    [
        ("tcp://127.0.0.1:11001", "127.0.0.1", 11001, "tcp://127.0.0.1:11001"),
        ("tcp://robot.test:1", "robot.test", 1, "tcp://robot.test:1"),
        ("tcp://[::1]:7447", "::1", 7447, "tcp://[::1]:7447"),
    ],
)
def test_an_address_is_read_and_written(text: str, host: str, port: int, shown: str) -> None:
    address = Address.parse(text)
    assert address == Address(host, port)
    assert str(address) == shown


@pytest.mark.parametrize(
    "text",
    [
        "",
        "robot",
        "127.0.0.1:11001",
        "udp://a:1",
        "tcp://a",
        "tcp://:1",
        "tcp://a:x",
        "tcp://a:65536",
        "tcp://a:1/b",
        "tcp://[a:1",
        "tcp://a:1?b",
    ],
)
def test_what_is_no_address_is_an_error_that_says_what_was_expected(text: str) -> None:
    with pytest.raises(LinkError, match="expected tcp://host:port") as caught:
        Address.parse(text)
    assert repr(text) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("tcp://robot.test:1", Address("robot.test", 1)),
        ("serial:///dev/ttyUSB0?baud=57600", SerialAddress("/dev/ttyUSB0", 57600)),
        (
            "serial:///dev/serial/by-id/usb-FTDI_%3F%20x-if00?baud=9600",
            SerialAddress("/dev/serial/by-id/usb-FTDI_? x-if00", 9600),
        ),
    ],
)
def test_a_robots_address_is_a_port_or_a_serial_line(text: str, address: DeviceAddress) -> None:
    assert parse_device_address(text) == address
    assert str(address) == text


@pytest.mark.parametrize(
    "text",
    [
        "serial://",
        "serial:///",
        "serial:///dev/ttyUSB0",
        "serial://dev/ttyUSB0?baud=9600",
        "serial:///dev/ttyUSB0?baud=",
        "serial:///dev/ttyUSB0?baud=fast",
        "serial:///dev/ttyUSB0?baud=0",
        "serial:///dev/ttyUSB0?baud=-9600",
        "serial:///dev/ttyUSB0?baud=99999999999",
        "serial:///dev/ttyUSB0?baud=²",
        "serial:///dev/ttyUSB0?baud=9600&baud=9600",
        "serial:///dev/ttyUSB0?baud=9600&parity=even",
        "serial:///dev/ttyUSB0?baud=9600#x",
        "serial:///dev/tty%00?baud=9600",
    ],
)
def test_what_is_no_serial_line_is_an_error_that_says_what_was_expected(text: str) -> None:
    with pytest.raises(LinkError, match=r"expected serial:///path\?baud=N") as caught:
        parse_device_address(text)
    assert repr(text) in str(caught.value)


def test_other_schemes_are_told_both_kinds_of_a_robots_address() -> None:
    with pytest.raises(LinkError, match=r"expected tcp://host:port or serial:///path\?baud=N"):
        parse_device_address("udp://a:1")


def test_only_a_robot_is_connected_by_a_serial_line() -> None:
    with pytest.raises(LinkError, match="only a robot is connected by a serial line"):
        Address.parse("serial:///dev/ttyUSB0?baud=57600")
