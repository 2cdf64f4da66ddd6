"""A robot that pages look at: of each key the newest, nothing beyond the bounds, and nothing once nobody looks."""

from __future__ import annotations

import asyncio
from typing import Any

import msgpack
import pytest

from tests.client import subscriptions
from tests.fake_bus import FakeBus
from zbridge.bus import IncomingQuery
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Pose, Text
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.metrics import Metrics
from zbridge.views.console import robot_watch
from zbridge.views.console.robot_watch import KEYS, TEXT_BYTES, TEXTS, RobotWatch, RobotWatches


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


class Scene:
    def __init__(self) -> None:
        self.network, self.clock = FakeBus(), Clock()
        self.metrics, keys = Metrics(), KeySpace("fleet", "r1")
        self.watch = RobotWatch(self.network.join("console"), keys, lambda: b"\x90", self.metrics, self.clock)

    def put(self, path: str, payload: bytes, robot: str = "r1") -> None:
        topic = topics.find(path) or Topic(path, Pose, topics.Delivery.STREAM)
        self.network.publisher(f"fleet/{robot}/{path}", topic).put(payload)

    def news(self, since: int = 0) -> tuple[int, dict[str, list[tuple[float, float, bytes]]]]:
        """Give the number of the newest message, and by path what is newer."""
        number, payload = self.watch.news(since)
        found: dict[str, list[tuple[float, float, bytes]]] = {}
        for path, came, period, content in msgpack.unpackb(payload)["news"] if payload else ():
            found.setdefault(path, []).append((came, period, content))
        return number, found


@pytest.fixture
async def scene() -> Any:
    made = Scene()
    made.watch.open()
    await asyncio.sleep(0)
    yield made
    made.watch.close()


def pose(x: float) -> bytes:
    return payloads.encode(Pose(x, 0.0, 0.0))


async def test_of_each_key_the_newest_message_is_news_once(scene: Scene) -> None:
    for x in (1.0, 2.0):
        scene.put("pose", pose(x))
    scene.put("sensor/front", b"\x80")
    number, news = scene.news()
    assert [content for _, _, content in news["pose"]] == [pose(2.0)]
    assert "sensor/front" in news
    assert scene.news(number) == (number, {})
    scene.put("pose", pose(3.0))
    assert [content for _, _, content in scene.news(number)[1]["pose"]] == [pose(3.0)]
    assert "sensor/front" not in scene.news(number)[1]


async def test_a_pause_of_a_key_is_not_its_period_from_then_on(scene: Scene) -> None:
    for pause in (0.1, 0.1, 60.0, 0.1):
        scene.put("pose", pose(0.0))
        scene.clock.now += pause
    scene.put("pose", pose(0.0))
    assert scene.news()[1]["pose"][0][1] == pytest.approx(0.1)


async def test_a_message_has_its_time_and_the_median_of_the_last_periods(scene: Scene) -> None:
    scene.put("pose", pose(0.0))
    assert scene.news()[1]["pose"][0][:2] == (100.0, 0.0)
    for _ in range(20):
        scene.clock.now += 0.1
        scene.put("pose", pose(0.0))
    ((came, period, _),) = scene.news()[1]["pose"]
    assert (came, period) == (pytest.approx(102.0), pytest.approx(0.1))


async def test_last_states_are_there_at_once_and_other_robots_are_not() -> None:
    scene = Scene()
    scene.put("map", b"map")
    scene.put("map", b"other", robot="r2")
    scene.put("@gateway/stats", b"stats")
    scene.watch.open()
    news = scene.news()[1]
    assert [content for _, _, content in news["map"]] == [b"map"]
    assert [content for _, _, content in news["@gateway/stats"]] == [b"stats"]
    scene.watch.close()


async def test_texts_are_all_kept_up_to_their_bounds(scene: Scene) -> None:
    for number in range(TEXTS + 10):
        scene.put("text", payloads.encode(Text(str(number))))
    number, news = scene.news()
    told = [msgpack.unpackb(content)["text"] for _, _, content in news["text"]]
    assert told == [str(number) for number in range(10, TEXTS + 10)]
    scene.put("text", payloads.encode(Text("x" * 10_000)))
    assert len(scene.news(number)[1]["text"]) == 1
    for _ in range(2 * TEXT_BYTES // 10_000):
        scene.put("text", payloads.encode(Text("x" * 10_000)))
    kept = scene.news()[1]["text"]
    assert TEXT_BYTES - 11_000 < sum(len(content) for _, _, content in kept) <= TEXT_BYTES


async def test_no_more_keys_are_kept_than_fit_and_the_rest_is_counted(scene: Scene) -> None:
    for number in range(KEYS + 5):
        scene.put(f"sensor/s{number}", b"\x80")
    assert len(scene.news()[1]) == KEYS
    assert scene.metrics.total("console_keys_left_out") >= 5
    scene.put("sensor/s0", b"\x81")
    assert scene.news()[1]["sensor/s0"][0][2] == b"\x81"


async def test_the_sessions_of_its_processes_are_queried_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_watch, "SESSIONS_EVERY_S", 0.01)
    scene = Scene()
    queries: list[IncomingQuery] = []

    def answer(query: IncomingQuery) -> None:
        queries.append(query)
        query.answer(b"table")

    scene.network.answer("fleet/r1/@rpc/sessions/gateway", answer)
    scene.watch.open()
    async with asyncio.timeout(5):
        while len(queries) < 3:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
    ((_, _, content),) = scene.news()[1]["@sessions"]
    assert msgpack.unpackb(content) == {"gateway": b"table"}
    scene.watch.close()
    await asyncio.sleep(0.05)
    count = len(queries)
    await asyncio.sleep(0.05)
    assert len(queries) == count


async def test_a_robot_is_subscribed_to_while_a_page_looks_at_it_and_no_longer() -> None:
    network = FakeBus()
    watches = RobotWatches(network.join("console"), "fleet", lambda robot: b"\x90", Metrics())
    one, other = watches.join("r1"), watches.join("r1")
    assert one is other
    assert subscriptions(network, "fleet/r1/*") == 1
    watches.leave("r1")
    assert subscriptions(network, "fleet/r1/*") == 1
    watches.leave("r1")
    assert (subscriptions(network, "fleet/r1/*"), watches.watched) == (0, {})


async def test_a_change_of_the_history_is_news() -> None:
    network, entries = FakeBus(), [b"\x90"]
    watches = RobotWatches(network.join("console"), "fleet", lambda robot: entries[-1], Metrics())
    watch = watches.join("r1")
    number, _ = watch.news(0)
    entries.append(b"\x91\x01")
    watches.history_changed("r1")
    watches.history_changed("r2")
    payload = watch.news(number)[1]
    assert payload is not None
    assert [entry[0] for entry in msgpack.unpackb(payload)["news"]] == ["@history"]
    watches.leave("r1")
