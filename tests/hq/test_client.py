"""One HQ program at a listener: its limits, what it commands, what it is refused."""

from __future__ import annotations

import math

import pytest

from tests.hq.scene import COMMANDS, KEYS, Scene, ToySession, ToySide, framed, play, serving
from tests.hq.scripts import scripts
from zbridge.bus.interface import IncomingQuery
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Drive, FleetMessage, Query, Refusal, Refusals, Switch, Text
from zbridge.fleet.topics import Topic
from zbridge.protocol.outbox import LIMIT
from zbridge.protocol.plugin import ATTEND_S, RobotUser, Send, Telemetry
from zbridge.protocol.session import Limits

pytestmark = pytest.mark.jumping


class HoldingSide(ToySide):
    """A protocol whose clients say motion once."""

    def attend(self, client: RobotUser) -> None:
        if client.silent_s > self.deadman_s - ATTEND_S:
            client.let_go("the connection is silent")
        else:
            client.repeat()


class ShowingSide(ToySide):
    """A protocol whose programs show whether they drive, and who does."""

    follows = (*ToySide.follows, "control")

    def not_driving(self, session: ToySession, now: float) -> None:
        session.send(b"off")

    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        if isinstance(message, Control):
            holder = str(message.holder).encode()
            return lambda session, now: session.outbox.set("holder", (framed(holder),), now)
        return super().show(topic, message)


class HalfSide(ToySide):
    """A protocol whose clients say two halves of a motion, one after the other."""

    half_at = math.inf

    def session(self, number: int, bounds: Limits) -> ToySession:
        session = super().session(number, bounds)
        session.handled = frozenset({bytes})
        return session

    def take(self, session: ToySession, message: bytes) -> tuple[Telemetry, ...]:
        if message != b"half":
            return super().take(session, message)
        if self.half_at == math.inf:
            self.half_at = session.said_at
            return ()
        self.half_at = math.inf
        return (COMMANDS[b"go"],)

    def deadline(self, session: ToySession) -> float:
        return self.half_at + 0.03

    def expire(self, session: ToySession, now: float) -> tuple[Telemetry, ...]:
        if now < self.deadline(session):
            return ()
        self.half_at = math.inf
        return ((topics.CMD_DRIVE, Drive(forward=0.25)),)


SCRIPTS = """
# Limits
a client that does not shake hands is closed, and one that did may be silent for ever [handshake_s=1.5]
    a connects; b greets; wait 1.4; a is open; wait 0.2; a is closed; ended toy.2 no handshake within 1.5 s; clients 3
    wait 10000; b is open
a client that is silent for too long is closed, whatever is sent to it [idle_s=3]
    a greets; b greets; 27 x (b says stand; at 1; wait 0.1); a is open; b says stand; wait 0.4; b says stand; wait 0.4
    a is closed; ended toy.2 silent for 3 s; b is open
a client that takes nothing is cut and costs the others nothing
    a greets; b greets; a stalls; 44 x (at 1; b hears at 1; wait 0.1); a is open; 15 x (at 1; wait 0.1); a is closed
    ended toy.2 read nothing for 5 s; clients 3
a client may stall now and then
    a greets; 20 x (a stalls; wait 4.0; a takes; wait 5.0); a is open
a client may not take a byte now and then
    a greets; 12 x (a stalls; wait 0.948; a takes; wait 0.048); a is closed
# The time while it did not run is no time in which a client took nothing, or was silent.
a process that was frozen cuts nobody for it [idle_s=5]
    a greets; b greets; frozen 60; 20 x (wait 0.1; a says stand; b says stand; a stalls); a is open; wait 2; b is open
a client that floods is closed after what it had the right to, and the others are served [rate_hz=50]
    a greets; b greets; a says 100 x [stop]; a is closed; ended toy.2 flood: more than 50 messages a second; stops 49
    at 1; b hears at 1
rubbish ends its own session only, after what came before it
    a greets; b greets; a garbles stop; a is closed; ended toy.2 broken stream: length 255; stops 1; b says stop
    stops 2; b is open
messages without meaning are counted and the next ones are taken
    a greets; a says ?, sing, stop; malformed_frames 2; stops 1; commands 1; a is open
of a stream a slow client gets the newest
    a greets; a stalls; at 1; at 2; at 3; a takes; a hears at 3; dropped 0
nothing is encoded for nobody
    at 1; encoded 0; a greets; at 1; encoded 1
# Control
a client drives until the deadman, and the lease follows
    a drives; driven 0.5; holder hq.toy.2; tokens gateway hq.toy.2; wait 1.3; a says go
    a hears ! deadman: centre the joystick first; wait 2; state free; active nothing
what was said while the process stood still moves nothing, and neutral must come anew
    a drives; b greets; b says stand; forget; frozen 0.7; b says go; a says go, stand, go; driven nothing
    holder nothing; wait 0.4; a says go; driven nothing; a says stand, go; driven 0.5
what a client holds is repeated until its machine falls silent [side=HoldingSide]
    a drives; wait 4; forget; wait 0.1; driven 0.5; holder hq.toy.2; a owes 1.2; wait 0.3; holder nothing; forget
    a owes 0; a says go; driven nothing; a says stand, go; driven nothing; a says stand; wait 0.31; a says go
    driven 0.5
one drives, another is told who, and only the first is told of what becomes of it
    a drives; b drives; b hears ! not driving: held by hq.toy.2 (priority 0); c greets; gateway-refuses busy: map
    a says go; shown; a hears ! drive: busy: map: send a neutral drive first; forget; a says stand, go; driven 0.5
    operator-takes-over; shown; a hears ! not driving: the lease has ended (taken over by operator); b hears nothing
    c hears nothing
a driver that is lost in any way gives the robot back: it leaves [rate_hz=100]
    a drives; holder hq.toy.2; a leaves; clients nothing; state free; tokens gateway
a driver that is lost in any way gives the robot back: it floods [rate_hz=100]
    a drives; holder hq.toy.2; a says 200 x [go]; clients nothing; state free; tokens gateway
a driver that is lost in any way gives the robot back: it sends rubbish [rate_hz=100]
    a drives; holder hq.toy.2; a garbles go; clients nothing; state free; tokens gateway
a driver that is lost in any way gives the robot back: it stalls [rate_hz=100]
    a drives; holder hq.toy.2; a stalls; 70 x (a says go; wait 0.1); clients nothing; state free; tokens gateway
a driver that is closed gives the robot back before its last words are out [idle_s=1]
    a drives; a stalls; text last words; wait 1.5; sessions closing; state free; tokens gateway
a program that shows whether it drives is shown each time that it does not [side=ShowingSide]
    a greets; a says go; a hears ! connected: centre the joystick first, off; a says go; a hears off; a says stand, go
    shown; a hears hq.toy.2; operator-takes-over; shown
    a hears operator, ! not driving: the lease has ended (taken over by operator), off
a program that shows whether it drives still does where a part of its motion is left out [side=ShowingSide]
    a drives; gateway-leaves-out turn; shown; a hears ! drive: turn, hq.toy.2; holder hq.toy.2
what a driver's lease was taken for is shown, and only to the driver [side=ShowingSide]
    a drives; b greets; shown; a hears hq.toy.2; b hears hq.toy.2; frozen 5; wait 0.15; a hears off; b hears nothing
a refused client is told why, and not all the time
    a greets; 10 x (a says go; wait 0.02); a hears ! connected: centre the joystick first; refused 10; wait 5.0
    a says go; a hears ! connected: centre the joystick first
# What waits for more of it; every step takes a millisecond.
a half waits until it has waited long enough, and is carried out once [side=HalfSide]
    a greets; a says stand, half; wait 0.026; driven nothing; wait 0.001; driven 0.25; wait 1; driven nothing
    commands 2
what comes in time is carried out with a half, and the next has its own time [side=HalfSide]
    a greets; a says stand, half; wait 0.02; a says half, half; driven 0.5; wait 0.025; driven nothing; wait 0.001
    driven 0.25; commands 3
what waits of a client that is gone is nothing [side=HalfSide]
    a greets; a says stand, half; a leaves; wait 1; driven nothing; commands 1
what waited in a frozen process moves nothing [side=HalfSide]
    a greets; a says stand, half; frozen 5; wait 0.05; a hears ! the gateway was frozen: centre the joystick first
    wait 1; driven nothing
"""


@scripts(SCRIPTS)
async def test_a_client(special: str, script: str) -> None:
    await play(special, script)


async def test_what_a_client_costs_is_counted_for_it_alone(scene: Scene) -> None:
    await scene.play("a greets; a says ?, go; a hears ! connected: centre the joystick first; a stalls; b greets")
    for number in range(LIMIT + 10):
        scene.say(topics.TEXT, Text(text=str(number)))
    scene.say(topics.LIDAR, Switch(on=True))
    await scene.play("dropped 10; left_out 1; a takes")
    assert scene.programs["a"].heard() == [b"%d" % number for number in range(LIMIT)]
    assert len(scene.programs["b"].heard()) == LIMIT + 10
    counters = [
        [shown.counters[name] for name in ("dropped", "malformed", "refused")] for shown in scene.manager.snapshots()
    ]
    assert counters == [[10, 1, 1], [0, 0, 0]]


# What is refused is told to the robot's gateway


NEUTRAL_FIRST = ("neutral_first", "connected: centre the joystick first", 1)
TOLD: dict[str, list[str | list[tuple[str, str, int]]]] = {
    "a robot that is missing is a reason where it has a gateway to be told": [
        "a greets; a says stand; robot connecting; a says go", [("not_ready", "robot connecting", 1)],
        "robot gone; a says go, go; wait 2", [],
    ],
    "what the gateway-refuses by itself is not told a second time": [
        "operator-drives; a drives; a hears ! not driving: held by operator (priority 0)", [],
        "a says go", [("neutral_first", "held by operator (priority 0): centre the joystick first", 1)],
    ],
    "a listener that ends does not wait to tell": ["a greets; a says go, go", [NEUTRAL_FIRST]],
}  # fmt: skip


@pytest.mark.parametrize("steps", TOLD.values(), ids=TOLD)
async def test_what_is_refused(steps: list[str | list[tuple[str, str, int]]]) -> None:
    """A list is what the gateway was told meanwhile: code, reason, and how often."""
    told: list[Refusal] = []

    def hear(question: IncomingQuery) -> None:
        told.extend(payloads.decode(Refusals, question.payload).refusals)
        question.answer(payloads.encode(Query()))

    async with serving() as scene:
        scene.gateway.bus.answer(KEYS.key("@rpc/control/refused/hq.toy"), hear)
        for step in steps:
            if isinstance(step, str):
                await scene.play(step)
            else:
                assert {(each.who, each.command) for each in told} <= {("hq.toy.2", "drive")}
                assert [(each.code, each.reason, each.count) for each in told] == step
                told.clear()
        ended_at = scene.now
    assert scene.now - ended_at < 0.5
    assert told == []
