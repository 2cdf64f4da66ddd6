"""Keys and certificates in their files: read back, and checked against each other. Errors name the file."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
from cryptography.x509 import Certificate

from zbridge.errors import ConfigError
from zbridge.security.certs import x509
from zbridge.security.certs.files import Folder, read, read_secret


def load_certificate(path: Path) -> Certificate:
    """Read a certificate; raise ConfigError."""
    content = read(path)
    try:
        return x509.read_certificate(content)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def load_authority(folder: Folder, now: datetime) -> x509.Authority:
    """Read the authority; raise ConfigError also if it has expired or its key is not its own."""
    certificate = load_certificate(folder.ca)
    if certificate.not_valid_after_utc <= now:
        raise ConfigError(
            f"{folder.ca}: the authority expired on {certificate.not_valid_after_utc:%Y-%m-%d}; `zbridge certs init"
            " --force` makes another, and every name then needs `zbridge certs renew`"
        )
    return x509.Authority(certificate, _matching_key(folder.ca_key, certificate))


def load_name(folder: Folder, name: str) -> tuple[EllipticCurvePrivateKey, Certificate]:
    """Read key and certificate of a name; raise ConfigError also if they do not match or others can read the key."""
    files = folder.of(name)
    certificate = load_certificate(files.certificate)
    return _matching_key(files.key, certificate), certificate


def fault(certificate: Certificate, authority: Certificate, expected: str, now: datetime) -> str:
    """Say why a certificate would be refused, or be nobody's; empty: it would not. expected: its common name."""
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
    content = read_secret(path)
    try:
        key = x509.read_key(content)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    if not x509.belongs_to(certificate, key):
        raise ConfigError(f"{path}: not the key of the certificate {x509.common_name_of(certificate)!r} beside it")
    return key
