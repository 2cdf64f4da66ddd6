"""``zbridge top`` under Textual's pilot: keys, the question before a stop, and what reaches the terminal."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import NamedTuple

import pytest
from rich.cells import cell_len
from textual.geometry import Region
from textual.pilot import Pilot
from textual.widgets import Static

from tests.client import World
from tests.fake_bus import FakeBus
from tests.views.top import EVIL_SHOWN, publish, put, serve, stats
from zbridge.client import Fleet, stops
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Latch, Refusal, Status
from zbridge.fleet.processes import SessionEntry, Sessions
from zbridge.views.top.app import TopApp, show
from zbridge.views.top.board import Board
from zbridge.views.top.columns import order_by
from zbridge.views.top.screens import LinesView, QuestionScreen

SIZE = (80, 24)


class Top(NamedTuple):
    """The program, and the hand at its keyboard."""

    app: TopApp
    pilot: Pilot[None]
    bus: FakeBus

    async def press(self, *keys: str) -> None:
        await self.pilot.press(*keys)
        await self.pilot.pause()

    @property
    def lines(self) -> list[str]:
        """The lines on the screen, as they are drawn."""
        drawing = self.app.screen.query_one(LinesView)
        return [drawing.render_line(y).text for y in range(drawing.size.height)]

    @property
    def text(self) -> str:
        return "\n".join(line.rstrip() for line in self.lines)

    @property
    def names(self) -> list[str]:
        """The names of the robots, from above; the selected one has a mark."""
        return [line.split()[0 if line[0] == " " else 1] for line in self.lines if "tcpudp" in line or "hub" in line]

    @property
    def question(self) -> str | None:
        return self.app.screen.question if isinstance(self.app.screen, QuestionScreen) else None

    def stops(self) -> list[str]:
        """The keys to which a stop was sent."""
        return [sample.key for sample in self.bus.network.history if sample.key.endswith("@cmd/stop")]


@asynccontextmanager
async def running(
    bus: FakeBus, fleet: Fleet | None = None, *, sort: str = "robot", size: tuple[int, int] = SIZE
) -> AsyncIterator[Top]:
    own = bus.join("top")
    fleet = fleet or Fleet(own, name="ann")
    async with fleet.watch() as model:
        app = TopApp(fleet, own, model, Board("fleet", order_by(sort)), lambda: "12:00:00")
        async with app.run_test(size=size) as pilot:
            app.follow_bus(True)
            await pilot.pause()
            yield Top(app, pilot, bus)


async def eventually(top: Top, text: str) -> None:
    for _ in range(200):
        if text in top.text:
            return
        await asyncio.sleep(0.01)
    pytest.fail(f"{text!r} did not appear:\n{top.text}")


def fleet_of(count: int) -> FakeBus:
    bus = FakeBus()
    for number in range(count):
        serve(bus, f"r{number:03}", stats(cpu=number / 1000, rates={"pose": float(count - number)}))
    return bus


async def test_two_hundred_robots_fit_a_terminal_of_eighty_by_twenty_four() -> None:
    async with running(fleet_of(200)) as top:
        assert len(top.lines) == 24
        assert {cell_len(line) for line in top.lines} == {80}
        assert "200 robots: 200 established" in top.lines[0]
        assert top.lines[0].rstrip().endswith("12:00:00")
        assert top.text.count("established") == 1 + 20 + 1
        await top.press("end")
        assert "> r199 " in top.text
        await top.press("pageup", "up")
        assert "> r178 " in top.text
        await top.press("home")
        assert "> r000 " in top.text


async def test_a_long_name_is_whole_where_other_columns_are_not() -> None:
    name = "press-17.hall-3.building-north.the-old-one"
    async with running(fleet_of(3)) as top:
        serve(top.bus, name)
        top.app.redraw()
        await top.pilot.pause()
        assert name in top.text
        assert "refused" not in top.text


async def test_the_screen_follows_the_size_of_the_terminal() -> None:
    async with running(fleet_of(50)) as top:
        await top.pilot.resize_terminal(130, 40)
        await top.pilot.pause()
        assert len(top.lines) == 40
        assert "protocol" in top.lines[1]
        await top.pilot.resize_terminal(30, 8)
        await top.pilot.pause()
        assert {cell_len(line) for line in top.lines} == {30}


async def test_keys_sort_by_another_column_and_reverse() -> None:
    async with running(fleet_of(10), sort="cpu") as top:
        assert top.names[:2] == ["r009", "r008"]
        await top.press("r")
        assert top.names[:2] == ["r000", "r001"]
        await top.press("r", "less_than_sign", "left", "left")
        assert "msg/s↓" in top.lines[1]
        assert top.names[:2] == ["r000", "r001"]
        await top.press("right", "greater_than_sign", "greater_than_sign")
        assert "cpu%↓" in top.lines[1]


async def test_a_filter_takes_all_keys_until_it_is_entered_and_escape_clears_it() -> None:
    async with running(fleet_of(12)) as top:
        await top.press("slash", "R", "0", "0", "x", "q", "backspace", "backspace")
        assert top.lines[-1].startswith("filter: R00_")
        assert len(top.names) == 10
        await top.press("enter", "down")
        assert "filter 'R00' (hides 2)" in top.lines[-1]
        await top.press("escape")
        assert len(top.names) == 12


async def test_details_show_what_the_table_has_no_room_for_and_escape_leads_back() -> None:
    bus = fleet_of(2)
    refusal = Refusal(who="bob", command="drive", code="held", reason="held by ann", count=4)
    publish(bus, "r001", control=Control("held", holder="ann", refusals=(refusal,)))
    session = Sessions((SessionEntry("robot", "10.0.0.7:11001", "hq", "established", version="1.3"),))
    key = "fleet/r001/@rpc/sessions/gateway"
    bus.join("gateway").answer(key, lambda query: query.answer(stops.payloads.encode(session)))
    async with running(bus) as top:
        await top.press("down", "enter")
        await eventually(top, "gateway: robot 10.0.0.7:11001: established, 1.3 by tcp")
        assert top.lines[0].startswith("r001: established")
        await top.press("end")
        await eventually(top, "4 x drive of bob: held: held by ann")
        await top.press("escape")
        assert "> r001" in top.text


async def test_keys_are_explained() -> None:
    async with running(fleet_of(1)) as top:
        await top.press("question_mark")
        assert "marks before the name" in top.text
        assert "more lines" in top.lines[-1]
        await top.press("end")
        assert "gaps" in top.text
        await top.press("q")
        assert "> r000" in top.text


@pytest.mark.parametrize("key", ["n", "N", "escape", "enter", "q"])
@pytest.mark.parametrize("stop", ["s", "S"])
async def test_a_stop_is_sent_by_no_other_key_than_yes(stop: str, key: str) -> None:
    async with running(fleet_of(2)) as top:
        await top.press(stop)
        assert top.question is not None
        await top.press("s", "S", "down", "space", key)
        assert top.question is None
        assert top.stops() == []
        assert "stop" not in top.lines[1]


async def test_a_confirmed_stop_of_the_selected_robot_is_reported() -> None:
    world = World("r1", "r2")
    async with running(world.bus, world.fleet) as top:
        await top.press("down", "s")
        assert top.question == "Stop r2? This ends any lease."
        await top.press("y")
        await eventually(top, "r2: stopped")
        assert set(top.stops()) == {"fleet/r2/@cmd/stop"}
        assert [gateway.machine.stops > 0 for gateway in world.gateways.values()] == [False, True]


async def test_the_question_is_about_the_robot_that_was_selected_when_the_key_was_pressed() -> None:
    world = World("r1", "r2")
    async with running(world.bus, world.fleet) as top:
        await top.press("s")
        serve(world.bus, "r0")
        top.app.redraw()
        assert top.question == "Stop r1? This ends any lease."
        await top.press("y")
        await eventually(top, "r1: stopped")
        assert set(top.stops()) == {"fleet/r1/@cmd/stop"}


async def test_all_robots_are_stopped_also_those_that_the_filter_hides() -> None:
    world = World("r1", "r2", "r3")
    async with running(world.bus, world.fleet) as top:
        await top.press("slash", "r", "1", "enter", "S")
        assert top.question == ("Stop ALL 3 robots of fleet, also the 2 that the filter hides? This ends any lease.")
        await top.press("y")
        await eventually(top, "3 of 3 stopped")
        assert [gateway.machine.stops > 0 for gateway in world.gateways.values()] == [True] * 3


async def test_a_stop_that_no_gateway_confirms_is_reported_as_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stops, "CONFIRM_S", 0.05)
    async with running(fleet_of(1)) as top:
        await top.press("s", "y")
        await eventually(top, "r000: stop sent, but no gateway confirmed it within 0.05 s")
        await top.press("escape", "enter", "s", "y")
        await eventually(top, "no gateway confirmed it")
        assert top.lines[1].startswith("r000"), "the report stands above the details too"


async def test_a_lost_bus_is_said_and_what_comes_after_it_is_shown() -> None:
    bus = fleet_of(2)
    async with running(bus) as top:
        top.app.follow_bus(False)
        await eventually(top, "NO BUS: lost at 12:00:00, nothing is known of the robots since; waiting for it")
        assert "2 unknown" in top.lines[0]
        top.app.follow_bus(True)
        put(bus, "r001", topics.STATUS, Status("offline", reason="no route"))
        await eventually(top, "offline")
        assert "1 offline, 1 established" in top.lines[0]


async def test_the_screen_is_drawn_again_once_a_second() -> None:
    async with running(fleet_of(1)) as top:
        publish(top.bus, "r000", control=Control("latched", latches=(Latch(b"1" * 16, "bob", "wet floor"),)))
        await eventually(top, "LATCHED")


async def test_text_of_peers_is_no_markup_and_no_command_of_the_terminal() -> None:
    evil = "\x1b[31m[bold]evil[/bold]\nline"
    async with running(fleet_of(1), size=(160, 24)) as top:
        put(top.bus, "r000", topics.STATUS, Status("offline", reason=evil))
        top.app.redraw()
        await top.pilot.pause()
        assert EVIL_SHOWN in top.text


@pytest.mark.parametrize("plain", [True, False])
async def test_no_color_removes_colour_and_bold(plain: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    if plain:
        monkeypatch.setenv("NO_COLOR", "1")
    bus = fleet_of(3)
    put(bus, "r001", topics.STATUS, Status("offline"))
    async with running(bus) as top:
        put(bus, "r001", topics.STATUS, Status("offline"))
        top.app.redraw()
        await top.pilot.pause()
        strips = top.app.screen.query_one(LinesView).render_lines(Region(0, 0, *SIZE))
        styled = [segment for strip in strips for segment in strip if segment.style]
        assert bool(styled) is not plain
        assert "offline" in top.text


async def test_a_stop_is_awaited_and_reported_also_where_the_program_ends_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = TopApp.run_async

    async def press(pilot: Pilot[None]) -> None:
        await pilot.press("S", "y", "q")

    async def headless(app: TopApp, **_: object) -> None:
        await run(app, headless=True, size=SIZE, auto_pilot=press)

    monkeypatch.setattr(TopApp, "run_async", headless)
    world = World("r1", "r2")
    stop = world.fleet.stop

    async def slow(names: list[str] | None) -> dict[str, stops.Outcome]:
        await asyncio.sleep(0.5)
        return await stop(names)

    monkeypatch.setattr(world.fleet, "stop", slow)
    board = Board("fleet", order_by("robot"))
    assert await show(world.fleet, world.bus.join("top"), board, lambda: "12:00:00") == 0
    assert [notice.text for notice in board.notices] == ["2 of 2 stopped"]
    assert board.no_bus == ""


async def test_a_question_is_no_markup() -> None:
    async with running(fleet_of(1)) as top:
        top.app.push_screen(QuestionScreen("Stop [bold]r[/bold]?"))
        await top.pilot.pause()
        drawn = top.app.screen.query_one(Static)
        strips = drawn.render_lines(Region(0, 0, *drawn.outer_size))
        assert "Stop [bold]r[/bold]?" in "\n".join(strip.text for strip in strips)


async def test_control_c_ends_the_program() -> None:
    async with running(fleet_of(1)) as top:
        await top.press("ctrl+c")
        assert not top.app.is_running or top.app.return_code == 0
