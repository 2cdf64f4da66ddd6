"""The robot, shown to all clients of a listener."""

from __future__ import annotations

import logging

import pytest

from tests.hq.scene import COMMANDS, Scene, ToySession, ToySide, play
from tests.hq.scripts import scripts
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage, Status, Text
from zbridge.fleet.topics import Topic
from zbridge.protocol.plugin import Send, Telemetry

pytestmark = pytest.mark.jumping


class ToldSide(ToySide):
    def presence(self, there: bool) -> Send:
        return lambda session, now: session.send(b"there" if there else b"lost")


SCRIPTS = """
every client is told and shown once that the robot is lost, and that it is there again [side=ToldSide]
    a greets; b greets; c connects; c hears who are you; robot offline no route; a hears ! robot offline: no route, lost
    b hears ! robot offline: no route, lost; robot handshaking; robot gone; a hears nothing; robot there
    a hears ! the robot is there, there; robot established; a hears nothing; robot gone
    a hears ! no gateway serves the robot, lost; c hears nothing
a client that comes while the robot is away is told so [robot=0]
    a connects; a says hi; a hears who are you, welcome, ! no gateway serves the robot; a says stand, go; asked nothing
    robot there; a hears ! the robot is there; a says stand, go; holder hq.toy.2
a driver whose gateway went must let go first
    a drives; robot gone; a hears ! no gateway serves the robot, ! not driving: the robot's gateway is gone; robot there
    gateway-forgets; forget; a says go; driven nothing; a says stand, go; holder hq.toy.2
what a client wants is followed while one wants it
    a greets; b greets; scan; encoded 0; a says scans on; b says scans on; scan; encoded 1; a hears scan; b hears scan
    a says scans off; scan; a hears nothing; b hears scan; b leaves; scan; encoded 2
"""


@scripts(SCRIPTS)
async def test_the_robot_is_shown(special: str, script: str) -> None:
    await play(special, script)


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
        scene.pose(x)
        program.say(b"what is this")
    scene.say(topics.TEXT, Text("hello"))
    assert program.heard() == [b"hello"]
    await program.said(b"stand", b"go")
    assert scene.driven() == [0.5]
    await scene.play("robot gone; robot there; sessions established")
    assert scene.count("hq_left_out") >= 1 + 50 + 50 + 2
    assert scene.count("hq_malformed_frames") == 50
    records = [*caplog.get_records("setup"), *caplog.records]
    errors = [record.getMessage() for record in records if record.levelno == logging.ERROR]
    assert sorted(errors) == [
        "toy: cannot decode a client's message: KeyError(b'what is this'); continuing without it",
        "toy: cannot send to a client: KeyError('unheard of'); continuing without it",
        "toy: pose not shown: KeyError('pose'); continuing without it",
        "toy: status not shown: KeyError('status'); continuing without it",
        "toy: the robot's presence not shown: KeyError(True); continuing without it",
    ]
