"""Robots of all protocols are driven from their pages, also where others drive: judged by the robot's body."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser.conftest import Browser, pushed
from tests.browser.rooms import Room, configured, console, room, simulated
from tests.e2e.conftest import Bench, Gateway, listener, repeated, until
from tests.e2e.rigs.ros2_scene import RosScene
from tests.ports import HOST, free_port
from zbridge.simulation.world import Body

pytestmark = pytest.mark.asyncio(loop_scope="session")

ROBOT = "/#/robot/r1"


@pytest.mark.parametrize("protocol", ["tcpudp", "alf", "wc2ec", "ros2"])
async def test_keys_stick_and_gamepad_drive_a_robot_and_letting_go_stops_it(
    tmp_path: Path, protocol: str, monkeypatch: pytest.MonkeyPatch, shared: Any
) -> None:
    async with room(protocol, shared, tmp_path, monkeypatch, Body(-1.0, 0.5, 0.3)) as scene:
        page = await scene.browser.open(ROBOT)
        await page.get_by_role("button", name="Take control").click()
        await page.get_by_text("Ready.").wait_for()
        keyboard = page.keyboard
        await pushed(page, lambda: keyboard.down("w"), lambda: keyboard.up("w"), scene.moves)
        await keyboard.up("w")
        await scene.rests()
        await pushed(page, lambda: drag(page), page.mouse.up, scene.moves)
        await page.mouse.up()
        await scene.rests()
        pad = "{index: 0, id: 'pad', connected: true, timestamp: 1, axes: [0, 0], buttons: []}"
        await page.evaluate(f"window.pad = {pad}; navigator.getGamepads = () => [window.pad]")
        await page.get_by_text("pad: drives").wait_for()
        await page.get_by_text("Ready.").wait_for()
        await page.evaluate("window.along = 0; setInterval(() => { pad.axes = [0, along]; pad.timestamp += 1; }, 50)")
        push, let_go = (lambda along=along: page.evaluate(f"window.along = {along}") for along in (-1, 0))
        await pushed(page, push, let_go, scene.moves)
        await let_go()
        await scene.rests()


async def drag(page: Any) -> None:
    """Pull the stick on the page back."""
    stick = page.get_by_label("Stick: drag to drive")
    await stick.hover()
    await page.mouse.down()
    box = await stick.bounding_box()
    await page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"])


async def takes_over(scene: Room, other: str) -> Any:
    """Open a page that sees who drives, is refused, and takes over; the other's stick is dead then."""
    await scene.moves()
    page = await scene.browser.open(ROBOT)
    await page.locator(".title .driver").get_by_text(other).wait_for()
    await page.get_by_role("button", name="Take control").click()
    await page.get_by_text("loses control at once").wait_for()
    await page.get_by_role("button", name="Take over").click()
    await page.get_by_text("Ready.").wait_for()
    await scene.rests(1.0)
    keyboard = page.keyboard
    await pushed(page, lambda: keyboard.down("s"), lambda: keyboard.up("s"), scene.moves)
    await keyboard.up("s")
    await scene.rests()
    return page


async def test_an_old_program_that_drives_is_seen_and_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shared: Any
) -> None:
    port = free_port()
    async with room("alf", shared, tmp_path, monkeypatch, Body(0.0, 0.5, 0.3), listener("hq", "tcpudp", port)) as scene:
        scene.bench.zbridge("simulate", "tcpudp", "--hq", f"tcp://{HOST}:{port}", "--drive", "0.3")
        page = await takes_over(scene, "hq")
        await page.get_by_role("heading", name="Refused lately").wait_for()  # what it still pushes


class RosRoom(RosScene):
    """ROS 2 beside a simulated robot."""

    @contextlib.asynccontextmanager
    async def console(self, monkeypatch: pytest.MonkeyPatch, shared: Any) -> AsyncIterator[Room]:
        body, bench = Body(0.0, 0.5, 0.3), Bench(self.folder, self.stack)
        async with simulated("alf", monkeypatch, body) as ports:
            Gateway(self.stack, self.folder / "r1.toml", self.fleet_at, configured("alf", ports))
            browser = Browser(shared, await console(bench, self.fleet_at))
            await asyncio.to_thread(self.told, "r1: state", "established")
            yield Room(bench, body, browser)
            assert browser.complaints == []


@pytest.mark.long
async def test_a_ros_publisher_that_drives_is_seen_and_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shared: Any
) -> None:
    with contextlib.ExitStack() as stack:
        ros = RosRoom(stack, tmp_path, "[robot.r1]\nspeed_full_mps = 0.5\nwheelbase_m = 0.3\n")
        async with ros.console(monkeypatch, shared) as scene:
            ended = asyncio.Event()
            pushing = asyncio.create_task(asyncio.to_thread(push, ros, ended))
            try:
                await takes_over(scene, "ros2.teleop")
                await asyncio.to_thread(ros.told, "r1: control", "held by console.browser1")
            finally:
                ended.set()
                await pushing


def push(ros: RosRoom, ended: asyncio.Event) -> None:
    """Push the stick of a ROS publisher until the end."""
    with ros.publishing("r1") as publisher, repeated(lambda: publisher.twist(0.25)):
        until(ended.is_set, 60.0, "the end")
