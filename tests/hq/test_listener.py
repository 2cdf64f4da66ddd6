"""A listener: who may come, and how its clients come and go."""

from __future__ import annotations

import asyncio
import gc
import logging
import re
import weakref

import pytest

from tests.hq.scene import KEYS, Program, Scene, ToySession, ToySide, serving, soon
from zbridge.fleet import topics
from zbridge.fleet.messages import Pose, Text
from zbridge.protocol.address import Address
from zbridge.protocol.session import Limits

pytestmark = pytest.mark.jumping


class RestingSide(ToySide):
    quiet_s = 2.0


# Coming and going


async def test_a_client_shakes_hands_and_is_shown_the_robot(scene: Scene) -> None:
    assert scene.listener.address == Address("127.0.0.1", 11002)
    program = scene.connect()
    assert program.heard() == [b"who are you"]
    scene.say(topics.POSE, Pose(x=1.0, y=0.0, heading=0.0))
    assert program.heard() == [], "nothing before the handshake"
    program.say(b"hi")
    assert program.heard() == [b"welcome"]
    scene.say(topics.POSE, Pose(x=2.0, y=0.0, heading=0.0))
    assert program.heard() == [b"at 2"]
    (entry,) = scene.manager.snapshots()
    assert (entry.name, entry.role, entry.state, entry.version) == ("toy.2", "robot", "established", "2.0")
    assert entry.peer == program.link.peer


async def test_clients_get_the_lowest_numbers_that_are_free(scene: Scene) -> None:
    programs = [scene.connect() for _ in range(4)]
    assert sorted(scene.listener.clients) == [2, 3, 4, 5]
    programs[1].leave()
    await soon()
    scene.connect()
    assert sorted(scene.listener.clients) == [2, 3, 4, 5]
    assert scene.reason("toy.3") is None
    assert scene.count("hq_accepted") == 5


@pytest.mark.scene(accept_hz=1000)
async def test_254_clients_are_served_and_the_255th_is_turned_away(scene: Scene) -> None:
    programs = [scene.connect().greeted() for _ in range(254)]
    assert sorted(scene.listener.clients) == list(range(2, 256))
    late = scene.connect()
    assert late.link.closed
    assert late.heard() == []
    late.say(b"hi", b"go")
    assert late.heard() == []
    assert (scene.count("hq_accepted"), scene.count("hq_turned_away")) == (254, 1)
    await soon()
    scene.say(topics.POSE, Pose(x=3.0, y=0.0, heading=0.0))
    assert all(program.heard() == [b"at 3"] for program in programs)
    assert scene.side.encoded == 1
    programs[76].leave()
    await soon()
    assert scene.connect().heard() == [b"who are you"]


@pytest.mark.scene(clients=2)
async def test_a_listener_may_be_told_to_serve_fewer(scene: Scene) -> None:
    programs = [scene.connect() for _ in range(3)]
    assert [program.link.closed for program in programs] == [False, False, True]
    programs[0].leave()
    await soon()
    assert not scene.connect().link.closed


@pytest.mark.scene(accept_hz=3.0)
async def test_more_than_so_many_connections_a_second_of_one_address_are_closed_at_once(scene: Scene) -> None:
    programs = [scene.connect() for _ in range(5)]
    assert [program.link.closed for program in programs] == [False, False, False, True, True]
    assert programs[4].heard() == []
    assert not scene.connect("10.0.0.2").link.closed, "another address"
    assert (scene.count("hq_accepted"), scene.count("hq_turned_away")) == (4, 2)
    for program in programs[:3]:
        program.leave()
    await soon()
    assert scene.connect().link.closed, "that they have left makes no room"
    await asyncio.sleep(1.0)
    assert not scene.connect().link.closed


async def test_twenty_connections_a_second_are_let_in_unless_told_otherwise(scene: Scene) -> None:
    assert [scene.connect().link.closed for _ in range(25)] == [False] * 20 + [True] * 5


@pytest.mark.parametrize("accept_hz", [20.0, 1000.0])
async def test_a_flood_of_connections_costs_a_few_lines_a_second(accept_hz, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        async with serving(accept_hz=accept_hz, clients=10_000) as scene:
            caplog.clear()
            for _ in range(800):
                program = scene.connect()
                program.leave()
                await asyncio.sleep(0.0025)
            scene.connect("10.0.0.9")
            await asyncio.sleep(2.0)
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) <= 20, lines
    came = sum(int(count) for line in lines for count in re.findall(r"(\d+) more connected", line))
    told = sum("10.0.0.1:" in line and "connected as client" in line for line in lines)
    assert came + told == scene.count("hq_accepted") - 1
    away = sum(int(count) for line in lines for count in re.findall(r"(\d+) more turned away", line))
    assert away + sum(" turned away (" in line for line in lines) == scene.count("hq_turned_away")
    assert any("tcp://10.0.0.9" in line and "connected as client" in line for line in lines), "others are told of"


@pytest.mark.scene(side=RestingSide)
async def test_a_number_rests_after_its_client_left(scene: Scene) -> None:
    scene.connect().leave()
    await soon()
    scene.connect().greeted().leave()
    await soon()
    assert scene.count("hq_accepted") == 2, "the first was never used, and need not rest"
    scene.connect()
    assert sorted(scene.listener.clients) == [3]
    await asyncio.sleep(2.0)
    scene.connect()
    assert sorted(scene.listener.clients) == [2, 3]


@pytest.mark.scene(side=RestingSide, clients=1)
async def test_numbers_that_rest_take_no_clients_place(scene: Scene) -> None:
    """``clients`` is the most at a time: a program that is restarted at once finds its place free."""
    scene.connect().leave()
    await soon()
    assert not scene.connect().link.closed
    assert scene.connect().link.closed


@pytest.mark.scene(accept_hz=1000)
async def test_many_clients_come_and_go_and_leave_nothing_behind(scene: Scene) -> None:
    await soon()
    tasks, kept = len(asyncio.all_tasks()), scene.bus._shared
    subscribers, queryables = len(kept.subscribers), len(kept.queryables)
    sessions: list[weakref.ref[ToySession]] = []
    for cycle in range(500):
        programs = [scene.connect() for _ in range(4)]
        for program in programs[:3]:
            program.say(b"hi")
        sessions += [weakref.ref(session) for session in scene.side.made[-4:]]
        programs[0].say(b"stand", b"go", b"scans on")
        programs[1].say(b"map?", b"?")
        if cycle % 2:
            await soon()
        for program in programs:
            program.leave()
        await soon()
    await asyncio.sleep(5.0)
    assert scene.listener.clients == {}
    assert len(asyncio.all_tasks()) == tasks
    assert (len(kept.subscribers), len(kept.queryables)) == (subscribers, queryables)
    assert kept.tokens == [KEYS.alive("gateway")]
    assert repr(scene.manager) == "<SessionTable 0 live, 32 ended>"
    assert len(scene.listener._context.bridge._publishers) <= 2
    assert (scene.listener._active, len(scene.listener._queries)) == (set(), 0)
    assert "0 of 254 taken" in repr(scene.listener._numbers)
    assert scene.gateway.report().state == "free"
    scene.side.made.clear()
    del programs, program
    gc.collect()
    assert sum(session() is not None for session in sessions) <= 1, "the last one is a variable of a loop"


async def test_the_table_says_why_a_client_went(scene: Scene) -> None:
    scene.connect().leave()
    await soon()
    assert scene.reason("toy.2") == "closed by peer"


# Who may come


@pytest.mark.parametrize(
    ("host", "welcome"),
    [
        ("10.1.2.3", True), ("192.168.1.7", True), ("192.168.1.8", False), ("127.0.0.1", False),
        ("[fd00::1]", True), ("[fe80::1%eth0]", False), ("[::1]", False), ("[::ffff:10.1.2.3]", True),
        ("[::ffff:11.1.2.3]", False),
    ],
)  # fmt: skip
@pytest.mark.scene(allow=("10.0.0.0/8", "192.168.1.7/32", "fd00::/8"))
async def test_only_allowed_networks_are_let_in(scene: Scene, host: str, welcome: bool) -> None:
    program = scene.connect(host)
    assert program.link.closed is not welcome
    assert scene.count("hq_turned_away") == (not welcome)
    assert len(scene.listener.clients) == welcome


async def test_without_a_list_everybody_is_let_in(scene: Scene) -> None:
    assert not any(scene.connect(host).link.closed for host in ("10.1.2.3", "127.0.0.1", "[fe80::1%eth0]"))


@pytest.mark.scene(allow=("10.0.0.0/8",))
async def test_a_client_that_is_turned_away_uses_up_no_number(scene: Scene) -> None:
    for _ in range(300):
        scene.connect("11.0.0.1")
    await soon()
    scene.connect()
    assert sorted(scene.listener.clients) == [2]


class SessionlessSide(ToySide):
    def session(self, number: int, bounds: Limits) -> ToySession:
        raise KeyError(self.view.protocol)


@pytest.mark.scene(side=SessionlessSide)
async def test_a_client_for_which_there_is_no_session_is_turned_away(scene: Scene) -> None:
    for _ in range(5):
        assert scene.connect().link.closed
    assert (scene.count("hq_accepted"), scene.count("hq_turned_away")) == (0, 5)
    assert repr(scene.listener._numbers) == "<ClientIds 0 of 254 taken>"


# The end


async def test_an_ending_listener_takes_leave_of_all_and_gives_the_robot_back() -> None:
    async with serving() as scene:
        driver, idle, early = scene.connect().greeted(), scene.connect().greeted(), scene.connect()
        driver.say(b"stand", b"go")
        await soon()
        assert scene.gateway.report().holder == "hq.toy.2"
        listener = scene.listener
    assert all(program.link.closed for program in (driver, idle, early))
    assert {shown.reason for shown in scene.manager.snapshots()} == {"gateway stopped"}
    assert scene.gateway.report().state == "free"
    assert scene.bus._shared.tokens == [KEYS.alive("gateway")]
    await soon()
    assert listener.clients == {}
    assert len(asyncio.all_tasks()) == 1
    late = Program(scene.accept(), "tcp://10.0.0.1:1")
    assert late.link.closed


async def test_an_ending_listener_does_not_wait_long_for_a_client_that_takes_nothing() -> None:
    async with serving() as scene:
        program = scene.connect().greeted()
        program.take_nothing()
        scene.say(topics.TEXT, Text(text="last words"))
        start = scene.loop.time()
    assert scene.loop.time() - start <= 1.0
    assert program.link.closed


async def test_a_listener_and_its_clients_print_themselves(scene: Scene) -> None:
    scene.connect()
    assert repr(scene.listener) == "<Listener toy tcp://127.0.0.1:11002, 1 clients>"
    assert repr(scene.listener.clients[2]) == "<Client 2 <ToySession toy.2 handshaking>>"
