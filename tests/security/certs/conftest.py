"""An authority in a temporary folder; its time stands still."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from tests.security.certs.lab import Lab
from zbridge.security.certs import authority
from zbridge.security.files import Folder


@pytest.fixture(autouse=True)
def no_power_cuts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not wait for the disk; each wait takes some 20 ms."""
    monkeypatch.setattr("os.fsync", lambda descriptor: None)


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    """An authority that has issued nothing yet."""
    made = Lab(Folder(tmp_path / "certs"), datetime(2030, 1, 31, 12, tzinfo=UTC))
    authority.init(made.folder, made.now)
    return made
