"""Where a peer of a legacy protocol is, as configurations and logs write it. Opens nothing.

A robot is at a :data:`DeviceAddress`: a TCP port, a serial line, or a Zenoh router of its own. Listeners and simulators
are at TCP ports. Where the protocol allows it (``Protocol.datagrams``), all of them may be at UDP ports.
"""

from __future__ import annotations

from urllib.parse import SplitResult, parse_qsl, quote, unquote, urlsplit

import msgspec

from zbridge.errors import LinkError

_TCP = "tcp://host:port"
_TLS = "tls://"
_SERIAL = "serial:///path?baud=N"


class Address(msgspec.Struct, frozen=True):
    """A TCP port: ``tcp://host:port``. tls: of a listener, which speaks TLS there: ``tls://host:port``."""

    host: str
    port: int
    tls: bool = False

    @classmethod
    def parse(cls, text: str) -> Address:
        """Read ``tcp://host:port``; raise LinkError that names what was expected."""
        parts = _split(text, _TCP)
        if parts.scheme == "serial":
            raise LinkError(f"{text!r}: expected {_TCP}; only a robot is connected by a serial line")
        return _port(text, parts, _TCP, ("tcp",))

    @classmethod
    def parse_listener(cls, text: str) -> Address:
        """Read ``tcp://host:port`` or ``tls://host:port``; raise LinkError that names what was expected."""
        if not text.startswith(_TLS):
            return cls.parse(text)
        plain = "tcp" + text[3:]
        try:
            found = cls.parse(plain)
        except LinkError as error:
            raise LinkError(f"{text!r}: expected tls://host:port") from error
        return cls(found.host, found.port, tls=True)

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'tls' if self.tls else 'tcp'}://{host}:{self.port}"


class DatagramAddress(Address, frozen=True):
    """A UDP port, for datagrams alone: ``udp://host:port``; ours where we wait for the peer to speak: ``udp-in://``."""

    waits: bool = False

    def __str__(self) -> str:
        return ("udp-in" if self.waits else "udp") + super().__str__()[3:]


class SerialAddress(msgspec.Struct, frozen=True):
    """A serial line: ``serial:///dev/ttyUSB0?baud=57600``. ``baud``: bits a second."""

    path: str
    baud: int

    def __str__(self) -> str:
        return f"serial://{quote(self.path)}?baud={self.baud}"


class ZenohAddress(msgspec.Struct, frozen=True):
    """A Zenoh router to which robots are connected: ``tcp://host:port``. It is not the fleet's bus."""

    host: str
    port: int

    def __str__(self) -> str:
        return str(Address(self.host, self.port))

    @property
    def endpoint(self) -> str:
        """The address as Zenoh writes it: ``tcp/host:port``."""
        return str(self).replace("://", "/")


DeviceAddress = Address | SerialAddress | ZenohAddress
"""Where a robot is."""


def parse_device_address(text: str, schemes: tuple[str, ...] = ("tcp",)) -> DeviceAddress:
    """Read ``tcp://host:port`` or ``serial:///path?baud=N``; raise LinkError that names what was expected."""
    expected = f"{_expected(schemes)} or {_SERIAL}"
    parts = _split(text, expected)
    return _serial(text, parts) if parts.scheme == "serial" else _port(text, parts, expected, schemes)


def parse_port(text: str, schemes: tuple[str, ...]) -> Address:
    """Read a port of one of the schemes ``tcp``, ``udp``, ``udp-in``; raise LinkError that names them."""
    expected = _expected(schemes)
    return _port(text, _split(text, expected), expected, schemes)


def _expected(schemes: tuple[str, ...]) -> str:
    return " or ".join(f"{scheme}://host:port" for scheme in schemes)


def _split(text: str, expected: str) -> SplitResult:
    try:
        return urlsplit(text)
    except ValueError as error:
        raise LinkError(f"{text!r}: {error}; expected {expected}") from error


def _port(text: str, parts: SplitResult, expected: str, schemes: tuple[str, ...]) -> Address:
    try:
        host, port = parts.hostname, parts.port
        (host or "").encode("idna")
    except ValueError as error:
        raise LinkError(f"{text!r}: {error}; expected {expected}") from error
    odd = parts.path or parts.query or parts.fragment or parts.username is not None
    if parts.scheme not in schemes or not host or port is None or odd:
        raise LinkError(f"{text!r}: expected {expected}")
    return Address(host, port) if parts.scheme == "tcp" else DatagramAddress(host, port, waits=parts.scheme == "udp-in")


def _serial(text: str, parts: SplitResult) -> SerialAddress:
    path = unquote(parts.path)
    settings = parse_qsl(parts.query, keep_blank_values=True)
    bauds = [value for name, value in settings if name == "baud" and value.isascii() and value.isdecimal()]
    odd = parts.netloc or parts.fragment or len(settings) != 1 or "\0" in path
    if odd or len(path) < 2 or len(bauds) != 1 or not 0 < int(bauds[0][:10]) < 2**31:
        raise LinkError(f"{text!r}: expected {_SERIAL}")
    return SerialAddress(path, int(bauds[0]))
