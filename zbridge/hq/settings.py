"""The settings of one listener as the configuration holds them, and the plan made of them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import msgspec

from zbridge.protocol.address import Address
from zbridge.protocol.networks import Network
from zbridge.protocol.plugin import Protocol

if TYPE_CHECKING:
    from ssl import SSLContext

Seconds = Annotated[float, msgspec.Meta(gt=0, le=3600)]


class ListenerTls(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The files of a listener at ``tls://``.

    certificate: of the listener. key: of this certificate. ca: clients must show a certificate of this authority; None:
    of none.
    """

    certificate: str
    key: str
    ca: str | None = None


class HqSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One ``[[hq]]``: where HQ programs of one protocol connect as if this were the robot, and their limits.

    protocol: the protocol of the HQ programs. listen: ``tcp://host:port`` or ``tls://host:port``; if the protocol
    allows datagrams alone (MAVLink) also ``udp://host:port``: a client is then an address and port that sends, and gone
    after 5 s without a datagram. to: with ``udp://`` only, addresses ``udp://host:port`` that are clients from the
    beginning, although nothing came from them: for programs that wait until the robot speaks. name: of the listener
    on the bus; absent: made of the protocol and the process. clients: most at a time. accept_hz: connections a second
    that are accepted from one address. handshake_s: longest time for a client's handshake. idle_s: longest silence of a
    client; absent: no limit. rate_hz: messages a second of one client. allow: networks that clients may connect from;
    empty: all. tls: the listener's certificate, at an address ``tls://host:port``.
    """

    protocol: str
    listen: str
    name: Annotated[str, msgspec.Meta(max_length=40)] | None = None
    options: dict[str, Any] = {}
    clients: Annotated[int, msgspec.Meta(ge=1, le=10_000)] = 256
    accept_hz: Annotated[float, msgspec.Meta(ge=0.1, le=1e5)] = 20.0
    handshake_s: Seconds = 5.0
    idle_s: Seconds | None = None
    rate_hz: Annotated[float, msgspec.Meta(ge=1, le=1e6)] = 1000.0
    allow: tuple[str, ...] = ()
    tls: ListenerTls | None = None
    to: tuple[str, ...] = ()


class ListenerPlan(msgspec.Struct, frozen=True):
    """What one listener is made of: its protocol, that protocol's options, where it listens, and for whom.

    tls: of a listener at ``tls://``, else None. to: clients unasked, of a listener at ``udp://``.
    """

    protocol: Protocol
    options: Any
    address: Address
    settings: HqSettings
    allow: tuple[Network, ...]
    tls: SSLContext | None = None
    to: tuple[Address, ...] = ()
