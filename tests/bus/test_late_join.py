"""A late joiner has the last values, once, and again after its gateway was gone."""

from __future__ import annotations

import asyncio

import pytest

from tests.fake_bus import FakeBus
from zbridge.bus.interface import Answer
from zbridge.bus.late_join import ASK_AFTER_S, ASKED_AT_ONCE, LateJoin
from zbridge.errors import BusError
from zbridge.fleet import topics
from zbridge.fleet.topics import gateways_of, of_robot

pytestmark = pytest.mark.jumping

MAP, STATUS = "fleet/r1/map", "fleet/r1/status"
LONG_S = 30.0


class Scene:
    """A gateway on one session, a late joiner on another whose questions are counted."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, key_expr: str = "fleet/*/map") -> None:
        self.gateway = FakeBus("gateway")
        self.bus = self.gateway.join("joiner")
        self.asked: list[str] = []
        self.answers: list[list[Answer]] = []
        """What the next questions get instead of the bus's answers."""
        self.seen: list[bytes] = []
        ask = self.bus.ask

        async def counted(key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
            self.asked.append(key_expr)
            await asyncio.sleep(0.05)
            return self.answers.pop(0) if self.answers else await ask(key_expr)

        monkeypatch.setattr(self.bus, "ask", counted)
        self.publisher = self.gateway.publisher(MAP, topics.MAP)
        self.key_expr = key_expr

    def join(self) -> LateJoin:
        return LateJoin(self.bus, self.key_expr, lambda sample: self.seen.append(sample.payload))


async def test_the_last_value_is_asked_for_when_the_gateway_is_there_and_again_when_it_comes_back(monkeypatch) -> None:
    scene = Scene(monkeypatch)
    scene.publisher.put(b"one")
    joined = scene.join()
    await asyncio.sleep(LONG_S)
    assert (scene.asked, scene.seen) == ([], []), "without a gateway there is nothing to be had"
    token = scene.gateway.announce("fleet/r1/@alive/gateway")
    await asyncio.sleep(LONG_S)
    assert (scene.asked, scene.seen) == ([MAP], [b"one"])
    token.close()
    scene.gateway.announce("fleet/r1/@alive/gateway")
    await asyncio.sleep(LONG_S)
    assert (scene.asked, scene.seen) == ([MAP, MAP], [b"one", b"one"])
    joined.close()
    scene.publisher.put(b"two")
    assert scene.seen == [b"one", b"one"]


async def test_an_answer_that_a_live_value_overtook_is_dropped(monkeypatch) -> None:
    scene = Scene(monkeypatch)
    scene.publisher.put(b"one")
    scene.answers = [[Answer(MAP, b"one"), Answer("fleet/r1/map2", b"other")]]
    scene.gateway.announce("fleet/r1/@alive/gateway")
    scene.join()
    await asyncio.sleep(0.02)
    scene.publisher.put(b"two")
    await asyncio.sleep(LONG_S)
    assert scene.seen == [b"two", b"other"]


@pytest.mark.parametrize("nothing", [[], [Answer("", b"", BusError("no"))]])
async def test_a_question_without_an_answer_is_put_again_a_few_times(monkeypatch, nothing: list[Answer]) -> None:
    scene = Scene(monkeypatch)
    scene.publisher.put(b"one")
    scene.gateway.announce("fleet/r1/@alive/gateway")
    scene.answers = [nothing] * (len(ASK_AFTER_S) - 1)
    scene.join()
    await asyncio.sleep(LONG_S)
    assert (len(scene.asked), scene.seen) == (len(ASK_AFTER_S), [b"one"])
    scene.answers = [nothing] * 100
    scene.join()
    await asyncio.sleep(LONG_S)
    assert len(scene.asked) == 2 * len(ASK_AFTER_S)


@pytest.mark.parametrize(("key_expr", "asked"), [("fleet/**", "fleet/r{}/**"), ("**/status", "**/status")])
async def test_every_robot_is_asked_by_itself_and_each_value_comes_once(monkeypatch, key_expr, asked) -> None:
    scene = Scene(monkeypatch, key_expr)
    for number in range(1, 4):
        scene.gateway.publisher(f"fleet/r{number}/status", topics.STATUS).put(b"%d" % number)
        scene.gateway.announce(f"fleet/r{number}/@alive/gateway")
    scene.join()
    await asyncio.sleep(LONG_S)
    assert sorted(scene.asked) == [asked.format(number) for number in range(1, 4)]
    assert sorted(scene.seen) == [b"1", b"2", b"3"]


async def test_a_handler_that_fails_for_one_value_gets_the_next(monkeypatch, caplog: pytest.LogCaptureFixture) -> None:
    scene = Scene(monkeypatch)
    scene.answers = [[Answer(MAP, b"bad"), Answer("fleet/r1/map2", b"good")]]
    scene.gateway.announce("fleet/r1/@alive/gateway")
    LateJoin(scene.bus, MAP, lambda sample: scene.seen.append(b"%d" % [b"good"].index(sample.payload)))
    await asyncio.sleep(LONG_S)
    assert scene.seen == [b"0"]
    assert [record.message for record in caplog.records] == ["a handler failed"]


async def test_a_closed_joiner_is_told_nothing_more(monkeypatch) -> None:
    scene = Scene(monkeypatch)
    scene.publisher.put(b"one")
    scene.gateway.announce("fleet/r1/@alive/gateway")
    joined = scene.join()
    assert not joined.closed
    await asyncio.sleep(0.02)
    joined.close()
    joined.close()
    assert joined.closed, "so that the bus forgets it"
    await asyncio.sleep(LONG_S)
    assert scene.seen == []


@pytest.mark.parametrize(
    ("key_expr", "gateways", "one_robots"),
    [
        ("fleet/r1/map", "fleet/r1/@alive/gateway", "fleet/r7/map"),
        ("fleet/*/sensor/*", "fleet/*/@alive/gateway", "fleet/r7/sensor/*"),
        ("fleet/**", "fleet/*/@alive/gateway", "fleet/r7/**"),
        ("**", "*/*/@alive/gateway", "**"),
        ("**/map", "*/*/@alive/gateway", "**/map"),
        ("fleet/**/map", "fleet/*/@alive/gateway", "fleet/**/map"),
    ],
)
def test_whose_gateway_and_which_keys_an_expression_means(key_expr: str, gateways: str, one_robots: str) -> None:
    assert gateways_of(key_expr) == gateways
    assert of_robot(key_expr, "fleet", "r7") == one_robots


async def test_many_robots_that_come_back_at_once_are_asked_a_few_at_a_time_and_all(monkeypatch) -> None:
    scene = Scene(monkeypatch, "fleet/*/status")
    asking, most, count = 0, 0, 10 * ASKED_AT_ONCE
    ask = scene.bus.ask

    async def counted(key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        nonlocal asking, most
        asking += 1
        most = max(most, asking)
        try:
            return await ask(key_expr)
        finally:
            asking -= 1

    monkeypatch.setattr(scene.bus, "ask", counted)
    for number in range(count):
        scene.gateway.publisher(f"fleet/r{number}/status", topics.STATUS).put(b"%d" % number)
        scene.gateway.announce(f"fleet/r{number}/@alive/gateway")
    scene.join()
    await asyncio.sleep(LONG_S)
    assert sorted(map(int, scene.seen)) == list(range(count))
    assert most == ASKED_AT_ONCE
