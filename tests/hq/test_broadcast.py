"""The robot, shown to all clients of a listener."""

from __future__ import annotations

import asyncio
import logging

import numpy as np
import pytest

from tests.hq.scene import COMMANDS, STATUS, Scene, ToySession, ToySide, soon
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Pose, Scan, Status, Text
from zbridge.fleet.topics import Topic
from zbridge.hq.client import TELL_S
from zbridge.protocol.plugin import Send, Telemetry

pytestmark = pytest.mark.jumping


# The robot comes and goes


async def test_clients_are_told_when_the_robot_goes_and_comes(scene: Scene) -> None:
    program, early = scene.connect().greeted(), scene.connect()
    early.heard()
    scene.go()
    scene.go()
    assert program.heard() == [b"! no gateway serves the robot"]
    assert early.heard() == [], "not before the handshake"
    await asyncio.sleep(TELL_S)
    scene.come()
    scene.say(topics.STATUS, STATUS)
    assert program.heard() == [b"! the robot is there"]
    scene.say(topics.STATUS, Status(state="offline", reason="no route", protocol="toy"))
    assert program.heard() == [b"! robot offline: no route"]


@pytest.mark.scene(robot=False)
async def test_a_client_that_comes_while_the_robot_is_away_is_told_so(scene: Scene) -> None:
    program = scene.connect()
    program.say(b"hi")
    assert program.heard() == [b"who are you", b"welcome", b"! no gateway serves the robot"]
    program.say(b"stand", b"go")
    await soon()
    assert scene.gateway.asked == []
    scene.come()
    assert program.heard() == [b"! the robot is there"]
    program.say(b"stand", b"go")
    await soon()
    assert scene.gateway.report().holder == "hq.toy.2"


async def test_a_driver_whose_gateway_went_must_let_go_first(scene: Scene) -> None:
    program = await scene.driver()
    scene.go()
    assert b"! not driving: the robot's gateway is gone" in program.heard()
    scene.come()
    scene.gateway.authority.stop("a new gateway knows of no lease")
    scene.gateway.taken()
    program.say(b"go")
    await soon()
    assert scene.gateway.taken() == []
    program.say(b"stand", b"go")
    await soon()
    assert scene.gateway.report().holder == "hq.toy.2"


# What is followed only now and then


async def test_what_a_client_wants_is_followed_while_one_wants_it(scene: Scene) -> None:
    first, second = scene.connect().greeted(), scene.connect().greeted()
    scan = Scan(0.0, 0.1, 0.1, 10.0, np.ones(3, np.float32))
    scene.say(topics.SCAN, scan)
    assert scene.side.encoded == 0
    first.say(b"scans on")
    second.say(b"scans on")
    scene.say(topics.SCAN, scan)
    assert scene.side.encoded == 1
    assert (first.heard(), second.heard()) == ([b"scan"], [b"scan"])
    first.say(b"scans off")
    scene.say(topics.SCAN, scan)
    assert (first.heard(), second.heard()) == ([], [b"scan"])
    second.leave()
    await soon()
    scene.say(topics.SCAN, scan)
    assert scene.side.encoded == 2, "nobody wants it"


# Whether the robot is there


class ToldSide(ToySide):
    def presence(self, there: bool) -> Send:
        self.encoded += 1
        return lambda session, now: session.send(b"there" if there else b"lost")


@pytest.mark.scene(side=ToldSide)
async def test_every_client_is_shown_once_that_the_robot_is_lost_and_that_it_is_there_again(scene: Scene) -> None:
    programs = [scene.connect().greeted() for _ in range(3)]
    silent = scene.connect()
    silent.heard()
    scene.say(topics.STATUS, Status(state="connecting", protocol="toy"))
    scene.say(topics.STATUS, Status(state="handshaking", protocol="toy"))
    scene.go()
    assert [program.heard().count(b"lost") for program in programs] == [1, 1, 1]
    scene.come()
    scene.say(topics.STATUS, STATUS)
    assert [program.heard().count(b"there") for program in programs] == [1, 1, 1]
    scene.go()
    assert [program.heard().count(b"lost") for program in programs] == [1, 1, 1]
    assert silent.heard() == [], "nothing before the handshake"


# A protocol that fails at what it does not know


class LostSide(ToySide):
    """A protocol of another package that has never met this robot."""

    def begin(self, session: ToySession, now: float) -> None:
        session.send({"toy": b"welcome"}[self.view.protocol or ""])

    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        return {"text": super().show}[topic.path](topic, message)

    def take(self, session: ToySession, message: bytes) -> tuple[Telemetry, ...]:
        return (COMMANDS[message],)

    def presence(self, there: bool) -> Send:
        raise KeyError(there)


@pytest.mark.scene(side=LostSide)
async def test_a_listener_goes_on_without_what_its_protocol_fails_at_and_says_so_once(scene: Scene, caplog) -> None:
    scene.say(topics.STATUS, Status(state="established", protocol="unheard of"))
    program = scene.connect()
    program.say(b"hi")
    assert program.heard() == [b"who are you"], "and no welcome"
    for x in range(50):
        scene.say(topics.POSE, Pose(x=float(x), y=0.0, heading=0.0))
        program.say(b"what is this")
    scene.say(topics.TEXT, Text("hello"))
    assert program.heard() == [b"hello"]
    program.say(b"stand", b"go")
    await soon()
    assert [message for _, message in scene.gateway.taken()] == [Drive(forward=0.5)]
    scene.go()
    scene.come()
    assert scene.reason("toy.2") is None
    assert scene.count("hq_left_out") >= 1 + 50 + 50 + 2
    assert scene.count("hq_malformed") == 50
    errors = [
        record.getMessage()
        for record in [*caplog.get_records("setup"), *caplog.records]
        if record.levelno == logging.ERROR
    ]
    assert sorted(errors) == [
        "toy: a client not sent: KeyError('unheard of'); going on without",
        "toy: a message of a client not understood: KeyError(b'what is this'); going on without",
        "toy: pose not shown: KeyError('pose'); going on without",
        "toy: status not shown: KeyError('status'); going on without",
        "toy: the robot's presence not shown: KeyError(True); going on without",
    ]
