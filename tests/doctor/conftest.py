"""The bus that doctor joins in these tests."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from tests.fake_bus import FakeBus
from zbridge.bus import BusSettings
from zbridge.doctor import bus as on_bus


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> FakeBus:
    bus = FakeBus()

    @asynccontextmanager
    async def joined(settings: BusSettings, realm: str) -> AsyncIterator[FakeBus]:
        yield bus.join("doctor")

    monkeypatch.setattr(on_bus, "joined", joined)
    return bus
