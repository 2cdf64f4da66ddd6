"""An authority in a folder: it issues, renews, revokes and lists names, and reads them back. The time is an argument.

Every change of the folder is made under its lock. Files of a name are written before ``roles.toml``: after a crash a
name may have files that no router knows, never the other way round. Every function raises ConfigError, which names the
file.
"""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import msgspec
from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
from cryptography.x509 import Certificate

from zbridge.bus.tls.files import ANOTHER_AUTHORITY, folder_tls, not_strict
from zbridge.errors import ConfigError
from zbridge.security.certs import x509
from zbridge.security.files import PUBLIC, SECRET, Folder, changing, make_folder, read, refuse_to_overwrite, write
from zbridge.security.roles import ROLES, Member, Roles, check_member, check_name, load_roles, save_roles

AUTHORITY_DAYS = 3650
DAYS = 365
"""How long a certificate is valid, by default."""
SOON = timedelta(days=30)
"""How long before its expiry a certificate should be renewed."""


def load_authority(folder: Folder, now: datetime) -> x509.CertificateAuthority:
    """Read the authority; raise ConfigError also if it has expired or its key is not its own."""
    certificate = x509.read_certificate(folder.ca)
    if certificate.not_valid_after_utc <= now:
        raise ConfigError(
            f"{folder.ca}: the authority expired on {certificate.not_valid_after_utc:%Y-%m-%d}; `zbridge certs init"
            " --force` makes another, and every name then needs `zbridge certs renew`"
        )
    return x509.CertificateAuthority(certificate, _matching_key(folder.ca_key, certificate))


def load_name(folder: Folder, name: str) -> tuple[EllipticCurvePrivateKey, Certificate]:
    """Read key and certificate of a name; raise ConfigError also if they do not match or others can read the key."""
    files = folder.of(name)
    certificate = x509.read_certificate(files.certificate)
    return _matching_key(files.key, certificate), certificate


def fault(certificate: Certificate, authority: Certificate, expected: str, now: datetime) -> str:
    """Return why a certificate would be refused, or belongs to nobody; empty: it is good. expected: its common name."""
    if not x509.issued_by(certificate, authority):
        return "issued by another authority"
    if (found := x509.common_name_of(certificate)) != expected:
        return f"issued as {found}, but roles.toml says {expected}"
    if certificate.not_valid_after_utc <= now:
        return f"expired on {certificate.not_valid_after_utc:%Y-%m-%d}"
    if certificate.not_valid_before_utc > now:
        return f"not valid before {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC"
    return ""


def _matching_key(path: Path, certificate: Certificate) -> EllipticCurvePrivateKey:
    key = x509.read_key(path)
    if certificate.public_key() != key.public_key():
        raise ConfigError(f"{path}: not the key of the certificate {x509.common_name_of(certificate)!r} beside it")
    return key


class CertificateRequest(msgspec.Struct, frozen=True):
    """A request to issue. hosts: names of a server with this certificate; a router has at least one."""

    name: str
    member: Member
    hosts: tuple[str, ...] = ()
    days: int = DAYS


class Issued(msgspec.Struct, frozen=True):
    """A certificate in its file. replaced_until: when the certificate that it replaces expires."""

    common_name: str
    expires: datetime
    fingerprint: str
    replaced_until: datetime | None = None


class Revoked(msgspec.Struct, frozen=True):
    """A revoked name. until: when its certificate expires, if any. server: its certificate is a server's too."""

    common_name: str
    until: datetime | None
    server: bool


def init(folder: Folder, now: datetime, *, force: bool = False) -> Issued:
    """Make an authority, and ``roles.toml`` if there is none. force: replace an authority."""
    make_folder(folder.path)
    with changing(folder):
        if not force:
            advice = "--force makes another authority; no certificate of this one is then accepted"
            refuse_to_overwrite(folder.ca, folder.ca_key, advice=advice)
        roles = load_roles(folder.roles) if folder.roles.exists() else Roles()
        made = x509.new_authority(now, AUTHORITY_DAYS)
        write(folder.ca_key, x509.key_pem(made.key), SECRET)
        write(folder.ca, x509.certificate_pem(made.certificate), PUBLIC)
        save_roles(folder.roles, roles)
    return _issued(made.certificate)


def issue(folder: Folder, request: CertificateRequest, now: datetime, *, force: bool = False) -> Issued:
    """Make key and certificate of a name, and write the name into ``roles.toml``. force: replace those of a name."""
    name, hosts = request.name, _checked_hosts(request)
    with changing(folder):
        known = load_roles(folder.roles)
        if name in known.revoked:
            raise ConfigError(f"{folder.roles}: {name!r} is revoked; issue a new name")
        if not force:
            _refuse_to_replace(folder, known, name)
        roles = known.with_member(name, request.member)
        authority = load_authority(folder, now)
        lifetime = (now, _checked_days(request.days, authority, now))
        key = x509.new_key()
        certificate = x509.new_certificate(authority, key.public_key(), roles.common_name(name), hosts, lifetime)
        replaced = _present(folder, name)
        make_folder(folder.of(name).folder)
        write(folder.of(name).key, x509.key_pem(key), SECRET)
        _write_certificate(folder, name, certificate)
        save_roles(folder.roles, roles)
    return _issued(certificate, replaced.not_valid_after_utc if replaced else None)


def renew(folder: Folder, name: str, now: datetime, *, days: int = DAYS) -> Issued:
    """Make a new certificate for a name's existing key, with its hosts, and the role in ``roles.toml``."""
    with changing(folder):
        roles = load_roles(folder.roles)
        check_known(folder, roles, name)
        key, old = load_name(folder, name)
        authority = load_authority(folder, now)
        lifetime = (now, _checked_days(days, authority, now))
        hosts = x509.hosts_of(old)
        certificate = x509.new_certificate(authority, key.public_key(), roles.common_name(name), hosts, lifetime)
        _write_certificate(folder, name, certificate)
    return _issued(certificate, old.not_valid_after_utc)


def revoke(folder: Folder, name: str) -> Revoked:
    """Remove a name from ``roles.toml`` for good. Its files stay; a restarted router does not know them."""
    with changing(folder):
        roles = load_roles(folder.roles)
        check_known(folder, roles, name)
        save_roles(folder.roles, roles.without(name))
    gone, certificate = roles.common_name(name), _present(folder, name)
    if certificate is None:
        return Revoked(gone, None, roles.names[name].role == "router")
    return Revoked(gone, certificate.not_valid_after_utc, bool(x509.hosts_of(certificate)))


def check_known(folder: Folder, roles: Roles, name: str) -> None:
    """Raise ConfigError if a name is not in ``roles.toml``, or is revoked."""
    if name in roles.revoked:
        raise ConfigError(f"{folder.roles}: {name!r} is revoked; issue a new name")
    if name not in roles.names:
        known = ", ".join(roles.names) or "none"
        raise ConfigError(f"{folder.roles}: {name!r} is not a name of this bus; known: {known}")


def _refuse_to_replace(folder: Folder, roles: Roles, name: str) -> None:
    files = folder.of(name)
    advice = "`zbridge certs renew` makes its certificate last longer, --force makes another key"
    refuse_to_overwrite(files.key, files.certificate, advice=advice)
    if name in roles.names:
        raise ConfigError(f"{folder.roles}: names.{name}: exists already; --force replaces it")


def _checked_hosts(request: CertificateRequest) -> tuple[str, ...]:
    check_name("NAME", request.name)
    if request.member.role not in ROLES:
        raise ConfigError(f"--role {request.member.role!r}: expected one of {', '.join(ROLES)}")
    check_member("--robot", request.member)
    hosts = tuple(dict.fromkeys(map(x509.check_host, request.hosts)))
    if request.member.role == "router" and not any(map(x509.zenoh_accepts, hosts)):
        raise ConfigError(
            f"--host {list(hosts)}: expected every host name and IPv4 address at which clients reach this router"
        )
    return hosts


def _checked_days(days: int, authority: x509.CertificateAuthority, now: datetime) -> int:
    end = authority.certificate.not_valid_after_utc
    most = (end - now) // timedelta(days=1)
    if not 1 <= days <= most:
        raise ConfigError(f"--days {days}: expected 1 to {most}: the authority expires on {end:%Y-%m-%d}")
    return days


def _write_certificate(folder: Folder, name: str, certificate: Certificate) -> None:
    files = folder.of(name)
    write(files.certificate, x509.certificate_pem(certificate), PUBLIC)
    write(files.ca, read(folder.ca), PUBLIC)


def _present(folder: Folder, name: str) -> Certificate | None:
    """Return the certificate of a name; None if there is none, or it cannot be read."""
    try:
        return x509.read_certificate(folder.of(name).certificate)
    except ConfigError:
        return None


def _issued(certificate: Certificate, replaced_until: datetime | None = None) -> Issued:
    expires = certificate.not_valid_after_utc
    return Issued(x509.common_name_of(certificate), expires, x509.fingerprint(certificate), replaced_until)


class ListedCertificate(msgspec.Struct, frozen=True):
    """One name. problem: what is wrong with its files, or that it is revoked; empty: nothing."""

    name: str
    role: str | None = None
    robots: tuple[str, ...] = ()
    hosts: tuple[str, ...] = ()
    expires: datetime | None = None
    fingerprint: str | None = None
    problem: str = ""


def list_names(folder: Folder, now: datetime) -> list[ListedCertificate]:
    """Return every name in ``roles.toml``, then the revoked ones; raise ConfigError if there is no authority."""
    roles = load_roles(folder.roles)
    authority = x509.read_certificate(folder.ca)
    known = [_entry(folder, authority, roles, name, now) for name in roles.names]
    return known + [ListedCertificate(name, problem="revoked") for name in roles.revoked]


def _entry(folder: Folder, authority: Certificate, roles: Roles, name: str, now: datetime) -> ListedCertificate:
    member = roles.names[name]
    try:
        _, certificate = load_name(folder, name)
    except ConfigError as error:
        return ListedCertificate(name, member.role, member.robots, problem=str(error))
    return ListedCertificate(
        name,
        member.role,
        member.robots,
        x509.hosts_of(certificate),
        certificate.not_valid_after_utc,
        x509.fingerprint(certificate),
        fault(certificate, authority, roles.common_name(name), now)
        or _authority_warning(folder, name)
        or _warning(certificate, now),
    )


def _authority_warning(folder: Folder, name: str) -> str:
    strict = not_strict(folder_tls(folder.of(name).folder))
    return f"{strict}; {ANOTHER_AUTHORITY}" if strict else ""


def _warning(certificate: Certificate, now: datetime) -> str:
    left = certificate.not_valid_after_utc - now
    days = left // timedelta(days=1)
    return f"expires in {days} day{'s' * (days != 1)}" if left < SOON else ""
