"""Networks of hosts, as settings name them, and which hosts are among them. Opens nothing."""

from __future__ import annotations

import ipaddress
from collections.abc import Collection, Iterable

from zbridge.errors import ConfigError

Network = ipaddress.IPv4Network | ipaddress.IPv6Network


def parse_network(named: str, text: str) -> Network:
    """Read a network; raise ConfigError, which begins with ``named``: the setting and its value."""
    try:
        return ipaddress.ip_network(text)
    except ValueError as error:
        raise ConfigError(f"{named}: expected a network like '192.168.1.0/24': {error}") from error


def parse_networks(key: str, texts: Iterable[str]) -> tuple[Network, ...]:
    """Read the networks of a setting that lists them; raise ConfigError, which names the one that is wrong."""
    return tuple(parse_network(f"{key}[{number}] = {text!r}", text) for number, text in enumerate(texts))


def is_among(host: str, networks: Collection[Network]) -> bool:
    """Return whether a peer's address, as its socket gives it, lies in one of the networks.

    An IPv4 peer of an IPv6 socket is its IPv4 address; a zone (``%eth0``) is ignored.
    """
    address = ipaddress.ip_address(host.partition("%")[0])
    address = getattr(address, "ipv4_mapped", None) or address
    return any(address in network for network in networks)


def is_loopback(host: str) -> bool:
    """Return whether a host (a name or an address) is certainly this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
