"""The lease as the view holds it for a publisher: asked for, driven by, lost and given back."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from tests.client import World
from zbridge.fleet.messages import Drive
from zbridge.views.ros2.holder import STALE_S, Holder

pytestmark = pytest.mark.jumping
FIRST, SECOND, THIRD = (Drive(forward=forward) for forward in (0.1, 0.2, 0.3))


class Scene:
    """One robot, and the holder."""

    def __init__(self, *, served: bool = True) -> None:
        self.world = World(served=served)
        self.lost: list[str] = []
        self.holder = Holder(self.world.robot, "ros2", self.lost.append)

    @property
    def driven(self) -> list[Drive]:
        return self.world.gateway.driven

    async def held(self) -> None:
        self.holder.acquire("/teleop", FIRST)
        await asyncio.sleep(0.1)
        assert self.driven == [FIRST]
        assert self.world.gateway.control.holder == "ros2.teleop"


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    scene = Scene()
    yield scene
    await scene.holder.close()


async def test_while_the_lease_is_held_a_command_is_sent_within_the_call(scene: Scene) -> None:
    await scene.held()
    for drive in (SECOND, THIRD, Drive()):
        scene.holder.send(drive)
    assert scene.driven == [FIRST, SECOND, THIRD, Drive()]


async def test_before_it_is_held_the_newest_command_waits_for_it(scene: Scene) -> None:
    scene.holder.acquire("/teleop", FIRST)
    scene.holder.send(SECOND)
    assert scene.driven == []
    await asyncio.sleep(0.1)
    assert scene.driven == [SECOND]


async def test_a_command_does_not_wait_for_long() -> None:
    scene = Scene(served=False)
    scene.holder.acquire("/teleop", FIRST)
    await asyncio.sleep(STALE_S)
    scene.world.gateway.serve()
    await asyncio.sleep(1.0)
    assert scene.world.gateway.control.holder == "ros2.teleop"
    assert scene.driven == []
    await scene.holder.close()


async def test_what_comes_after_a_release_goes_by_the_next_lease_only(scene: Scene) -> None:
    await scene.held()
    scene.holder.acquire("/other", SECOND)
    scene.holder.send(THIRD)
    assert scene.driven == [FIRST], "not by the lease that is given back"
    await asyncio.sleep(0.5)
    assert scene.driven[-1] == THIRD
    assert SECOND not in scene.driven
    assert scene.world.gateway.control.holder == "ros2.other"
    assert scene.lost == []


async def test_a_command_that_the_robot_refuses_ends_the_lease_and_is_not_tried_again(scene: Scene) -> None:
    await scene.held()
    scene.world.machine.refusal = "no legs"
    scene.holder.send(SECOND)
    scene.world.machine.refusal = None
    await asyncio.sleep(0.1)  # the refusal is shown
    scene.holder.send(THIRD)
    await asyncio.sleep(0.5)
    assert scene.driven[-1] != THIRD
    assert [why.endswith("no legs") for why in scene.lost] == [True]
    assert scene.world.gateway.control.holder is None


async def test_a_lease_that_is_lost_is_told_once_and_nothing_is_sent_by_it(scene: Scene) -> None:
    await scene.held()
    await scene.world.others.stop()
    driven = len(scene.driven)
    scene.holder.send(SECOND)
    await asyncio.sleep(0.5)
    assert len(scene.driven) == driven
    assert len(scene.lost) == 1


async def test_a_bus_that_breaks_under_a_command_ends_the_lease(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    await scene.held()

    def broken(_: Drive) -> bool:
        raise OSError("no bus")

    monkeypatch.setattr(scene.holder._driver, "now", broken)
    scene.holder.send(SECOND)
    await asyncio.sleep(0.5)
    assert len(scene.lost) == 1
    assert "no bus" in scene.lost[0]
    assert scene.world.gateway.control.holder is None
