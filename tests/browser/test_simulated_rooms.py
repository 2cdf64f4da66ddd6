"""A robot of each protocol in its simulated room: the pixels of its page are compared with the walls."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest

from tests.browser.rooms import room
from tests.browser.scene import Places, middle, places
from zbridge.simulation.world import BOXES, HALF_SIDE_M, Body

pytestmark = pytest.mark.asyncio(loop_scope="session")

PUBLISHED = {
    "tcpudp": {"map", "robot"},
    "alf": {"scan"},
    "wc2ec": {"scan"},
    "ros2": {"map", "robot", "scan"},
}
PLACES = {"wc2ec": (0.9, 1.6, 0.2)}
"""Where the robot stands: its distance sensors see one metre."""


def depth(x: float, y: float) -> float:
    """Give how deep in a box, or beyond the walls, a place is; below 0 in the open."""
    boxes = [min(x - box.x_min, box.x_max - x, y - box.y_min, box.y_max - y) for box in BOXES]
    return max(*boxes, abs(x) - HALF_SIDE_M, abs(y) - HALF_SIDE_M)


def wall_distance(x: float, y: float) -> float:
    """Give the distance from a place to the next surface of the room."""
    away = [math.hypot(max(b.x_min - x, 0.0, x - b.x_max), max(b.y_min - y, 0.0, y - b.y_max)) for b in BOXES]
    inside = depth(x, y)
    return inside if inside > 0 else min(*away, HALF_SIDE_M - abs(x), HALF_SIDE_M - abs(y))


def in_room(body: Body, points: Places) -> Places:
    """Turn places in the robot's own frame to the room's."""
    cos, sin = math.cos(body.heading), math.sin(body.heading)
    return [(body.x + x * cos - y * sin, body.y + x * sin + y * cos) for x, y in points]


def farthest(points: Places) -> float:
    """Give how far the worst of these places is from a surface."""
    return max(wall_distance(x, y) for x, y in points)


@pytest.mark.parametrize("protocol", PUBLISHED)
async def test_map_scan_and_robot_are_where_they_are_in_the_room(
    tmp_path: Path, protocol: str, monkeypatch: pytest.MonkeyPatch, shared: Any
) -> None:
    body = Body(*PLACES.get(protocol, (0.3, -0.2, 0.7)))
    async with room(protocol, shared, tmp_path, monkeypatch, body) as scene:
        page = await scene.browser.open("/#/robot/r1")
        found = await drawn(page, PUBLISHED[protocol])
        await scene.browser.photograph(page, f"room-{protocol}")
    if "map" in PUBLISHED[protocol]:
        assert farthest(found["occupied"]) < 0.16, "cells of 0.1 m, and one of noise"
        assert max(depth(x, y) for x, y in found["free"]) < 0.1, "free is what no box and no wall occupies"
    if "scan" in PUBLISHED[protocol]:
        scan = found["scan"] if "robot" in PUBLISHED[protocol] else in_room(body, found["scan"])
        assert farthest(scan) < 0.12, "a point is three pixels wide, 0.075 m"
    if "robot" in PUBLISHED[protocol]:
        x, y = middle(found["robot"])
        assert math.hypot(x - body.x, y - body.y) < 0.1
        tip = max(found["robot"], key=lambda place: math.dist(place, (body.x, body.y)))
        assert abs(math.remainder(math.atan2(tip[1] - body.y, tip[0] - body.x) - body.heading, math.tau)) < 0.2


async def drawn(page: Any, published: set[str]) -> dict[str, Places]:
    """Wait until everything that the robot publishes is drawn."""
    needed = {"map": ("occupied", "free"), "scan": ("scan",), "robot": ("robot",)}
    colors = [color for name in published for color in needed[name]]
    async with asyncio.timeout(20):
        while True:
            await page.wait_for_timeout(500)
            found = await places(page, *colors)
            if all(found[color] for color in colors):
                return found
