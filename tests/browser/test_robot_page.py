"""The page of one robot, from a mocked feed: all its states are drawn, what is old is grey, and texts stay texts."""

from __future__ import annotations

import base64
import json
import math
import re
import struct
import time
from typing import Any

import msgpack
import pytest

from tests.browser.conftest import NARROW, WIDE, Browser, Feed, row, soon, told
from tests.browser.scene import middle, places
from tests.browser.test_fleet_page import EVIL, NOBODY_ANSWERS

pytestmark = pytest.mark.asyncio(loop_scope="session")

NOW_NS = time.time_ns()
POSE = {"x": 1.0, "y": 2.0, "heading": 0.5, "stamp_ns": NOW_NS}
MAP = {"rows": 40, "columns": 40, "cell": 0.1, "origin": [-1.0, 0.0], "cells": bytes([1]) * 800 + bytes([2, 0]) * 400}
SCAN = {
    "angle_min": -math.pi / 2,
    "angle_increment": math.pi / 180,
    "range_min": 0.1,
    "range_max": 10.0,
    "ranges": struct.pack("<181f", *(1.0 + 0.001 * step for step in range(181))),
    "stamp_ns": NOW_NS,
}
STATUS = {"state": "established", "links": [{"name": "robot", "state": "established", "peer": "tcp://10.0.0.1:11001"}]}
CONTROL = {
    "state": "held",
    "refusals": [{"who": "bob", "command": "drive", "code": "held", "reason": "held by ann", "count": 7, "by": None}],
}
STATS = {
    "process": {"cpu": 0.02, "resident_bytes": 60_000_000, "proportional_bytes": 33_000_000},
    "rates": {"pose": 20.0},
}
SESSIONS = {
    "gateway": msgpack.packb({"sessions": [{"name": "hq 2", "peer": "10.0.0.7", "state": "closed", "version": "1.2"}]})
}
HISTORY = [{"at": 1_700_000_000.0, "text": "ann drives"}, {"at": 1_700_000_009.0, "text": "stopped by this console"}]
READING = {"value": 0.25, "kind": "distance", "fault": False}
FULL: dict[str, Any] = {
    "pose": POSE,
    "map": MAP,
    "scan": SCAN,
    "status": STATUS,
    "control": CONTROL,
    "motion": {"speed": 0.5, "temperature": 36.5},
    "battery": {"level": 0.75, "charging": False},
    "sensor__front%20left": READING,
    "lidar": {"on": True},
    "text": {"text": "hello", "kind": "chat", "sender": "hq 2"},
    "@gateway__stats": STATS,
    "@sessions": SESSIONS,
    "@history": HISTORY,
}
STATES: dict[str, dict[str, Any]] = {
    "free": row("r1", commands=["stop", "drive", "lidar", "light", "camera"]),
    "held": row("r1", driver="ann@desk"),
    "busy": row("r1", reason="busy: it saves its map", commands=[]),
    "held-back": row("r1", driver="ann@desk", reason="ann must centre the joystick first"),
    "stopped": row("r1", driver="stopped"),
    "latched": row("r1", "LATCHED", 8, latched=["latched by ann (wet floor)"], driver="LATCHED"),
    "stalled": row("r1", "stalled", 3, reason="its link acknowledges nothing"),
    "away": row("r1", "offline", 2, reason="connection refused", commands=[], rate=None),
    "silent": row("r1", "SILENT", 1, rate=None, seen=1_700_000_000, commands=[]),
    "killed": row("r1", "NO GATEWAY", 0, protocol="", version="", refused=None, gaps=None, commands=[]),
    "hostile": row("r1", reason=EVIL * 300, driver=EVIL, protocol=EVIL, version=EVIL, host=EVIL, latched=[EVIL]),
}
ROBOT = "/#/robot/r1"


async def opened(browser: Browser, *, state: str = "free", **options: Any) -> tuple[Any, Feed]:
    """Open the page of r1 in a state."""
    feed = Feed(STATES[state])
    page = await browser.open(ROBOT, feed=feed, **options)
    await feed.looked_at("r1")
    return page, feed


@pytest.mark.parametrize(("size", "scheme"), [(WIDE, "light"), (NARROW, "dark")])
async def test_every_state_is_drawn_without_a_complaint(browser: Browser, size: Any, scheme: str) -> None:
    page, feed = await opened(browser, size=size, scheme=scheme)
    for state, told_row in STATES.items():
        feed.tell(rows=[told_row])
        feed.publish("r1", **{**FULL, "text": {"text": f"in {state}"}})
        await page.get_by_text(f"in {state}").last.wait_for()
        if state not in ("away", "silent", "killed"):
            await page.locator(".uplot").first.wait_for()
        assert await page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        assert await page.evaluate("document.querySelector('.robot').scrollWidth <= innerWidth")
        assert await page.locator("img").count() == 0
        await browser.photograph(page, f"robot-{state}-{scheme}")
    assert browser.complaints == []


async def test_where_a_stop_may_not_arrive_the_page_says_so_and_gives_no_control(browser: Browser) -> None:
    page, feed = await opened(browser)
    for state in ("free", "held", "latched", "stalled", "away", "silent", "killed"):
        feed.tell(rows=[STATES[state]])
        feed.publish("r1", text={"text": f"in {state}", "kind": "chat"})
        await page.get_by_text(f"in {state}").last.wait_for()
        warned = await page.get_by_role("alert").all_inner_texts()
        take = page.get_by_role("button", name="Take control")
        driven = bool(STATES[state]["commands"])
        assert await take.count() == (1 if driven else 0), state
        if state in ("free", "held", "latched"):
            assert warned == [], state
        else:
            assert "Stop may not reach it. Use the emergency stop on the robot." in warned[0]
        assert not driven or await take.is_enabled() == (state in ("free", "held")), state


async def test_what_a_robot_publishes_is_shown_and_what_it_does_not_is_said(browser: Browser) -> None:
    page, feed = await opened(browser)
    feed.publish("r1", **FULL)
    text = page.locator(".panels")
    await page.get_by_text("Not published: image.").wait_for()
    told = await text.inner_text()
    for expected in (
        *(
            "robot: established tcp://10.0.0.1:11001",
            "75 %",
            "36.5 °C",
            "pose (20.0 a second)",
            "front left",
            "0.250 distance",
        ),
        *(
            "7 x drive of bob: held by ann",
            "stopped by this console",
            "hq 2 10.0.0.7, version 1.2: closed",
            "chat hq 2 hello",
        ),
        *("2.0 %, 33 MB",),
    ):
        assert expected in told, expected
    newest, oldest = told.index("stopped by this console"), told.index("ann drives")
    assert newest < oldest
    assert browser.complaints == []


async def test_map_scan_and_robot_are_drawn_where_they_are(browser: Browser) -> None:
    page, feed = await opened(browser)
    feed.publish("r1", pose=POSE, map=MAP, scan=SCAN)
    await page.wait_for_timeout(300)
    found = await places(page, "occupied", "free", "scan", "robot")
    x, y = middle(found["robot"])
    assert math.hypot(x - 1.0, y - 2.0) < 0.1
    assert all(2.0 - 0.03 < y < 4.03 for _, y in found["occupied"])
    assert all(-1.03 < x < 3.03 and -0.03 < y < 2.03 for x, y in found["free"])
    assert len(found["free"]) > 1500
    assert len(found["scan"]) > 300
    for x, y in found["scan"]:
        bearing = math.atan2(y - 2.0, x - 1.0) - 0.5
        expected = 1.0 + 0.001 * math.degrees(bearing + math.pi / 2)
        assert abs(math.hypot(x - 1.0, y - 2.0) - expected) < 0.08


async def test_a_scan_is_drawn_where_the_robot_was_when_it_measured(browser: Browser) -> None:
    page, feed = await opened(browser)
    for step, heading in enumerate((0.0, 1.0, 2.0)):
        feed.publish("r1", pose={**POSE, "heading": heading, "stamp_ns": NOW_NS + step * 200_000_000})
    one_ray = {**SCAN, "angle_min": 0.0, "ranges": struct.pack("<f", 2.0), "stamp_ns": NOW_NS + 100_000_000}
    feed.publish("r1", scan=one_ray)
    await page.wait_for_timeout(300)
    x, y = middle((await places(page, "scan"))["scan"])
    assert abs(math.atan2(y - 2.0, x - 1.0) - 0.5) < 0.03, "half way between the first two poses"


async def test_what_ends_at_the_range_of_the_scanner_is_no_wall(browser: Browser) -> None:
    page, feed = await opened(browser)
    invalid = struct.pack("<5f", 10.0, math.inf, math.nan, 0.05, -1.0)
    feed.publish("r1", pose=POSE, scan={**SCAN, "ranges": invalid})
    await page.wait_for_timeout(300)
    assert (await places(page, "scan"))["scan"] == []


async def test_a_robot_without_a_pose_is_drawn_in_its_own_frame_forward_up(browser: Browser) -> None:
    page, feed = await opened(browser)
    ahead = {**SCAN, "angle_min": 0.0, "ranges": struct.pack("<f", 2.0)}
    feed.publish("r1", scan=ahead)
    await page.wait_for_timeout(300)
    x, y = middle((await places(page, "scan"))["scan"])
    assert math.hypot(x - 2.0, y) < 0.05
    view = await page.evaluate("JSON.parse(document.querySelector('.picture canvas').dataset.view)")
    assert view[1] < 0
    assert view[0] == 0
    assert await page.get_by_text("in the robot's own frame").count() == 1


async def test_what_has_not_come_for_three_periods_is_grey_and_shows_its_age_and_nothing_is_free(
    browser: Browser,
) -> None:
    page, feed = await opened(browser)
    feed.publish("r1", pose=POSE, map=MAP, scan=SCAN, period_s=0.3)
    await page.wait_for_timeout(300)
    assert await page.locator(".overlay.age").count() == 0
    assert (await places(page, "free"))["free"]
    await page.get_by_text(re.compile(r"map \d+ s old, scan \d+ s old, pose \d+ s old")).wait_for()
    found = await places(page, "free", "occupied", "scan", "robot", "old")
    assert [len(found[name]) for name in ("free", "occupied", "scan", "robot")] == [0, 0, 0, 0]
    assert len(found["old"]) > 1000
    feed.publish("r1", pose=POSE, map=MAP, scan=SCAN, period_s=0.3)
    await page.wait_for_timeout(200)
    assert (await places(page, "free"))["free"], "what comes again is fresh"


async def test_a_burst_after_a_stall_is_as_old_as_it_is(browser: Browser) -> None:
    page, feed = await opened(browser)
    feed.publish("r1", pose=POSE, period_s=0.3)
    await page.wait_for_timeout(300)
    feed.publish("r1", map=MAP, scan=SCAN, period_s=0.3, late_s=5.0)
    await page.get_by_text(re.compile(r"map ([5-9]|\d\d) s old, scan ([5-9]|\d\d) s old")).wait_for()
    assert (await places(page, "free"))["free"] == []


async def test_a_map_that_came_once_stays_and_that_of_a_robot_that_is_away_does_not(browser: Browser) -> None:
    page, feed = await opened(browser)
    feed.publish("r1", map=MAP, period_s=0.0)
    await page.wait_for_timeout(1500)
    assert (await places(page, "free"))["free"]
    feed.tell(rows=[STATES["away"]])
    await page.get_by_text(re.compile(r"map \d+ s old")).wait_for()
    await page.wait_for_timeout(100)
    assert (await places(page, "free"))["free"] == []


async def test_the_picture_is_moved_and_zoomed_by_mouse_and_keys(browser: Browser) -> None:
    page, feed = await opened(browser)
    feed.publish("r1", pose=POSE)
    canvas = page.locator(".picture canvas")

    async def view() -> list[float]:
        await page.wait_for_timeout(100)
        found: list[float] = await page.evaluate("JSON.parse(document.querySelector('.picture canvas').dataset.view)")
        return found

    before = await view()
    await canvas.hover()
    await page.mouse.wheel(0, -100)
    zoomed = await view()
    assert zoomed[0] == pytest.approx(before[0] * 1.25)
    await page.mouse.down()
    await page.mouse.move(400, 300)
    await page.mouse.move(430, 280)
    await page.mouse.up()
    moved = await view()
    feed.publish("r1", pose={**POSE, "x": 9.0})
    assert await view() == moved, "it follows no longer"
    await page.get_by_role("button", name="Follow").click()
    assert (await view())[4] != moved[4]
    await canvas.focus()
    await page.keyboard.press("-")
    assert (await view())[0] == pytest.approx(zoomed[0] / 1.25)


async def test_fit_shows_all_of_the_map(browser: Browser) -> None:
    page, feed = await opened(browser, size=NARROW)
    feed.publish("r1", pose=POSE, map={**MAP, "cell": 0.5})
    await page.wait_for_timeout(300)
    await page.get_by_role("button", name="Fit").click()
    await page.wait_for_timeout(200)
    found = await places(page, "occupied", "free")
    xs, ys = zip(*found["occupied"], *found["free"], strict=True)
    assert (min(xs), max(xs)) == pytest.approx((-1.0, 19.0), abs=0.6)
    assert (min(ys), max(ys)) == pytest.approx((0.0, 20.0), abs=0.6)


async def test_switches_are_shown_for_what_the_robot_accepts_and_their_state_for_what_it_reports(
    browser: Browser,
) -> None:
    page, feed = await opened(browser)
    feed.publish("r1", lidar={"on": False})
    group = page.get_by_role("group", name="lidar")
    await group.get_by_role("button", name="Off", pressed=True).wait_for()
    await group.get_by_role("button", name="On").click()
    await page.get_by_role("group", name="light").get_by_role("button", name="Off").click()
    await soon(lambda: len(feed.requests()) == 2)
    assert feed.requests() == [
        {"do": "switch", "robot": "r1", "name": "lidar", "on": True},
        {"do": "switch", "robot": "r1", "name": "light", "on": False},
    ]
    feed.tell(rows=[row("r1", commands=["stop"])])
    await soon(lambda: True)
    await group.wait_for(state="detached")


async def test_escape_stops_all_and_the_button_stops_this_robot(browser: Browser) -> None:
    page, feed = await opened(browser)
    feed.publish("r1", **FULL)
    await page.get_by_role("button", name="Stop r1").click()
    for name in ("Zoom in", "Zoom out", "All robots", "Stop r1"):
        await page.get_by_label(name, exact=True).focus()
        await page.keyboard.press("Escape")
    await page.locator(".picture canvas").focus()
    await page.keyboard.press("Escape")
    await soon(lambda: len(feed.requests()) == 6)
    assert feed.requests() == [{"do": "stop", "robot": "r1"}, *5 * [{"do": "stop_all"}]]


async def test_a_page_that_is_hidden_or_left_looks_at_no_robot(browser: Browser) -> None:
    page, feed = await opened(browser)
    hide = "hidden => { Object.defineProperty(document, 'hidden', {value: hidden, configurable: true}); }"
    for hidden, robot in ((True, ""), (False, "r1")):
        await page.evaluate(hide, hidden)
        await page.evaluate("document.dispatchEvent(new Event('visibilitychange'))")
        await soon(lambda: feed.asked[-1] == {"do": "look", "robot": robot})  # noqa: B023
    await page.get_by_role("link", name="All robots").click()
    await soon(lambda: feed.asked[-1] == {"do": "look", "robot": ""})


async def test_a_camera_picture_is_shown_and_what_is_none_is_said(browser: Browser) -> None:
    page, feed = await opened(browser)
    png = await page.locator("header").screenshot()
    feed.publish("r1", image={"format": "png", "data": png})
    image = page.get_by_alt_text("Camera of r1")
    await image.wait_for()
    await page.wait_for_function("document.querySelector('.camera img').naturalWidth > 0")
    await page.get_by_text(re.compile(r"picture \d+ s old")).wait_for()
    feed.publish("r1", image={"format": "svg", "data": b"<svg onload=alert(1)>"})
    await page.get_by_text("no picture").wait_for()
    assert browser.complaints == []


async def test_messages_that_cannot_be_read_and_hostile_texts_break_nothing(browser: Browser) -> None:
    page, feed = await opened(browser)
    for broken in (
        b"",
        b"\xc1",
        b"\xdd\xff\xff\xff\xff",
        b"\x81\xa1",
        b"\x91" * 1000,
        msgpack.packb(7),
        msgpack.packb([]),
    ):
        feed.publish("r1", **dict.fromkeys(FULL, broken))
    cells = {**MAP, "rows": 10**9}
    feed.publish("r1", map=cells, scan={**SCAN, "ranges": b"\0" * 7}, pose={"x": "1", "y": None, "heading": math.nan})
    feed.publish("r1", text={"text": EVIL * 400, "kind": EVIL}, sensor__x={"value": "1e9"}, battery={"level": "full"})
    feed.publish("r1", **{"sensor/%FF%00" + "y" * 200: READING, "sensor/%": READING, "motion": {"speed": "fast"}})
    feed.publish("r1", **{"@history": [{"text": EVIL}, 7], "@sessions": {"gateway": b"\xc1", "hq": 7}})
    feed.publish("r2", text={"text": "of another robot"})
    feed.publish("r1", text={"text": "the last one", "kind": "debug"})
    await page.get_by_text("the last one").wait_for()
    await page.get_by_role("term").filter(has_text="(unnamed)").wait_for()
    assert await page.get_by_text("of another robot").count() == 0
    assert await page.locator("img").count() == 0
    assert await page.evaluate("document.querySelector('.robot').scrollWidth <= innerWidth")
    assert browser.complaints == []


async def test_a_robot_that_nobody_knows_is_said(browser: Browser) -> None:
    page = await browser.open("/#/robot/r9", feed=Feed(row("r1")))
    await page.get_by_text("The console does not know this robot.").wait_for()


async def test_a_page_looks_again_after_the_console_was_away(browser: Browser) -> None:
    page, feed = await opened(browser)
    feed.publish("r1", pose=POSE, text={"text": "before", "kind": "chat"})
    await page.get_by_text("before").wait_for()
    await page.evaluate(NOBODY_ANSWERS)
    await feed.close()
    await page.get_by_text("does not answer").wait_for()
    await page.wait_for_timeout(200)
    assert (await places(page, "robot"))["robot"] == [], "nothing is shown as present"
    feed.asked.clear()
    await page.evaluate("() => { WebSocket = window.Real; }")
    await feed.looked_at("r1")
    feed.publish("r1", pose=POSE, text={"text": "before", "kind": "chat"})
    await page.wait_for_timeout(300)
    assert await page.get_by_text("before").count() == 1
    assert (await places(page, "robot"))["robot"]


async def test_a_console_that_hangs_is_not_taken_for_present_and_a_stop_without_an_answer_is_said(
    browser: Browser,
) -> None:
    page, feed = await opened(browser)
    feed.quiet = True
    await page.keyboard.press("Escape")
    await page.get_by_text("STOP ALL was sent, and the console has not answered yet").wait_for()
    await page.evaluate(
        "() => { const now = performance.now.bind(performance); performance.now = () => now() + 7000; }"
    )
    await page.get_by_text("The console does not answer").wait_for()
    feed.tell(notices={"": told("stop_all", "1 of 1 stopped", good=True)})
    await page.get_by_text("1 of 1 stopped").wait_for()
    await page.wait_for_timeout(2000)
    assert await page.get_by_text("1 of 1 stopped").count() == 1


async def test_what_is_shown_is_old_while_the_console_says_nothing(browser: Browser) -> None:
    page, feed = await opened(browser)
    feed.publish("r1", period_s=0.0, map=MAP)
    await page.get_by_text("in the robot's own frame").wait_for()
    assert await page.get_by_text("Not live").count() == 0, "it came once, and stays as it is"
    feed.quiet = True
    await page.evaluate(
        "() => { const now = performance.now.bind(performance); performance.now = () => now() + 4000; }"
    )
    await page.get_by_text("Not live").first.wait_for()


async def test_after_another_console_nothing_of_the_one_before_has_an_age(browser: Browser) -> None:
    """The console's machine was restarted: its clock begins anew."""
    page, feed = await opened(browser)
    feed.publish("r1", scan=SCAN, pose=POSE, period_s=0.1)
    await page.get_by_label(re.compile("Map, scan and place")).wait_for()
    await feed.close()
    await feed.looked_at("r1")
    await page.get_by_text("No map and no scan received.").wait_for()


VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 127, 128, 255, 256, 65535, 65536, 2**32 - 1, 2**32, 2**53, -1, -32, -33, -128, -129),
    *(-32768, -32769, -(2**31), -(2**31) - 1, -(2**53), 0.0, -1.5, 1e300, "", "a", "ü" * 40, "x" * 300, "y" * 70_000),
    *([], [1, [2, [3]]], list(range(20)), list(range(70_000)), {}, {"a": {"b": None}}, {str(n): n for n in range(20)}),
    {str(n): n for n in range(70_000)},
)


async def test_messagepack_is_read_as_the_library_writes_it(browser: Browser) -> None:
    page = await browser.open()
    code = """async (packed) => {
      const { unpack } = await import('/static/msgpack.js');
      const plain = (name, value) => (value instanceof Uint8Array ? [...value] : value);
      const bytes = Uint8Array.from(atob(packed), (each) => each.charCodeAt(0));
      try { return JSON.stringify({ value: unpack(bytes) }, plain); }
      catch (error) { return JSON.stringify({ error: error.name }); }
    }"""

    async def read(packed: bytes) -> Any:
        return json.loads(await page.evaluate(code, base64.b64encode(packed).decode()))

    for value in VALUES:
        assert await read(msgpack.packb(value)) == {"value": value}
    assert await read(msgpack.packb(1.5, use_single_float=True)) == {"value": 1.5}
    assert await read(msgpack.packb(msgpack.ExtType(5, b"12345"))) == {"value": None}
    for size in (3, 300, 70_000):
        packed = msgpack.packb(b"z" * size)
        assert await read(packed) == {"value": [122] * size}
    whole = msgpack.packb({"a": [1, 2.5, "text", b"bin", {"b": 2**40}]})
    for size in range(len(whole)):
        assert await read(whole[:size]) == {"error": "RangeError"}
    for broken in (b"\xc1", b"\x91" * 100 + b"\x01", b"\xdd\xff\xff\xff\xff\x01", b"\xdf\xff\xff\xff\xff\xa1a"):
        assert await read(broken) == {"error": "RangeError"}
