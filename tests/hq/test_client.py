"""One HQ program at a listener: its limits, what it commands, what it is refused."""

from __future__ import annotations

import asyncio
import math

import pytest

from tests.hq.scene import COMMANDS, KEYS, Program, Scene, ToySession, ToySide, framed, serving, soon
from zbridge.bus.interface import IncomingQuery
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Acquire, Drive, Pose, Query, Refusal, Refusals, Status, Switch, Text
from zbridge.hq.client import STALL_S, SWEEP_S, TELL_S
from zbridge.protocol.outbox import LIMIT
from zbridge.protocol.plugin import Telemetry
from zbridge.protocol.session import Limits, State

pytestmark = pytest.mark.jumping


# Limits


@pytest.mark.scene(handshake_s=1.5)
async def test_a_client_that_does_not_shake_hands_is_closed(scene: Scene) -> None:
    silent, served = scene.connect(), scene.connect().greeted()
    await asyncio.sleep(1.4)
    assert not silent.link.closed
    await asyncio.sleep(0.2)
    assert silent.link.closed
    assert scene.reason("toy.2") == "no handshake within 1.5 s"
    assert not served.link.closed
    assert sorted(scene.listener.clients) == [3]


@pytest.mark.scene(idle_s=3.0)
async def test_a_client_that_is_silent_for_too_long_is_closed(scene: Scene) -> None:
    silent, talking = scene.connect().greeted(), scene.connect().greeted()
    for _ in range(30):
        talking.say(b"stand")
        await asyncio.sleep(0.1)
        assert not silent.link.closed or scene.loop.time() > 1002.9
    await asyncio.sleep(0.7)
    assert silent.link.closed
    assert scene.reason("toy.2") == "silent for 3 s"
    assert not talking.link.closed


async def test_a_client_may_be_silent_for_ever_where_no_limit_is_set(scene: Scene) -> None:
    silent = scene.connect().greeted()
    await asyncio.sleep(10_000)
    assert not silent.link.closed


@pytest.mark.scene(idle_s=1.0)
async def test_what_is_sent_to_a_client_is_no_sign_of_its_life(scene: Scene) -> None:
    silent = scene.connect().greeted()
    for step in range(20):
        scene.say(topics.POSE, Pose(x=float(step), y=0.0, heading=0.0))
        await asyncio.sleep(0.1)
    assert silent.link.closed


async def test_a_client_that_takes_nothing_is_cut_and_costs_the_others_nothing(scene: Scene) -> None:
    stalled, served = scene.connect().greeted(), scene.connect().greeted()
    await soon()
    stalled.take_nothing()
    start = scene.loop.time()
    while not stalled.link.closed:
        scene.say(topics.POSE, Pose(x=1.0, y=0.0, heading=0.0))
        assert served.heard() == [b"at 1"]
        await asyncio.sleep(0.02)
        assert scene.loop.time() - start < 2 * STALL_S
    assert STALL_S - SWEEP_S <= scene.loop.time() - start <= STALL_S + 2 * SWEEP_S
    assert scene.reason("toy.2") == f"took nothing for {STALL_S:g} s"
    assert stalled.heard() == []
    await soon()
    assert sorted(scene.listener.clients) == [3]


@pytest.mark.parametrize(
    ("stalls_s", "takes_s", "times", "cut"), [(STALL_S - 2 * SWEEP_S, STALL_S, 20, False), (0.95, 0.05, 12, True)]
)
async def test_a_client_may_stall_now_and_then_but_not_take_a_byte_now_and_then(
    scene: Scene, stalls_s: float, takes_s: float, times: int, cut: bool
) -> None:
    program = scene.connect().greeted()
    for _ in range(times):
        program.take_nothing()
        await asyncio.sleep(stalls_s)
        program.take_all()
        await asyncio.sleep(takes_s)
    assert program.link.closed is cut


@pytest.mark.scene(idle_s=5.0)
async def test_a_process_that_was_frozen_cuts_nobody_for_it(scene: Scene) -> None:
    """The time while it did not run is no time in which a client took nothing, or was silent."""
    stalled, silent = scene.connect().greeted(), scene.connect().greeted()
    await soon()
    scene.skipped_s += 60.0
    for _ in range(20):
        await asyncio.sleep(0.1)
        silent.say(b"stand")
        stalled.say(b"stand")
        stalled.take_nothing()
    assert not stalled.link.closed, "it has taken nothing for two seconds"
    await asyncio.sleep(2.0)
    assert not silent.link.closed, "it has been silent for two seconds"


@pytest.mark.scene(rate_hz=50.0)
async def test_a_client_that_floods_is_closed_and_the_others_are_served(scene: Scene) -> None:
    wild, served = scene.connect().greeted(), scene.connect().greeted()
    await soon()
    wild.say(*[b"stop"] * 100)
    await soon()
    assert wild.link.closed
    assert scene.reason("toy.2") == "flood: more than 50 messages a second"
    assert len(scene.bus.values("fleet/r1/@cmd/stop")) == 49, "what it had the right to"
    scene.say(topics.POSE, Pose(x=1.0, y=0.0, heading=0.0))
    assert served.heard() == [b"at 1"]


async def test_rubbish_ends_its_own_session_only(scene: Scene) -> None:
    broken, served = scene.connect().greeted(), scene.connect().greeted()
    broken.receiver.received(framed(b"stop") + b"\xff rubbish")
    await soon()
    assert broken.link.closed
    assert scene.reason("toy.2") == "broken stream: length 255"
    assert len(scene.bus.values("fleet/r1/@cmd/stop")) == 1, "what came before it"
    served.say(b"stop")
    assert len(scene.bus.values("fleet/r1/@cmd/stop")) == 2


async def test_messages_without_meaning_are_counted_and_the_next_ones_are_taken(scene: Scene) -> None:
    program = scene.connect().greeted()
    program.say(b"?", b"sing", b"stop")
    assert scene.count("hq_malformed") == 2
    assert scene.manager.snapshots()[0].counters["malformed"] == 2
    assert len(scene.bus.values("fleet/r1/@cmd/stop")) == 1
    assert scene.count("hq_commands") == 1


async def test_a_full_queue_drops_for_its_client_alone(scene: Scene) -> None:
    slow, served = scene.connect().greeted(), scene.connect().greeted()
    await soon()
    slow.take_nothing()
    for number in range(LIMIT + 10):
        scene.say(topics.TEXT, Text(text=str(number)))
    assert len(served.heard()) == LIMIT + 10
    assert scene.count("hq_dropped") == 10
    counters = {shown.name: shown.counters["dropped"] for shown in scene.manager.snapshots()}
    assert counters == {"toy.2": 10, "toy.3": 0}
    slow.take_all()
    await soon()
    assert slow.heard() == [b"%d" % number for number in range(LIMIT)]


async def test_of_a_stream_a_slow_client_gets_the_newest(scene: Scene) -> None:
    slow = scene.connect().greeted()
    await soon()
    slow.take_nothing()
    for number in range(100):
        scene.say(topics.POSE, Pose(x=float(number), y=0.0, heading=0.0))
    slow.take_all()
    await soon()
    assert slow.heard() == [b"at 99"]
    assert scene.count("hq_dropped") == 0


async def test_what_cannot_be_shown_is_counted_and_nothing_is_encoded_for_nobody(scene: Scene) -> None:
    scene.say(topics.POSE, Pose(x=1.0, y=0.0, heading=0.0))
    assert scene.side.encoded == 0
    program = scene.connect().greeted()
    scene.say(topics.LIDAR, Switch(on=True))
    assert scene.count("hq_left_out") == 1
    scene.say(topics.POSE, Pose(x=1.0, y=0.0, heading=0.0))
    assert program.heard() == [b"at 1"]


# What is refused


class Told:
    """What the robot's gateway was told that the listener refused."""

    def __init__(self, scene: Scene) -> None:
        self.refusals: list[Refusal] = []
        scene.gateway.bus.answer(KEYS.key("@rpc/control/refused/hq.toy"), self._hear)

    def _hear(self, question: IncomingQuery) -> None:
        self.refusals += payloads.decode(Refusals, question.payload).refusals
        question.answer(payloads.encode(Query()))

    def shown(self) -> list[tuple[str | None, str, str, str, int]]:
        """Who, command, code, reason, and how often."""
        return [(each.who, each.command, each.code, each.reason, each.count) for each in self.refusals]


async def test_what_a_client_may_not_is_told_to_the_gateway(scene: Scene) -> None:
    told, program = Told(scene), scene.connect().greeted()
    program.say(b"go", b"go", b"go")
    await asyncio.sleep(2.0)
    reason = "connected: release the stick first"
    assert told.shown() == [
        ("hq.toy.2", "drive", "neutral_first", reason, 1),
        ("hq.toy.2", "drive", "neutral_first", reason, 2),
    ]
    assert scene.count("hq_refused") == 3


async def test_a_robot_that_is_missing_is_a_reason_where_it_has_a_gateway_to_be_told(scene: Scene) -> None:
    told, program = Told(scene), scene.connect().greeted()
    program.say(b"stand")
    scene.status.put(payloads.encode(Status(state="connecting", protocol="toy")))
    program.say(b"go")
    await soon()
    assert told.shown() == [("hq.toy.2", "drive", "not_ready", "robot connecting", 1)]
    scene.go()
    for _ in range(3):
        program.say(b"go")
    await asyncio.sleep(2.0)
    assert len(told.refusals) == 1, "there is nobody to be told"


async def test_what_the_gateway_refuses_by_itself_is_not_told_a_second_time(scene: Scene) -> None:
    told, program = Told(scene), scene.connect().greeted()
    scene.gateway.authority.acquire(Acquire(who="operator"), scene.now)
    program.say(b"stand", b"go")
    await soon()
    assert program.heard()[-1] == b"! not driving: held by operator (priority 0)"
    assert told.shown() == []
    program.say(b"go")
    await soon()
    assert told.shown() == [
        ("hq.toy.2", "drive", "neutral_first", "held by operator (priority 0): release the stick first", 1)
    ]


async def test_a_listener_that_ends_does_not_wait_to_tell() -> None:
    async with serving() as scene:
        told, program = Told(scene), scene.connect().greeted()
        program.say(b"go", b"go")
        await soon()
        ended_at = scene.now
    assert scene.now - ended_at < 0.5
    assert len(told.refusals) == 1


# Control


async def test_a_client_drives_and_its_name_is_shown(scene: Scene) -> None:
    await scene.driver()
    assert scene.gateway.taken() == [("drive", Drive(forward=0.5))]
    assert scene.gateway.report().holder == "hq.toy.2"
    assert KEYS.alive("hq.toy.2") in scene.bus._shared.tokens


async def test_what_was_said_while_the_process_stood_still_moves_nothing_and_neutral_must_come_anew(scene) -> None:
    driver, idle = scene.connect().greeted(), scene.connect().greeted()
    driver.say(b"stand", b"go")
    idle.say(b"stand")
    await soon()
    scene.gateway.taken()
    scene.skipped_s += 0.7
    idle.say(b"go")
    driver.say(b"go", b"stand", b"go")
    await soon()
    assert [moved for moved in scene.gateway.taken() if moved[1] != Drive()] == []
    assert scene.gateway.report().holder is None
    await asyncio.sleep(0.4)
    driver.say(b"go")
    await soon()
    assert scene.gateway.taken() == []
    driver.say(b"stand", b"go")
    await soon()
    assert scene.gateway.taken() == [("drive", Drive(forward=0.5))]


async def test_what_a_client_holds_is_repeated_until_its_machine_falls_silent(scene: Scene) -> None:
    scene.side.hold = True
    program = scene.connect().greeted()
    program.say(b"stand", b"go")
    await asyncio.sleep(4.0)
    assert scene.gateway.report().holder == "hq.toy.2"
    assert scene.gateway.taken()[-1] == ("drive", Drive(forward=0.5))
    program.link.silent_s = 1.2
    await asyncio.sleep(0.3)
    assert scene.gateway.report().holder is None
    scene.gateway.taken()
    program.link.silent_s = 0.0
    program.say(b"go")
    await soon()
    assert scene.gateway.taken() == []
    program.say(b"stand", b"go")
    await soon()
    assert scene.gateway.taken() == [("drive", Drive(forward=0.5))]


async def test_a_refused_client_is_told_why_and_not_all_the_time(scene: Scene) -> None:
    program = scene.connect().greeted()
    for _ in range(10):
        program.say(b"go")
        await asyncio.sleep(0.02)
    assert program.heard() == [b"! connected: release the stick first"]
    assert (scene.count("hq_refused"), scene.manager.snapshots()[0].counters["refused"]) == (10, 10)
    await asyncio.sleep(TELL_S)
    program.say(b"go")
    await soon()
    assert program.heard() == [b"! connected: release the stick first"]


async def test_one_drives_another_is_told_who_and_only_the_first_is_told_of_the_loss(
    scene: Scene,
) -> None:
    first, second, idle = await scene.driver(), await scene.driver(), scene.connect().greeted()
    assert second.heard() == [b"! not driving: held by hq.toy.2 (priority 0)"]
    scene.gateway.authority.takeover(Acquire(who="operator"), scene.now)
    scene.report()
    await soon()
    assert first.heard() == [b"! not driving: the lease has ended (taken over by operator)"]
    assert (second.heard(), idle.heard()) == ([], [])


@pytest.mark.parametrize("end", ["leaves", "floods", "rubbish", "stalls"])
@pytest.mark.scene(rate_hz=100.0)
async def test_a_driver_that_is_lost_in_any_way_gives_the_robot_back(scene: Scene, end: str) -> None:
    program = await scene.driver()
    assert scene.gateway.report().holder == "hq.toy.2"
    if end == "leaves":
        program.leave()
    elif end == "floods":
        program.say(*[b"go"] * 200)
    elif end == "rubbish":
        program.receiver.received(b"\xff")
    else:
        program.take_nothing()
        for _ in range(70):
            program.say(b"go")
            await asyncio.sleep(0.1)
    await soon()
    assert scene.gateway.report().state == "free"
    assert KEYS.alive("hq.toy.2") not in scene.bus._shared.tokens
    assert scene.listener.clients == {}


@pytest.mark.scene(idle_s=1.0)
async def test_a_driver_that_is_closed_gives_the_robot_back_before_its_last_words_are_out(scene: Scene) -> None:
    program = await scene.driver()
    program.take_nothing()
    scene.say(topics.TEXT, Text(text="last words"))
    for _ in range(40):
        if not scene.listener.clients[2].session.over:
            await asyncio.sleep(0.05)
    assert scene.listener.clients[2].session.state is State.CLOSING
    assert scene.gateway.report().state == "free"


async def test_motion_that_is_not_repeated_ends_with_the_deadman_and_the_lease_follows(scene: Scene) -> None:
    program = scene.connect().greeted()
    program.say(b"stand", b"go")
    await asyncio.sleep(1.3)
    program.say(b"go")
    await soon()
    assert program.heard() == [b"! deadman: release the stick first"]
    await asyncio.sleep(2.0)
    assert scene.gateway.report().holder is None
    assert scene.listener._active == set()


async def test_what_a_robot_refuses_is_told_to_whom_it_was_refused(scene: Scene) -> None:
    first, second = await scene.driver(), scene.connect().greeted()
    scene.gateway.authority.hold_back("busy: map")
    first.say(b"go")
    scene.report()
    assert first.heard() == [b"! drive: busy: map: send a neutral drive first"]
    assert second.heard() == []
    first.say(b"stand", b"go")
    assert [message for _, message in scene.gateway.taken()][-1] == Drive(forward=0.5)


# What waits for more of it


class HalfSide(ToySide):
    """A protocol whose clients say two halves of a motion, one after the other."""

    def session(self, number: int, bounds: Limits) -> ToySession:
        session = super().session(number, bounds)
        session.handled = frozenset({bytes})
        session.half_at = math.inf
        return session

    def take(self, session: ToySession, message: bytes) -> tuple[Telemetry, ...]:
        if message != b"half":
            return super().take(session, message)
        if session.half_at == math.inf:
            session.half_at = session.said_at
            return ()
        session.half_at = math.inf
        return (COMMANDS[b"go"],)

    def deadline(self, session: ToySession) -> float:
        return session.half_at + 0.03

    def expire(self, session: ToySession, now: float) -> tuple[Telemetry, ...]:
        if now < self.deadline(session):
            return ()
        session.half_at = math.inf
        return ((topics.CMD_DRIVE, Drive(forward=0.25)),)


def neutral(scene: Scene) -> Program:
    """A client that may drive."""
    program = scene.connect().greeted()
    program.say(b"stand")
    return program


def driven(scene: Scene) -> list[float]:
    """The speeds that were commanded since the last call."""
    return [message.forward for _, message in scene.gateway.taken() if isinstance(message, Drive)]


@pytest.mark.scene(side=HalfSide)
async def test_what_waits_for_more_is_carried_out_when_it_has_waited_long_enough(scene: Scene) -> None:
    program = neutral(scene)
    program.say(b"half")
    await asyncio.sleep(0.029)
    assert driven(scene) == []
    await asyncio.sleep(0.0015)
    assert driven(scene) == [0.25]
    assert scene.count("hq_commands") == 2
    await asyncio.sleep(1.0)
    assert driven(scene) == []


@pytest.mark.scene(side=HalfSide)
async def test_what_comes_in_time_is_carried_out_with_it_at_once_and_the_next_has_its_own_time(scene: Scene) -> None:
    program = neutral(scene)
    program.say(b"half")
    await asyncio.sleep(0.02)
    program.say(b"half", b"half")
    await asyncio.sleep(0.001)
    assert driven(scene) == [0.5]
    await asyncio.sleep(0.02)
    assert driven(scene) == [], "the second has waited 21 ms"
    await asyncio.sleep(0.0095)
    assert driven(scene) == [0.25]


@pytest.mark.scene(side=HalfSide)
async def test_what_waits_of_a_client_that_is_gone_is_nothing(scene: Scene) -> None:
    program = neutral(scene)
    program.say(b"half")
    program.leave()
    await asyncio.sleep(1.0)
    assert driven(scene) == []
    assert scene.count("hq_commands") == 1


@pytest.mark.scene(side=HalfSide)
async def test_what_waited_while_the_process_stood_still_moves_nothing(scene: Scene) -> None:
    program = neutral(scene)
    program.say(b"half")
    scene.skipped_s += 5.0
    await asyncio.sleep(0.05)
    assert driven(scene) == []
    assert program.heard() == [b"! the gateway was frozen: release the stick first"]
