"""What an authority has issued, and what is wrong with it. The time is an argument."""

from __future__ import annotations

from datetime import datetime, timedelta

import msgspec
from cryptography.x509 import Certificate

from zbridge.errors import ConfigError
from zbridge.security.certs import x509
from zbridge.security.certs.files import Folder
from zbridge.security.certs.reading import fault, load_certificate, load_name
from zbridge.security.roles import Roles, load_roles

SOON = timedelta(days=30)
"""How long before its end a certificate is due to be renewed."""


class Entry(msgspec.Struct, frozen=True):
    """One name. problem: what is wrong with its files, or that it is revoked; empty: nothing."""

    name: str
    role: str | None = None
    robots: tuple[str, ...] = ()
    hosts: tuple[str, ...] = ()
    expires: datetime | None = None
    fingerprint: str | None = None
    problem: str = ""


def list_names(folder: Folder, now: datetime) -> list[Entry]:
    """Return every name in ``roles.toml``, then the revoked ones; raise ConfigError if there is no authority."""
    roles = load_roles(folder.roles)
    authority = load_certificate(folder.ca)
    known = [_entry(folder, authority, roles, name, now) for name in roles.names]
    return known + [Entry(name, problem="revoked") for name in roles.revoked]


def _entry(folder: Folder, authority: Certificate, roles: Roles, name: str, now: datetime) -> Entry:
    member = roles.names[name]
    try:
        _, certificate = load_name(folder, name)
    except ConfigError as error:
        return Entry(name, member.role, member.robots, problem=str(error))
    return Entry(
        name,
        member.role,
        member.robots,
        x509.hosts_of(certificate),
        certificate.not_valid_after_utc,
        x509.fingerprint(certificate),
        fault(certificate, authority, roles.common_name(name), now) or _warning(certificate, now),
    )


def _warning(certificate: Certificate, now: datetime) -> str:
    left = certificate.not_valid_after_utc - now
    days = left // timedelta(days=1)
    return f"expires in {days} day{'s' * (days != 1)}" if left < SOON else ""
