"""An operator for one HQ program, against a gateway that keeps the lease as real ones do. Times are made up."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

import msgspec
import pytest

from tests.proofs import numbered
from zbridge.bus.fake import FakeBus
from zbridge.bus.interface import Handle, IncomingQuery, Sample
from zbridge.control.authority import Authority
from zbridge.control.proof import read
from zbridge.errors import BusError, Code, Refused
from zbridge.fleet import payload as payloads
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
from zbridge.fleet.topics import KeySpace
from zbridge.fleet.view import RobotView
from zbridge.hq.bridge import PUBLISHERS, Bridge
from zbridge.hq.command_queue import WAITING
from zbridge.hq.intent import LEASE_S, Intent
from zbridge.hq.operator import Operator
from zbridge.protocol.plugin import ATTEND_S

KEYS = KeySpace("fleet", "r1")
DEADMAN_S = 1.25
GO, STAND = Drive(forward=0.5), Drive()
LEFT, RIGHT = topics.CMD_MOTOR("left"), topics.CMD_MOTOR("right")
RAW = topics.CMD_RAW("toy")


class Gateway:
    """The robot's end of the bus: the lease as it is, and every command with what became of it."""

    def __init__(self, bus: FakeBus, scene: Scene) -> None:
        self.bus = bus
        self.scene = scene
        self.authority = Authority(LEASE_S, 2.0, numbered())
        self.commands: list[tuple[str, FleetMessage]] = []
        self.refused: list[str] = []
        self.asked: list[str] = []
        self.requests: list[Acquire] = []
        self.control = bus.publisher(KEYS.key("control"), topics.CONTROL)
        bus.subscribe(KEYS.key("@cmd/**"), self._take)
        self.serving: list[Handle] = []
        self.serve()
        bus.watch_alive(KEYS.alive("*"), self._on_alive)

    def serve(self) -> None:
        rpc = ("acquire/*", "takeover/*", "renew", "release")
        self.serving = [self.bus.answer(KEYS.key(f"@rpc/control/{name}"), self._decide) for name in rpc]

    def vanish(self) -> None:
        for handle in self.serving:
            handle.close()

    def _decide(self, question: IncomingQuery) -> None:
        what, _, name = KEYS.path(question.key).removeprefix("@rpc/control/").partition("/")
        self.asked.append(what)
        now = self.scene.now
        if what == "acquire":
            self.requests.append(request := payloads.decode(Acquire, question.payload))
            assert request.who.startswith(f"{name}."), "asked in the name of the listener"
            lease = self.authority.acquire(request, now)
        else:
            decide = self.authority.renew if what == "renew" else self.authority.release
            lease = decide(read(question.payload), question.asked, now)
        question.answer(payloads.encode(lease))

    def _take(self, sample: Sample) -> None:
        topic = topics.find(KEYS.path(sample.key))
        assert topic is not None
        message = payloads.decode(topic.message, sample.payload)
        if isinstance(message, Drive | Motor | Mode | Raw):
            who = None
            try:
                who = self.authority.admit(sample.attachment, sample.key, sample.payload, self.scene.now)
                moving = isinstance(message, Drive | Motor) and message.moving
                if moving:
                    self.authority.require_motion()
                if isinstance(message, Drive | Motor):
                    self.authority.applied(topic.path, self.scene.now, moving=moving)
            except Refused as refusal:
                self.refused.append(str(refusal))
                command = topic.path.removeprefix("@cmd/")
                self.authority.refuse(command, refusal, refusal.who or who)
                return
        else:
            assert sample.attachment is None
        self.commands.append((topic.path.removeprefix("@cmd/"), message))

    def _on_alive(self, key: str, alive: bool) -> None:
        if not alive:
            self.authority.vanished(key.removeprefix(KEYS.alive("")))

    def report(self) -> Control:
        self.authority.expire(self.scene.now)
        return self.authority.report(self.scene.now)

    def taken(self) -> list[tuple[str, FleetMessage]]:
        """What was carried out since the last call."""
        commands, self.commands = self.commands, []
        return commands


class RepeatingOperator(Operator):
    """The operator of a program that sets motion once."""

    def tick(self) -> None:
        self.repeat()
        super().tick()


def is_motion_of_wheels(command: Drive | Motor) -> bool:
    return bool(command.value if isinstance(command, Motor) else command.forward or command.left)


class Scene:
    """A robot, its gateway, and any number of programs; nothing is answered before :meth:`settle`."""

    def __init__(self, *, protocol: str = "toy") -> None:
        self.now = 100.0
        self.bus = FakeBus("hq")
        self.gateway = Gateway(self.bus.join("gw"), self)
        self.view = RobotView()
        self.view.alive = True
        self.view.note(topics.STATUS, Status(state="established", protocol=protocol))
        self.tasks: set[asyncio.Task[None]] = set()
        self.bridge = Bridge(self.bus, KEYS, self.view, self.spawn)
        self.told: list[str] = []

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)

    async def settle(self) -> None:
        """Let everything be answered that was asked."""
        while self.tasks:
            for done in (await asyncio.wait(self.tasks))[0]:
                done.result()
            await asyncio.sleep(0)

    def operator(
        self,
        who: str = "hq.toy.1",
        *,
        needs_mode: bool = False,
        protocol: str = "toy",
        steers: bool = False,
        hold: bool = False,
    ) -> Operator:
        kind = RepeatingOperator if hold else Operator
        operator = kind(
            Intent(DEADMAN_S),
            self.bridge,
            who=who,
            protocol=protocol,
            is_motion=is_motion_of_wheels if steers else lambda command: command.moving,
            tell=self.told.append,
            clock=lambda: self.now,
        )
        if needs_mode:
            operator.command(topics.CMD_MODE, Mode("none"))
        return operator

    def look(self, *operators: Operator) -> None:
        """Let the gateway say how things stand."""
        report = self.gateway.report()
        self.view.note(topics.CONTROL, report)
        for operator in operators:
            operator.look(report)

    async def driving(self, **kind: Any) -> Operator:
        """Make an operator whose program drives."""
        operator = self.operator(**kind)
        operator.command(topics.CMD_DRIVE, STAND)
        operator.command(topics.CMD_DRIVE, GO)
        await self.settle()
        assert self.gateway.taken() == [("drive", GO)]
        return operator


# Taking the robot


async def test_motion_acquires_the_robot_and_is_then_carried_out() -> None:
    scene = Scene()
    operator = scene.operator()
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_DRIVE, GO)
    assert scene.gateway.taken() == []
    await scene.settle()
    assert scene.gateway.requests == [Acquire(who="hq.toy.1", deadman_s=DEADMAN_S, alive="hq.toy.1")]
    assert scene.gateway.taken() == [("drive", GO)]
    assert await scene.bus.alive(KEYS.alive("*")) == [KEYS.alive("hq.toy.1")]
    assert operator.active


async def test_nothing_moves_and_nothing_is_asked_before_neutral() -> None:
    scene = Scene()
    operator = scene.operator()
    for _ in range(3):
        with pytest.raises(Refused, match="connected: release the stick first"):
            operator.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    assert (scene.gateway.asked, scene.bus.values("fleet/r1/@cmd/**")) == ([], [])
    assert await scene.bus.alive(KEYS.alive("*")) == []
    assert not operator.active


async def test_neutral_of_a_program_that_holds_nothing_is_sent_nowhere() -> None:
    scene = Scene()
    operator = scene.operator()
    for _ in range(3):
        operator.command(topics.CMD_DRIVE, STAND)
    await scene.settle()
    assert (scene.gateway.asked, scene.bus.values("fleet/r1/@cmd/**")) == ([], [])


async def test_of_what_is_said_while_the_answer_is_awaited_the_newest_counts() -> None:
    scene = Scene()
    operator = scene.operator()
    operator.command(topics.CMD_DRIVE, STAND)
    for step in range(1, 10):
        operator.command(topics.CMD_DRIVE, Drive(forward=step / 10))
    await scene.settle()
    assert scene.gateway.asked == ["acquire"]
    assert scene.gateway.taken() == [("drive", Drive(forward=0.9))]


async def test_a_program_that_let_go_while_the_answer_was_awaited_does_not_move() -> None:
    scene = Scene()
    operator = scene.operator()
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_DRIVE, GO)
    operator.command(topics.CMD_DRIVE, STAND)
    await scene.settle()
    assert scene.gateway.taken() == [("drive", STAND)]
    assert operator.intent.held


async def test_an_answer_that_comes_after_the_deadman_moves_nothing() -> None:
    scene = Scene()
    operator = scene.operator()
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_DRIVE, GO)
    scene.now += DEADMAN_S
    await scene.settle()
    assert scene.gateway.taken() == []
    assert operator.intent.held
    with pytest.raises(Refused, match="deadman"):
        operator.command(topics.CMD_DRIVE, GO)


async def test_a_robot_that_somebody_else_drives_is_refused_and_neutral_must_come() -> None:
    scene = Scene()
    scene.gateway.authority.acquire(Acquire(who="operator"), scene.now)
    operator = scene.operator()
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    assert scene.told == ["not driving: held by operator (priority 0)"]
    assert scene.gateway.taken() == []
    assert not operator.active
    with pytest.raises(Refused, match=r"held by operator \(priority 0\): release the stick first"):
        operator.command(topics.CMD_DRIVE, GO)
    scene.look(operator)
    assert len(scene.told) == 1, "the refusal of the question itself is not told again"


async def test_without_a_gateway_the_answer_is_no() -> None:
    scene = Scene()
    scene.gateway.vanish()
    operator = scene.operator()
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    assert scene.told == ["not driving: no gateway answers"]
    assert not operator.active


@pytest.mark.parametrize(
    ("status", "alive", "reason"),
    [
        (Status(state="offline", reason="no route", protocol="toy"), True, "robot offline: no route"),
        (Status(state="connecting", protocol="toy"), True, "robot connecting"),
        (Status(state="established", protocol="toy"), False, "no gateway serves the robot"),
    ],
)
async def test_a_robot_that_is_not_there_is_not_asked_for(status: Status, alive: bool, reason: str) -> None:
    scene = Scene()
    scene.view.note(topics.STATUS, status)
    scene.view.alive = alive
    operator = scene.operator()
    operator.command(topics.CMD_DRIVE, STAND)
    with pytest.raises(Refused, match=f"^{reason}$"):
        operator.command(topics.CMD_DRIVE, GO)
    scene.view.note(topics.STATUS, Status(state="established", protocol="toy"))
    scene.view.alive = True
    with pytest.raises(Refused, match=f"{reason}: release the stick first"):
        operator.command(topics.CMD_DRIVE, GO)
    assert scene.gateway.asked == []


async def test_two_programs_share_a_robot_one_after_the_other() -> None:
    scene = Scene()
    first = await scene.driving()
    second = scene.operator("hq.toy.2")
    second.command(topics.CMD_DRIVE, STAND)
    second.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    assert scene.told == ["not driving: held by hq.toy.1 (priority 0)"]
    first.close()
    await scene.settle()
    second.command(topics.CMD_DRIVE, STAND)
    second.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    assert scene.gateway.taken() == [("drive", GO)]
    assert scene.gateway.report().holder == "hq.toy.2"


# Commands


async def test_commands_that_are_open_to_all_need_no_lease_and_no_neutral() -> None:
    scene = Scene()
    operator = scene.operator()
    operator.command(topics.CMD_STOP, Stop())
    operator.command(topics.CMD_LIDAR, Switch(on=True))
    operator.command(topics.CMD_SENSOR("front"), SensorSetting(enable=True))
    assert [path for path, _ in scene.gateway.taken()] == ["stop", "lidar", "sensor/front"]
    assert scene.gateway.asked == []


async def test_a_drive_does_not_overtake_what_a_thread_carries() -> None:
    """Everything but a drive blocks, and goes by way of a thread: it is numbered when its turn comes."""
    scene = Scene()
    operator = await scene.driving()
    operator.command(RAW, Raw(id=40))
    operator.command(RAW, Raw(id=41))
    operator.command(topics.CMD_DRIVE, Drive(forward=0.1))
    operator.command(topics.CMD_DRIVE, Drive(forward=0.2))
    assert [path for path, _ in scene.gateway.taken()] == ["raw/toy"]
    await scene.settle()
    assert scene.gateway.taken() == [("raw/toy", Raw(id=41)), ("drive", Drive(forward=0.2))]
    assert scene.gateway.refused == []


async def test_what_waits_for_the_bus_is_bounded_and_motion_finds_a_place() -> None:
    scene = Scene()
    operator = await scene.driving()
    for number in range(WAITING + 1):
        operator.command(RAW, Raw(id=number))
    with pytest.raises(Refused, match="64 commands wait for the bus"):
        operator.command(RAW, Raw(id=200))
    operator.command(topics.CMD_DRIVE, STAND)
    await scene.settle()
    assert [message for _, message in scene.gateway.taken()] == [*(Raw(id=n) for n in range(WAITING + 1)), STAND]


async def test_raw_needs_the_lease_like_motion_and_acquires_it() -> None:
    scene = Scene()
    operator = scene.operator()
    with pytest.raises(Refused, match="connected"):
        operator.command(RAW, Raw(id=40))
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(RAW, Raw(id=40))
    await scene.settle()
    assert scene.gateway.taken() == [("raw/toy", Raw(id=40))]


async def test_a_flush_that_fails_does_not_stop_what_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    operator = await scene.driving()

    async def fails() -> None:
        raise BusError("the bus is closed")

    monkeypatch.setattr(scene.bus, "flush", fails)
    operator.command(RAW, Raw(id=40))
    operator.command(topics.CMD_DRIVE, STAND)
    await scene.settle()
    assert scene.gateway.taken() == [("raw/toy", Raw(id=40)), ("drive", STAND)]


@pytest.mark.parametrize("late", [True, False])
async def test_motion_that_waited_for_the_bus_is_not_sent_when_its_time_is_over(late, monkeypatch) -> None:
    scene = Scene()
    operator = await scene.driving()
    taken = asyncio.Event()

    async def blocked() -> None:
        await taken.wait()

    monkeypatch.setattr(scene.bus, "flush", blocked)
    operator.command(RAW, Raw(id=40))
    operator.command(RAW, Raw(id=41))
    operator.command(topics.CMD_DRIVE, Drive(forward=0.25))
    if late:
        scene.now += DEADMAN_S
    else:
        operator.look(refusals(("hq.toy.1", "drive", "busy: map", 1), code=Code.NEUTRAL_FIRST))
    taken.set()
    await scene.settle()
    assert scene.gateway.taken() == [("raw/toy", Raw(id=40))]
    operator.command(topics.CMD_DRIVE, STAND)
    assert scene.gateway.taken() == [("drive", STAND)]


async def test_neutral_that_waited_for_the_bus_is_sent_however_late(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene()
    operator = await scene.driving()
    taken = asyncio.Event()

    async def blocked() -> None:
        await taken.wait()

    monkeypatch.setattr(scene.bus, "flush", blocked)
    operator.command(RAW, Raw(id=40))
    operator.command(topics.CMD_DRIVE, GO)
    operator.command(topics.CMD_DRIVE, STAND)
    scene.now += 2.0
    taken.set()
    await scene.settle()
    assert scene.gateway.taken() == [("raw/toy", Raw(id=40)), ("drive", STAND)]


# Light


async def test_the_light_is_told_only_when_it_changes() -> None:
    scene = Scene()
    operator = scene.operator()
    operator.command(topics.CMD_DRIVE, Drive(light=False))
    operator.command(topics.CMD_DRIVE, Drive(forward=0.5, light=False))
    await scene.settle()
    for light in (True, True, False, False):
        operator.command(topics.CMD_DRIVE, Drive(forward=0.5, light=light))
    assert [message for _, message in scene.gateway.taken()] == [
        GO,
        Drive(forward=0.5, light=True),
        GO,
        Drive(forward=0.5, light=False),
        GO,
    ]


async def test_a_light_switched_on_before_the_robot_was_had_is_told() -> None:
    scene = Scene()
    operator = scene.operator()
    operator.command(topics.CMD_DRIVE, Drive(light=True))
    operator.command(topics.CMD_DRIVE, Drive(forward=0.5, light=True))
    await scene.settle()
    operator.command(topics.CMD_DRIVE, Drive(forward=0.5, light=True))
    lights = [message.light for _, message in scene.gateway.taken() if isinstance(message, Drive)]
    assert lights[0] is True


async def test_a_light_switched_on_by_a_refused_command_is_told_with_the_next() -> None:
    scene = Scene()
    operator = await scene.driving()
    scene.now += DEADMAN_S
    with pytest.raises(Refused, match="deadman"):
        operator.command(topics.CMD_DRIVE, Drive(forward=0.5, light=True))
    operator.command(topics.CMD_DRIVE, Drive(light=True))
    assert scene.gateway.taken() == [("drive", Drive(light=True))]


async def test_the_light_of_a_new_lease_is_told_anew() -> None:
    scene = Scene()
    operator = await scene.driving()
    operator.command(topics.CMD_DRIVE, Drive(light=True))
    scene.gateway.authority.stop("stop")
    scene.look(operator)
    await scene.settle()
    scene.gateway.taken()
    operator.command(topics.CMD_DRIVE, Drive(light=True))
    operator.command(topics.CMD_DRIVE, Drive(forward=0.5, light=True))
    await scene.settle()
    assert scene.gateway.taken() == [("drive", Drive(forward=0.5, light=True))]


# Steering


async def test_turning_the_wheels_is_neutral_to_a_program_that_steers() -> None:
    scene = Scene()
    operator = scene.operator(steers=True)
    operator.command(topics.CMD_DRIVE, Drive(turn=0.5))
    await scene.settle()
    assert scene.gateway.asked == []
    operator.command(topics.CMD_DRIVE, Drive(forward=0.5, turn=0.5))
    await scene.settle()
    operator.command(topics.CMD_DRIVE, Drive(turn=-0.5))
    assert scene.gateway.taken() == [("drive", Drive(forward=0.5, turn=0.5)), ("drive", Drive(turn=-0.5))]


async def test_wheels_are_set_only_when_nothing_need_be_said_first() -> None:
    scene = Scene()
    operator = await scene.driving(steers=True)
    scene.now += DEADMAN_S
    operator.command(topics.CMD_DRIVE, Drive(turn=-0.5, light=True))
    operator.command(topics.CMD_DRIVE, Drive(turn=-0.5, light=True))
    assert scene.gateway.taken() == [("drive", Drive(light=True)), ("drive", Drive(turn=-0.5))]
    assert scene.gateway.refused == []


async def test_turning_is_motion_to_a_program_that_does_not_steer() -> None:
    scene = Scene()
    operator = scene.operator()
    with pytest.raises(Refused, match="connected"):
        operator.command(topics.CMD_DRIVE, Drive(turn=0.5))


# Control modes


async def test_the_mode_is_told_to_a_robot_that_has_any_before_the_motion() -> None:
    scene = Scene()
    operator = scene.operator(needs_mode=True)
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_MODE, Mode(mode="manual"))
    await scene.settle()
    assert scene.gateway.asked == [], "a mode alone moves nothing"
    operator.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    assert scene.gateway.taken() == [("mode", Mode(mode="manual")), ("drive", GO)]


async def test_a_robot_of_another_protocol_is_told_no_mode() -> None:
    scene = Scene(protocol="other")
    operator = scene.operator(needs_mode=True)
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_MODE, Mode(mode="manual"))
    operator.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    operator.command(topics.CMD_MODE, Mode(mode="none"))
    await scene.settle()
    assert scene.gateway.taken() == [("drive", GO)]
    assert scene.gateway.report().state == "free"


async def test_mode_none_is_told_and_gives_the_robot_back() -> None:
    scene = Scene()
    operator = scene.operator(needs_mode=True)
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_MODE, Mode(mode="manual"))
    operator.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    scene.gateway.taken()
    operator.command(topics.CMD_MODE, Mode(mode="none"))
    await scene.settle()
    assert scene.gateway.taken() == [("mode", Mode(mode="none"))]
    assert scene.gateway.asked == ["acquire", "release"]
    assert scene.gateway.report().state == "free"
    with pytest.raises(Refused, match="control mode is none"):
        operator.command(topics.CMD_DRIVE, GO)


async def test_mode_none_is_told_although_another_command_is_still_on_its_way() -> None:
    scene = Scene()
    operator = scene.operator(needs_mode=True)
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_MODE, Mode(mode="autonomous"))
    await scene.settle()
    operator.command(topics.CMD_MODE, Mode(mode="manual"))
    operator.command(topics.CMD_DRIVE, GO)
    operator.command(topics.CMD_MODE, Mode(mode="none"))
    await scene.settle()
    assert [message for _, message in scene.gateway.taken()] == [
        Mode(mode="autonomous"),
        Mode(mode="manual"),
        Mode(mode="none"),
    ]
    assert scene.gateway.refused == []
    assert scene.gateway.report().state == "free"


async def test_mode_none_while_the_answer_is_awaited_gives_back_what_was_granted() -> None:
    scene = Scene()
    operator = scene.operator(needs_mode=True)
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_MODE, Mode(mode="manual"))
    operator.command(topics.CMD_DRIVE, GO)
    operator.command(topics.CMD_MODE, Mode(mode="none"))
    await scene.settle()
    assert scene.gateway.taken() == []
    assert scene.gateway.asked == ["acquire", "release"]
    assert scene.gateway.report().state == "free"
    assert not operator.active


async def test_mode_autonomous_acquires_is_told_and_keeps_the_lease() -> None:
    scene = Scene()
    operator = scene.operator(needs_mode=True)
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_MODE, Mode(mode="autonomous"))
    await scene.settle()
    assert scene.gateway.taken() == [("mode", Mode(mode="autonomous"))]
    for _ in range(200):
        scene.now += ATTEND_S
        operator.intent.heard(scene.now)
        operator.tick()
        await scene.settle()
    assert scene.gateway.report().holder == "hq.toy.1"
    renewals = scene.gateway.asked.count("renew")
    assert 15 <= renewals <= 21, "once in a third of the lease"
    for _ in range(31):
        scene.now += ATTEND_S
        operator.tick()
        await scene.settle()
    assert scene.gateway.report().state == "free", "total silence"


# Losing the robot


async def test_a_stop_ends_the_drive_and_neutral_must_come() -> None:
    scene = Scene()
    operator = await scene.driving()
    scene.gateway.authority.stop("stop")
    scene.look(operator)
    await scene.settle()
    assert scene.told == ["not driving: the lease has ended (stop)"]
    with pytest.raises(Refused, match=r"the lease has ended \(stop\): release the stick first"):
        operator.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    assert scene.gateway.asked == ["acquire", "renew"]
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    assert scene.gateway.report().holder == "hq.toy.1"


@pytest.mark.parametrize("code", [Code.NEUTRAL_FIRST, Code.LEASE_ENDED, Code.NOT_READY])
async def test_what_listeners_tell_of_refusals_is_nothing_to_a_program_whoever_they_name(code: Code) -> None:
    scene = Scene()
    operator = await scene.driving()
    renewals = scene.gateway.asked.count("renew")
    told = Refusal(who="hq.toy.1", command="drive", code=code, reason="somebody said so", count=1, by="hq.toy")
    operator.look(msgspec.structs.replace(scene.gateway.report(), refusals=(told,)))
    await scene.settle()
    assert scene.told == []
    assert scene.gateway.asked.count("renew") == renewals
    operator.command(topics.CMD_DRIVE, GO)
    assert scene.gateway.taken() == [("drive", GO)]


async def test_a_takeover_is_noticed_and_told_once() -> None:
    scene = Scene()
    operator = await scene.driving()
    scene.gateway.authority.takeover(Acquire(who="operator"), scene.now)
    for _ in range(5):
        scene.look(operator)
        await scene.settle()
    assert scene.told == ["not driving: the lease has ended (taken over by operator)"]
    assert not operator.active


async def test_the_gateway_going_away_ends_the_drive() -> None:
    scene = Scene()
    operator = await scene.driving()
    operator.gateway_lost()
    operator.gateway_lost()
    assert scene.told == ["not driving: the robot's gateway is gone"]
    with pytest.raises(Refused, match="the robot's gateway is gone: release the stick first"):
        operator.command(topics.CMD_DRIVE, GO)


async def test_an_idle_program_is_not_told_of_the_gateways_end_by_its_operator() -> None:
    scene = Scene()
    scene.operator().gateway_lost()
    assert scene.told == []


# Refusals


def refusals(*entries: tuple[str | None, str, str, int], code: Code = Code.BUSY) -> Control:
    return Control(
        state="held",
        holder="hq.toy.1",
        refusals=tuple(Refusal(who=who, command=what, code=code, reason=why, count=n) for who, what, why, n in entries),
    )


async def test_a_refused_command_is_told_once_for_each_time_it_is_refused() -> None:
    scene = Scene()
    operator = await scene.driving()
    for number in (1, 1, 2, 2, 3):
        operator.look(refusals(("hq.toy.1", "raw/toy", "busy", number)))
    assert scene.told == ["raw/toy: busy"] * 3
    assert operator.intent.held


async def test_a_refusal_that_bears_no_name_is_told_to_who_has_just_given_such_a_command() -> None:
    scene = Scene()
    asking, idle = scene.operator(), scene.operator("hq.toy.2")
    asking.command(topics.CMD_LIDAR, Switch(True))
    refused = (None, "lidar", "the robot has no such command", 1)
    for operator in (idle, asking):
        operator.look(refusals(refused, (None, "text", "no", 1)))
    assert scene.told == ["lidar: the robot has no such command"]
    scene.now += 1.0
    asking.look(refusals((*refused[:3], 2)))
    assert len(scene.told) == 1


async def test_commands_that_need_no_lease_are_bounded_for_each_program() -> None:
    scene = Scene()
    greedy, other = scene.operator(), scene.operator("hq.toy.2")
    for _ in range(50):
        greedy.command(topics.CMD_LIDAR, Switch(True))
    with pytest.raises(Refused, match="more than 50 commands a second"):
        greedy.command(topics.CMD_LIDAR, Switch(True))
    other.command(topics.CMD_LIDAR, Switch(True))
    scene.now += 0.1
    greedy.command(topics.CMD_LIDAR, Switch(True))


async def test_a_robot_of_another_protocol_is_not_taken_to_move_by_itself() -> None:
    scene = Scene(protocol="other")
    operator = scene.operator(needs_mode=True)
    operator.command(topics.CMD_DRIVE, STAND)
    with pytest.raises(Refused, match="does not move by itself"):
        operator.command(topics.CMD_MODE, Mode("autonomous"))
    await scene.settle()
    assert (scene.gateway.asked, operator.intent.mode) == ([], "manual"), "but it can be driven"


async def test_what_was_refused_to_a_program_of_this_name_before_is_not_told() -> None:
    scene = Scene()
    scene.view.note(topics.CONTROL, refusals(("hq.toy.1", "drive", "busy", 4)))
    operator = scene.operator()
    operator.look(refusals(("hq.toy.1", "drive", "busy", 4)))
    assert scene.told == []
    operator.look(refusals(("hq.toy.1", "drive", "busy", 5)))
    assert scene.told == ["drive: busy"]


async def test_a_robot_that_must_hear_neutral_first_makes_the_program_say_it() -> None:
    scene = Scene()
    operator = await scene.driving()
    scene.gateway.authority.hold_back("busy: map")
    operator.command(topics.CMD_DRIVE, GO)
    scene.look(operator)
    assert scene.told == ["drive: busy: map: send a neutral drive first"]
    with pytest.raises(Refused, match="motion was refused: release the stick first"):
        operator.command(topics.CMD_DRIVE, GO)
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_DRIVE, GO)
    assert [message for _, message in scene.gateway.taken()] == [STAND, GO]


# Holding, and giving back


async def test_what_a_controller_set_once_is_repeated_while_it_lives() -> None:
    scene = Scene()
    operator = scene.operator(hold=True)
    operator.command(LEFT, Motor(value=0.0))
    operator.command(LEFT, Motor(value=5.0))
    await scene.settle()
    assert scene.gateway.taken() == [("motor/left", Motor(value=5.0))]
    for _ in range(100):
        scene.now += ATTEND_S
        operator.tick()
        await scene.settle()
    assert scene.gateway.taken() == [("motor/left", Motor(value=5.0))] * 100
    assert scene.gateway.report().holder == "hq.toy.1"
    assert scene.gateway.refused == []
    operator.command(LEFT, Motor(value=0.0))
    await scene.settle()
    scene.gateway.taken()
    scene.now += ATTEND_S
    operator.tick()
    await scene.settle()
    assert scene.gateway.taken() == [], "neutral is not repeated"


async def test_what_other_programs_set_is_not_repeated() -> None:
    scene = Scene()
    operator = await scene.driving()
    scene.now += ATTEND_S
    operator.tick()
    await scene.settle()
    assert scene.gateway.taken() == []


async def test_every_motor_there_can_be_is_set_and_held() -> None:
    scene = Scene()
    operator = scene.operator(hold=True)
    motors = [topics.CMD_MOTOR(f"m{number}") for number in range(255)]
    operator.command(motors[0], Motor(value=0.0))
    for motor in motors:
        operator.command(motor, Motor(value=1.0))
    await scene.settle()
    assert len(scene.gateway.taken()) == 255
    scene.now += ATTEND_S
    operator.tick()
    operator.tick()
    await scene.settle()
    assert {path for path, _ in scene.gateway.taken()} == {f"motor/m{number}" for number in range(255)}


async def test_one_motor_at_rest_is_no_neutral_while_another_is_still_set() -> None:
    """A controller that turns about one wheel says 0 for it all the time: a stop would not outlast that."""
    scene = Scene()
    operator = scene.operator(hold=True)
    operator.command(LEFT, Motor(value=0.0))
    operator.command(LEFT, Motor(value=5.0))
    operator.command(RIGHT, Motor(value=0.0))
    await scene.settle()
    scene.gateway.authority.stop("stop")
    scene.look(operator)
    await scene.settle()
    scene.gateway.taken()
    for _ in range(10):
        scene.now += ATTEND_S
        with pytest.raises(Refused, match="release the stick first"):
            operator.command(LEFT, Motor(value=5.0))
        operator.command(RIGHT, Motor(value=0.0))
        operator.tick()
        await scene.settle()
    assert scene.gateway.taken() == []
    assert scene.gateway.asked.count("acquire") == 1
    operator.command(LEFT, Motor(value=0.0))
    operator.command(LEFT, Motor(value=5.0))
    await scene.settle()
    assert scene.gateway.taken() == [("motor/left", Motor(value=5.0))]


async def test_a_motor_that_was_set_once_before_the_robot_was_had_does_not_keep_the_others_back() -> None:
    """A controller puts its arm where it belongs when it starts, and never says 0 of that."""
    scene = Scene()
    operator = scene.operator(hold=True)
    with pytest.raises(Refused, match="connected"):
        operator.command(topics.CMD_MOTOR("arm"), Motor(value=0.2))
    operator.command(LEFT, Motor(value=0.0))
    with pytest.raises(Refused, match="connected"):
        operator.command(LEFT, Motor(value=5.0))
    scene.now += DEADMAN_S
    operator.command(LEFT, Motor(value=0.0))
    operator.command(LEFT, Motor(value=5.0))
    await scene.settle()
    operator.tick()
    await scene.settle()
    assert scene.gateway.taken() == [("motor/left", Motor(value=5.0))] * 2, "what was refused is not held"


async def test_what_was_set_before_the_deadman_does_not_move_again_by_itself() -> None:
    """The loop was away for a while: what is held has lapsed, and one motor's neutral does not revive the other."""
    scene = Scene()
    operator = scene.operator(hold=True)
    operator.command(LEFT, Motor(value=0.0))
    operator.command(LEFT, Motor(value=5.0))
    operator.command(RIGHT, Motor(value=5.0))
    await scene.settle()
    scene.gateway.taken()
    scene.now += DEADMAN_S
    operator.tick()
    operator.command(LEFT, Motor(value=0.0))
    await scene.settle()
    operator.tick()
    await scene.settle()
    assert all(not message.value for _, message in scene.gateway.taken() if isinstance(message, Motor))


async def test_a_controller_of_wheels_may_become_one_of_motors() -> None:
    """The robot was another one for a while: a drive that was never ended is not waited for."""
    scene = Scene()
    operator = scene.operator(hold=True)
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    scene.gateway.authority.stop("stop")
    scene.look(operator)
    await scene.settle()
    scene.now += DEADMAN_S
    operator.command(LEFT, Motor(value=0.0))
    operator.command(LEFT, Motor(value=5.0))
    await scene.settle()
    scene.gateway.authority.stop("stop")
    scene.look(operator)
    await scene.settle()
    scene.now += DEADMAN_S
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    assert [path for path, _ in scene.gateway.taken()] == ["drive", "motor/left", "drive"]


async def test_neutral_for_the_time_of_the_lease_gives_the_robot_back() -> None:
    scene = Scene()
    operator = await scene.driving()
    for _ in range(26):
        scene.now += ATTEND_S
        operator.command(topics.CMD_DRIVE, STAND)
        operator.tick()
        await scene.settle()
        assert operator.intent.held
    for _ in range(2):
        scene.now += ATTEND_S
        operator.tick()
    await scene.settle()
    assert scene.gateway.report().state == "free"
    assert not operator.active
    assert scene.told == [], "nobody wanted it any more"
    operator.command(topics.CMD_DRIVE, GO)
    await scene.settle()
    assert scene.gateway.report().holder == "hq.toy.1"


async def test_silence_lets_the_motion_lapse_and_gives_the_robot_back() -> None:
    scene = Scene()
    operator = await scene.driving()
    for _ in range(31):
        scene.now += ATTEND_S
        operator.tick()
        await scene.settle()
    assert scene.gateway.report().state in ("free", "stopped")
    assert not operator.active
    with pytest.raises(Refused, match="deadman"):
        operator.command(topics.CMD_DRIVE, GO)


async def test_a_lease_shorter_than_usual_is_given_back_sooner() -> None:
    scene = Scene()
    scene.gateway.authority.lease_s = 1.0
    operator = await scene.driving()
    scene.now += 0.7
    operator.tick()
    assert operator.intent.held
    scene.now += 0.06
    operator.tick()
    assert not operator.intent.held
    await scene.settle()


# The end


async def test_a_program_that_went_gives_the_robot_back_at_once() -> None:
    scene = Scene()
    operator = await scene.driving()
    operator.close()
    operator.close()
    await scene.settle()
    assert scene.gateway.asked == ["acquire", "release"]
    assert scene.gateway.report().state == "free"
    assert await scene.bus.alive(KEYS.alive("*")) == []
    assert not operator.active


async def test_a_program_that_went_while_it_asked_gives_back_what_was_granted() -> None:
    scene = Scene()
    operator = scene.operator()
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_DRIVE, GO)
    operator.close()
    await scene.settle()
    assert scene.gateway.taken() == []
    assert scene.gateway.asked == ["acquire", "release"]
    assert scene.gateway.report().state == "free"
    assert await scene.bus.alive(KEYS.alive("*")) == []


async def test_a_program_that_went_while_it_asked_in_vain_leaves_nothing() -> None:
    scene = Scene()
    scene.gateway.authority.acquire(Acquire(who="operator"), scene.now)
    operator = scene.operator()
    operator.command(topics.CMD_DRIVE, STAND)
    operator.command(topics.CMD_DRIVE, GO)
    operator.close()
    await scene.settle()
    assert scene.gateway.report().holder == "operator"
    assert await scene.bus.alive(KEYS.alive("*")) == []


async def test_a_program_that_never_asked_leaves_without_a_word() -> None:
    scene = Scene()
    operator = scene.operator()
    operator.close()
    await scene.settle()
    assert scene.gateway.asked == []


async def test_a_program_that_goes_while_the_robot_is_being_given_back_leaves_it_free() -> None:
    scene = Scene()
    operator = await scene.driving()
    scene.now += LEASE_S - 0.01
    operator.command(topics.CMD_DRIVE, STAND)
    scene.now += 0.01
    operator.tick()
    operator.close()
    await scene.settle()
    assert scene.gateway.report().state == "free", "given back, not lost"
    assert await scene.bus.alive(KEYS.alive("*")) == []


async def test_many_programs_come_and_go_and_leave_nothing() -> None:
    scene = Scene()
    for number in range(300):
        operator = await scene.driving(who=f"hq.toy.{number}")
        operator.close()
        await scene.settle()
    assert scene.tasks == set()
    assert await scene.bus.alive(KEYS.alive("*")) == []
    scene.bridge.close()
    assert "Bridge to r1" in repr(scene.bridge)
    assert repr(operator).startswith("<Operator hq.toy.299 <Intent")


async def test_keys_that_are_commanded_one_after_the_other_do_not_add_up() -> None:
    scene = Scene()
    for number in range(2 * PUBLISHERS):
        scene.bridge.put(topics.CMD_SENSOR(f"s{number}"), SensorSetting(value=1.0))
    assert len(scene.bridge._publishers) == PUBLISHERS
    assert len(scene.bus.values("fleet/r1/@cmd/sensor/*")) == 2 * PUBLISHERS
