"""A robot is driven from its page, against the gateway's own lease: whoever cannot be known to steer moves nothing."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import pytest_asyncio

from tests.browser.conftest import Browser, pushed, soon
from tests.client import Gateway, World
from tests.views.console.serving import served
from zbridge.fleet import topics
from zbridge.fleet.messages import Device, Devices, Drive, Mode, Motor, Status

pytestmark = pytest.mark.asyncio(loop_scope="session")

COMMANDS = ("stop", "drive", "mode", "motor")
ROBOT = "/#/robot/r1"
LIMIT = 0.5
PAD = """() => {
  window.pad = { index: 0, id: 'Test pad', connected: true, timestamp: 1, axes: [0, 0, 0, 0],
                 buttons: Array.from({ length: 16 }, () => ({ pressed: false })) };
  window.pads = [window.pad];
  navigator.getGamepads = () => window.pads;
  window.push = (...axes) => { window.pad.axes = axes; window.pad.timestamp += 1; };
}"""


class Lane:
    """One robot, its console, and pages that drive it."""

    def __init__(self, world: World, browser: Browser) -> None:
        self.world, self.browser = world, browser
        self.robot: Gateway = world.gateways["r1"]
        self.commands = COMMANDS
        """What the robot accepts."""

    async def publish_status(self) -> None:
        """Publish the robot's status as a gateway does."""
        while True:
            self.robot.publish(topics.STATUS, Status("established", commands=self.commands))
            await asyncio.sleep(0.5)

    async def page(self, **options: Any) -> Any:
        page = await self.browser.open(ROBOT, **options)
        await page.get_by_role("button", name="Take control").wait_for()
        return page

    async def driver(self, **options: Any) -> Any:
        """Open a page that has control, with its stick centred."""
        page = await self.page(**options)
        await page.get_by_role("button", name="Take control").click()
        await page.get_by_text("Ready.").wait_for()
        return page

    @property
    def last(self) -> Drive:
        """The drive that the robot was sent last."""
        return self.robot.driven[-1] if self.robot.driven else Drive()  # type: ignore[return-value]

    async def moves(self, forward: float = LIMIT, left: float = 0.0, turn: float = 0.0) -> None:
        """Wait until the robot is driven so."""
        await soon(lambda: self.last == Drive(forward=forward, left=left, turn=turn), 5.0)

    async def press(self, page: Any, key: str = "w", forward: float = LIMIT) -> None:
        """Hold a key until it drives the robot."""
        keyboard = page.keyboard
        await pushed(page, lambda: keyboard.down(key), lambda: keyboard.up(key), lambda: self.moves(forward))

    async def stops(self, within_s: float = 5.0) -> None:
        await soon(lambda: not self.last.moving, within_s)

    async def stays(self, seconds: float = 0.6) -> None:
        """See that nothing moves the robot for a while."""
        await self.stops()
        count = len(self.robot.driven)
        await asyncio.sleep(seconds)
        assert not [drive for drive in self.robot.driven[count:] if drive.moving]  # type: ignore[attr-defined]


@pytest_asyncio.fixture(loop_scope="session")
async def lane(tmp_path: Path, shared: Any) -> AsyncIterator[Lane]:
    world = World("r1")
    async with served(world.fleet, world.bus.join("console"), tmp_path / "roster") as at:
        made = Lane(world, Browser(shared, at))
        publishing = asyncio.create_task(made.publish_status())
        yield made
        assert made.browser.complaints == []
    publishing.cancel()
    await asyncio.gather(publishing, return_exceptions=True)


async def test_keys_drive_while_they_are_held_and_the_limit_counts(lane: Lane) -> None:
    page = await lane.driver()
    keyboard = page.keyboard
    for keys, motion in {
        ("w",): (LIMIT, 0.0, 0.0),
        ("ArrowDown",): (-LIMIT, 0.0, 0.0),
        ("w", "a"): (LIMIT, 0.0, LIMIT),
        ("ArrowRight",): (0.0, 0.0, -LIMIT),
        ("q",): (0.0, LIMIT, 0.0),
    }.items():
        for key in keys:
            await keyboard.down(key)
        await lane.moves(*motion)
        for key in keys:
            await keyboard.up(key)
        await lane.stops()
    await page.get_by_role("slider").fill("20")
    await page.locator("h1").click()
    await keyboard.down("w")
    await lane.moves(0.2)
    await keyboard.down("s")
    await lane.stops()
    await keyboard.up("s")
    await keyboard.up("w")
    await page.get_by_role("button", name="Give back").click()
    await soon(lambda: lane.robot.control.state == "free")
    await keyboard.down("w")
    await lane.stays()


async def test_a_stick_that_was_deflected_when_control_was_taken_must_be_centred(lane: Lane) -> None:
    page = await lane.page()
    await page.evaluate(PAD)
    await page.evaluate("push(0, -1)")
    await page.get_by_role("button", name="Take control").click()
    await page.get_by_text("centre the stick: control was just taken").wait_for()
    await lane.stays()
    await page.evaluate("push(0, 0)")
    await page.get_by_text("Ready.").wait_for()
    await page.evaluate("push(0, -1)")
    await lane.moves()


async def test_space_stops_the_robot_and_clicks_no_button_again(lane: Lane) -> None:
    page = await lane.driver()
    await lane.press(page)
    stops = lane.robot.machine.stops
    await page.keyboard.press("Space")
    await soon(lambda: lane.robot.machine.stops > stops)
    await page.get_by_text("the lease has ended").wait_for()
    await lane.stays()
    assert await page.get_by_role("button", name="Take control").count() == 1


async def test_space_stops_wherever_the_focus_is_and_once_for_each_press(lane: Lane) -> None:
    page = await lane.driver()
    await page.get_by_role("slider").focus()
    stops = lane.robot.machine.stops
    await page.evaluate("dispatchEvent(new KeyboardEvent('keydown', {code: 'Space', repeat: true}))")
    await page.wait_for_timeout(200)
    assert lane.robot.machine.stops == stops
    await page.keyboard.press("Space")
    await soon(lambda: lane.robot.machine.stops > stops)


@pytest.mark.parametrize(
    "event", ["new MouseEvent('contextmenu')", "new Event('dragstart')", "new KeyboardEvent('keydown', {key: 'Meta'})"]
)
async def test_a_key_whose_release_the_page_may_not_hear_counts_no_longer(lane: Lane, event: str) -> None:
    page = await lane.driver()
    await lane.press(page)
    await page.evaluate(f"dispatchEvent({event})")
    await lane.stays()


async def test_a_stick_that_vanishes_while_it_is_dragged_is_let_go(lane: Lane) -> None:
    page = await lane.driver()
    box = await page.get_by_label("Stick: drag to drive").bounding_box()
    await page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    await page.mouse.down()
    await page.mouse.move(box["x"] + box["width"] / 2, box["y"])
    await lane.moves()
    lane.commands = ("stop", "motor")
    await page.get_by_label("Stick: drag to drive").wait_for(state="detached")
    lane.commands = COMMANDS
    await page.get_by_label("Stick: drag to drive").wait_for()
    await lane.stays()
    await page.mouse.up()


async def test_the_stick_on_the_page_is_dragged_by_mouse_and_let_go(lane: Lane) -> None:
    page = await lane.driver()
    stick = page.get_by_label("Stick: drag to drive")
    box = await stick.bounding_box()
    middle, top = box["x"] + box["width"] / 2, box["y"]
    await page.mouse.move(middle, top + box["height"] / 2)
    await page.mouse.down()
    await page.mouse.move(middle, top - 50)
    await lane.moves()
    await page.mouse.move(box["x"] - 50, top + box["height"] / 2)
    await soon(lambda: lane.last.turn > 0.4)
    await page.mouse.up()
    await lane.stops(1.0)


async def test_the_stick_on_the_page_is_dragged_by_a_finger(lane: Lane) -> None:
    page = await lane.driver()
    box = await page.get_by_label("Stick: drag to drive").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    devtools = await page.context.new_cdp_session(page)

    async def touch(kind: str, *points: dict[str, float]) -> None:
        await devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": list(points)})

    await touch("touchStart", {"x": x, "y": y})
    await touch("touchMove", {"x": x, "y": y - 200})
    await lane.moves()
    await touch("touchEnd")
    await lane.stops(1.0)


async def test_a_gamepad_drives_with_its_dead_zone_and_profiles(lane: Lane) -> None:
    page = await lane.page()
    await page.evaluate(PAD)
    await page.get_by_role("button", name="Take control").click()
    await page.get_by_text("Test pad: drives").wait_for()
    await page.evaluate("push(0.1, -0.1)")
    await page.get_by_text("Ready.").wait_for()
    await page.evaluate("push(0, -1)")
    await lane.moves()
    await page.evaluate("push(1, 0)")
    await lane.moves(0.0, 0.0, -LIMIT)
    await page.evaluate("push(0, 0)")
    await lane.stops()
    for name in ("Sideways", "Inverted"):
        await page.get_by_role("button", name=name).click()
        await page.wait_for_timeout(100)
    await page.evaluate("push(-1, 0, 1)")
    await lane.moves(0.0, LIMIT, -LIMIT)
    await page.evaluate("push(0, 1)")
    await lane.moves()
    await page.evaluate("push(0, 0)")
    await lane.stops()
    await page.get_by_role("button", name="Hold a shoulder button").click()
    await page.wait_for_timeout(100)
    await page.evaluate("push(0, 1)")
    await lane.stays()
    await page.evaluate("pad.buttons[5].pressed = true; push(0, 1)")
    await lane.moves()
    await page.evaluate("pad.buttons[5].pressed = false; push(0, 1)")
    await lane.stops()


async def pushing(lane: Lane) -> Any:
    """Open a page whose gamepad is pushed forward."""
    page = await lane.page()
    await page.evaluate(PAD)
    await page.get_by_role("button", name="Take control").click()
    await page.get_by_text("Ready.").wait_for()
    await page.evaluate("window.alive = setInterval(() => push(0, -1), 100)")
    await lane.moves()
    return page


async def test_a_gamepad_that_froze_counts_as_centred_until_it_was_centred(lane: Lane) -> None:
    page = await pushing(lane)
    began = time.monotonic()
    await page.evaluate("clearInterval(alive)")
    await lane.stops()
    assert 1.5 < time.monotonic() - began < 3.5
    await page.get_by_text("sends nothing new: it counts as centred").wait_for()
    await page.evaluate("push(0, -1)")
    await page.get_by_text("the gamepads have changed").wait_for()
    await lane.stays()
    await page.evaluate("push(0, 0)")
    await page.get_by_text("Ready.").wait_for()
    await page.evaluate("push(0, -1)")
    await lane.moves()


async def test_a_gamepad_that_is_gone_and_comes_back_deflected_moves_nothing(lane: Lane) -> None:
    page = await pushing(lane)
    await page.evaluate("pads = []")
    await lane.stops(1.0)
    await page.evaluate("pads = [null, {...pad, index: 1}]; window.pad = pads[1]")
    await page.get_by_text("the gamepads have changed").wait_for()
    await lane.stays()


async def test_without_the_focus_nothing_moves_and_a_key_must_be_pressed_anew(lane: Lane) -> None:
    page = await lane.driver()
    await lane.press(page)
    await page.evaluate("document.hasFocus = () => false")
    await lane.stops(1.0)
    await page.get_by_text("this page does not have the focus").wait_for()
    await page.evaluate("document.hasFocus = () => true; dispatchEvent(new Event('blur'))")
    await page.keyboard.down("w")  # repeats
    await lane.stays()
    await page.keyboard.up("w")
    await page.get_by_text("Ready.").wait_for()
    await lane.press(page)


async def test_a_gamepad_that_is_still_pushed_when_the_focus_returns_must_be_centred(lane: Lane) -> None:
    page = await pushing(lane)
    await page.evaluate("document.hasFocus = () => false")
    await lane.stops(1.0)
    await page.evaluate("document.hasFocus = () => true")
    await page.get_by_text("the page was out of focus").wait_for()
    await lane.stays()


async def test_keys_that_are_pressed_without_the_focus_are_discarded(lane: Lane) -> None:
    page = await lane.driver()
    await page.evaluate("document.hasFocus = () => false")
    await page.keyboard.down("w")
    await page.evaluate("document.hasFocus = () => true")
    await lane.stays()


async def test_a_hidden_page_moves_nothing(lane: Lane) -> None:
    page = await lane.driver()
    await lane.press(page)
    await page.evaluate("Object.defineProperty(document, 'hidden', {value: true, configurable: true})")
    await page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
    await lane.stops(1.0)
    await lane.stays()


async def test_a_closed_tab_stops_the_robot_and_gives_it_back(lane: Lane) -> None:
    page = await lane.driver()
    await lane.press(page)
    await page.close()
    await lane.stops(1.0)
    await soon(lambda: lane.robot.control.state == "free", 5.0)


async def test_another_page_of_the_console_gives_the_robot_back(lane: Lane) -> None:
    page = await lane.driver()
    await lane.press(page)
    await page.evaluate("location.hash = ''")
    await lane.stops(1.0)
    await soon(lambda: lane.robot.control.state == "free", 1.0)


async def test_a_reloaded_page_has_its_control_back_and_waits_for_neutral(lane: Lane) -> None:
    page = await lane.driver()
    holder = lane.robot.control.holder
    await lane.press(page)
    await page.reload()
    await lane.stops(1.0)
    await page.get_by_text("You drive r1").wait_for()
    assert lane.robot.control.holder == holder
    assert len(lane.robot.questions("acquire")) == 1
    await lane.stays()
    await page.keyboard.up("w")
    await page.get_by_text("Ready.").wait_for()
    await lane.press(page)


async def test_a_copied_tab_does_not_get_the_control(lane: Lane) -> None:
    page = await lane.driver()
    async with page.context.expect_page() as opening:
        await page.evaluate("open(location.href)")
    copy = await opening.value
    await copy.get_by_role("button", name="Take control").wait_for()
    await copy.wait_for_timeout(300)
    assert await page.get_by_text("You drive r1").count() == 1
    await page.close()
    await soon(lambda: lane.robot.control.state == "free")
    assert await copy.get_by_text("You drive r1").count() == 0


class Wire:
    """The drive socket of a page, which can be stalled in each direction, or cut."""

    def __init__(self) -> None:
        self.up, self.down, self.held = True, True, list[tuple[Any, Any]]()
        self._server: Any = None
        self._page: Any = None

    def __call__(self, socket: Any) -> None:
        self._page, self._server = socket, socket.connect_to_server()
        socket.on_message(lambda text: self._pass(self._server, text, self.up))
        self._server.on_message(lambda text: self._pass(socket, text, self.down))

    def _pass(self, to: Any, text: Any, passes: bool) -> None:
        if passes:
            to.send(text)
        else:
            self.held.append((to, text))

    def release(self) -> None:
        """Deliver what was held up, all at once."""
        self.up = self.down = True
        for to, text in self.held:
            to.send(text)
        self.held.clear()

    async def cut(self) -> None:
        await self._page.close()  # first: nothing more is passed on to a server that has ended
        await self._server.close()


@pytest.mark.parametrize("direction", ["up", "down"])
async def test_a_stalled_connection_stops_the_robot_and_its_burst_moves_nothing(lane: Lane, direction: str) -> None:
    wire = Wire()
    page = await lane.page()
    await page.route_web_socket("**/drive/*", wire)
    await page.get_by_role("button", name="Take control").click()
    await page.get_by_text("Ready.").wait_for()
    await lane.press(page)
    setattr(wire, direction, False)
    await lane.stops(1.5)
    await asyncio.sleep(1.0)
    assert wire.held
    wire.release()
    await lane.stays()
    await page.get_by_text("connection to this page").wait_for()
    await page.keyboard.up("w")
    await page.get_by_text("Ready.").wait_for()
    await lane.press(page)


async def test_a_cut_connection_stops_the_robot_and_control_comes_back_with_neutral(lane: Lane) -> None:
    wire = Wire()
    page = await lane.page()
    await page.route_web_socket("**/drive/*", wire)
    await page.get_by_role("button", name="Take control").click()
    await page.get_by_text("Ready.").wait_for()
    await lane.press(page)
    await wire.cut()
    await lane.stops(1.0)
    await page.get_by_text("You drive r1").wait_for()
    await lane.stays()
    await page.keyboard.up("w")
    await page.get_by_text("Ready.").wait_for()


async def test_a_slow_connection_does_not_drive(lane: Lane) -> None:
    page = await lane.page()

    def slow(socket: Any) -> None:
        upstream = socket.connect_to_server()
        loop = asyncio.get_running_loop()
        socket.on_message(lambda text: loop.call_later(0.13, upstream.send, text))
        upstream.on_message(lambda text: loop.call_later(0.13, socket.send, text))

    await page.route_web_socket("**/drive/*", slow)
    await page.get_by_role("button", name="Take control").click()
    await page.get_by_text("the connection is too slow or stalled").wait_for()
    await page.keyboard.down("w")
    await lane.stays(1.0)


async def frozen(page: Any, chromium: Any) -> list[int]:
    """Give the processes that draw pages."""
    devtools = await chromium.new_browser_cdp_session()
    found = (await devtools.send("SystemInfo.getProcessInfo"))["processInfo"]
    return [int(process["id"]) for process in found if process["type"] == "renderer"]


async def test_a_frozen_renderer_stops_the_robot_and_its_key_counts_no_longer(lane: Lane) -> None:
    page = await lane.driver()
    await lane.press(page)
    pids = await frozen(page, page.context.browser)
    try:
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        await lane.stops(1.5)
        await asyncio.sleep(0.7)
    finally:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)
    await lane.stays(1.0)
    await page.keyboard.up("w")
    await page.get_by_text("Ready.").wait_for()
    await lane.press(page)


async def test_a_second_browser_is_refused_sees_by_whom_and_may_take_over(lane: Lane) -> None:
    first = await lane.driver()
    await lane.press(first)
    second = await lane.browser.open(ROBOT)
    await second.get_by_text("console.browser1 drives").first.wait_for()
    await second.get_by_role("button", name="Take control").click()
    question = second.locator(".drive .question")
    assert "console.browser1 is driving now, and loses control at once" in (await question.inner_text())
    await second.get_by_role("button", name="Keep watching").click()
    await second.get_by_role("button", name="Take control").click()
    await second.get_by_role("button", name="Take over").click()
    await second.get_by_text("Ready.").wait_for()
    await first.get_by_text("held by console.browser2").wait_for()
    await lane.stays()
    await lane.press(second, "s", -LIMIT)


async def test_who_drives_by_another_program_refuses_the_page(lane: Lane) -> None:
    page = await lane.page()
    async with lane.world.others.control("ann@desk"):
        drive: Callable[[], Any] = lambda: page.evaluate(  # noqa: E731
            "document.querySelector('.drive button').click()"
        )
        await drive()
        await (
            page.get_by_text("r1 is held by ann@desk").or_(page.get_by_text("ann@desk is driving now")).first.wait_for()
        )
    assert await page.get_by_text("You drive r1").count() == 0


async def test_modes_and_motors_are_there_for_what_the_robot_accepts(lane: Lane) -> None:
    devices = Devices(
        (Device("left wheel", 1, "rotational"), Device("lift", 2, "linear"), Device("ds0", 3, "distance"))
    )
    lane.robot.publish(topics.DEVICES, devices)
    page = await lane.driver()
    await page.get_by_role("button", name="manual").click()
    await page.get_by_role("button", name="manual", pressed=True).wait_for()
    assert ("mode", Mode("manual")) in lane.robot.machine.commands
    await page.get_by_role("button", name="autonomous", exact=True).click()
    await page.get_by_text("r1 then moves by itself.").wait_for()
    assert ("mode", Mode("autonomous")) not in lane.robot.machine.commands
    await page.get_by_role("button", name="Set autonomous").click()
    await soon(lambda: ("mode", Mode("autonomous")) in lane.robot.machine.commands)
    await page.evaluate("document.hasFocus = () => false")
    await page.get_by_role("button", name="none", pressed=True).wait_for()
    await page.evaluate("document.hasFocus = () => true")
    await soon(lambda: lane.robot.machine.commands[-1] == ("mode", Mode("none")) or not lane.last.moving)
    await soon(lambda: not lane.robot.authority.motion.autonomous)
    await page.get_by_text("Ready.").wait_for()
    await page.get_by_text("Single motors").click()
    button = page.get_by_role("button", name="left wheel forwards")
    await button.hover()
    await page.mouse.down()
    await soon(lambda: lane.robot.machine.commands[-1] == ("motor/left%20wheel", Motor(1.0)))
    await page.mouse.up()
    await soon(lambda: ("motor/left%20wheel", Motor(0.0)) in lane.robot.machine.commands)
    await soon(lambda: lane.robot.machine.commands[-1] == ("drive", Drive()))
    assert await page.get_by_role("button", name="ds0 forwards").count() == 0


async def test_a_robot_does_not_move_by_itself_if_nobody_watches_when_it_begins(lane: Lane) -> None:
    page = await lane.driver()
    await page.get_by_role("button", name="autonomous", exact=True).dblclick()
    await page.wait_for_timeout(300)
    assert ("mode", Mode("autonomous")) not in lane.robot.machine.commands, "it is asked first"
    await page.get_by_role("button", name="Set autonomous").evaluate(
        "(button) => { button.click(); document.hasFocus = () => false; }"
    )
    await soon(lambda: ("mode", Mode("none")) in lane.robot.machine.commands)
    await soon(lambda: not lane.robot.authority.motion.autonomous)
    await lane.stays()
    assert not lane.robot.authority.motion.autonomous


async def test_the_page_says_how_long_a_round_trip_takes(lane: Lane) -> None:
    page = await lane.driver()
    text = await page.get_by_text("round trip").inner_text()
    trip_ms = int(text.rpartition("round trip ")[2].split()[0])
    assert 0 <= trip_ms < 200
    assert json.loads(await page.evaluate("JSON.stringify(Object.keys(sessionStorage))")) == ["zbridge.control.r1"]
