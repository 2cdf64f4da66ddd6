"""Who drove and who stopped each robot: told by what ``control`` shows; a stop names nobody but the console itself."""

from __future__ import annotations

import msgpack
import pytest

from tests.client import World
from tests.fake_bus import FakeBus
from zbridge.client.stops import new_stop
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Latch
from zbridge.views.console.history import ENTRIES, ROBOTS, ControlHistory, changes

OWN, OTHER = bytes(16), bytes(15) + b"1"
WET = Latch(OTHER, "bob", "wet floor")
FREE = Control("free")
ANN = Control("held", holder="ann", lease=b"lease--1")


@pytest.mark.parametrize(
    ("before", "now", "texts"),
    [
        (FREE, FREE, []),
        (FREE, ANN, ["ann drives"]),
        (ANN, FREE, ["ann no longer drives"]),
        (ANN, Control("held", holder="ann", lease=b"lease--2"), ["ann no longer drives", "ann drives"]),
        (ANN, Control("held", holder="bob", lease=b"lease--2"), ["ann no longer drives", "bob drives"]),
        (ANN, Control("stopped"), ["ann was stopped"]),
        (ANN, Control("stopped", stops=(OTHER,)), ["a stop: ann no longer drives"]),
        (ANN, Control("stopped", stops=(OWN,)), ["stopped by this console: ann no longer drives"]),
        (FREE, Control("stopped", stops=(OWN,)), ["stopped by this console"]),
        (Control("stopped", stops=(OTHER,)), Control("stopped", stops=(OTHER, OWN)), ["stopped by this console"]),
        (ANN, Control("latched", latches=(WET,), stops=(OTHER,)), ["latched by bob (wet floor): ann no longer drives"]),
        (FREE, Control("latched", latches=(WET,)), ["latched by bob (wet floor)"]),
        (Control("latched", latches=(WET,)), Control("stopped"), ["no longer latched by bob (wet floor)"]),
    ],
)
def test_what_happened_between_two_messages(before: Control, now: Control, texts: list[str]) -> None:
    assert changes(before, now, {OWN: "this console"}) == texts


class Scene:
    def __init__(self) -> None:
        self.network, self.changed = FakeBus(), list[str]()
        self.history = ControlHistory(self.network.join("console"), "fleet", self.changed.append, lambda: 7.0)
        self.history.open()

    def control(self, control: Control, robot: str = "r1") -> None:
        self.put(payloads.encode(control), robot)

    def put(self, payload: bytes, robot: str = "r1") -> None:
        self.network.publisher(f"fleet/{robot}/control", topics.CONTROL).put(payload)

    def texts(self, robot: str = "r1") -> list[str]:
        return [entry["text"] for entry in msgpack.unpackb(self.history.payload(robot))]


def test_a_history_begins_with_the_first_change_and_each_robot_has_its_own() -> None:
    scene = Scene()
    scene.control(ANN)
    scene.control(FREE, "r2")
    assert scene.texts() == []
    scene.control(FREE)
    assert (scene.texts(), scene.texts("r2"), scene.changed) == (["ann no longer drives"], [], ["r1"])
    assert msgpack.unpackb(scene.history.payload("r1"))[0]["at"] == 7.0


def test_what_cannot_be_read_is_skipped_and_hostile_names_are_cut_and_escaped() -> None:
    scene = Scene()
    scene.control(FREE)
    scene.put(b"\xc1")
    scene.control(Control("held", holder="\x1b[2J" + "x" * 10_000, lease=b"12345678"))
    (text,) = scene.texts()
    assert "\x1b" not in text
    assert len(text) <= 200


def test_histories_are_bounded() -> None:
    scene = Scene()
    for _ in range(ENTRIES + 5):
        scene.control(FREE)
        scene.control(ANN)
    assert len(scene.texts()) == ENTRIES
    for number in range(ROBOTS + 5):
        scene.control(FREE, f"x{number}")
        scene.control(ANN, f"x{number}")
    assert scene.texts(f"x{ROBOTS + 4}") == []


async def test_a_stop_of_its_own_is_told_from_another_one_on_a_gateway() -> None:
    world = World("r1")
    history = ControlHistory(world.bus.join("console"), "fleet", lambda robot: None)
    history.open()
    world.gateway.enforcer.report()
    stop = new_stop("console", None, latch=False)
    assert isinstance(stop.id, bytes)
    history.note_own(stop.id, "this console")
    await world.fleet.send_stop(stop, ["r1"])
    await world.robot.stop()
    history.close()
    texts = [entry["text"] for entry in msgpack.unpackb(history.payload("r1"))]
    assert texts == ["stopped by this console", "a stop"]
