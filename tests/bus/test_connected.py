"""Whether a session is connected, as events and Zenoh's list of connections tell it, in whatever order."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from zbridge.bus.zenoh.connected import POLL_S, ConnectedWatch

pytestmark = pytest.mark.jumping

MADE, GONE = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE


class Info:
    """What Zenoh knows of a session's connections: ``zids`` of the list; events come as a test says."""

    def __init__(self) -> None:
        self.zids: list[str] = []
        self.tell: Any = None

    def transports(self) -> list[Any]:
        return [SimpleNamespace(zid=zid) for zid in self.zids]

    def declare_transport_events_listener(self, callback: Any, history: bool) -> Any:
        assert history
        self.tell = callback.callback
        return SimpleNamespace(undeclare=lambda: None)

    def event(self, kind: zenoh.SampleKind, zid: str) -> None:
        self.tell(SimpleNamespace(kind=kind, transport=SimpleNamespace(zid=zid)))


@pytest.mark.parametrize(
    ("events", "list_then", "list_later", "told"),
    [
        pytest.param([(MADE, "a")], "a", "a", [True], id="made"),
        pytest.param([(MADE, "a"), (GONE, "a")], "a", "", [True, False], id="gone, and still on the list"),
        pytest.param([(MADE, "a"), (GONE, "a"), (GONE, "b")], "ab", "", [True, False], id="two gone, both on the list"),
        pytest.param([(MADE, "a"), (GONE, "b")], "ab", "a", [True], id="one of two gone"),
        pytest.param([(MADE, "a"), (GONE, "a"), (MADE, "a")], "a", "a", [True, False, True], id="back soon"),
        pytest.param([(MADE, "a"), (GONE, "a")], "a", "a", [True, False, True], id="back before the old one ended"),
    ],
)
async def test_the_last_word_is_what_is_true(
    events: list[tuple[zenoh.SampleKind, str]], list_then: str, list_later: str, told: list[bool]
) -> None:
    info, heard = Info(), list[bool]()
    ConnectedWatch(info, asyncio.get_running_loop(), heard.append)
    info.zids = [*list_then]
    for kind, zid in events:
        info.event(kind, zid)
    info.zids = [*list_later]
    await asyncio.sleep(2 * max(POLL_S))
    assert heard == told


async def test_a_list_that_is_late_is_looked_at_again() -> None:
    info, heard = Info(), list[bool]()
    ConnectedWatch(info, asyncio.get_running_loop(), heard.append)
    info.zids = ["a", "b"]
    for kind, zid in ((MADE, "a"), (MADE, "b"), (GONE, "a"), (GONE, "b")):
        info.event(kind, zid)
    await asyncio.sleep(1.5)
    info.zids = []
    await asyncio.sleep(1.0)
    assert heard == [True, False]
    info.event(MADE, "c")
    await asyncio.sleep(0)
    assert heard == [True, False, True]


async def test_who_closed_the_watch_hears_no_more() -> None:
    info, heard = Info(), list[bool]()
    watch = ConnectedWatch(info, asyncio.get_running_loop(), heard.append)
    info.event(MADE, "a")
    await asyncio.sleep(0)
    info.event(GONE, "a")
    watch.close()
    await asyncio.sleep(2 * max(POLL_S))
    assert heard == [True]
