"""The files of one member of a secure bus: checks them, and reads a folder with them and its endpoints.

``zbridge certs bundle`` makes such a folder: ``ca.pem``, ``certificate.pem``, ``key.pem``, and ``bus.toml``, whose
``[bus]`` table names the routers.
"""

from __future__ import annotations

import contextlib
import ssl
import tomllib
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec

from zbridge.bus.interface import BusSettings, Tls
from zbridge.bus.tls.certificate import Certificate, read_certificate
from zbridge.errors import ConfigError

WARN = timedelta(days=30)
"""How long before a certificate expires there is a warning."""
TLS_VARIABLE = "ZBRIDGE_TLS"
"""The environment variable that names a folder if no option does."""
ANOTHER_AUTHORITY = "`zbridge certs init --force`, then `zbridge certs renew --all`"
"""What to do about an authority that is not good."""
_NO_CHECK_TIME = 0x200000
"""OpenSSL's flag: a chain is checked without its dates."""
_FLIGHTS = 10
"""Most rounds of a handshake in memory."""


def folder_tls(folder: Path) -> Tls:
    """Return the files of a folder made by ``zbridge certs bundle``."""
    return Tls(str(folder / "ca.pem"), str(folder / "certificate.pem"), str(folder / "key.pem"))


def tls_beside(tls: Tls, folder: Path) -> Tls:
    """Resolve relative paths against a folder: that of the configuration which names them."""
    ca, certificate, key = (name and str(folder / name) for name in (tls.ca, tls.certificate, tls.key))
    return Tls(ca or tls.ca, certificate, key)


def folder_settings(folder: Path, endpoints: Sequence[str] = ()) -> BusSettings:
    """Return the bus settings for a folder: these endpoints, else those of its ``bus.toml``.

    Raises ConfigError if there is no such folder, or neither names a router.
    """
    if not folder.is_dir():
        raise ConfigError(f"--tls {folder}: no such folder; expected one as `zbridge certs bundle` makes it")
    return BusSettings(
        mode="client", multicast=False, connect=tuple(endpoints) or _routers(folder), tls=folder_tls(folder)
    )


def _routers(folder: Path) -> tuple[str, ...]:
    file = folder / "bus.toml"
    try:
        bus = tomllib.loads(file.read_text(encoding="utf-8"))["bus"]
        return msgspec.convert(bus["connect"], tuple[str, ...])
    except FileNotFoundError:
        raise ConfigError(f"--tls {folder}: no bus.toml there; give --connect tls/HOST:7447") from None
    except OSError as error:
        raise ConfigError(f"{file}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError, msgspec.ValidationError) as error:
        raise ConfigError(f'{file}: expected a [bus] table with connect = ["tls/HOST:7447"]') from error


def own_certificate(tls: Tls | None) -> Certificate | None:
    """Return the certificate of these settings; None if there is none; raise ConfigError."""
    return read_certificate(Path(tls.certificate)) if tls is not None and tls.certificate is not None else None


def own_name(tls: Tls | None) -> str | None:
    """Return the name in the common name ``role.name`` of our certificate, to which the router binds keys.

    None if there is none of this form. Raises ConfigError if the certificate cannot be read.
    """
    certificate = own_certificate(tls)
    return (certificate.name or None) if certificate is not None else None


def own_role(tls: Tls | None) -> str | None:
    """Return the role in that common name, as :func:`own_name` does."""
    certificate = own_certificate(tls)
    return (certificate.role or None) if certificate is not None else None


def unusable(tls: Tls) -> str | None:
    """Return why these files allow no connection, whatever the time is; None if they do."""
    try:
        read_certificate(Path(tls.ca))
        if own_certificate(tls) is None or tls.key is None:
            return None if tls.certificate is tls.key is None else "certificate and key: expected both, or neither"
        client_context(tls)
    except ConfigError as error:
        return str(error)
    return None


def out_of_date(certificate: Certificate, now: datetime) -> str | None:
    """Return why a certificate is not valid now; None if it is."""
    if certificate.ends <= now:
        renew = f"; `zbridge certs renew {certificate.name}`" if certificate.name else ""
        return f"the certificate of {certificate.common_name} expired on {certificate.ends:%Y-%m-%d %H:%M} UTC{renew}"
    if certificate.begins > now:
        return (
            f"the certificate of {certificate.common_name} is not valid before {certificate.begins:%Y-%m-%d %H:%M} UTC:"
            " is the clock of this machine wrong?"
        )
    return None


def ends_soon(certificate: Certificate, now: datetime) -> str | None:
    """Warn of a certificate that ends within :data:`WARN`; None if it is valid for longer."""
    if now < certificate.ends - WARN:
        return None
    return out_of_date(certificate, now) or (
        f"the certificate of {certificate.common_name} ends on {certificate.ends:%Y-%m-%d}: renew it"
        f" (`zbridge certs renew {certificate.name}`) and restart"
    )


def utc_now() -> datetime:
    """Return the time by the clock of this machine."""
    return datetime.now(UTC)


def client_context(tls: Tls) -> ssl.SSLContext:
    """Return the TLS context of a client with these files; raise ConfigError, which names the file."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.hostname_checks_common_name = False  # nor does Zenoh
    _load_authority(context, tls)
    _load_own(context, tls)
    return context


def is_of_authority(tls: Tls) -> bool:
    """Return whether the authority has signed the certificate, whatever the time is, by a handshake in memory."""
    return _chain_fault(tls) is None


def not_strict(tls: Tls) -> str | None:
    """Return why programs that verify strictly refuse certificates of the authority; None if they do not.

    Python does by default, from 3.13 on. Zenoh and zbridge do not: a bus works with such an authority. The remedy is
    :data:`ANOTHER_AUTHORITY`. Expects usable files. Returns None also for a certificate of another authority.
    """
    if not is_of_authority(tls):
        return None
    fault = _chain_fault(tls, ssl.VERIFY_X509_STRICT)
    return fault and f"Python 3.13 and other strict programs refuse certificates of this authority: {fault}"


def _chain_fault(tls: Tls, flags: int = 0) -> str | None:
    """Return why a server with the authority refuses the certificate, whatever the time is; None if it does not."""
    server, client = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    client.check_hostname, client.verify_mode = False, ssl.CERT_NONE
    server.verify_mode = ssl.CERT_REQUIRED
    server.verify_flags |= _NO_CHECK_TIME | flags
    _load_authority(server, tls)
    for context in (server, client):
        _load_own(context, tls)
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (client.wrap_bio(to_client, to_server), server.wrap_bio(to_server, to_client, server_side=True))
    try:
        for _ in range(_FLIGHTS):
            for end in ends:
                with contextlib.suppress(ssl.SSLWantReadError):
                    end.do_handshake()
    except ssl.SSLCertVerificationError as error:
        return error.verify_message
    except ssl.SSLError as error:
        return error.reason or str(error)
    return None if ends[1].getpeercert() is not None else "no certificate was shown"


def _load_authority(context: ssl.SSLContext, tls: Tls) -> None:
    try:
        context.load_verify_locations(tls.ca)
    except (OSError, ssl.SSLError) as error:
        raise ConfigError(f"{tls.ca}: not a certificate in PEM form") from error


def _load_own(context: ssl.SSLContext, tls: Tls) -> None:
    if tls.certificate is None or tls.key is None:
        return
    try:
        context.load_cert_chain(tls.certificate, tls.key, password=lambda: "")  # never prompt on the terminal
    except ssl.SSLError as error:
        if error.reason in ("KEY_VALUES_MISMATCH", "KEY_TYPE_MISMATCH"):
            raise ConfigError(f"{tls.key}: not the key of the certificate {tls.certificate}") from error
        raise ConfigError(f"{tls.key}: not a private key in PEM form without a password") from error
    except OSError as error:
        raise ConfigError(f"{tls.key}: {error.strerror or error}") from error
