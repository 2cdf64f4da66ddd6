"""A listener: who may come, and how its clients come and go."""

from __future__ import annotations

import asyncio
import gc
import logging
import re
import weakref

import pytest

from tests.bounds import most_kept
from tests.hq.scene import KEYS, Program, Scene, ToySession, ToySide, play, serving, soon
from tests.hq.scripts import scripts
from zbridge.protocol.address import Address
from zbridge.protocol.session import Limits

pytestmark = pytest.mark.jumping


class RestingSide(ToySide):
    quiet_s = 2.0


class SessionlessSide(ToySide):
    def session(self, number: int, bounds: Limits) -> ToySession:
        raise KeyError(self.view.protocol)


# Coming and going


COMING = """
a client shakes hands and is shown the robot until it goes
    a connects; a hears who are you; at 1; a hears nothing; a says hi; a hears welcome; at 2; a hears at 2
    sessions established; a leaves; ended toy.2 closed by peer; clients nothing
a listener may be told to serve fewer, and a number that rests takes no client's place [clients=1 side=RestingSide]
    a greets; b connects; b is closed; a leaves; c connects; c is open; d connects; d is closed
a number rests after its client left, unless it was never used [side=RestingSide]
    a connects; a leaves; b greets; b leaves; c connects; clients 3; wait 2; d connects; clients 2 3
a client for which there is no session is turned away and uses up no number [side=SessionlessSide clients=1]
    a connects; a is closed; b connects; b is closed; accepted 0; turned_away 2; clients nothing
"""


@scripts(COMING)
async def test_a_client(special: str, script: str) -> None:
    await play(special, script)


async def test_a_session_is_shown_in_the_table(scene: Scene) -> None:
    assert scene.listener.address == Address("127.0.0.1", 11002)
    (program,), (entry,) = scene.greeted(1), scene.manager.snapshots()
    shown = (entry.name, entry.role, entry.state, entry.version, entry.peer)
    assert shown == ("toy.2", "robot", "established", "2.0", program.link.peer)


@pytest.mark.scene(accept_hz=1000)
async def test_254_clients_are_served_and_the_255th_is_turned_away_until_one_leaves(scene: Scene) -> None:
    programs = scene.greeted(254)
    assert sorted(scene.listener.clients) == list(range(2, 256))
    late = scene.connect()
    late.say(b"hi", b"go")
    assert (late.link.closed, late.heard()) == (True, [])
    assert (
        scene.count("hq_connections", outcome="accepted"),
        scene.count("hq_connections", outcome="turned_away"),
    ) == (254, 1)
    await soon()
    scene.pose(3.0)
    assert all(program.heard() == [b"at 3"] for program in programs)
    assert scene.side.encoded == 1
    programs[75].leave()
    await soon()
    assert scene.connect().heard() == [b"who are you"]
    assert sorted(scene.listener.clients) == list(range(2, 256)), "it got the number that was free"


async def test_twenty_connections_a_second_of_one_address_are_let_in_unless_told_otherwise(scene: Scene) -> None:
    programs = [scene.connect() for _ in range(25)]
    assert [program.link.closed for program in programs] == [False] * 20 + [True] * 5
    assert programs[24].heard() == []
    assert not scene.connect("10.0.0.2").link.closed, "another address"
    assert (
        scene.count("hq_connections", outcome="accepted"),
        scene.count("hq_connections", outcome="turned_away"),
    ) == (21, 5)
    programs[0].leave()
    await soon()
    assert scene.connect().link.closed, "that one has left makes no room"
    await asyncio.sleep(1.0)
    assert not scene.connect().link.closed


@pytest.mark.parametrize("accept_hz", [20.0, 1000.0])
async def test_a_flood_of_connections_costs_a_few_lines_a_second(accept_hz, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        async with serving(accept_hz=accept_hz, clients=10_000) as scene:
            caplog.clear()
            for _ in range(800):
                scene.connect().leave()
                await asyncio.sleep(0.0025)
            scene.connect("10.0.0.9")
            await asyncio.sleep(2.0)
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) <= 20, lines
    came = sum(int(count) for line in lines for count in re.findall(r"(\d+) more connected", line))
    told = sum("10.0.0.1:" in line and "connected as client" in line for line in lines)
    assert came + told == scene.count("hq_connections", outcome="accepted") - 1
    away = sum(int(count) for line in lines for count in re.findall(r"(\d+) more turned away", line))
    assert away + sum(" turned away (" in line for line in lines) == scene.count(
        "hq_connections", outcome="turned_away"
    )
    assert any("tcp://10.0.0.9" in line and "connected as client" in line for line in lines), "others are told of"


@pytest.mark.scene(accept_hz=1000)
async def test_many_clients_come_and_go_and_leave_nothing_behind(scene: Scene) -> None:
    await soon()
    tasks, kept, most = len(asyncio.all_tasks()), scene.bus.network, most_kept(scene.listener)
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
    assert most_kept(scene.listener) == most
    assert "0 of 254 taken" in repr(scene.listener._numbers)
    assert scene.gateway.report().state == "free"
    scene.side.made.clear()
    del programs, program
    gc.collect()
    assert sum(session() is not None for session in sessions) <= 1, "the last one is a variable of a loop"


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
async def test_only_allowed_networks_are_let_in_and_who_is_turned_away_uses_up_no_number(scene, host, welcome) -> None:
    assert scene.connect(host).link.closed is not welcome
    assert scene.count("hq_connections", outcome="turned_away") == (not welcome)
    assert list(scene.listener.clients) == [2] * welcome
    await soon()
    scene.connect("10.9.9.9")
    assert len(scene.listener.clients) == max(scene.listener.clients) - 1


# The end


async def test_an_ending_listener_takes_leave_of_all_and_gives_the_robot_back() -> None:
    async with serving() as scene:
        await scene.play("a drives; b greets; c connects; holder hq.toy.2; b stalls; text last words")
        start = scene.loop.time()
    assert scene.loop.time() - start <= 1.0, "it does not wait long for a client that takes nothing"
    assert all(program.link.closed for program in scene.programs.values())
    assert {shown.reason for shown in scene.manager.snapshots()} == {"gateway stopped"}
    assert scene.gateway.report().state == "free"
    assert scene.bus.network.tokens == [KEYS.alive("gateway")]
    await soon()
    assert scene.listener.clients == {}
    assert len(asyncio.all_tasks()) == 1
    late = Program(scene.accept(), "tcp://10.0.0.1:1")
    assert late.link.closed
