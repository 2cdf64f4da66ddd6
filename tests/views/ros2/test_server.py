"""Which robots of a realm are shown as nodes: those whose gateway lives, by names that ROS can write."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest

from tests.fake_bus import FakeBus
from zbridge.errors import ConfigError
from zbridge.metrics import Metrics
from zbridge.ros2.types import types_of
from zbridge.views.ros2 import server
from zbridge.views.ros2.outlets import RosSide
from zbridge.views.ros2.server import HIDDEN_AFTER_S, View
from zbridge.views.ros2.settings import Ros2Settings, plan

pytestmark = pytest.mark.jumping


def alive(robot: str) -> str:
    return f"fleet/{robot}/@alive/gateway"


class Scene:
    """A fleet's bus, ROS's bus, and what is shown of the one on the other."""

    def __init__(self, **options: Any) -> None:
        self.fleet, self.ros, self.metrics = FakeBus(), FakeBus(), Metrics()
        side = RosSide(self.ros, 0, types_of("jazzy"), self.metrics)
        self.view = View(plan(Ros2Settings(**options)), self.fleet.join("2"), side, None)
        self.view.start()

    def nodes(self) -> dict[str, str]:
        return {name: node.node.full_name for name, node in self.view.nodes.items()}

    def shown(self) -> set[str]:
        """Give the nodes that ROS sees."""
        return {token.split("/")[7] for token in self.ros.network.tokens if "/NN/" in token}


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    made = Scene()
    yield made
    await made.view.close()


async def test_a_robot_is_a_node_while_its_gateway_lives(scene: Scene) -> None:
    token = scene.fleet.announce(alive("r1"))
    assert (scene.nodes(), scene.shown()) == ({"r1": "/r1/zbridge"}, {"%r1"})
    token.close()
    await asyncio.sleep(HIDDEN_AFTER_S - 0.1)
    assert scene.nodes() == {"r1": "/r1/zbridge"}
    await asyncio.sleep(0.2)
    assert (scene.nodes(), scene.shown(), scene.ros.network.queryables) == ({}, set(), [])


async def test_a_gateway_that_comes_back_soon_keeps_its_node(scene: Scene) -> None:
    token = scene.fleet.announce(alive("r1"))
    node = scene.view.nodes["r1"]
    token.close()
    await asyncio.sleep(HIDDEN_AFTER_S - 0.1)
    scene.fleet.announce(alive("r1"))
    await asyncio.sleep(10.0)
    assert scene.view.nodes == {"r1": node}


async def test_robots_whose_names_are_the_same_in_ros_are_shown_once(scene: Scene) -> None:
    scene.fleet.announce(alive("front-left"))
    scene.fleet.announce(alive("front.left"))
    assert scene.nodes() == {"front-left": "/front_left/zbridge"}
    assert scene.metrics.total("ros2_robots_left_out") == 1


async def test_robots_are_bounded(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "ROBOTS", 2)
    for name in ("r1", "r2", "r3"):
        scene.fleet.announce(alive(name))
    assert list(scene.nodes()) == ["r1", "r2"]
    assert scene.metrics.total("ros2_robots_left_out") == 1


async def test_only_named_robots_are_shown_and_driven_where_that_is_allowed() -> None:
    for drive in (False, True):
        scene = Scene(robots=("r1",), drive=drive)
        for name in ("r1", "r2"):
            scene.fleet.announce(alive(name))
        assert list(scene.nodes()) == ["r1"]
        assert (scene.view.nodes["r1"].teleop is not None) is drive
        await scene.view.close()
        assert (scene.nodes(), scene.shown()) == ({}, set())


async def test_whoever_drives_is_stopped_when_ross_router_is_gone() -> None:
    scene = Scene(drive=True)
    scene.fleet.announce(alive("r1"))
    told: list[bool] = []
    scene.view.nodes["r1"].teleop.connected = told.append  # type: ignore[method-assign, union-attr]
    scene.ros.connection(False)
    scene.ros.connection(True)
    assert told == [False, True]
    await scene.view.close()


class Routed(FakeBus):
    """A session that is connected to these routers."""

    def __init__(self, zid: str, *routers: str) -> None:
        super().__init__(zid)
        self._routers = list(routers)

    def routers(self) -> list[str]:
        return self._routers


def test_one_router_for_both_sides_is_refused() -> None:
    planned = plan(Ros2Settings())
    server.require_two_routers(Routed("1", "a"), Routed("2", "b"), planned)
    for fleet, ros in ((Routed("1", "a"), Routed("2", "b", "a")), (Routed("1"), Routed("2", "1"))):
        with pytest.raises(ConfigError, match=r"ros = tcp/localhost:7447: the same router as the fleet's"):
            server.require_two_routers(fleet, ros, planned)
