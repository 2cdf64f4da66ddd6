"""nftables rules for a router's ports: how many connections one address may open, made of where the router listens.

Zenoh waits 100 ms after each connection that fails, and a handshake that does not come keeps others waiting: only the
kernel can refuse such connections before Zenoh accepts them.
"""

from __future__ import annotations

from zbridge.errors import ConfigError
from zbridge.security.router_settings import RouterSettings

NEW_HZ = 5
"""New connections a second of one address. Each that fails keeps newcomers waiting for 100 ms."""
BURST = 50
"""Connections that one address may open at once before that: machines that run many gateways reconnect together."""
AT_A_TIME = 256
"""Connections of one address at a time."""
_TRANSPORTS = {"tcp": "tcp", "tls": "tcp", "ws": "tcp", "quic": "udp", "udp": "udp"}


def nftables(settings: RouterSettings) -> str:
    """Return rules for ``nft -f``; raise ConfigError if the router listens at no port."""
    ports = {transport: _ports(settings, transport) for transport in ("tcp", "udp")}
    rules = [
        rule
        for transport, numbers in ports.items()
        if numbers
        for family, address in (("4", "ip saddr"), ("6", "ip6 saddr"))
        for rule in _rules(f"{transport} dport {{ {', '.join(map(str, numbers))} }}", transport, family, address)
    ]
    if not rules:
        raise ConfigError(f"listen = {list(settings.listen)}: expected an address with a port")
    sets = [
        _set(f"{transport}_{kind}{family}", family, more)
        for transport, numbers in ports.items()
        if numbers
        for kind, more in (("open", "flags dynamic;"), ("new", "flags dynamic,timeout; timeout 1m;"))
        for family in ("4", "6")
    ]
    return _HEAD + _FILE.format(sets="\n".join(sets), rules="\n".join(f"        {rule}" for rule in rules))


def _ports(settings: RouterSettings, transport: str) -> list[int]:
    found = set()
    for address in settings.listen:
        kind, _, at = address.partition("/")
        port = at.partition("#")[0].partition("?")[0].rpartition(":")[2]
        if _TRANSPORTS.get(kind) == transport and port.isdecimal() and int(port):
            found.add(int(port))
    return sorted(found)


def _rules(ports: str, transport: str, family: str, address: str) -> tuple[str, str]:
    new = f"{ports} ct state new"
    return (
        f"{new} add @{transport}_open{family} {{ {address} ct count over {AT_A_TIME} }} counter drop",
        f"{new} update @{transport}_new{family} {{ {address} limit rate over {NEW_HZ}/second burst {BURST} packets }}"
        " counter drop",
    )


def _set(name: str, family: str, more: str) -> str:
    return f"    set {name} {{ type ipv{family}_addr; size 65535; {more} }}"


_HEAD = f"""\
# Limits the connections that one address may open to a Zenoh router, as `zbridge router --print-nftables` prints it:
# {AT_A_TIME} at a time, and {NEW_HZ} new ones a second after the first {BURST}. The router's own machine has no limit.
# Use it with `nft -f FILE`, take it away with `nft delete table inet zbridge_router`, and see what was dropped with
# `nft list table inet zbridge_router`. Raise the numbers where many gateways share one address.
"""
_FILE = """\
table inet zbridge_router
delete table inet zbridge_router
table inet zbridge_router {{
{sets}
    chain input {{
        type filter hook input priority filter; policy accept;
        iifname "lo" accept
{rules}
    }}
}}
"""
