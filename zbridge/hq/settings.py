"""The settings of one listener, as a configuration has them, and the plan made of them."""

from __future__ import annotations

import ipaddress
from typing import Annotated, Any

import msgspec

from zbridge.address import Address
from zbridge.protocol.plugin import Protocol

Seconds = Annotated[float, msgspec.Meta(gt=0, le=3600)]
Network = ipaddress.IPv4Network | ipaddress.IPv6Network


class HqSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One ``[[hq]]``: where HQ programs of one protocol connect as if this were the robot, and what bounds them.

    name: of the listener on the bus, the protocol's and this process's where left out. clients: most at a time.
    accept_hz: connections a second that are taken from one address. handshake_s, idle_s: seconds a client has for its
    handshake, and may be silent (None: for ever). rate_hz: messages a second of one client. allow: networks clients may
    come from, all where empty.
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


class ListenerPlan(msgspec.Struct, frozen=True):
    """One listener for HQ programs."""

    protocol: Protocol
    options: Any
    address: Address
    settings: HqSettings
    allow: tuple[Network, ...]
