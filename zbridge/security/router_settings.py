"""The settings of a router: its TOML file or options, checked as a whole, and Zenoh's configuration made of them.

With ``tls`` every member presents a certificate, and the rules of ``roles.toml`` limit it. Without it nobody is
limited, so the router serves this machine only, unless it is set to be insecure. Every ConfigError names key, value
and what was expected.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec

from zbridge.bus import Tls
from zbridge.bus.interface import FULL_QUEUES, SECURE, Connection
from zbridge.bus.tls.files import tls_beside
from zbridge.errors import ConfigError
from zbridge.fleet.topics import is_name
from zbridge.protocol.networks import is_loopback
from zbridge.security.access import MESSAGE_BYTES, STOPS_HZ, access_control, downsampling, low_pass_filter
from zbridge.security.roles import Roles, load_roles
from zbridge.toml import read_struct

LISTEN = "tcp/127.0.0.1:7447"
LISTEN_TLS = "tls/0.0.0.0:7447"
_HEADROOM_BYTES = 65_536
"""Bytes by which a message exceeds its payload and attachment."""
NEW_HZ = 5
"""New connections a second of one address. Each that fails delays newcomers by 100 ms."""
BURST = 50
"""Connections that one address may open at once before that: machines that run many gateways reconnect together."""
AT_A_TIME = 256
"""Connections of one address at a time."""
_TRANSPORTS = {"tcp": "tcp", "tls": "tcp", "ws": "tcp", "quic": "udp", "udp": "udp"}


class RouterLimits(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[limits]``: what one member may use of the router.

    sessions: connections at a time; pending: connections being opened at a time, for example after a restart, when all
    members connect at once. message_bytes: of payload and attachment, unless a smaller bound applies. stops_hz: stops a
    second of one member to one robot. opening_s: time limit to open a connection.
    """

    sessions: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 2000
    pending: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 500
    message_bytes: Annotated[int, msgspec.Meta(ge=65_536, le=2**30)] = MESSAGE_BYTES
    stops_hz: Annotated[float, msgspec.Meta(ge=200.0)] = STOPS_HZ
    opening_s: Annotated[float, msgspec.Meta(ge=0.5, le=60.0)] = 5.0


class RouterSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A router's TOML file. Paths in it are relative to the file.

    listen: where members connect; without it ``tcp/127.0.0.1:7447``, with tls ``tls/0.0.0.0:7447``. connect: other
    routers. realm: the first chunk of all keys. tls: the files of its certificate. roles: the file that says who may do
    what. insecure: serve other machines without tls.
    """

    listen: tuple[Connection, ...] = ()
    connect: tuple[Connection, ...] = ()
    realm: str = "fleet"
    tls: Tls | None = None
    roles: str | None = None
    insecure: bool = False
    limits: RouterLimits = RouterLimits()


class RouterPlan(msgspec.Struct, frozen=True):
    """A router's settings with the roles that they name."""

    settings: RouterSettings
    roles: Roles = Roles()


def load_router(path: Path) -> RouterSettings:
    """Read a router's TOML file; raise ConfigError, which names the file as well."""
    settings = read_struct(path, RouterSettings)
    beside = path.absolute().parent
    tls = tls_beside(settings.tls, beside) if settings.tls is not None else None
    roles = settings.roles
    return msgspec.structs.replace(settings, tls=tls, roles=None if roles is None else str(beside / roles))


def plan_router(settings: RouterSettings, *, files: bool = True) -> RouterPlan:
    """Check settings and read the roles that they name; raise ConfigError. files: whether TLS files must exist."""
    if not is_name(settings.realm):
        raise ConfigError(f"realm = {settings.realm!r}: expected letters, digits, '_', '.' and '-' only")
    if not settings.listen:
        listen = (LISTEN if settings.tls is None else LISTEN_TLS,)
        settings = msgspec.structs.replace(settings, listen=listen)
    if settings.tls is None:
        _check_open(settings)
        return RouterPlan(settings)
    _check_secure(settings, settings.tls, files=files)
    if settings.roles is None:
        raise ConfigError("roles: missing, it is required with tls: without it nobody may do anything")
    return RouterPlan(settings, load_roles(Path(settings.roles)))


def zenoh_values(plan: RouterPlan) -> dict[str, Any]:
    """Return a router's Zenoh configuration, by paths (``listen/endpoints``)."""
    settings, limits = plan.settings, plan.settings.limits
    values: dict[str, Any] = {
        "mode": "router",
        "listen/endpoints": list(settings.listen),
        "connect/endpoints": list(settings.connect),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": settings.tls is None,  # it tells members where others listen
        "transport/shared_memory/enabled": False,
        **FULL_QUEUES,
        "transport/link/rx/max_message_size": limits.message_bytes + _HEADROOM_BYTES,
        "transport/unicast/max_sessions": limits.sessions,
        "transport/unicast/accept_pending": limits.pending,
        "transport/unicast/accept_timeout": int(1000 * limits.opening_s),
        "low_pass_filter": low_pass_filter(settings.realm, limits.message_bytes),
    }
    if settings.tls is not None:
        values |= {
            "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
            "transport/link/protocols": list(SECURE),
            **_tls_values(settings.tls),
            "downsampling": downsampling(plan.roles, settings.realm, limits.stops_hz),
            "access_control": access_control(plan.roles, settings.realm),
        }
    return values


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Write a configuration by paths as the file that Zenoh's own router reads."""
    tree: dict[str, Any] = {}
    for path, value in values.items():
        *parents, last = path.split("/")
        at = tree
        for parent in parents:
            at = at.setdefault(parent, {})
        at[last] = value
    return tree


def _tls_values(tls: Tls) -> dict[str, Any]:
    at = "transport/link/tls"
    values: dict[str, Any] = {f"{at}/root_ca_certificate": tls.ca}
    for side in ("listen", "connect"):  # it connects to other routers
        values |= {f"{at}/{side}_certificate": tls.certificate, f"{at}/{side}_private_key": tls.key}
    return values | {
        f"{at}/enable_mtls": True,
        f"{at}/verify_name_on_connect": True,
        f"{at}/close_link_on_expiration": True,
    }


def _check_open(settings: RouterSettings) -> None:
    if settings.roles is not None:
        raise ConfigError(f"roles = {settings.roles!r}: expected tls too: a role is known by its certificate")
    for address in settings.listen:
        if not settings.insecure and not _is_loopback(address):
            raise ConfigError(
                f"listen = {address!r}: without tls whoever reaches this address may do everything: expected a loopback"
                " address, or tls and roles, or --insecure (insecure = true)"
            )


def _check_secure(settings: RouterSettings, tls: Tls, *, files: bool) -> None:
    if settings.insecure:
        raise ConfigError("insecure = true: expected no tls beside it")
    for key, addresses in (("listen", settings.listen), ("connect", settings.connect)):
        for address in addresses:
            if address.partition("/")[0] not in SECURE:
                raise ConfigError(f"{key} = {address!r}: expected tls/host:port: with tls nothing goes in the open")
    for key, name in (("ca", tls.ca), ("certificate", tls.certificate), ("key", tls.key)):
        if name is None:
            raise ConfigError(f"tls.{key}: missing, it is required in a router")
        if files and not os.access(name, os.R_OK):
            why = "cannot be read" if os.path.exists(name) else "no such file"
            raise ConfigError(f"tls.{key} = {name!r}: {why}")


def _is_loopback(address: str) -> bool:
    kind, _, at = address.partition("/")
    host = at.partition("#")[0].rpartition(":")[0].strip("[]")
    return kind == "unixsock-stream" or is_loopback(host)


def nftables(settings: RouterSettings) -> str:
    """Return rules for ``nft -f``; raise ConfigError if the router has no port."""
    listening = {transport: ports for transport in ("tcp", "udp") if (ports := _ports(settings, transport))}
    if not listening:
        raise ConfigError(f"listen = {list(settings.listen)}: expected an address with a port")
    sets = [
        f"    set {transport}_{kind}{family} {{ type ipv{family}_addr; size 65535; {more} }}"
        for transport in listening
        for kind, more in (("open", "flags dynamic;"), ("new", "flags dynamic,timeout; timeout 1m;"))
        for family in _SOURCE
    ]
    rules = [
        f"        {transport} dport {{ {', '.join(map(str, ports))} }} ct state new {rule} counter drop"
        for transport, ports in listening.items()
        for family, source in _SOURCE.items()
        for rule in (
            f"add @{transport}_open{family} {{ {source} ct count over {AT_A_TIME} }}",
            f"update @{transport}_new{family} {{ {source} limit rate over {NEW_HZ}/second burst {BURST} packets }}",
        )
    ]
    return _HEAD + _FILE.format(sets="\n".join(sets), rules="\n".join(rules))


def _ports(settings: RouterSettings, transport: str) -> list[int]:
    found = set()
    for address in settings.listen:
        kind, _, at = address.partition("/")
        port = at.partition("#")[0].partition("?")[0].rpartition(":")[2]
        if _TRANSPORTS.get(kind) == transport and port.isdecimal() and int(port):
            found.add(int(port))
    return sorted(found)


_SOURCE = {"4": "ip saddr", "6": "ip6 saddr"}
"""By the version of IP, what a rule calls the address that a packet comes from."""
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
