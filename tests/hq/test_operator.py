"""An operator for one HQ program, against a gateway that keeps the lease as real ones do. Times are made up."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

import msgspec
import pytest

from tests.hq.gateway import KEYS, Gateway
from zbridge.bus.fake import FakeBus
from zbridge.errors import BusError, Code, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import (
    Acquire,
    Control,
    Drive,
    FleetMessage,
    Mode,
    Motor,
    Raw,
    Refusal,
    SensorSetting,
    Status,
    Stop,
    Switch,
)
from zbridge.fleet.view import RobotView
from zbridge.hq.bridge import PUBLISHERS, Bridge
from zbridge.hq.command_queue import WAITING
from zbridge.hq.intent import LEASE_S, Intent
from zbridge.hq.operator import Operator
from zbridge.protocol.plugin import ATTEND_S

DEADMAN_S = 1.25
GO, STAND = Drive(forward=0.5), Drive()
LEFT, RIGHT = topics.CMD_MOTOR("left"), topics.CMD_MOTOR("right")
TOPICS = {
    Drive: topics.CMD_DRIVE,
    Mode: topics.CMD_MODE,
    Raw: topics.CMD_RAW("toy"),
    Stop: topics.CMD_STOP,
    Switch: topics.CMD_LIDAR,
}
Command = FleetMessage | tuple[topics.Topic, FleetMessage]
"""A message, with its topic where there are several for such messages."""


def left(value: float) -> Command:
    return LEFT, Motor(value=value)


def right(value: float) -> Command:
    return RIGHT, Motor(value=value)


def is_motion_of_wheels(command: Drive | Motor) -> bool:
    return bool(command.value if isinstance(command, Motor) else command.forward or command.left)


class Program(Operator):
    """An operator, and what its program says."""

    scene: Scene
    hold = False
    """The program sets motion once."""

    def tick(self) -> None:
        if self.hold:
            self.repeat()
        super().tick()

    def say(self, *commands: Command) -> None:
        for command in commands:
            topic, message = command if isinstance(command, tuple) else (TOPICS[type(command)], command)
            self.command(topic, message)

    async def said(self, *commands: Command) -> list[Command]:
        """Say that, let everything be answered, and return what was carried out since the last look."""
        self.say(*commands)
        return await self.scene.done()

    def refused(self, reason: str, *commands: Command) -> None:
        """Say that, each of which is refused."""
        for command in commands:
            with pytest.raises(Refused, match=reason):
                self.say(command)

    async def ticks(self, count: int = 1, *commands: Command) -> list[Command]:
        """Let so many ticks pass, say that before each, and return what was carried out."""
        carried_out = []
        for _ in range(count):
            self.scene.now += ATTEND_S
            self.say(*commands)
            self.tick()
            carried_out += await self.scene.done()
        return carried_out

    async def stopped(self) -> list[Command]:
        """Let somebody stop the robot, and return what was carried out before."""
        self.scene.gateway.authority.stop("stop")
        self.scene.look(self)
        return await self.scene.done()


class Scene:
    """A robot, its gateway, and any number of programs; nothing is answered before :meth:`done`."""

    def __init__(self) -> None:
        self.now = 100.0
        self.bus = FakeBus("hq")
        self.gateway = Gateway(self.bus.join("gw"), self)
        self.view = RobotView()
        self.view.alive = True
        self.robot("toy")
        self.tasks: set[asyncio.Task[None]] = set()
        self.bridge = Bridge(self.bus, KEYS, self.view, self.spawn)
        self.told: list[str] = []

    def robot(self, protocol: str) -> None:
        self.view.note(topics.STATUS, Status(state="established", protocol=protocol))

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)

    async def done(self) -> list[Command]:
        """Let everything be answered that was asked, and return what was carried out since the last look."""
        while self.tasks:
            for done in (await asyncio.wait(self.tasks))[0]:
                done.result()
            await asyncio.sleep(0)
        return self.taken()

    def taken(self) -> list[Command]:
        """What was carried out since the last look."""
        taken: list[Command] = []
        for path, message in self.gateway.taken():
            topic = topics.find(f"@cmd/{path}")
            assert topic is not None
            taken.append(message if TOPICS.get(type(message)) == topic else (topic, message))
        return taken

    @property
    def asked(self) -> list[str]:
        return self.gateway.asked

    @property
    def state(self) -> str:
        return self.gateway.report().state

    @property
    def holder(self) -> str | None:
        return self.gateway.report().holder

    async def alive(self) -> list[str]:
        return await self.bus.alive(KEYS.alive("*"))

    def program(
        self, who: str = "hq.toy.1", *, needs_mode: bool = False, steers: bool = False, hold: bool = False
    ) -> Program:
        program = Program(
            Intent(DEADMAN_S),
            self.bridge,
            who=who,
            protocol="toy",
            is_motion=is_motion_of_wheels if steers else lambda command: command.moving,
            tell=self.told.append,
            clock=lambda: self.now,
        )
        program.scene, program.hold = self, hold
        if needs_mode:
            program.say(Mode("none"))
        return program

    def look(self, program: Program) -> None:
        """Let the gateway say how things stand."""
        report = self.gateway.report()
        self.view.note(topics.CONTROL, report)
        program.look(report)

    async def driving(self, who: str = "hq.toy.1", **kind: bool) -> Program:
        """Make a program that drives."""
        program = self.program(who, **kind)
        assert await program.said(STAND, GO) == [GO]
        return program

    async def holding(self, *commands: Command) -> Program:
        """Make a program that sets its left motor once, and then says that."""
        program = self.program(hold=True)
        assert await program.said(left(0.0), left(5.0)) == [left(5.0)]
        program.say(*commands)
        await self.done()
        return program


@pytest.fixture
def scene() -> Scene:
    return Scene()


# Taking the robot


async def test_motion_acquires_the_robot_and_is_then_carried_out(scene: Scene) -> None:
    program = scene.program()
    program.say(STAND, GO)
    assert scene.taken() == []
    assert await scene.done() == [GO]
    assert scene.gateway.requests == [Acquire(who="hq.toy.1", deadman_s=DEADMAN_S, alive="hq.toy.1")]
    assert await scene.alive() == [KEYS.alive("hq.toy.1")]
    assert program.active


async def test_nothing_moves_and_nothing_is_asked_before_neutral_nor_by_neutral(scene: Scene) -> None:
    program = scene.program()
    program.refused("connected: release the stick first", GO, GO, GO)
    await program.said(STAND, STAND, STAND)
    assert (scene.asked, scene.bus.values("fleet/r1/@cmd/**"), await scene.alive()) == ([], [], [])
    assert not program.active


@pytest.mark.parametrize(
    ("said", "carried_out"),
    [([Drive(forward=step / 10) for step in range(1, 10)], Drive(forward=0.9)), ([GO, STAND], STAND)],
    ids=["motion", "neutral"],
)
async def test_of_what_is_said_while_the_answer_is_awaited_the_newest_counts(scene, said, carried_out) -> None:
    program = scene.program()
    assert await program.said(STAND, *said) == [carried_out]
    assert scene.asked == ["acquire"]
    assert program.intent.held


async def test_an_answer_that_comes_after_the_deadman_moves_nothing(scene: Scene) -> None:
    program = scene.program()
    program.say(STAND, GO)
    scene.now += DEADMAN_S
    assert await scene.done() == []
    assert program.intent.held
    program.refused("deadman", GO)


async def test_a_robot_that_somebody_else_drives_is_refused_and_neutral_must_come(scene: Scene) -> None:
    scene.gateway.authority.acquire(Acquire(who="operator"), scene.now)
    program = scene.program()
    assert await program.said(STAND, GO) == []
    assert scene.told == ["not driving: held by operator (priority 0)"]
    assert not program.active
    program.refused(r"held by operator \(priority 0\): release the stick first", GO)
    scene.look(program)
    assert len(scene.told) == 1, "the refusal of the question itself is not told again"


async def test_without_a_gateway_the_answer_is_no(scene: Scene) -> None:
    scene.gateway.vanish()
    program = scene.program()
    await program.said(STAND, GO)
    assert scene.told == ["not driving: no gateway answers"]
    assert not program.active


@pytest.mark.parametrize(
    ("status", "alive", "reason"),
    [
        (Status(state="offline", reason="no route", protocol="toy"), True, "robot offline: no route"),
        (Status(state="connecting", protocol="toy"), True, "robot connecting"),
        (Status(state="established", protocol="toy"), False, "no gateway serves the robot"),
    ],
)
async def test_a_robot_that_is_not_there_is_not_asked_for(scene: Scene, status: Status, alive: bool, reason) -> None:
    scene.view.note(topics.STATUS, status)
    scene.view.alive = alive
    program = scene.program()
    program.say(STAND)
    program.refused(f"^{reason}$", GO)
    own = scene.program("hq.toy.2", needs_mode=True)
    own.say(STAND)
    own.refused(f"^{reason}$", Mode("autonomous"))
    scene.robot("toy")
    scene.view.alive = True
    program.refused(f"{reason}: release the stick first", GO)
    assert scene.asked == []


async def test_two_programs_share_a_robot_one_after_the_other(scene: Scene) -> None:
    first, second = await scene.driving(), scene.program("hq.toy.2")
    await second.said(STAND, GO)
    assert scene.told == ["not driving: held by hq.toy.1 (priority 0)"]
    first.close()
    await scene.done()
    assert await second.said(STAND, GO) == [GO]
    assert scene.holder == "hq.toy.2"


# Commands


async def test_commands_that_are_open_to_all_need_no_lease_and_no_neutral(scene: Scene) -> None:
    commands = [Stop(), Switch(on=True), (topics.CMD_SENSOR("front"), SensorSetting(enable=True))]
    scene.program().say(*commands)
    assert scene.taken() == commands
    assert scene.asked == []


async def test_a_drive_does_not_overtake_what_a_thread_carries(scene: Scene) -> None:
    """Everything but a drive blocks, and goes by way of a thread: it is numbered when its turn comes."""
    program = await scene.driving()
    program.say(Raw(id=40), Raw(id=41), Drive(forward=0.1), Drive(forward=0.2))
    assert scene.taken() == [Raw(id=40)]
    assert await scene.done() == [Raw(id=41), Drive(forward=0.2)]
    assert scene.gateway.refused == []


async def test_what_waits_for_the_bus_is_bounded_and_motion_finds_a_place(scene: Scene) -> None:
    program = await scene.driving()
    waiting = [Raw(id=number) for number in range(WAITING + 1)]
    program.say(*waiting)
    program.refused("64 commands wait for the bus", Raw(id=200))
    assert await program.said(STAND) == [*waiting, STAND]


async def test_raw_needs_the_lease_like_motion_and_acquires_it(scene: Scene) -> None:
    program = scene.program()
    program.refused("connected", Raw(id=40))
    assert await program.said(STAND, Raw(id=40)) == [Raw(id=40)]


async def test_a_flush_that_fails_does_not_stop_what_waits(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    program = await scene.driving()

    async def fails() -> None:
        raise BusError("the bus is closed")

    monkeypatch.setattr(scene.bus, "flush", fails)
    assert await program.said(Raw(id=40), STAND) == [Raw(id=40), STAND]


@pytest.fixture
def freed(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> asyncio.Event:
    """A bus that takes nothing until this is set."""
    freed = asyncio.Event()

    async def blocked() -> None:
        await freed.wait()

    monkeypatch.setattr(scene.bus, "flush", blocked)
    return freed


async def blocked_driver(scene: Scene, freed: asyncio.Event) -> Program:
    """Make a program that drives, before the bus takes nothing any more."""
    freed.set()
    program = await scene.driving()
    freed.clear()
    return program


@pytest.mark.parametrize("late", [True, False])
async def test_motion_that_waited_for_the_bus_is_not_sent_when_its_time_is_over(scene, freed, late) -> None:
    program = await blocked_driver(scene, freed)
    program.say(Raw(id=40), Raw(id=41), Drive(forward=0.25))
    if late:
        scene.now += DEADMAN_S
    else:
        program.look(refusals(("hq.toy.1", "drive", "busy: map", 1), code=Code.NEUTRAL_FIRST))
    freed.set()
    assert await scene.done() == [Raw(id=40)]
    program.say(STAND)
    assert scene.taken() == [STAND]


async def test_neutral_that_waited_for_the_bus_is_sent_however_late(scene: Scene, freed: asyncio.Event) -> None:
    program = await blocked_driver(scene, freed)
    program.say(Raw(id=40), GO, STAND)
    scene.now += 2.0
    freed.set()
    assert await scene.done() == [Raw(id=40), STAND]


# Light


async def test_the_light_is_told_only_when_it_changes(scene: Scene) -> None:
    program = scene.program()
    await program.said(Drive(light=False))
    assert await program.said(Drive(forward=0.5, light=False)) == [GO]
    on, off = Drive(forward=0.5, light=True), Drive(forward=0.5, light=False)
    program.say(on, on, off, off)
    assert scene.taken() == [on, GO, off, GO]


async def test_a_light_switched_on_by_a_refused_command_is_told_with_the_next(scene: Scene) -> None:
    program = await scene.driving()
    scene.now += DEADMAN_S
    program.refused("deadman", Drive(forward=0.5, light=True))
    assert await program.said(Drive(light=True)) == [Drive(light=True)]


async def test_a_light_that_was_on_before_a_lease_is_told_with_every_new_one(scene: Scene) -> None:
    program, lit = scene.program(), Drive(forward=0.5, light=True)
    assert await program.said(Drive(light=True), lit) == [lit]
    program.say(Drive(light=True))
    await program.stopped()
    assert await program.said(Drive(light=True), lit) == [lit]


# Steering


async def test_turning_the_wheels_is_neutral_to_a_program_that_steers(scene: Scene) -> None:
    program = scene.program(steers=True)
    await program.said(Drive(turn=0.5))
    assert scene.asked == []
    driven = Drive(forward=0.5, turn=0.5)
    assert await program.said(driven) == [driven]
    assert await program.said(Drive(turn=-0.5)) == [Drive(turn=-0.5)]


async def test_wheels_are_set_only_when_nothing_need_be_said_first(scene: Scene) -> None:
    program = await scene.driving(steers=True)
    scene.now += DEADMAN_S
    turned = Drive(turn=-0.5, light=True)
    assert await program.said(turned, turned) == [Drive(light=True), Drive(turn=-0.5)]
    assert scene.gateway.refused == []


async def test_turning_is_motion_to_a_program_that_does_not_steer(scene: Scene) -> None:
    scene.program().refused("connected", Drive(turn=0.5))


# Control modes


async def test_the_mode_is_told_to_a_robot_that_has_any_before_the_motion(scene: Scene) -> None:
    program = scene.program(needs_mode=True)
    await program.said(STAND, Mode("manual"))
    assert scene.asked == [], "a mode alone moves nothing"
    assert await program.said(GO) == [Mode("manual"), GO]


async def test_a_robot_of_another_protocol_is_told_no_mode(scene: Scene) -> None:
    scene.robot("other")
    program = scene.program(needs_mode=True)
    assert await program.said(STAND, Mode("manual"), GO) == [GO]
    assert await program.said(Mode("none")) == []
    assert scene.state == "free"


async def test_mode_none_is_told_and_gives_the_robot_back(scene: Scene) -> None:
    program = scene.program(needs_mode=True)
    await program.said(STAND, Mode("manual"), GO)
    assert await program.said(Mode("none")) == [Mode("none")]
    assert (scene.asked, scene.state) == (["acquire", "release"], "free")
    program.refused("control mode is none", GO)


async def test_mode_none_is_told_although_another_command_is_still_on_its_way(scene: Scene) -> None:
    program = scene.program(needs_mode=True)
    assert await program.said(STAND, Mode("autonomous")) == [Mode("autonomous")]
    assert await program.said(Mode("manual"), GO, Mode("none")) == [Mode("manual"), Mode("none")]
    assert (scene.gateway.refused, scene.state) == ([], "free")


async def test_mode_none_while_the_answer_is_awaited_gives_back_what_was_granted(scene: Scene) -> None:
    program = scene.program(needs_mode=True)
    assert await program.said(STAND, Mode("manual"), GO, Mode("none")) == []
    assert (scene.asked, scene.state) == (["acquire", "release"], "free")
    assert not program.active


async def test_mode_autonomous_acquires_is_told_and_keeps_the_lease(scene: Scene) -> None:
    program = scene.program(needs_mode=True)
    assert await program.said(STAND, Mode("autonomous")) == [Mode("autonomous")]
    for _ in range(200):
        program.intent.heard(scene.now + ATTEND_S)
        await program.ticks()
    assert scene.holder == "hq.toy.1"
    assert 15 <= scene.asked.count("renew") <= 21, "once in a third of the lease"
    await program.ticks(31)
    assert scene.state == "free", "total silence"


# Losing the robot


async def test_a_stop_ends_the_drive_and_neutral_must_come(scene: Scene) -> None:
    program = await scene.driving()
    await program.stopped()
    assert scene.told == ["not driving: the lease has ended (stop)"]
    program.refused(r"the lease has ended \(stop\): release the stick first", GO)
    await scene.done()
    assert scene.asked == ["acquire", "renew"]
    await program.said(STAND, GO)
    assert scene.holder == "hq.toy.1"


@pytest.mark.parametrize("code", [Code.NEUTRAL_FIRST, Code.LEASE_ENDED, Code.NOT_READY])
async def test_what_listeners_tell_of_refusals_is_nothing_to_a_program_whoever_they_name(scene: Scene, code) -> None:
    program = await scene.driving()
    renewals = scene.asked.count("renew")
    told = Refusal(who="hq.toy.1", command="drive", code=code, reason="somebody said so", count=1, by="hq.toy")
    program.look(msgspec.structs.replace(scene.gateway.report(), refusals=(told,)))
    await scene.done()
    assert scene.told == []
    assert scene.asked.count("renew") == renewals
    assert await program.said(GO) == [GO]


async def test_a_takeover_is_noticed_and_told_once(scene: Scene) -> None:
    program = await scene.driving()
    scene.gateway.authority.takeover(Acquire(who="operator"), scene.now)
    for _ in range(5):
        scene.look(program)
        await scene.done()
    assert scene.told == ["not driving: the lease has ended (taken over by operator)"]
    assert not program.active


async def test_the_gateway_going_away_ends_the_drive_and_is_nothing_to_an_idle_program(scene: Scene) -> None:
    scene.program().gateway_lost()
    assert scene.told == []
    program = await scene.driving()
    program.gateway_lost()
    program.gateway_lost()
    assert scene.told == ["not driving: the robot's gateway is gone"]
    program.refused("the robot's gateway is gone: release the stick first", GO)


# Refusals


def refusals(*entries: tuple[str | None, str, str, int], code: Code = Code.BUSY) -> Control:
    return Control(
        state="held",
        holder="hq.toy.1",
        refusals=tuple(Refusal(who=who, command=what, code=code, reason=why, count=n) for who, what, why, n in entries),
    )


async def test_a_refused_command_is_told_once_for_each_time_it_is_refused(scene: Scene) -> None:
    program = await scene.driving()
    for number in (1, 1, 2, 2, 3):
        program.look(refusals(("hq.toy.1", "raw/toy", "busy", number)))
    assert scene.told == ["raw/toy: busy"] * 3
    assert program.intent.held


async def test_a_refusal_that_bears_no_name_is_told_to_who_has_just_given_such_a_command(scene: Scene) -> None:
    asking, idle = scene.program(), scene.program("hq.toy.2")
    asking.say(Switch(True))
    refused = (None, "lidar", "the robot has no such command", 1)
    for program in (idle, asking):
        program.look(refusals(refused, (None, "text", "no", 1)))
    assert scene.told == ["lidar: the robot has no such command"]
    scene.now += 1.0
    asking.look(refusals((*refused[:3], 2)))
    assert len(scene.told) == 1


async def test_commands_that_need_no_lease_are_bounded_for_each_program(scene: Scene) -> None:
    greedy, other = scene.program(), scene.program("hq.toy.2")
    greedy.say(*[Switch(True)] * 50)
    greedy.refused("more than 50 commands a second", Switch(True))
    other.say(Switch(True))
    scene.now += 0.1
    greedy.say(Switch(True))


async def test_a_robot_of_another_protocol_is_not_taken_to_move_by_itself(scene: Scene) -> None:
    scene.robot("other")
    program = scene.program(needs_mode=True)
    program.say(STAND)
    program.refused("does not move by itself", Mode("autonomous"))
    await scene.done()
    assert (scene.asked, program.intent.mode) == ([], "manual"), "but it can be driven"


async def test_what_was_refused_to_a_program_of_this_name_before_is_not_told(scene: Scene) -> None:
    scene.view.note(topics.CONTROL, refusals(("hq.toy.1", "drive", "busy", 4)))
    program = scene.program()
    program.look(refusals(("hq.toy.1", "drive", "busy", 4)))
    assert scene.told == []
    program.look(refusals(("hq.toy.1", "drive", "busy", 5)))
    assert scene.told == ["drive: busy"]


async def test_a_robot_that_must_hear_neutral_first_makes_the_program_say_it(scene: Scene) -> None:
    program = await scene.driving()
    scene.gateway.authority.hold_back("busy: map")
    program.say(GO)
    scene.look(program)
    assert scene.told == ["drive: busy: map: send a neutral drive first"]
    program.refused("motion was refused: release the stick first", GO)
    program.say(STAND, GO)
    assert scene.taken() == [STAND, GO]


# Holding, and giving back


async def test_what_a_controller_set_once_is_repeated_while_it_lives(scene: Scene) -> None:
    program = await scene.holding()
    assert await program.ticks(100) == [left(5.0)] * 100
    assert (scene.holder, scene.gateway.refused) == ("hq.toy.1", [])
    await program.said(left(0.0))
    assert await program.ticks() == [], "neutral is not repeated"


async def test_what_other_programs_set_is_not_repeated(scene: Scene) -> None:
    assert await (await scene.driving()).ticks() == []


async def test_every_motor_there_can_be_is_set_and_held(scene: Scene) -> None:
    program = scene.program(hold=True)
    motors = [topics.CMD_MOTOR(f"m{number}") for number in range(255)]
    program.say((motors[0], Motor(value=0.0)))
    moved: list[Command] = [(motor, Motor(value=1.0)) for motor in motors]
    assert await program.said(*moved) == moved
    held = await program.ticks(2)
    assert all(command in held for command in moved)


async def test_one_motor_at_rest_is_no_neutral_while_another_is_still_set(scene: Scene) -> None:
    """A controller that turns about one wheel says 0 for it all the time: a stop would not outlast that."""
    program = await scene.holding(right(0.0))
    await program.stopped()
    for _ in range(10):
        program.refused("release the stick first", left(5.0))
        assert await program.ticks(1, right(0.0)) == []
    assert scene.asked.count("acquire") == 1
    assert await program.said(left(0.0), left(5.0)) == [left(5.0)]


async def test_a_motor_that_was_set_once_before_the_robot_was_had_does_not_keep_the_others_back(scene: Scene) -> None:
    """A controller puts its arm where it belongs when it starts, and never says 0 of that."""
    program = scene.program(hold=True)
    program.refused("connected", (topics.CMD_MOTOR("arm"), Motor(value=0.2)))
    program.say(left(0.0))
    program.refused("connected", left(5.0))
    scene.now += DEADMAN_S
    assert await program.said(left(0.0), left(5.0)) == [left(5.0)]
    program.tick()
    assert await scene.done() == [left(5.0)], "what was refused is not held"


async def test_what_was_set_before_the_deadman_does_not_move_again_by_itself(scene: Scene) -> None:
    """The loop was away for a while: what is held has lapsed, and one motor's neutral does not revive the other."""
    program = await scene.holding(right(5.0))
    scene.now += DEADMAN_S
    program.tick()
    carried_out = await program.said(left(0.0))
    program.tick()
    carried_out += await scene.done()
    assert set(carried_out) <= {left(0.0), right(0.0)}


async def test_a_controller_of_wheels_may_become_one_of_motors(scene: Scene) -> None:
    """The robot was another one for a while: a drive that was never ended is not waited for."""
    program = scene.program(hold=True)
    for neutral, motion in ((STAND, GO), (left(0.0), left(5.0)), (STAND, GO)):
        assert await program.said(neutral, motion) == [motion]
        await program.stopped()
        scene.now += DEADMAN_S


async def test_neutral_for_the_time_of_the_lease_gives_the_robot_back(scene: Scene) -> None:
    program = await scene.driving()
    for _ in range(26):
        await program.ticks(1, STAND)
        assert program.intent.held
    await program.ticks(2)
    assert scene.state == "free"
    assert not program.active
    assert scene.told == [], "nobody wanted it any more"
    await program.said(GO)
    assert scene.holder == "hq.toy.1"


async def test_silence_lets_the_motion_lapse_and_gives_the_robot_back(scene: Scene) -> None:
    program = await scene.driving()
    await program.ticks(31)
    assert scene.state in ("free", "stopped")
    assert not program.active
    program.refused("deadman", GO)


async def test_a_lease_shorter_than_usual_is_given_back_sooner(scene: Scene) -> None:
    scene.gateway.authority.lease_s = 1.0
    program = await scene.driving()
    for seconds, held in ((0.7, True), (0.06, False)):
        scene.now += seconds
        program.tick()
        assert program.intent.held is held
    await scene.done()


# The end


@pytest.mark.parametrize("asking", [False, True])
async def test_a_program_that_went_gives_the_robot_back_at_once_or_when_it_is_granted(scene: Scene, asking) -> None:
    program = scene.program() if asking else await scene.driving()
    program.say(*[STAND, GO] * asking)
    program.close()
    program.close()
    assert program.active is asking
    assert await scene.done() == []
    assert (scene.asked, scene.state, await scene.alive()) == (["acquire", "release"], "free", [])


async def test_a_program_that_went_while_it_asked_in_vain_leaves_nothing(scene: Scene) -> None:
    scene.gateway.authority.acquire(Acquire(who="operator"), scene.now)
    program = scene.program()
    program.say(STAND, GO)
    program.close()
    await scene.done()
    assert (scene.holder, await scene.alive()) == ("operator", [])


async def test_a_program_that_never_asked_leaves_without_a_word(scene: Scene) -> None:
    scene.program().close()
    await scene.done()
    assert scene.asked == []


async def test_a_program_that_goes_while_the_robot_is_being_given_back_leaves_it_free(scene: Scene) -> None:
    program = await scene.driving()
    scene.now += LEASE_S - 0.01
    program.say(STAND)
    scene.now += 0.01
    program.tick()
    program.close()
    await scene.done()
    assert (scene.state, await scene.alive()) == ("free", []), "given back, not lost"


async def test_many_programs_come_and_go_and_leave_nothing(scene: Scene) -> None:
    for number in range(300):
        program = await scene.driving(f"hq.toy.{number}")
        program.close()
        await scene.done()
    assert scene.tasks == set()
    assert await scene.alive() == []
    scene.bridge.close()
    assert "Bridge to r1" in repr(scene.bridge)
    assert repr(program).startswith("<Operator hq.toy.299 <Intent")


async def test_keys_that_are_commanded_one_after_the_other_do_not_add_up(scene: Scene) -> None:
    for number in range(2 * PUBLISHERS):
        scene.bridge.put(topics.CMD_SENSOR(f"s{number}"), SensorSetting(value=1.0))
    assert len(scene.bridge._publishers) == PUBLISHERS
    assert len(scene.bus.values("fleet/r1/@cmd/sensor/*")) == 2 * PUBLISHERS
