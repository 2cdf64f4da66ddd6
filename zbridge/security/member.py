"""Checks a gateway's certificate before it is used: errors, and warnings.

Contacts no router, and does not need the package ``cryptography``.
"""

from __future__ import annotations

from pathlib import Path

from zbridge.app.config import GatewayPlan
from zbridge.bus import Tls
from zbridge.bus.tls.certificate import Certificate
from zbridge.bus.tls.files import is_of_authority, own_certificate, unusable
from zbridge.errors import ConfigError
from zbridge.security.files import read_secret
from zbridge.security.roles import ROLES


def check_member(plan: GatewayPlan) -> Certificate | None:
    """Return the certificate of a gateway's bus, None without one; raise ConfigError for permanent faults.

    These are: files that are missing, do not match, or can be read by others, and a role that does not fit.
    """
    tls = plan.config.bus.tls
    if tls is None:
        return None
    if tls.certificate is None or tls.key is None:
        raise ConfigError("bus.tls: expected ca, certificate and key: a secure bus knows everybody by a certificate")
    certificate = own_certificate(tls)
    read_secret(Path(tls.key))
    if problem := unusable(tls):
        raise ConfigError(problem)
    if not is_of_authority(tls):
        raise ConfigError(f"{tls.certificate}: issued by another authority than {tls.ca}")
    assert certificate is not None
    _check_role(plan, tls, certificate)
    return certificate


def not_checked(plan: GatewayPlan, certificate: Certificate) -> str:
    """Return a note about what only the router can check."""
    what = "serve" if plan.device is not None else "serve HQ programs of"
    return (
        f"not checked: whether the router knows {certificate.common_name} and lets it {what} {plan.config.robot.name}"
    )


def _check_role(plan: GatewayPlan, tls: Tls, certificate: Certificate) -> None:
    needed = "gateway" if plan.device is not None else "hq"
    if certificate.role == needed or certificate.role not in ROLES:  # not ours: its rules are its owner's
        return
    if plan.device is None and certificate.role == "gateway":  # one with listeners has the permissions of an hq
        return
    part = "[device]" if plan.device is not None else "[[hq]] and no [device]"
    raise ConfigError(
        f"{tls.certificate}: the certificate of {certificate.common_name}: expected the role {needed} for a file with"
        f" {part}"
    )
