"""One viewer on a connection that the test plays: what it says is carried out, refused, counted, or ends it."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import AsyncIterator, Mapping
from typing import Any

import pytest

from zbridge.errors import BusError, Unsupported
from zbridge.views.foxglove import viewer as module
from zbridge.views.foxglove.hub import Hub, Subscriber
from zbridge.views.foxglove.replies import Service
from zbridge.views.foxglove.requests import ClientChannel, PlaybackRequest
from zbridge.views.foxglove.source import ViewerSource
from zbridge.views.foxglove.viewer import CALLS, PUBLISHED, RATE_HZ, SEND_S, WARNINGS_HZ, Overrun, Viewer
from zbridge.views.pictures import ViewerChannel
from zbridge.views.schemas import Schema

pytestmark = pytest.mark.jumping

CHANNELS = [ViewerChannel(f"/r1/{name}", name, Schema("S", "jsonschema", b"{}", "json")) for name in ("pose", "scan")]


class Connection:
    """What the viewer says, and what it was sent. takes: whether the socket has room."""

    def __init__(self) -> None:
        self.said: asyncio.Queue[str | bytes | None] = asyncio.Queue()
        self.sent: list[str | bytes] = []
        self.room = asyncio.Event()
        self.room.set()

    async def __aiter__(self) -> AsyncIterator[str | bytes]:
        while (message := await self.said.get()) is not None:
            yield message

    def send_now(self, message: bytes) -> bool:
        if self.room.is_set():
            self.sent.append(message)
        return self.room.is_set()

    async def send(self, message: str | bytes) -> None:
        await self.room.wait()
        self.sent.append(message)


class PlayedSource(ViewerSource):
    """Notes what it is asked for, and refuses what the test says."""

    def __init__(self, hub: Hub) -> None:
        super().__init__(hub)
        self.commands = self  # type: ignore[assignment]
        self.greeting = "hello"
        self.done: list[tuple[Any, ...]] = []
        self.fails: Exception | None = None
        self.goes_on = asyncio.Event()
        self.goes_on.set()

    def services(self) -> list[Service]:
        return [Service(1, "/stop", "zbridge/Stop", {}, {})]

    def greet(self, viewer: Subscriber) -> None:
        if self.greeting:
            viewer.say(self.greeting)

    def published(self, viewer: Subscriber, channel: ClientChannel, payload: bytes) -> None:
        self.done.append((channel.topic, payload))
        self._fail()

    def unpublished(self, viewer: Subscriber, channel: ClientChannel) -> None:
        self.done.append(("unpublished", channel.topic))

    def play(self, viewer: Subscriber, request: PlaybackRequest) -> None:
        self.done.append(("play", request.play))
        self._fail()

    def watch_parameters(self, watched: bool) -> None:
        self.done.append(("watch", watched))

    async def call(self, viewer: Subscriber, service_id: int, payload: bytes) -> bytes:
        await self.goes_on.wait()
        self.done.append((service_id, payload))
        self._fail()
        return b"{}"

    async def parameters(self, names: tuple[str, ...], *, ask: bool = True) -> Mapping[str, Any]:
        return dict.fromkeys(names, ask)

    async def set_parameter(self, viewer: Subscriber, name: str, value: Any) -> None:
        self.done.append((name, value))
        self._fail()

    async def left(self, viewer: Subscriber) -> None:
        self.done.append(("left",))
        self._fail()

    def _fail(self) -> None:
        if self.fails is not None:
            raise self.fails


class Scene:
    """A viewer of two channels. It has been greeted."""

    def __init__(self) -> None:
        self.hub, self.connection = Hub(), Connection()
        self.hub.offer(CHANNELS)
        self.source = PlayedSource(self.hub)
        clock = asyncio.get_running_loop().time
        self.viewer = Viewer("ann.1", self.source, self.connection, may_drive=True, clock=clock)
        self.running = asyncio.ensure_future(self.viewer.run())

    async def says(self, *messages: Any) -> list[Any]:
        """Let the viewer say something; give what it is sent then."""
        self.connection.sent.clear()
        for message in messages:
            text = message if isinstance(message, bytes | str) else json.dumps(message)
            self.connection.said.put_nowait(text)
        await asyncio.sleep(0.01)
        return self.sent()

    def sent(self) -> list[Any]:
        read = [json.loads(each) if str(each)[:1] == "{" else each for each in self.connection.sent]
        self.connection.sent.clear()
        return read

    async def warned(self, *messages: Any) -> list[str]:
        """Let the viewer say something; give what the person is warned of."""
        return [each["message"] for each in await self.says(*messages) if each["op"] == "status"]

    async def ends(self) -> None:
        self.connection.said.put_nowait(None)
        await self.running

    @property
    def counts(self) -> dict[str, int]:
        return {name: count for name, count in self.viewer.counts.items() if count}


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    made = Scene()
    await asyncio.sleep(0.01)
    yield made
    made.running.cancel()
    await asyncio.wait([made.running])


def subscribe(*pairs: tuple[int, int]) -> dict[str, Any]:
    return {"op": "subscribe", "subscriptions": [{"id": own, "channelId": channel} for own, channel in pairs]}


def advertise(*channels: tuple[int, str]) -> dict[str, Any]:
    listed = [{"id": own, "topic": topic, "encoding": "json", "schemaName": "s"} for own, topic in channels]
    return {"op": "advertise", "channels": listed}


def call(number: int, service: int = 1, encoding: bytes = b"json") -> bytes:
    return b"\x02" + struct.pack("<III", service, number, len(encoding)) + encoding + b"{}"


async def test_a_viewer_is_greeted_with_the_server_its_channels_and_its_services(scene: Scene) -> None:
    info, channels, services, greeting = scene.sent()
    assert info["op"] == "serverInfo"
    assert [each["topic"] for each in channels["channels"]] == ["/r1/pose", "/r1/scan"]
    assert [each["name"] for each in services["services"]] == ["/stop"]
    assert greeting == "hello"


# Channels


async def test_a_subscription_gets_the_messages_of_its_channel_until_it_ends(scene: Scene) -> None:
    assert await scene.says(subscribe((7, 1))) == []
    scene.hub.publish("/r1/pose", 5, b"here")
    scene.hub.publish("/r1/scan", 5, b"not wanted")
    assert scene.sent() == [b"\x01" + struct.pack("<IQ", 7, 5) + b"here"]
    await scene.says({"op": "unsubscribe", "subscriptionIds": [7, 8]})
    scene.hub.publish("/r1/pose", 6, b"there")
    assert scene.sent() == []
    assert await scene.warned(subscribe((7, 1))) == [], "it may come back"
    assert scene.counts == {"said": 3}


async def test_what_cannot_be_subscribed_to_is_refused_and_the_rest_is_not(scene: Scene) -> None:
    told = await scene.warned(subscribe((7, 1), (7, 2), (8, 1), (9, 3), (10, 2)))
    assert told == [
        "channel 2 or subscription 7 is subscribed already",
        "channel 1 or subscription 8 is subscribed already",
        "there is no channel 3",
    ]
    assert len(scene.hub.wanted()) == 2
    assert scene.counts == {"said": 1, "refused": 3}


async def test_a_channel_that_is_withdrawn_may_be_subscribed_to_anew(scene: Scene) -> None:
    await scene.says(subscribe((7, 1)))
    scene.hub.withdraw(["/r1/pose"])
    scene.hub.offer(CHANNELS)
    assert await scene.warned(subscribe((7, 3))) == []
    scene.hub.publish("/r1/pose", 5, b"here")
    assert len(scene.sent()) == 1


async def test_subscriptions_are_bounded(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SUBSCRIPTIONS", 1)
    assert await scene.warned(subscribe((7, 1), (8, 2))) == ["more than 1 subscriptions"]


async def test_messages_for_a_socket_without_room_wait_and_the_newest_win(scene: Scene) -> None:
    await scene.says(subscribe((7, 1)))
    scene.connection.room.clear()
    for number in range(50):
        scene.hub.publish("/r1/pose", number, b"")
    scene.connection.room.set()
    await asyncio.sleep(0.01)
    stamps = [struct.unpack_from("<Q", each, 5)[0] for each in scene.sent()]
    assert stamps == sorted(stamps)
    assert stamps[-1] == 49
    assert 30 < len(stamps) < 50
    await scene.ends()
    assert scene.counts["dropped"] == 50 - len(stamps)


async def test_a_viewer_that_takes_nothing_for_long_is_ended() -> None:
    scene = Scene()
    await asyncio.sleep(0.01)
    scene.connection.room.clear()
    scene.viewer.say("news")
    began = asyncio.get_running_loop().time()
    with pytest.raises(TimeoutError):
        await scene.running
    assert SEND_S <= asyncio.get_running_loop().time() - began < 1.5 * SEND_S
    assert scene.source.done == [("left",)]


@pytest.mark.parametrize("greeting", ["hello", ""])
async def test_a_viewer_that_has_nothing_to_read_is_kept(greeting: str) -> None:
    scene = Scene()
    scene.source.greeting = greeting
    await asyncio.sleep(100 * SEND_S)
    assert not scene.running.done()
    await scene.ends()


# What it publishes


async def test_what_comes_on_a_channel_of_the_viewer_is_handed_on_until_it_is_withdrawn(scene: Scene) -> None:
    message = b"\x01" + struct.pack("<I", 3) + b"{}"
    await scene.says(advertise((3, "/r1/cmd_vel")), message, {"op": "unadvertise", "channelIds": [3, 4]})
    assert scene.source.done == [("/r1/cmd_vel", b"{}"), ("unpublished", "/r1/cmd_vel")]
    assert await scene.warned(message) == ["channel 3 is not one of yours"]
    assert scene.counts == {"said": 4, "refused": 1}


async def test_channels_of_a_viewer_have_numbers_of_their_own_and_a_bound(scene: Scene) -> None:
    told = await scene.warned(advertise((3, "/a"), (3, "/b")))
    assert told == [f"channel 3 is there already, or there are {PUBLISHED}"]
    await scene.says(advertise(*((10 + number, "/c") for number in range(PUBLISHED))))
    assert scene.counts["refused"] == 2


async def test_a_refusal_of_the_source_and_a_spoiled_message_are_counted_and_end_nothing(scene: Scene) -> None:
    scene.source.fails = Unsupported("not here")
    play = b"\x03" + struct.pack("<BfBQI", 0, 1.0, 0, 0, 0)
    told = await scene.warned(advertise((3, "/x")), b"\x01" + struct.pack("<I", 3), play, "{", b"\x09")
    assert told[:2] == ["not here", "not here"]
    assert "text message" in told[2]
    assert "opcode 09" in told[3]
    assert scene.counts == {"said": 5, "refused": 2, "malformed": 2}
    assert scene.source.done[-1] == ("play", True)
    assert not scene.running.done()


async def test_warnings_are_few_and_counts_are_not(scene: Scene) -> None:
    told = await scene.warned(*["{"] * 100)
    assert WARNINGS_HZ <= len(told) < 2 * WARNINGS_HZ
    assert scene.counts == {"said": 100, "malformed": 100}
    await asyncio.sleep(1.0)
    assert await scene.warned("{") != []


@pytest.mark.parametrize(("count", "ended"), [(int(RATE_HZ), False), (2 * int(RATE_HZ), True)])
async def test_a_viewer_that_says_too_much_is_ended(count: int, ended: bool) -> None:
    scene = Scene()
    await scene.says(*["{"] * count)
    assert scene.running.done() is ended
    if ended:
        with pytest.raises(Overrun, match="more than 500 messages a second"):
            await scene.running
    else:
        await scene.ends()


async def test_a_viewer_that_lets_answers_wait_is_ended() -> None:
    scene = Scene()
    await asyncio.sleep(0.01)
    scene.connection.room.clear()
    for _ in range(2000):
        scene.viewer.say("news")
    scene.connection.said.put_nowait("{")
    with pytest.raises(Overrun, match="too many queued answers"):
        await scene.running


# Calls and parameters


async def test_a_call_is_answered_and_a_failed_one_says_why(scene: Scene) -> None:
    answer = b"\x03" + struct.pack("<III", 1, 5, 4) + b"json{}"
    assert await scene.says(call(5)) == [answer]
    for error, text in ((Unsupported("no"), "no"), (BusError("away"), "away")):
        scene.source.fails = error
        (failure,) = await scene.says(call(6))
        assert (failure["op"], failure["serviceId"], failure["callId"]) == ("serviceCallFailure", 1, 6)
        assert failure["message"] == text
    (failure,) = await scene.says(call(7, encoding=b"ros1"))
    assert failure["message"] == "encoding 'ros1': expected 'json'"
    assert scene.counts == {"said": 4, "refused": 3}


async def test_calls_at_the_same_time_are_bounded(scene: Scene) -> None:
    scene.source.goes_on.clear()
    (failure,) = await scene.says(*(call(number) for number in range(CALLS + 1)))
    assert (failure["callId"], failure["message"]) == (CALLS, f"more than {CALLS} calls at the same time")
    (warning,) = await scene.warned({"op": "setParameters", "parameters": []})
    assert "calls at the same time" in warning
    scene.source.goes_on.set()
    await asyncio.sleep(0.01)
    assert len(scene.sent()) == CALLS
    assert len(await scene.says(call(99))) == 1, "there is room again"


async def test_parameters_are_told_and_set(scene: Scene) -> None:
    (told,) = await scene.says({"op": "getParameters", "parameterNames": ["r1.light"], "id": "a"})
    assert told == {"op": "parameterValues", "parameters": [{"name": "r1.light", "value": True}], "id": "a"}
    setting = {"op": "setParameters", "parameters": [{"name": "r1.light", "value": True}]}
    assert await scene.says(setting) == []
    (told,) = await scene.says(setting | {"id": "b"})
    assert (told["id"], told["parameters"]) == ("b", [{"name": "r1.light", "value": False}]), "as they are now"
    assert scene.source.done == [("r1.light", True)] * 2
    scene.source.fails = Unsupported("no such parameter")
    assert await scene.warned(setting) == ["no such parameter"]
    assert scene.counts["refused"] == 1


def watching(op: str, *names: str) -> dict[str, Any]:
    return {"op": f"{op}ParameterUpdates", "parameterNames": names}


WATCHED: list[tuple[list[dict[str, Any]], set[str]]] = [
    ([], set()),
    ([watching("subscribe", "a")], {"a"}),
    ([watching("subscribe", "a"), watching("subscribe", "b")], {"a", "b"}),
    ([watching("subscribe")], {"a", "b", "c"}),
    ([watching("subscribe", "a"), watching("subscribe")], {"a", "b", "c"}),
    ([watching("subscribe"), watching("subscribe", "a")], {"a", "b", "c"}),
    ([watching("subscribe", "a", "b"), watching("unsubscribe", "b")], {"a"}),
    ([watching("subscribe", "a"), watching("unsubscribe", "a")], set()),
    ([watching("subscribe"), watching("unsubscribe")], set()),
    ([watching("unsubscribe", "a")], set()),
]


@pytest.mark.parametrize(("said", "told"), WATCHED)
async def test_parameters_that_are_watched_are_told_when_they_change(
    scene: Scene, said: list[dict[str, Any]], told: set[str]
) -> None:
    await scene.says(*said)
    scene.hub.parameters_changed({"a": 1, "b": 2, "c": 3})
    await asyncio.sleep(0.01)
    assert {each["name"] for message in scene.sent() for each in message["parameters"]} == told
    begun = [what for what in scene.source.done if what == ("watch", True)]
    ended = [what for what in scene.source.done if what == ("watch", False)]
    assert (len(begun) - len(ended) == 1) is bool(told)
    await scene.ends()
    assert scene.source.done.count(("watch", True)) == scene.source.done.count(("watch", False)) <= 1


# Its end


async def test_a_viewer_that_leaves_leaves_nothing_behind(scene: Scene) -> None:
    await scene.says(subscribe((7, 1)))
    scene.source.goes_on.clear()
    await scene.says(call(1))
    scene.source.fails = RuntimeError("a fault of ours")
    await scene.ends()
    assert (scene.hub.viewers, scene.hub.wanted()) == (set(), [])
    assert scene.source.done == [("left",)], "the call was given up"
