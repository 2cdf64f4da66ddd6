"""Certificates for tests, made with ``openssl``: an authority, members, and members that are wrong in one way."""

from __future__ import annotations

import subprocess
from pathlib import Path

ALTERNATIVE = "subjectAltName=DNS:localhost,IP:127.0.0.1"
_SIGNS = ("-addext", "keyUsage=critical,keyCertSign,cRLSign")
"""Without it Python 3.13 refuses an authority (``ssl.VERIFY_X509_STRICT``)."""
_KEY = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")


def openssl(*arguments: str) -> None:
    subprocess.run(["openssl", *arguments], check=True, capture_output=True)


class Authority:
    """A certificate authority in a folder. strict: with the extensions that strict programs demand."""

    def __init__(self, folder: Path, name: str = "lab", *, strict: bool = True) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        self.ca, self._key = folder / "ca.pem", folder / "ca.key"
        openssl(
            *("req", "-x509", *_KEY, "-days", "30", "-subj", f"/CN={name}"),
            *(*(_SIGNS if strict else ()), "-keyout", str(self._key), "-out", str(self.ca)),
        )

    def issue(self, common_name: str, *, days: int = 5) -> Path:
        """Give a folder with ``ca.pem``, ``certificate.pem`` and ``key.pem``, as ``zbridge certs bundle`` makes it."""
        folder = self.folder / common_name
        folder.mkdir()
        (folder / "ca.pem").write_bytes(self.ca.read_bytes())
        openssl(
            *("req", "-x509", *_KEY, "-days", str(days), "-subj", f"/CN={common_name}", "-addext", ALTERNATIVE),
            *("-addext", "basicConstraints=critical,CA:FALSE", "-CA", str(self.ca), "-CAkey", str(self._key)),
            *("-keyout", str(folder / "key.pem"), "-out", str(folder / "certificate.pem")),
        )
        return folder
