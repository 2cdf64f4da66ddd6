"""The list: every name, what is wrong with its files, and the revoked names."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from datetime import datetime, timedelta

import pytest
from cryptography import x509 as cx509
from cryptography.hazmat.primitives import hashes
from cryptography.x509.oid import NameOID

from tests.security.certs.lab import Lab
from zbridge.errors import ConfigError
from zbridge.security.certs import authority, x509
from zbridge.security.certs.authority import ListedCertificate, list_names
from zbridge.security.roles import Member, Roles, save_roles


def entry(lab: Lab, name: str) -> ListedCertificate:
    return next(entry for entry in list_names(lab.folder, lab.now) if entry.name == name)


def test_the_list_tells_role_robots_hosts_expiry_and_fingerprint(lab: Lab) -> None:
    issued = lab.issue("r1", "gateway", "r1", "r2")
    lab.issue("hub", "router", hosts=("hub.lab", "192.168.0.2"))
    fingerprint = lab.certificate("r1").fingerprint(hashes.SHA256())
    assert entry(lab, "r1") == ListedCertificate(
        "r1", "gateway", ("r1", "r2"), (), issued.expires, ":".join(f"{byte:02X}" for byte in fingerprint)
    )
    assert entry(lab, "hub").hosts == ("hub.lab", "192.168.0.2")


def test_revoked_names_end_the_list(lab: Lab) -> None:
    for name in ("ann", "bob"):
        lab.issue(name)
    authority.revoke(lab.folder, "ann")
    assert [(entry.name, entry.problem) for entry in list_names(lab.folder, lab.now)] == [
        ("bob", ""),
        ("ann", "revoked"),
    ]


PROBLEMS: dict[str, Callable[[Lab], object]] = {
    "issued by another authority": lambda lab: authority.init(lab.folder, lab.now, force=True),
    "issued as viewer.ann, but roles.toml says operator.ann": lambda lab: save_roles(
        lab.folder.roles, Roles({"ann": Member("operator")})
    ),
    "others can read or write this key (mode 0644)": lambda lab: lab.folder.of("ann").key.chmod(0o644),
    "certificate.pem: No such file or directory": lambda lab: shutil.rmtree(lab.folder.of("ann").folder),
}


@pytest.mark.parametrize("problem", PROBLEMS)
def test_what_is_wrong_with_a_name_is_told(lab: Lab, problem: str) -> None:
    lab.issue("ann")
    assert entry(lab, "ann").problem == ""
    PROBLEMS[problem](lab)
    assert problem in entry(lab, "ann").problem


AGES = [
    (-1, "not valid before 2030-01-31 11:00 UTC"),
    (0, ""),
    (335, ""),
    (335.5, "expires in 29 days"),
    (363.5, "expires in 1 day"),
    (364.5, "expires in 0 days"),
    (365, "expired on 2031-01-31"),
]


@pytest.mark.parametrize(("days", "problem"), AGES)
def test_the_age_of_a_certificate_is_told(lab: Lab, days: float, problem: str) -> None:
    lab.issue("ann")
    assert entry(lab.later(days), "ann").problem == problem


def test_an_authority_that_strict_programs_refuse_is_told_with_the_remedy_which_helps(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(x509, "new_authority", without_key_usage)
        authority.init(lab.folder, lab.now, force=True)
    lab.issue("ann")
    assert entry(lab, "ann").problem == (
        "Python 3.13 and other strict programs refuse certificates of this authority: CA cert does not include key"
        " usage extension; `zbridge certs init --force`, then `zbridge certs renew --all`"
    )
    authority.init(lab.folder, lab.now, force=True)
    authority.renew(lab.folder, "ann", lab.now)
    assert entry(lab, "ann").problem == ""


def without_key_usage(now: datetime, days: int) -> x509.CertificateAuthority:
    key, name = x509.new_key(), cx509.Name([cx509.NameAttribute(NameOID.COMMON_NAME, "old")])
    builder = cx509.CertificateBuilder(name, name, key.public_key(), 7, now, now + timedelta(days=days))
    constraints = cx509.BasicConstraints(ca=True, path_length=None)
    identifier = cx509.SubjectKeyIdentifier.from_public_key(key.public_key())
    builder = builder.add_extension(constraints, critical=True).add_extension(identifier, critical=False)
    return x509.CertificateAuthority(builder.sign(key, hashes.SHA256()), key)


def test_the_list_needs_no_key_of_the_authority(lab: Lab) -> None:
    lab.issue("ann")
    lab.folder.ca_key.unlink()
    assert entry(lab, "ann").problem == ""


def test_a_folder_without_an_authority_is_told(lab: Lab) -> None:
    lab.folder.ca.write_text("x")
    with pytest.raises(ConfigError, match=r"ca\.pem: not a certificate in PEM form"):
        list_names(lab.folder, lab.now)
