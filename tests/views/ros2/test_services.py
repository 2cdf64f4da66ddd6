"""The services of one robot on a fake bus: what is carried out, answered, refused and bounded. The robot is played."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import AsyncIterator
from typing import Any

import pytest

from tests.fake_bus import FakeBus, FakeQuery
from zbridge.errors import BusError, Held, Malformed, NotReady
from zbridge.metrics import Metrics
from zbridge.ros2.rmw_zenoh import read_attachment
from zbridge.ros2.types import types_of
from zbridge.views.ros2.outlets import RosSide
from zbridge.views.ros2.services import AT_ONCE, MOST_BYTES, Services

HEAD = b"\x00\x01\x00\x00"
TRIGGER, ON, OFF = HEAD + b"\x00", HEAD + b"\x01", HEAD + b"\x00"
BESIDE = struct.pack("<qqB", 7, 5, 16) + bytes(range(16))
"""The attachment of a client's seventh request."""


class Robot:
    """Notes what it is told; fails when it is to."""

    name = "r1"

    def __init__(self) -> None:
        self.done: list[Any] = []
        self.fails: Exception | None = None
        self.goes_on = asyncio.Event()
        self.goes_on.set()

    async def _do(self, what: Any) -> None:
        self.done.append(what)
        await self.goes_on.wait()
        if self.fails is not None:
            raise self.fails

    async def stop(self) -> None:
        await self._do("stop")

    async def latch(self) -> None:
        await self._do("latch")

    async def unlatch(self) -> None:
        await self._do("unlatch")

    async def set_light(self, on: bool) -> None:
        await self._do(("light", on))

    async def set_lidar(self, on: bool) -> None:
        await self._do(("lidar", on))

    async def set_camera(self, on: bool) -> None:
        await self._do(("camera", on))


class Scene:
    def __init__(self, *, drive: bool = True) -> None:
        self.bus, self.robot, self.metrics = FakeBus(), Robot(), Metrics()
        self.side = RosSide(self.bus, 0, types_of("jazzy"), self.metrics)
        node = self.side.node("/r1", "zbridge")
        told = self.robot.done
        self.services = Services(self.side, node, self.robot, drive=drive, on_stop=lambda: told.append("told"))  # type: ignore[arg-type]

    def names(self) -> list[str]:
        return [key.split("/")[2] for key, _, _ in self.bus.network.queryables]

    async def call(self, name: str, payload: bytes = TRIGGER, attachment: bytes | None = BESIDE) -> FakeQuery:
        """Call a service, and let it work."""
        query = FakeQuery("key", payload)
        query.attachment = attachment
        handler = next(handler for key, handler, _ in self.bus.network.queryables if f"/{name}/" in key)
        handler(query)
        for _ in range(4):
            await asyncio.sleep(0)
        return query


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    made = Scene()
    yield made
    made.services.close()


def answered(query: FakeQuery) -> tuple[bool, str]:
    """Read a response by hand: the header, a bool, and a text with its length and a zero."""
    (reply,) = query.replies
    assert reply.error is None
    success, length = struct.unpack_from("<?xxxI", reply.payload, 4)
    return success, reply.payload[12 : 12 + length - 1].decode()


CALLS: dict[str, tuple[bytes, list[Any]]] = {
    "stop": (TRIGGER, ["told", "stop"]),
    "latch": (TRIGGER, ["told", "latch"]),
    "unlatch": (TRIGGER, ["unlatch"]),
    "set_light": (ON, [("light", True)]),
    "set_lidar": (OFF, [("lidar", False)]),
    "set_camera": (ON, [("camera", True)]),
}


@pytest.mark.parametrize("name", CALLS)
async def test_a_call_is_carried_out_and_answered_with_its_number(scene: Scene, name: str) -> None:
    payload, done = CALLS[name]
    query = await scene.call(name, payload)
    assert scene.robot.done == done
    assert answered(query) == (True, "")
    back = read_attachment(query.attached[0])
    assert (back.number, back.gid) == (7, bytes(range(16)))
    assert (scene.metrics.total("ros2_calls"), scene.metrics.total("ros2_calls_refused")) == (1, 0)


@pytest.mark.parametrize(
    "error", [Held("r1 is driven by ann", holder="ann"), BusError("no answer"), ValueError("what")]
)
async def test_what_was_not_done_is_answered_with_the_reason(scene: Scene, error: Exception) -> None:
    scene.robot.fails = error
    success, why = answered(await scene.call("stop"))
    assert not success
    assert str(error) in why


async def test_without_driving_a_robot_is_stopped_and_latched_only() -> None:
    assert Scene(drive=False).names() == ["stop", "latch"]
    assert Scene().names() == list(CALLS)


async def test_a_request_of_no_bytes_at_all_is_one_without_fields(scene: Scene) -> None:
    for payload in (HEAD, b"\x00\x00\x00\x00"):
        assert answered(await scene.call("stop", payload)) == (True, "")


@pytest.mark.parametrize(
    ("payload", "attachment"),
    [(TRIGGER, None), (TRIGGER, BESIDE[:-1]), (b"", BESIDE), (TRIGGER.ljust(MOST_BYTES + 1, b"\0"), BESIDE)],
)
async def test_a_request_that_cannot_be_read_is_refused_and_counted(
    scene: Scene, payload: bytes, attachment: bytes | None
) -> None:
    (reply,) = (await scene.call("stop", payload, attachment)).replies
    assert isinstance(reply.error, Malformed)
    assert scene.robot.done == []
    assert (scene.metrics.total("ros2_calls"), scene.metrics.total("ros2_calls_refused")) == (1, 1)


async def test_calls_at_the_same_time_are_bounded_and_end_with_the_services(scene: Scene) -> None:
    scene.robot.goes_on.clear()
    waiting = [await scene.call("unlatch") for _ in range(AT_ONCE)]
    (reply,) = (await scene.call("unlatch")).replies
    assert isinstance(reply.error, NotReady)
    assert scene.metrics.total("ros2_calls_refused") == 1
    scene.services.close()
    scene.services.close()
    scene.robot.goes_on.set()
    await asyncio.sleep(0.001)
    assert [query.replies for query in waiting] == [[]] * AT_ONCE
    assert (scene.bus.network.queryables, scene.bus.network.tokens) == ([], [])


async def test_there_is_room_for_a_call_when_another_one_has_ended(scene: Scene) -> None:
    for _ in range(2 * AT_ONCE):
        assert answered(await scene.call("unlatch")) == (True, "")
