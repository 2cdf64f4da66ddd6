"""Zenoh is not waited for without end, and what it opens too late is closed."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest
import zenoh

from zbridge.bus.zenoh import opening
from zbridge.errors import BusError


class HangingZenoh:
    """Opens nothing before it is told to; ``closed`` once the session that it opened then was closed."""

    def __init__(self) -> None:
        self.goes_on, self.closed = threading.Event(), threading.Event()

    def open(self, config: zenoh.Config) -> Any:
        self.goes_on.wait(10)
        return self

    def close(self) -> None:
        self.closed.set()


@pytest.fixture
def hanging(monkeypatch: pytest.MonkeyPatch) -> HangingZenoh:
    hanging = HangingZenoh()
    monkeypatch.setattr(zenoh, "open", hanging.open)
    return hanging


async def test_a_session_that_never_opens_is_an_error_and_one_that_opens_late_is_closed(
    hanging: HangingZenoh, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opening, "OPEN_S", 0.05)
    with pytest.raises(BusError, match=r"opened no session within 0\.05 s"):
        await opening.open_session(zenoh.Config())
    hanging.goes_on.set()
    assert await asyncio.to_thread(hanging.closed.wait, 5)


async def test_who_gives_up_waiting_leaves_no_session_open(hanging: HangingZenoh) -> None:
    opening_task = asyncio.create_task(opening.open_session(zenoh.Config()))
    await asyncio.sleep(0.02)
    opening_task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening_task
    hanging.goes_on.set()
    assert await asyncio.to_thread(hanging.closed.wait, 5)
