"""An authority at one moment, with what its tests ask of it."""

from __future__ import annotations

from datetime import datetime, timedelta

import msgspec
from cryptography.x509 import Certificate, load_pem_x509_certificate

from zbridge.security.certs import authority
from zbridge.security.certs.authority import CertificateRequest, Issued
from zbridge.security.files import Folder
from zbridge.security.roles import Member, Role


class Lab(msgspec.Struct, frozen=True):
    folder: Folder
    now: datetime

    def issue(
        self,
        name: str,
        role: Role = "viewer",
        *robots: str,
        hosts: tuple[str, ...] = (),
        days: int = 365,
        force: bool = False,
    ) -> Issued:
        request = CertificateRequest(name, Member(role, robots), hosts, days)
        return authority.issue(self.folder, request, self.now, force=force)

    def later(self, days: float) -> Lab:
        return Lab(self.folder, self.now + timedelta(days=days))

    def certificate(self, name: str) -> Certificate:
        return load_pem_x509_certificate(self.folder.of(name).certificate.read_bytes())

    def content(self) -> dict[str, bytes]:
        """Every file of the folder, to see what an attempt has changed."""
        paths = sorted(path for path in self.folder.path.rglob("*") if path.is_file())
        return {str(path.relative_to(self.folder.path)): path.read_bytes() for path in paths}
