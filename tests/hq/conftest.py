"""Scenes accept their links by hand."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from tests.clock import scene_of
from tests.hq.scene import SCENES, Scene, serving
from zbridge.hq import listener as listeners
from zbridge.protocol.address import Address
from zbridge.transport.link import Receiver


@pytest.fixture(autouse=True)
def by_hand(monkeypatch: pytest.MonkeyPatch) -> list[Scene]:
    """Let scenes accept links by hand."""
    scenes: list[Scene] = []

    @contextlib.asynccontextmanager
    async def listen(address: Address, receiver: Callable[[], Receiver], **kwargs: Any) -> AsyncIterator[Address]:
        scenes[-1].accept = receiver
        yield Address(address.host, 11002)

    monkeypatch.setattr(listeners, "listen", listen)
    SCENES.append(scenes)
    return scenes


scene = scene_of(serving)
