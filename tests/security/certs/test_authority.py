"""Issuing, renewing and revoking: what the certificates say, what stands in the files, what is refused."""

from __future__ import annotations

import contextlib
import os
import shutil
import ssl
import stat
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import pytest
from cryptography import x509 as cx509
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, EllipticCurvePublicKey
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from tests.security.certs.lab import Lab
from zbridge.errors import ConfigError
from zbridge.security.certs import authority
from zbridge.security.files import changing
from zbridge.security.roles import OF_ROBOTS, ROLES, Member, Role, Roles, load_roles, save_roles

NO_CHECK_TIME = 0x200000  # OpenSSL's flag: the time of these tests stands still
CLIENT, SERVER = ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH

WRONG_REQUESTS = [
    ({"name": "a.b"}, "NAME = 'a.b': expected at most 48 letters"),
    ({"name": ".."}, "NAME = '..': expected at most 48 letters"),
    ({"name": "a/b"}, "NAME = 'a/b': expected at most 48 letters"),
    ({"role": "driver"}, "--role 'driver': expected one of viewer, operator, supervisor, gateway, hq, recorder"),
    ({"role": "gateway"}, "--robot = []: expected the robots of this gateway"),
    ({"robots": ("r1",)}, "--robot = ['r1']: expected none: the role viewer is for all robots"),
    ({"role": "hq", "robots": ("*",)}, "--robot = ['*']: '*': expected letters"),
    ({"role": "router"}, "--host []: expected every host name and IPv4 address"),
    ({"role": "router", "hosts": ("::1",)}, "--host ['::1']: expected every host name and IPv4 address"),
    ({"hosts": ("tls/lab:7447",)}, "--host 'tls/lab:7447': expected a host name or an IP address, without a port"),
    ({"hosts": ("*.lab",)}, "--host '*.lab': expected a host name"),
    ({"hosts": ("192.168.0.256",)}, "--host '192.168.0.256': expected a host name"),
    ({"hosts": ("",)}, "--host '': expected a host name"),
    ({"hosts": ("0.0.0.0",)}, "--host '0.0.0.0': expected the address that clients connect to"),
    ({"days": 0}, "--days 0: expected 1 to 3650: the authority expires on 2040-01-29"),
    ({"days": 3651}, "--days 3651: expected 1 to 3650"),
    ({"days": 10**12}, "--days 1000000000000: expected 1 to 3650"),
]


def mode(path: os.PathLike[str]) -> int:
    return stat.S_IMODE(os.stat(path).st_mode)


def usage(certificate: cx509.Certificate) -> set[cx509.ObjectIdentifier]:
    return set(certificate.extensions.get_extension_for_class(cx509.ExtendedKeyUsage).value)


def test_an_authority_signs_certificates_for_ten_years_and_nothing_below_them(lab: Lab) -> None:
    made = cx509.load_pem_x509_certificate(lab.folder.ca.read_bytes())
    assert made.not_valid_after_utc == lab.now + timedelta(days=3650)
    constraints = made.extensions.get_extension_for_class(cx509.BasicConstraints)
    assert (constraints.critical, constraints.value.ca, constraints.value.path_length) == (True, True, 0)
    assert made.extensions.get_extension_for_class(cx509.KeyUsage).value.key_cert_sign
    assert load_roles(lab.folder.roles) == Roles()


def extension(certificate: cx509.Certificate, kind: type[Any]) -> tuple[bool, Any]:
    found = certificate.extensions.get_extension_for_class(kind)
    return found.critical, found.value


@pytest.mark.parametrize(("role", "hosts"), [("router", ("localhost",)), ("viewer", ())])
def test_authority_and_certificates_have_the_extensions_that_strict_programs_demand(
    lab: Lab, role: Role, hosts: tuple[str, ...]
) -> None:
    ca = cx509.load_pem_x509_certificate(lab.folder.ca.read_bytes())
    critical, usages = extension(ca, cx509.KeyUsage)
    assert (critical, usages.key_cert_sign, usages.crl_sign) == (True, True, True)
    lab.issue("it", role, hosts=hosts)
    made = lab.certificate("it")
    for certificate in (ca, made):
        assert extension(certificate, cx509.BasicConstraints)[0], "critical"
        assert extension(certificate, cx509.KeyUsage)[0], "critical"
        own = cx509.SubjectKeyIdentifier.from_public_key(certificate.public_key())
        assert extension(certificate, cx509.SubjectKeyIdentifier) == (False, own)
    _, issuer = extension(made, cx509.AuthorityKeyIdentifier)
    assert issuer.key_identifier == extension(ca, cx509.SubjectKeyIdentifier)[1].digest
    assert certificate.version is ca.version is cx509.Version.v3


@pytest.mark.parametrize("router_is", ["server", "client"])
def test_a_strict_handshake_as_python_3_13_makes_it_succeeds_on_every_python(lab: Lab, router_is: str) -> None:
    lab.issue("hub", "router", hosts=("localhost", "127.0.0.1"))
    lab.issue("ann", hosts=("localhost",))
    names = ("hub", "ann") if router_is == "server" else ("ann", "hub")
    contexts = (ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.create_default_context())
    for context, name in zip(contexts, names, strict=True):
        context.verify_mode = ssl.CERT_REQUIRED
        context.verify_flags |= ssl.VERIFY_X509_STRICT | ssl.VERIFY_X509_PARTIAL_CHAIN | NO_CHECK_TIME
        context.load_verify_locations(lab.folder.ca)
        context.load_cert_chain(lab.folder.of(name).certificate, lab.folder.of(name).key)
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    server = contexts[0].wrap_bio(to_server, to_client, server_side=True)
    client = contexts[1].wrap_bio(to_client, to_server, server_hostname="localhost")
    for _ in range(3):
        for end in (client, server):
            with contextlib.suppress(ssl.SSLWantReadError):
                end.do_handshake()
    assert [dict(end.getpeercert()["subject"][0])["commonName"].split(".")[1] for end in (client, server)] == [*names]


def test_two_authorities_have_different_names(lab: Lab) -> None:
    first = lab.folder.ca.read_bytes()
    authority.init(lab.folder, lab.now, force=True)
    subjects = {cx509.load_pem_x509_certificate(pem).subject for pem in (first, lab.folder.ca.read_bytes())}
    assert len(subjects) == 2


@pytest.mark.parametrize("umask", [0o000, 0o077])
def test_keys_are_for_their_owner_alone_whatever_the_umask(lab: Lab, umask: int) -> None:
    before = os.umask(umask)
    try:
        authority.init(lab.folder, lab.now, force=True)
        lab.issue("ann")
    finally:
        os.umask(before)
    files = lab.folder.of("ann")
    assert [mode(path) for path in (lab.folder.ca_key, files.key)] == [0o600, 0o600]
    assert [mode(path) for path in (lab.folder.path, files.folder)] == [0o700, 0o700]
    assert [mode(path) for path in (lab.folder.ca, files.ca, files.certificate)] == [0o644] * 3


@pytest.mark.parametrize("role", ROLES)
def test_a_certificate_says_role_and_name_and_is_for_the_use_of_its_role(lab: Lab, role: Role) -> None:
    hosts = ("hub.lab", "192.168.0.2") if role == "router" else ()
    issued = lab.issue("it", role, *(("r1",) if role in OF_ROBOTS else ()), hosts=hosts)
    made = lab.certificate("it")
    assert made.subject.rfc4514_string() == f"CN={role}.it" == f"CN={issued.common_name}"
    assert usage(made) == ({CLIENT, SERVER} if role == "router" else {CLIENT})
    assert made.extensions.get_extension_for_class(cx509.BasicConstraints).value.ca is False
    key_usage = made.extensions.get_extension_for_class(cx509.KeyUsage).value
    assert (key_usage.digital_signature, key_usage.key_cert_sign) == (True, False)
    made.verify_directly_issued_by(cx509.load_pem_x509_certificate(lab.folder.ca.read_bytes()))


def test_a_certificate_is_of_p256_and_begins_an_hour_ago_and_lasts_the_days_asked_for(lab: Lab) -> None:
    issued = lab.issue("ann", days=7)
    made = lab.certificate("ann")
    key = made.public_key()
    assert isinstance(key, EllipticCurvePublicKey)
    assert isinstance(key.curve, SECP256R1)
    assert made.not_valid_before_utc == lab.now - timedelta(hours=1)
    assert made.not_valid_after_utc == issued.expires == lab.now + timedelta(days=7)


def test_hosts_stand_in_the_certificate_as_names_and_as_addresses_each_once(lab: Lab) -> None:
    lab.issue("hub", "router", hosts=("Hub.Lab.", "hub.lab", "192.168.0.2", "[fe80::1]", "my_host"))
    names = lab.certificate("hub").extensions.get_extension_for_class(cx509.SubjectAlternativeName).value
    assert names.get_values_for_type(cx509.DNSName) == ["hub.lab", "my_host"]
    assert [str(address) for address in names.get_values_for_type(cx509.IPAddress)] == ["192.168.0.2", "fe80::1"]


def test_any_certificate_with_hosts_is_a_servers_too(lab: Lab) -> None:
    lab.issue("r1", "gateway", "r1", hosts=("localhost",))
    assert usage(lab.certificate("r1")) == {CLIENT, SERVER}


def test_an_issued_name_stands_in_the_roles_beside_the_others(lab: Lab) -> None:
    lab.issue("ann")
    lab.issue("r1", "gateway", "r1", "r2")
    assert load_roles(lab.folder.roles) == Roles({"ann": Member("viewer"), "r1": Member("gateway", ("r1", "r2"))})


@pytest.mark.parametrize(("wrong", "error"), WRONG_REQUESTS)
def test_a_wrong_request_is_refused_and_changes_nothing(lab: Lab, wrong: dict[str, object], error: str) -> None:
    before = lab.content()
    fields = {"name": "it", "role": "viewer", "robots": (), "hosts": (), "days": 365, **wrong}
    with pytest.raises(ConfigError) as raised:
        lab.issue(fields["name"], fields["role"], *fields["robots"], hosts=fields["hosts"], days=fields["days"])
    assert error in str(raised.value)
    assert lab.content() == before


ALREADY: dict[str, Callable[[Lab], object]] = {
    "certs/ca.pem: exists already": lambda lab: authority.init(lab.folder, lab.now),
    "certs/ann/key.pem: exists already": lambda lab: lab.issue("ann", "operator"),
}


@pytest.mark.parametrize("error", ALREADY)
def test_nothing_is_overwritten_without_force(lab: Lab, error: str) -> None:
    lab.issue("ann")
    before = lab.content()
    with pytest.raises(ConfigError, match=error):
        ALREADY[error](lab)
    assert lab.content() == before


def test_a_name_that_stands_only_in_the_roles_is_not_overwritten_either(lab: Lab) -> None:
    save_roles(lab.folder.roles, Roles({"ann": Member("supervisor")}))
    with pytest.raises(ConfigError, match=r"roles\.toml: names\.ann: exists already"):
        lab.issue("ann")
    assert load_roles(lab.folder.roles).names["ann"].role == "supervisor"


def test_force_replaces_key_role_and_certificate_and_tells_how_long_the_old_one_lasts(lab: Lab) -> None:
    first = lab.issue("ann")
    key = lab.folder.of("ann").key.read_bytes()
    issued = lab.later(10).issue("ann", "operator", force=True)
    assert (issued.common_name, issued.replaced_until) == ("operator.ann", first.expires)
    assert lab.folder.of("ann").key.read_bytes() != key
    assert load_roles(lab.folder.roles).names == {"ann": Member("operator")}


def test_another_authority_keeps_the_roles_and_names_are_renewed_under_it(lab: Lab) -> None:
    lab.issue("ann")
    lab.issue("old")
    authority.revoke(lab.folder, "old")
    authority.init(lab.folder, lab.now, force=True)
    assert load_roles(lab.folder.roles) == Roles({"ann": Member("viewer")}, ("old",))
    authority.renew(lab.folder, "ann", lab.now)
    lab.certificate("ann").verify_directly_issued_by(cx509.load_pem_x509_certificate(lab.folder.ca.read_bytes()))
    assert lab.folder.of("ann").ca.read_bytes() == lab.folder.ca.read_bytes()


def test_renewing_keeps_key_and_hosts_and_tells_how_long_the_old_one_lasts(lab: Lab) -> None:
    first = lab.issue("hub", "router", hosts=("hub.lab", "192.168.0.2"))
    key, old = lab.folder.of("hub").key.read_bytes(), lab.certificate("hub")
    renewed = authority.renew(lab.folder, "hub", lab.now + timedelta(days=400), days=30)
    made = lab.certificate("hub")
    assert (renewed.replaced_until, renewed.expires) == (first.expires, lab.now + timedelta(days=430))
    assert lab.folder.of("hub").key.read_bytes() == key
    assert made.public_key() == old.public_key()
    assert made.serial_number != old.serial_number
    sans = [item.extensions.get_extension_for_class(cx509.SubjectAlternativeName).value for item in (made, old)]
    assert sans[0] == sans[1]
    assert usage(made) == {CLIENT, SERVER}


def test_renewing_takes_the_role_that_the_roles_say_now(lab: Lab) -> None:
    lab.issue("ann")
    save_roles(lab.folder.roles, Roles({"ann": Member("operator")}))
    authority.renew(lab.folder, "ann", lab.now)
    names = lab.certificate("ann").subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    assert [name.value for name in names] == ["operator.ann"]


def test_a_revoked_name_is_gone_and_is_neither_issued_nor_renewed_again(lab: Lab) -> None:
    issued = lab.issue("ann")
    gone = authority.revoke(lab.folder, "ann")
    assert (gone.common_name, gone.until, gone.server) == ("viewer.ann", issued.expires, False)
    assert load_roles(lab.folder.roles) == Roles({}, ("ann",))
    shutil.rmtree(lab.folder.of("ann").folder)
    for force in (False, True):
        with pytest.raises(ConfigError, match=r"roles\.toml: 'ann' is revoked; issue a new name"):
            lab.issue("ann", force=force)
    for again in (lambda: authority.renew(lab.folder, "ann", lab.now), lambda: authority.revoke(lab.folder, "ann")):
        with pytest.raises(ConfigError, match="'ann' is revoked"):
            again()
    assert not lab.folder.of("ann").folder.exists()


def test_revoking_a_server_says_so_with_its_files_and_without(lab: Lab) -> None:
    for name in ("hub", "hub2"):
        lab.issue(name, "router", hosts=("localhost",))
    assert authority.revoke(lab.folder, "hub").server
    shutil.rmtree(lab.folder.of("hub2").folder)
    gone = authority.revoke(lab.folder, "hub2")
    assert (gone.server, gone.until) == (True, None)


def test_a_name_with_a_spoiled_certificate_is_revoked_and_replaced_all_the_same(lab: Lab) -> None:
    for name in ("ann", "bob"):
        lab.issue(name)
        lab.folder.of(name).certificate.write_text("x")
    assert lab.issue("bob", force=True).replaced_until is None
    assert authority.revoke(lab.folder, "ann").until is None
    assert load_roles(lab.folder.roles).revoked == ("ann",)


def test_an_unknown_name_is_neither_renewed_nor_revoked(lab: Lab) -> None:
    lab.issue("ann")
    for act in (lambda: authority.renew(lab.folder, "bob", lab.now), lambda: authority.revoke(lab.folder, "bob")):
        with pytest.raises(ConfigError, match="'bob' is not a name of this bus; known: ann"):
            act()


def test_an_expired_authority_issues_and_renews_nothing(lab: Lab) -> None:
    lab.issue("ann")
    late = lab.later(3650)
    error = r"ca\.pem: the authority expired on 2040-01-29; `zbridge certs init --force` makes another"
    for act in (lambda: late.issue("bob"), lambda: authority.renew(late.folder, "ann", late.now)):
        with pytest.raises(ConfigError, match=error):
            act()


def test_the_last_certificate_ends_no_later_than_its_authority(lab: Lab) -> None:
    late = lab.later(3649)
    with pytest.raises(ConfigError, match="--days 2: expected 1 to 1: the authority expires on 2040-01-29"):
        late.issue("ann", days=2)
    assert late.issue("ann", days=1).expires == lab.now + timedelta(days=3650)


@pytest.mark.parametrize("bits", [0o640, 0o604, 0o620, 0o602, 0o610])
def test_keys_that_others_can_read_or_write_are_refused(lab: Lab, bits: int) -> None:
    lab.issue("ann")
    lab.folder.of("ann").key.chmod(bits)
    with pytest.raises(ConfigError, match=rf"ann/key\.pem: others can read or write this key \(mode {bits:04o}\)"):
        authority.renew(lab.folder, "ann", lab.now)
    lab.folder.ca_key.chmod(bits)
    with pytest.raises(ConfigError, match=r"ca-key\.pem: others can read or write this key"):
        lab.issue("bob")


SPOILED: dict[str, tuple[Callable[[Lab], object], str]] = {
    "the key of another": (
        lambda lab: shutil.copy(lab.folder.of("bob").key, lab.folder.of("ann").key),
        r"ann/key\.pem: not the key of the certificate 'viewer\.ann'",
    ),
    "a key that is none": (lambda lab: lab.folder.of("ann").key.write_text("x"), r"ann/key\.pem: not a private key"),
    "no key": (lambda lab: lab.folder.of("ann").key.unlink(), r"ann/key\.pem: No such file"),
    "a certificate that is none": (
        lambda lab: lab.folder.of("ann").certificate.write_text("x"),
        r"ann/certificate\.pem: not a certificate in PEM form",
    ),
    "the key of another authority": (
        lambda lab: shutil.copy(lab.folder.of("ann").key, lab.folder.ca_key),
        r"ca-key\.pem: not the key of the certificate 'zbridge authority",
    ),
    "no authority": (lambda lab: lab.folder.ca.unlink(), r"ca\.pem: No such file"),
}


@pytest.mark.parametrize("what", SPOILED)
def test_spoiled_files_are_named(lab: Lab, what: str) -> None:
    spoil, error = SPOILED[what]
    lab.issue("ann")
    lab.issue("bob")
    spoil(lab)
    with pytest.raises(ConfigError, match=error):
        authority.renew(lab.folder, "ann", lab.now)


def test_a_folder_without_an_authority_is_told(lab: Lab) -> None:
    shutil.rmtree(lab.folder.path)
    with pytest.raises(ConfigError, match="certs: No such file or directory: expected the folder of"):
        lab.issue("ann")


def test_two_programs_do_not_change_the_folder_at_once(lab: Lab) -> None:
    with changing(lab.folder), pytest.raises(ConfigError, match="another program issues or revokes here now"):
        lab.issue("ann")
    lab.issue("ann")
