"""Addresses as configurations write them."""

import re

import pytest

from zbridge.errors import LinkError
from zbridge.protocol.address import (
    Address,
    DatagramAddress,
    DeviceAddress,
    SerialAddress,
    parse_device_address,
    parse_port,
)

ADDRESSES: dict[str, DeviceAddress] = {
    "tcp://127.0.0.1:11001": Address("127.0.0.1", 11001),
    "tcp://robot.test:1": Address("robot.test", 1),
    "tcp://[::1]:7447": Address("::1", 7447),
    "serial:///dev/ttyUSB0?baud=57600": SerialAddress("/dev/ttyUSB0", 57600),
    "serial:///dev/serial/usb-FTDI_%3F%20x?baud=9600": SerialAddress("/dev/serial/usb-FTDI_? x", 9600),
}
NO_PORT = (
    *("", "robot", "127.0.0.1:11001", "udp://a:1", "tcp://a", "tcp://:1", "tcp://a:x", "tcp://a:65536"),
    *("tcp://a:1/b", "tcp://[a:1", "tcp://a:1?b"),
)
NO_LINE = (
    *("serial://", "serial:///", "serial:///dev/ttyUSB0", "serial://dev/ttyUSB0?baud=9600"),
    *(f"serial:///dev/ttyUSB0?baud={baud}" for baud in ("", "fast", "0", "-9600", "99999999999", "²", "9600#x")),
    *(f"serial:///dev/ttyUSB0?baud=9600&{more}" for more in ("baud=9600", "parity=even")),
    "serial:///dev/tty%00?baud=9600",
)


@pytest.mark.parametrize("text", ADDRESSES)
def test_an_address_is_read_and_written(text: str) -> None:
    address = parse_device_address(text)
    assert (address, str(address)) == (ADDRESSES[text], text)
    if isinstance(address, Address):
        assert Address.parse(text) == address


@pytest.mark.parametrize(
    ("text", "parse", "expected"),
    [
        *((text, Address.parse, "expected tcp://host:port") for text in NO_PORT),
        *((text, parse_device_address, "expected serial:///path?baud=N") for text in NO_LINE),
        ("udp://a:1", parse_device_address, "expected tcp://host:port or serial:///path?baud=N"),
        ("serial:///dev/ttyUSB0?baud=9600", Address.parse, "only a robot is connected by a serial line"),
    ],
)
def test_what_is_no_address_is_an_error_that_says_what_was_expected(text: str, parse, expected: str) -> None:
    with pytest.raises(LinkError, match=re.escape(repr(text)) + ".*" + re.escape(expected)):
        parse(text)


def test_a_listener_may_be_at_an_address_of_tls_and_a_robot_may_not() -> None:
    assert Address.parse_listener("tls://[::1]:6666") == Address("::1", 6666, tls=True)
    assert str(Address("::1", 6666, tls=True)) == "tls://[::1]:6666"
    assert Address.parse_listener("tcp://a:1") == Address("a", 1)
    for parse, text, expected in (
        (Address.parse_listener, "tls://a", "expected tls://host:port"),
        (Address.parse_listener, "udp://a:1", "expected tcp://host:port"),
        (Address.parse, "tls://a:1", "expected tcp://host:port"),
        (parse_device_address, "tls://a:1", "expected tcp://host:port"),
    ):
        with pytest.raises(LinkError, match=re.escape(repr(text)) + ".*" + re.escape(expected)):
            parse(text)


def test_where_the_protocol_allows_it_peers_are_at_udp_ports() -> None:
    schemes = ("tcp", "udp", "udp-in")
    for text, address in {
        "udp://robot.test:14550": DatagramAddress("robot.test", 14550),
        "udp-in://[::]:14550": DatagramAddress("::", 14550, waits=True),
        **ADDRESSES,
    }.items():
        assert parse_device_address(text, schemes) == address
        assert str(address) == text
    assert parse_port("udp://0.0.0.0:14550", ("tcp", "udp")) == DatagramAddress("0.0.0.0", 14550)
    assert parse_port("tcp://a:1", ("tcp", "udp")) == Address("a", 1) != DatagramAddress("a", 1)
    every = "expected tcp://host:port or udp://host:port or udp-in://host:port or serial:///path?baud=N"
    for parse, text, expected in (
        (lambda text: parse_device_address(text, schemes), "udp://a", every),
        (lambda text: parse_port(text, ("tcp", "udp")), "udp-in://a:1", "expected tcp://host:port or udp://host:port"),
        (lambda text: parse_port(text, ("udp",)), "tcp://a:1", "expected udp://host:port"),
        (parse_device_address, "udp-in://a:1", "expected tcp://host:port or serial:///path?baud=N"),
    ):
        with pytest.raises(LinkError, match=re.escape(repr(text)) + ".*" + re.escape(expected)):
            parse(text)
