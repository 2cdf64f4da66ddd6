"""The name and role of this process on a secure bus: what its certificate says. The router binds keys to them."""

from __future__ import annotations

from pathlib import Path

from zbridge.bus.interface import Tls
from zbridge.bus.tls.certificate import read_certificate


def own_name(tls: Tls | None) -> str | None:
    """Return the name in the common name ``role.name`` of our certificate; None where there is none of this form.

    Raises ConfigError if the certificate cannot be read.
    """
    if tls is None or tls.certificate is None:
        return None
    return read_certificate(Path(tls.certificate)).name or None


def own_role(tls: Tls | None) -> str | None:
    """Return the role in the common name ``role.name`` of our certificate; None where there is none of this form.

    Raises ConfigError if the certificate cannot be read.
    """
    if tls is None or tls.certificate is None:
        return None
    return read_certificate(Path(tls.certificate)).role or None
