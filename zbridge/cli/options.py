"""Options that several commands have, and what checks them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import typer

from zbridge.bus.tls.files import TLS_VARIABLE
from zbridge.cli import give_up
from zbridge.fleet.topics import is_name

ENDPOINT = re.compile(r"(tcp|udp|tls|quic|ws|unixsock-stream|serial|vsock)/\S+")


def _read_realm(realm: str) -> str:
    check_name("--realm", realm)
    return realm


def _read_endpoints(endpoints: list[str]) -> list[str]:
    for endpoint in endpoints:
        if not ENDPOINT.fullmatch(endpoint) or not endpoint.isprintable():
            give_up(2, f"--connect {endpoint!r}: expected an endpoint like tcp/192.168.0.2:7447")
    return endpoints


Realm = Annotated[str, typer.Option(help="first chunk of all keys", callback=_read_realm)]
Connect = Annotated[
    list[str],
    typer.Option(
        help="Zenoh endpoint, for example tcp/192.168.0.2:7447; without it: multicast and the router on this machine",
        envvar="ZBRIDGE_CONNECT",
        callback=_read_endpoints,
        show_default=False,
    ),
]
TlsFolder = Annotated[
    Path | None,
    typer.Option(
        "--tls",
        help="for a secure bus: a folder as `zbridge certs bundle` makes it; its endpoints are used without --connect",
        envvar=TLS_VARIABLE,
        show_default=False,
    ),
]
FileTls = Annotated[
    Path | None,
    typer.Option(
        "--tls",
        help=f"for a FILE without bus.tls: a folder as `zbridge certs bundle` makes it; or {TLS_VARIABLE}",
        show_default=False,
    ),
]


Json = Annotated[bool, typer.Option("--json", help="one JSON object a line")]


S = TypeVar("S", bound=msgspec.Struct)


def chosen(options: type[S], parameters: Mapping[str, Any]) -> S:
    """Make the options of a command of its parameters (``locals()``): they have the names of the fields."""
    return options(**{name: parameters[name] for name in options.__struct_fields__})


def check_name(argument: str, name: str) -> None:
    """End the process with exit code 2 if ``name`` cannot be a robot's name."""
    if not is_name(name):
        give_up(2, f"{argument} = {name!r}: expected letters, digits, '_', '.' and '-' only")
