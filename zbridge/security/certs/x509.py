"""Makes and reads the keys and X.509 certificates of a secure bus. The time is an argument.

ECDSA on P-256. A certificate is for clients; one with hosts, which a server needs, is for both. Zenoh 1.10 (rustls)
demands that a router's certificate is for servers and names the host that clients connect to as a subject alternative
name (a common name is no host), and that a client's is for clients. By TLS Zenoh connects to no IPv6 address, only to a
name that has one.
"""

from __future__ import annotations

import ipaddress
import re
from datetime import datetime, timedelta
from pathlib import Path

import msgspec
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric.ec import (
    SECP256R1,
    EllipticCurvePrivateKey,
    EllipticCurvePublicKey,
    generate_private_key,
)
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from zbridge.errors import ConfigError
from zbridge.security.files import read, read_secret

EARLIER = timedelta(hours=1)
"""How long before its issue a certificate becomes valid: the clock of another machine may be slow."""

_LABEL = r"[a-z0-9_]([a-z0-9_-]{0,61}[a-z0-9_])?"
_HOST = re.compile(rf"(?=.{{1,253}}$){_LABEL}(\.{_LABEL})*")


class CertificateAuthority(msgspec.Struct, frozen=True):
    """An authority that can sign."""

    certificate: x509.Certificate
    key: EllipticCurvePrivateKey


def new_key() -> EllipticCurvePrivateKey:
    """Make a private key."""
    return generate_private_key(SECP256R1())


def new_authority(now: datetime, days: int) -> CertificateAuthority:
    """Make an authority for ``days`` days. Its name is unique: programs distinguish authorities by it."""
    key = new_key()
    number = x509.random_serial_number()
    name = _name(f"zbridge authority {number % 2**32:08x}")
    builder = _builder(name, name, key.public_key(), (now, days), number)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_usage(signs_certificates=True), critical=True)
    return CertificateAuthority(builder.sign(key, hashes.SHA256()), key)


def new_certificate(
    authority: CertificateAuthority,
    key: EllipticCurvePublicKey,
    common_name: str,
    hosts: tuple[str, ...],
    lifetime: tuple[datetime, int],
) -> x509.Certificate:
    """Sign a certificate for a key. lifetime: now, and the number of days. hosts: for a server certificate."""
    builder = _builder(_name(common_name), authority.certificate.subject, key, lifetime, x509.random_serial_number())
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key())
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if hosts else [])]
    builder = (
        builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        .add_extension(issuer, critical=False)
    )
    if hosts:
        builder = builder.add_extension(x509.SubjectAlternativeName([*map(_general_name, hosts)]), critical=False)
    return builder.sign(authority.key, hashes.SHA256())


def check_host(text: str) -> str:
    """Return a host in the form of a certificate; raise ConfigError if it is neither a name nor an IP address."""
    try:
        address = ipaddress.ip_address(text.removeprefix("[").removesuffix("]"))
    except ValueError:
        host = text.lower().removesuffix(".")
        if _HOST.fullmatch(host) and not re.fullmatch(r"[0-9.]+", host):
            return host
        raise ConfigError(f"--host {text!r}: expected a host name or an IP address, without a port") from None
    if address.is_unspecified:
        raise ConfigError(f"--host {text!r}: expected the address that clients connect to")
    return str(address)


def zenoh_accepts(host: str) -> bool:
    """Return whether Zenoh can connect to a host by TLS. It treats ``tls/[::1]:7447`` as a name, and rejects it."""
    return ":" not in host


def read_certificate(path: Path) -> x509.Certificate:
    """Read a certificate; raise ConfigError, which names the file."""
    try:
        return x509.load_pem_x509_certificate(read(path))
    except ValueError as error:
        raise ConfigError(f"{path}: not a certificate in PEM form") from error


def read_key(path: Path) -> EllipticCurvePrivateKey:
    """Read a private key; raise ConfigError, which names the file, also if others can read or write it."""
    try:
        key = load_pem_private_key(read_secret(path), password=None)
    except (ValueError, TypeError) as error:  # TypeError: a password protects the key
        raise ConfigError(f"{path}: not a private key in PEM form without a password") from error
    if not isinstance(key, EllipticCurvePrivateKey):
        raise ConfigError(f"{path}: not an ECDSA key")
    return key


def certificate_pem(certificate: x509.Certificate) -> bytes:
    """Write a certificate."""
    return certificate.public_bytes(Encoding.PEM)


def key_pem(key: EllipticCurvePrivateKey) -> bytes:
    """Write a private key, without a password."""
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def common_name_of(certificate: x509.Certificate) -> str:
    """Return the common name, which access rules use; empty if there is none."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def hosts_of(certificate: x509.Certificate) -> tuple[str, ...]:
    """Return the host names and IP addresses under which a server may use a certificate, in their order."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names if isinstance(name, x509.DNSName | x509.IPAddress))


def fingerprint(certificate: x509.Certificate) -> str:
    """Return the SHA-256 fingerprint as openssl prints it: ``3F:A2:...``."""
    return certificate.fingerprint(hashes.SHA256()).hex(":").upper()


def issued_by(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    """Return whether an authority has signed a certificate."""
    try:
        certificate.verify_directly_issued_by(authority)
    except (InvalidSignature, ValueError, TypeError):
        return False
    return True


def _builder(
    name: x509.Name,
    issuer: x509.Name,
    key: EllipticCurvePublicKey,
    lifetime: tuple[datetime, int],
    number: int,
) -> x509.CertificateBuilder:
    now, days = lifetime
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(number)
        .not_valid_before(now - EARLIER)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )
