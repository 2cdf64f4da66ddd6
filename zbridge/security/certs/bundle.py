"""Packs one name for another machine: its files, and a ``[bus]`` table that uses them; for a router, the roles."""

from __future__ import annotations

import re
from datetime import datetime
from pathlib import Path

import msgspec

from zbridge.errors import ConfigError
from zbridge.protocol.networks import is_loopback
from zbridge.security.certs import x509
from zbridge.security.certs.authority import check_known, fault, load_name
from zbridge.security.files import (
    PUBLIC,
    SECRET,
    Folder,
    NameFiles,
    make_folder,
    read,
    read_secret,
    refuse_to_overwrite,
    write,
)
from zbridge.security.roles import Roles, load_roles
from zbridge.toml import as_toml

PORT = 7447
"""The default port of Zenoh routers."""

_ENDPOINT = re.compile(r"tls/[A-Za-z0-9_.-]+:[0-9]{1,5}")
_EXAMPLE = f"tls/router.lab:{PORT}"


class Packing(msgspec.Struct, frozen=True):
    """The destination of a bundle. connect: Zenoh endpoints; none: those of the routers that the authority has issued.

    at: the folder's path on the other machine, if it differs from ``folder``.
    """

    folder: Path
    connect: tuple[str, ...] = ()
    at: Path | None = None


def bundle(folder: Folder, name: str, packing: Packing, now: datetime, *, force: bool = False) -> tuple[Path, ...]:
    """Write the files of a name into a folder, and return their paths; raise ConfigError.

    A router gets ``roles.toml``, every other name ``bus.toml``. force: overwrite what is there.
    """
    roles = load_roles(folder.roles)
    check_known(folder, roles, name)
    _, certificate = load_name(folder, name)
    if problem := fault(certificate, x509.read_certificate(folder.ca), roles.common_name(name), now):
        raise ConfigError(f"{folder.of(name).certificate}: {problem}; `zbridge certs renew {name}`")
    files, packed = folder.of(name), NameFiles(packing.folder)
    if roles.names[name].role == "router":
        last, text = packing.folder / "roles.toml", read(folder.roles)
    else:
        last, text = packing.folder / "bus.toml", _bus(folder, roles, name, packing).encode()
    paths = (packed.ca, packed.certificate, packed.key, last)
    if not force:
        refuse_to_overwrite(*paths, advice="--force overwrites it")
    make_folder(packing.folder)
    write(packed.ca, read(folder.ca), PUBLIC)
    write(packed.certificate, read(files.certificate), PUBLIC)
    write(packed.key, read_secret(files.key), SECRET)
    write(last, text, PUBLIC)
    return paths


def _bus(folder: Folder, roles: Roles, name: str, packing: Packing) -> str:
    for endpoint in packing.connect:
        if not _ENDPOINT.fullmatch(endpoint):
            raise ConfigError(f"--connect {endpoint!r}: expected an endpoint like {_EXAMPLE}")
    endpoints = packing.connect or _routers(folder, roles)
    there = NameFiles(packing.at or packing.folder.absolute())
    paths = {"ca": there.ca, "certificate": there.certificate, "key": there.key}
    return _BUS.format(
        common_name=roles.common_name(name),
        connect=as_toml(endpoints),
        tls=", ".join(f"{key} = {as_toml(str(path))}" for key, path in paths.items()),
    )


def _routers(folder: Folder, roles: Roles) -> tuple[str, ...]:
    """Return one endpoint of each router: its first host that is not loopback, else its first; never an IPv6 one."""
    endpoints = []
    for name, member in roles.names.items():
        if member.role == "router":
            _, certificate = load_name(folder, name)
            hosts = [host for host in x509.hosts_of(certificate) if x509.zenoh_accepts(host)]
            hosts.sort(key=is_loopback)
            endpoints += [f"tls/{host}:{PORT}" for host in hosts[:1]]
    if not endpoints:
        raise ConfigError(f"--connect: missing: no router is issued yet; expected an endpoint like {_EXAMPLE}")
    return tuple(endpoints)


_BUS = """\
# [bus] of a gateway or listener that joins the bus as {common_name}: put it into the configuration.
[bus]
mode = "client"
multicast = false
connect = {connect}
tls = {{ {tls} }}
"""
