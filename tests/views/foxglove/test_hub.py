"""Channels and subscriptions: work on demand, last values, channels that come and go."""

import json
from typing import Any

from zbridge.views.foxglove.hub import Hub
from zbridge.views.pictures import ViewerChannel
from zbridge.views.schemas import Schema

SCHEMA = Schema("x", "jsonschema", b"{}", "json")
SCAN = ViewerChannel("/r1/scan", "scan", SCHEMA)
MAP = ViewerChannel("/r1/map", "map", SCHEMA, keeps_last=True)


class Looking:
    """A viewer that keeps what it is sent."""

    def __init__(self) -> None:
        self.said: list[dict[str, Any]] = []
        self.shown: list[tuple[int, bytes]] = []
        self.over: list[int] = []

    def say(self, message: str | bytes) -> None:
        self.said.append(json.loads(message))

    def show(self, subscription: int, message: bytes) -> None:
        self.shown.append((subscription, message[13:]))

    def ended(self, subscription: int) -> None:
        self.over.append(subscription)

    def parameters_changed(self, values: Any) -> None:
        """Not looked at."""


def a_hub() -> tuple[Hub, list[tuple[str, bool]]]:
    hub, wanted = Hub(), list[tuple[str, bool]]()
    hub.on_wanted = lambda channel, on: wanted.append((channel.path, on))
    hub.offer([SCAN, MAP])
    return hub, wanted


def ids(viewer: Looking) -> dict[str, int]:
    return {
        channel["topic"]: channel["id"]
        for message in viewer.said
        if message["op"] == "advertise"
        for channel in message["channels"]
    }


def test_the_source_is_told_of_each_viewer_of_a_channel_and_when_the_last_one_goes() -> None:
    hub, wanted = a_hub()
    first, second = Looking(), Looking()
    for viewer in (first, second):
        hub.join(viewer)
    scan = ids(first)["/r1/scan"]
    assert hub.subscribe(first, 5, scan)
    assert hub.subscribe(second, 6, scan)
    assert wanted == [("scan", True)] * 2
    hub.publish("/r1/scan", 9, b"data")
    assert (first.shown, second.shown) == ([(5, b"data")], [(6, b"data")])
    hub.unsubscribe(first, scan)
    assert wanted == [("scan", True)] * 2
    hub.leave(second)
    assert wanted == [("scan", True)] * 2 + [("scan", False)]
    hub.publish("/r1/scan", 9, b"data")
    assert len(first.shown) == 1


def test_who_comes_later_is_shown_the_last_message_of_what_keeps_it_while_it_is_wanted() -> None:
    hub, _ = a_hub()
    first, second = Looking(), Looking()
    for viewer in (first, second):
        hub.join(viewer)
    for topic, channel_id in ids(first).items():
        hub.subscribe(first, channel_id, channel_id)
        hub.publish(topic, 1, topic.encode())
    for channel_id in ids(second).values():
        hub.subscribe(second, channel_id, channel_id)
    assert [data for _, data in second.shown] == [b"/r1/map"]
    for viewer in (first, second):
        hub.leave(viewer)
    hub.join(second)
    second.shown.clear()
    hub.subscribe(second, 1, ids(second)["/r1/map"])
    assert second.shown == []  # nobody renewed it meanwhile


def test_a_channel_that_is_withdrawn_ends_its_subscriptions_and_comes_back_with_another_id() -> None:
    hub, wanted = a_hub()
    viewer = Looking()
    hub.join(viewer)
    before = ids(viewer)["/r1/scan"]
    hub.subscribe(viewer, 5, before)
    hub.withdraw(["/r1/scan", "/r1/unknown"])
    assert viewer.over == [5]
    assert wanted[-1] == ("scan", False)
    assert viewer.said[-1] == {"op": "unadvertise", "channelIds": [before]}
    assert not hub.subscribe(viewer, 6, before)
    hub.offer([SCAN])
    assert ids(viewer)["/r1/scan"] != before


def test_channels_are_bounded() -> None:
    hub = Hub()
    left_out = hub.offer(ViewerChannel(f"/r/{number}", "x", SCHEMA) for number in range(8200))
    assert left_out == 8
