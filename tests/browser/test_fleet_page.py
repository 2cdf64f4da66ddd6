"""The fleet page: every state of a robot is drawn, STOP ALL is always there, and Escape stops wherever the focus is."""

from __future__ import annotations

import time
from typing import Any

import pytest

from tests.browser.conftest import NARROW, WIDE, Browser, Feed, row, soon, told

pytestmark = pytest.mark.asyncio(loop_scope="session")

EVIL = "<img src=x onerror=alert(1)>"
STATES = [
    row("away", "offline", 2, reason="connection refused", rate=None, commands=[]),
    row("busy", "established", reason="busy: it saves its map"),
    row("evil", "established", reason=EVIL, driver=EVIL, protocol=EVIL, host=EVIL),
    row("free"),
    row("held", driver="ann@desk"),
    row("hung", "SILENT", 1, rate=None, seen=1_700_000_000, commands=[]),
    row("killed", "NO GATEWAY", 0, protocol="", version="", rate=None, refused=None, gaps=None, commands=[]),
    row("latched", "LATCHED", 8, latched=["latched by ann (wet floor)"], driver="LATCHED"),
    row("long", reason="x" * 10_000, driver="y" * 10_000),
    row("stalled", "stalled", 3, reason="its link acknowledges nothing"),
    row("stopped", driver="stopped"),
    row("unknown", "unknown", 7, rate=None),
]
NOBODY_ANSWERS = """() => {
  window.Real = WebSocket;
  WebSocket = class {
    static OPEN = 1;
    readyState = 0;
    constructor() { setTimeout(() => this.onclose({ code: 1006 }), 10); }
  };
}"""
FILTERS = ["Connected 5", "tcpudp 10"]
CONTROLS = ["Filter robots", *FILTERS, "Stop free", "Forget killed", "free", "zbridge console"]


@pytest.mark.parametrize(("size", "scheme"), [(WIDE, "light"), (NARROW, "dark")])
async def test_every_state_of_a_robot_is_drawn_without_a_complaint_and_nothing_is_wider_than_the_page(
    browser: Browser, size: Any, scheme: str
) -> None:
    page = await browser.open(feed=Feed(*STATES), size=size, scheme=scheme)
    await page.locator(".tall .row").first.wait_for()
    seen = set()
    for top in range(0, 92 * len(STATES), 300):
        await page.evaluate("top => document.querySelector('.box').scrollTop = top", top)
        await page.wait_for_timeout(100)
        seen |= set(await page.locator(".tall .name").all_inner_texts())
    assert seen == {each["name"] for each in STATES}
    assert await page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert await page.locator("img").count() == 0
    await browser.photograph(page, f"fleet-{scheme}")
    assert browser.complaints == []


async def test_of_200_robots_those_in_sight_are_drawn_and_each_is_found(browser: Browser) -> None:
    page = await browser.open(feed=Feed(*(row(f"r{number}", protocol="alf") for number in range(200))))
    await page.locator(".tall .row").first.wait_for()
    assert await page.locator(".tall .row").count() < 40
    await page.get_by_label("Filter robots").fill("r199")
    assert await page.locator(".tall .name").all_inner_texts() == ["r199"]
    await page.get_by_label("Filter robots").fill("r199 tcpudp")
    assert "No robot matches" in await page.locator(".empty").inner_text()
    assert browser.complaints == []


async def test_filters_by_state_and_protocol_are_buttons_that_are_pressed(browser: Browser) -> None:
    page = await browser.open(feed=Feed(row("r1"), row("r2", protocol="alf"), row("r3", "offline", 2)))
    await page.get_by_role("button", name="alf 1").click()
    assert await page.locator(".tall .name").all_inner_texts() == ["r2"]
    assert await page.get_by_role("button", name="alf 1").get_attribute("aria-pressed") == "true"
    await page.get_by_role("button", name="alf 1").click()
    await page.get_by_role("button", name="Offline 1").click()
    assert await page.locator(".tall .name").all_inner_texts() == ["r3"]


async def test_stop_all_is_in_sight_on_every_page_and_a_click_leaves_it_without_the_focus(browser: Browser) -> None:
    feed = Feed(*STATES)
    page = await browser.open(feed=feed, size=NARROW)
    for path in ("", "#/robot/free", "#/robot/nobody"):
        await page.goto(f"{browser.at}/{path}")
        button = page.get_by_role("button", name="STOP ALL", exact=True)
        await button.wait_for()
        box = await button.bounding_box()
        assert box["y"] + box["height"] < NARROW["height"] / 2
        before = len(feed.requests())
        await button.click()
        await soon(lambda: len(feed.requests()) > before)  # noqa: B023
        await page.keyboard.press("Space")
        await page.keyboard.press("Enter")
        await page.wait_for_timeout(100)
        assert feed.requests()[before:] == [{"do": "stop_all"}]


async def test_escape_stops_whatever_has_the_focus_and_once_for_each_press(browser: Browser) -> None:
    feed = Feed(*STATES)
    page = await browser.open(feed=feed, size={"width": 1200, "height": 900})
    await page.locator(".tall .row").first.wait_for()
    for number, name in enumerate(CONTROLS, 1):
        control = page.get_by_label(name, exact=True).or_(page.get_by_text(name, exact=True)).first
        focusable = control if name not in FILTERS else page.get_by_role("button", name=name)
        await focusable.focus()
        await page.keyboard.press("Escape")
        await soon(lambda: len(feed.asked) >= number)  # noqa: B023
    await page.get_by_label("Filter robots").focus()
    await page.evaluate("dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape', repeat: true}))")
    await page.wait_for_timeout(100)
    assert feed.asked == [{"do": "stop_all"}] * len(CONTROLS)


async def test_release_asks_once_more_and_only_where_a_robot_is_latched(browser: Browser) -> None:
    feed = Feed(row("r1"))
    page = await browser.open(feed=feed)
    await page.locator(".tall .row").first.wait_for()
    assert await page.get_by_role("button", name="Release").count() == 0
    feed.tell(rows=[row("r1", "LATCHED", 8, latched=["latched"])])
    await page.get_by_role("button", name="Release").click()
    assert feed.asked == []
    question = await page.locator(".question").inner_text()
    assert "Release 1 robot? Programs and people can move them again at once." in question
    await page.get_by_role("button", name="Keep latched").click()
    await page.get_by_role("button", name="Release", exact=True).click()
    await page.get_by_role("button", name="Release 1 robot").click()
    await soon(lambda: feed.asked)
    assert feed.asked == [{"do": "release"}]


async def test_one_robot_is_stopped_or_forgotten_by_its_row(browser: Browser) -> None:
    feed = Feed(*STATES)
    page = await browser.open(feed=feed, size={"width": 1200, "height": 900})
    await page.get_by_role("button", name="Stop free").click()
    await page.get_by_role("button", name="Forget killed").click()
    await soon(lambda: len(feed.asked) == 2)
    assert feed.asked == [{"do": "stop", "robot": "free"}, {"do": "forget", "robot": "killed"}]


async def cut_off(browser: Browser, **more: Any) -> tuple[Any, Feed]:
    """Open the page of a console that does not answer any more."""
    feed = Feed(row("r1"), **more)
    page = await browser.open(feed=feed)
    await page.locator(".tall .row").first.wait_for()
    await page.evaluate(NOBODY_ANSWERS)
    await feed.close()
    await page.get_by_text("does not answer: what is shown is old").wait_for()
    return page, feed


@pytest.mark.parametrize(
    ("robot", "said", "asked"),
    [
        ("", "STOP ALL was NOT sent", {"do": "stop_all"}),
        ("r1", "r1: the stop was NOT sent", {"do": "stop", "robot": "r1"}),
    ],
)
async def test_a_stop_that_was_not_sent_is_said_until_it_is_answered_and_sent_when_the_console_is_back(
    browser: Browser, robot: str, said: str, asked: dict[str, str]
) -> None:
    old = {**told(asked["do"], "of an earlier stop", good=True), "at": time.time() - 60}
    page, feed = await cut_off(browser, notices={robot: old})
    await page.get_by_role("button", name=f"Stop {robot}" if robot else "STOP ALL", exact=True).click()
    await page.get_by_text(said).wait_for()
    assert feed.asked == []
    await page.evaluate("() => { WebSocket = window.Real; }")
    await soon(lambda: feed.asked)
    assert feed.asked == [asked]
    await page.get_by_text("Live").wait_for()
    assert await page.get_by_text(said).count() == 1, "the notice of an earlier stop is no answer"
    feed.tell(notices={robot: {**old, "at": time.time() - 30}})
    await page.wait_for_timeout(200)
    assert await page.get_by_text(said).count() == 1, "nor that of somebody else's, before"
    feed.tell(notices={robot: told(asked["do"], "done", good=True)})
    await page.get_by_text("done").wait_for()
    await page.get_by_text(said).wait_for(state="detached")
    await page.wait_for_timeout(1700)
    assert await page.get_by_text("has not answered").count() == 0


async def test_a_stop_without_an_answer_is_said_and_one_that_a_cut_swallowed_is_sent_again(browser: Browser) -> None:
    feed = Feed(row("r1"))
    page = await browser.open(feed=feed)
    await page.get_by_role("button", name="Stop r1").click()
    await page.get_by_text("r1: the stop was sent, and the console has not answered yet").wait_for()
    await page.keyboard.press("Escape")
    await soon(lambda: {"do": "stop_all"} in feed.asked)
    count = len(feed.asked)
    await feed.close()
    await soon(lambda: len(feed.asked) > count + 1)
    assert feed.asked[count:] == [{"do": "stop", "robot": "r1"}, {"do": "stop_all"}]
    assert await page.get_by_text("STOP ALL was NOT confirmed").count() == 1


async def test_a_stop_that_a_restart_of_the_console_left_open_is_sent_again_and_one_that_was_released_is_not(
    browser: Browser,
) -> None:
    feed = Feed(row("r1"))
    page = await browser.open(feed=feed)
    await page.get_by_role("button", name="Stop r1").click()
    await page.keyboard.press("Escape")
    await soon(lambda: len(feed.asked) == 2)
    waiting = {"": told("stop_all", "STOP ALL is sent", good=None), "r1": told("stop", "r1: is sent", good=None)}
    feed.tell(notices=waiting)
    await page.get_by_text("STOP ALL is sent").wait_for()
    feed.tell(notices={**waiting, "": told("release", "released", good=True)})
    await page.get_by_text("released").wait_for()
    await feed.close()
    await soon(lambda: len(feed.asked) == 3)
    assert feed.asked[2] == {"do": "stop", "robot": "r1"}
    await page.get_by_text("r1: the stop was NOT confirmed").wait_for()


async def test_a_page_whose_login_has_ended_says_that_it_stops_nothing(browser: Browser) -> None:
    feed = Feed(row("r1"))
    page = await browser.open(feed=feed)
    await page.locator(".tall .row").first.wait_for()
    await page.route("**/api/me", lambda route: route.abort())
    await feed.close(4401)
    await page.get_by_text("STOP ALL and Escape do nothing on this page").wait_for()
    assert await page.get_by_role("button", name="STOP ALL").count() == 0
    await page.unroute("**/api/me")
    await page.get_by_role("button", name="STOP ALL").wait_for()
    browser.complaints.clear()  # of the request that was refused


async def test_what_a_person_asks_for_is_not_lost_in_silence(browser: Browser) -> None:
    feed = Feed(row("r1", "LATCHED", 8, latched=["latched"]))
    page = await browser.open(feed=feed)
    await page.get_by_role("button", name="Release").click()
    await page.evaluate(NOBODY_ANSWERS)
    await feed.close()
    await page.get_by_text("does not answer: what is shown is old").wait_for()
    await page.get_by_role("button", name="Release 1 robot").click()
    await page.get_by_text("release was NOT sent: the console does not answer.").wait_for()


async def test_the_age_of_a_notice_is_by_the_consoles_clock(browser: Browser) -> None:
    page = await browser.open(
        feed=Feed(row("r1"), now=1000.0, notices={"r1": {**told("stop", "r1 away", good=False), "at": 970.0}})
    )
    await page.get_by_text("30 s ago").wait_for()


async def test_escape_stops_though_a_control_keeps_its_keys_to_itself(browser: Browser) -> None:
    feed = Feed(row("r1"))
    page = await browser.open(feed=feed)
    await page.get_by_label("Filter robots").evaluate(
        "(field) => field.addEventListener('keydown', (event) => event.stopPropagation())"
    )
    await page.get_by_label("Filter robots").press("Escape")
    await soon(lambda: feed.asked == [{"do": "stop_all"}])


async def test_an_address_that_is_cut_off_is_the_fleet(browser: Browser) -> None:
    page = await browser.open("/#/robot/%", feed=Feed(row("r1")))
    await page.locator(".tall .row").first.wait_for()
    assert browser.complaints == []


async def test_a_notice_is_read_out_and_hostile_text_stays_text(browser: Browser) -> None:
    feed = Feed(row("r1"), notices={"": {"action": "release", "text": EVIL, "at": 1_700_000_000, "good": False}})
    page = await browser.open(feed=feed)
    status = page.get_by_role("status")
    await status.get_by_text(EVIL).wait_for()
    assert await status.get_attribute("aria-live") == "assertive"
    feed.tell(bus=False)
    await page.get_by_text("The bus is lost").wait_for()
    assert browser.complaints == []


async def test_a_confirmed_stop_tells_to_watch_the_robots_and_its_notice_ends_by_itself(browser: Browser) -> None:
    good = told("stop_all", "1 of 1 stopped (their gateways sent it)", good=True)
    feed = Feed(row("r1"), notices={"": good})
    page = await browser.open(feed=feed)
    await page.get_by_text("Sent is not stopped: watch the robots.").wait_for()
    feed.tell(notices={"": good, "r1": told("stop", "r1 is not confirmed", good=False)})
    await page.get_by_text("r1 is not confirmed").wait_for()
    await page.evaluate(
        "() => { const now = performance.now.bind(performance); performance.now = () => now() + 61000; }"
    )
    feed.tell()
    await page.get_by_text("Sent is not stopped").wait_for(state="detached")
    assert await page.get_by_text("r1 is not confirmed").count() == 1
