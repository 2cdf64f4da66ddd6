"""The list: every name, what is wrong with its files, and the revoked names."""

from __future__ import annotations

import shutil
from collections.abc import Callable

import pytest
from cryptography.hazmat.primitives import hashes

from tests.security.certs.lab import Lab
from zbridge.errors import ConfigError
from zbridge.security.certs import authority
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


def test_the_list_needs_no_key_of_the_authority(lab: Lab) -> None:
    lab.issue("ann")
    lab.folder.ca_key.unlink()
    assert entry(lab, "ann").problem == ""


def test_a_folder_without_an_authority_is_told(lab: Lab) -> None:
    lab.folder.ca.write_text("x")
    with pytest.raises(ConfigError, match=r"ca\.pem: not a certificate in PEM form"):
        list_names(lab.folder, lab.now)
