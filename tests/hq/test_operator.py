"""An operator for one HQ program, against a gateway that keeps the lease as real ones do. Times are made up."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any

import msgspec
import pytest

from tests.bounds import most_kept
from tests.fake_bus import FakeBus
from tests.hq.gateway import KEYS, Gateway
from tests.hq.scripts import scripts
from zbridge.control.events import StopCause
from zbridge.errors import BusError, Code, Refused
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Acquire
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Motor, Raw, Refusal, SensorSetting, Status, Stop, Switch
from zbridge.fleet.view import RobotView
from zbridge.hq.context import Bridge
from zbridge.hq.intent import Intent
from zbridge.hq.operator import Operator
from zbridge.lease.commands import PUBLISHERS
from zbridge.protocol.plugin import ATTEND_S

DEADMAN_S = 1.25
NOTHING = "nothing"
LIGHTS = {"lit": True, "unlit": False}
OPEN: dict[str, tuple[topics.Topic, FleetMessage]] = {
    "stop": (topics.CMD_STOP, Stop()),
    "lidar": (topics.CMD_LIDAR, Switch(on=True)),
    "sensor": (topics.CMD_SENSOR("front"), SensorSetting(enable=True)),
}
"""Commands that need no lease."""

Command = tuple[str, FleetMessage]


def commands(text: str) -> list[Command]:
    """Read commands: ``stand, go, go lit, drive turn=0.5, left 5, raw 40, mode manual, stop``."""
    return [] if text == NOTHING else [_command(*one.split()) for one in text.split(", ")]


def _command(word: str, *more: str) -> Command:
    if word in ("stand", "go", "drive"):
        fields = {name: float(value) for name, _, value in (part.partition("=") for part in more) if value}
        light = next((LIGHTS[part] for part in more if part in LIGHTS), None)
        return topics.CMD_DRIVE.path, Drive(**({"forward": 0.5} if word == "go" else fields), light=light)
    if word in OPEN:
        return OPEN[word][0].path, OPEN[word][1]
    if word == "raw":
        return topics.CMD_RAW("toy").path, Raw(id=int(more[0]))
    if word == "mode":
        return topics.CMD_MODE.path, Mode(more[0])  # type: ignore[arg-type]
    return topics.CMD_MOTOR(word).path, Motor(value=float(more[0]))


def is_motion_of_wheels(command: Drive | Motor) -> bool:
    return bool(command.value if isinstance(command, Motor) else command.forward or command.left)


class Program(Operator):
    """An operator. hold: its program sets motion once."""

    hold = False

    def tick(self) -> None:
        if self.hold:
            self.repeat()
        super().tick()

    def say(self, text: str) -> None:
        for path, message in commands(text):
            topic = topics.find(path)
            assert topic is not None
            self.command(topic, message)


class Scene:
    """A robot, its gateway, and programs; nothing is answered before :meth:`done`."""

    def __init__(self) -> None:
        self.now = 100.0
        self.bus = FakeBus("hq")
        self.gateway = Gateway(self.bus.join("gw"), self)
        self.authority = self.gateway.authority
        self.view = RobotView()
        self.view.alive = True
        self.robot_is("established")
        self.tasks: set[asyncio.Task[None]] = set()
        self.bridge = Bridge(self.bus, KEYS, self.view, self.spawn)
        self.told: list[str] = []
        self.freed = asyncio.Event()
        self.program_is("1")

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self.tasks.add(task)
        task.add_done_callback(self.tasks.discard)

    def taken(self) -> list[Command]:
        """What was carried out since the last look."""
        return [(f"@cmd/{path}", message) for path, message in self.gateway.taken()]

    async def done(self) -> list[Command]:
        """Let everything be answered that was asked, and return what was carried out since the last look."""
        while self.tasks:
            for done in (await asyncio.wait(self.tasks))[0]:
                done.result()
            await asyncio.sleep(0)
        return self.taken()

    async def play(self, script: str) -> None:
        """Play the steps of a script, one after the other, separated by semicolons:

        ``stand, go -> go``: the program says so, and when all is answered, that was carried out. ``go ! deadman``: that
        is refused, and the reason begins so. ``now -> go``: that was carried out by now. Others: ``STEPS``, ``LOOKS``.
        """
        for step in script.split("; "):
            if " ! " in step:
                said, reason = step.split(" ! ")
                with pytest.raises(Refused) as caught:
                    self.program.say(said)
                assert str(caught.value).startswith(reason), step
            elif " -> " in step:
                said, expected = step.split(" -> ")
                assert await self._carried_out(said) == commands(expected), step
            elif step.startswith("tick"):
                await self._carried_out(step)
            elif step.split()[0] in LOOKS:
                look, _, expected = step.partition(" ")
                assert LOOKS[look](self) == expected, step
            else:
                verb, _, rest = step.partition(" ")
                STEPS[verb](self, rest)

    async def _carried_out(self, said: str) -> list[Command]:
        """``tick 3 stand``: three times ATTEND_S passes, the program says that, and all is answered."""
        if said == "now":
            return self.taken()
        if not said.startswith("tick"):
            if said != "done":
                self.program.say(said)
            return await self.done()
        count, _, said = said.removeprefix("tick").strip().partition(" ")
        carried_out = []
        for _ in range(int(count or 1)):
            self.now += ATTEND_S
            self.program.say(said or NOTHING)
            self.program.tick()
            carried_out += await self.done()
        return carried_out

    def program_is(self, number: str, kind: str = "") -> None:
        """Make another program the one that speaks."""
        self.program = Program(
            Intent(DEADMAN_S),
            self.bridge,
            who=f"hq.toy.{number}",
            protocol="toy",
            is_motion=is_motion_of_wheels if kind == "steers" else lambda command: command.moving,
            tell=lambda text, drives: self.told.append(text),
            clock=lambda: self.now,
            clock_ms=lambda: self.now * 1000,
        )
        self.program.hold = kind == "holds"
        if kind == "modes":
            self.program.say("mode none")

    def robot_is(self, state: str, reason: str | None = None, protocol: str = "toy") -> None:
        status = Status(state=state, reason=reason, protocol=protocol)  # type: ignore[arg-type]
        self.view.note(topics.STATUS, status)

    def show(self, *refusals: Refusal) -> None:
        """Let the gateway say how things stand."""
        report = self.gateway.report()
        if refusals:
            report = msgspec.structs.replace(report, refusals=refusals)
        self.view.note(topics.CONTROL, report)
        self.program.look(report)

    def skip(self, seconds: float) -> None:
        self.now += seconds

    def block(self, *, fails: bool) -> None:
        """Let the bus take nothing, or fail to."""

        async def flush() -> None:
            if fails:
                raise BusError("the bus is closed")
            await self.freed.wait()

        self.bus.flush = flush  # type: ignore[method-assign]

    def heard(self) -> str:
        """What the people were told since the last look."""
        heard = " | ".join(self.told) or NOTHING
        self.told.clear()
        return heard


def refusal(code: str, count: str, by: str | None = None) -> Refusal:
    return Refusal(who="hq.toy.1", command="drive", code=code, reason="busy", count=int(count), by=by)


OPERATOR = Acquire(who="operator")
STEPS: dict[str, Callable[[Scene, str], object]] = {
    "program": lambda scene, number_and_kind: scene.program_is(*number_and_kind.split()),  # modes, steers, holds
    "say": lambda scene, text: scene.program.say(text),
    "close": lambda scene, _: scene.program.close(),
    "wait": lambda scene, seconds: scene.skip(float(seconds)),
    "shown": lambda scene, _: scene.show(),
    "refused": lambda scene, text: scene.show(refusal(*text.split())),  # code, count, and the listener that tells of it
    "robot": lambda scene, text: scene.robot_is(*text.split(" ", 1)),
    "other-robot": lambda scene, _: scene.robot_is("established", protocol="other"),
    "gateway-gone": lambda scene, _: setattr(scene.view, "alive", False),
    "gateway-there": lambda scene, _: setattr(scene.view, "alive", True),
    "gateway-lost": lambda scene, _: scene.program.gateway_lost(),
    "operator-drives": lambda scene, _: scene.authority.acquire(OPERATOR, scene.now),
    "operator-takes-over": lambda scene, _: scene.authority.takeover(OPERATOR, scene.now),
    "somebody-stops": lambda scene, _: scene.authority.stop("stop"),
    "busy": lambda scene, why: scene.authority.require_neutral(why, StopCause.ROBOT_BUSY),
    "bus-fails": lambda scene, _: scene.block(fails=True),
    "bus-blocked": lambda scene, _: scene.block(fails=False),
    "bus-freed": lambda scene, _: scene.freed.set(),
}
LOOKS: dict[str, Callable[[Scene], str]] = {
    "told": Scene.heard,
    "asked": lambda scene: " ".join(scene.gateway.asked) or NOTHING,  # since the beginning
    "state": lambda scene: scene.gateway.report().state,
    "holder": lambda scene: scene.gateway.report().holder or NOTHING,
    "held": lambda scene: str(scene.program.intent.held),
    "active": lambda scene: str(scene.program.active),
    "tokens": lambda scene: " ".join(key.removeprefix(KEYS.alive("")) for key in scene.bus.network.tokens) or NOTHING,
    "violations": lambda scene: " ".join(scene.gateway.refused) or NOTHING,
}


@pytest.fixture
async def scene() -> Scene:
    return Scene()


DRIVES = "stand, go -> go"
SCRIPTS = """
motion acquires the robot and is then carried out
    say stand, go; now -> nothing; done -> go; held True; active True; holder hq.toy.1; tokens hq.toy.1
nothing moves and nothing is asked before neutral nor by neutral
    go ! connected: centre the joystick first; go ! connected: centre the joystick first; stand, stand -> nothing
    asked nothing; tokens nothing; active False
of motion said while the answer is awaited the newest counts
    stand, drive forward=0.1, drive forward=0.9 -> drive forward=0.9; asked acquire; held True
of neutral said while the answer is awaited the newest counts
    stand, go, stand -> stand; asked acquire
an answer that comes after the deadman moves nothing
    say stand, go; wait 1.25; done -> nothing; held True; go ! deadman
a robot that somebody else drives is refused, told once, and neutral must come
    operator-drives; stand, go -> nothing; told not driving: held by operator (priority 0); active False
    go ! held by operator (priority 0): centre the joystick first; shown; told nothing
a robot that is not there is not asked for: robot offline: no route
    robot offline no route; say stand; go ! robot offline: no route; robot established; gateway-there
    go ! robot offline: no route: centre the joystick first; program 2 modes; say stand; robot offline no route
    mode autonomous ! robot offline: no route; asked nothing
a robot that is not there is not asked for: robot connecting
    robot connecting; say stand; go ! robot connecting; robot established; gateway-there
    go ! robot connecting: centre the joystick first; program 2 modes; say stand; robot connecting
    mode autonomous ! robot connecting; asked nothing
a robot that is not there is not asked for: no gateway serves the robot
    gateway-gone; say stand; go ! no gateway serves the robot; robot established; gateway-there
    go ! no gateway serves the robot: centre the joystick first; program 2 modes; say stand; gateway-gone
    mode autonomous ! no gateway serves the robot; asked nothing
commands that are open to all need no lease and no neutral
    stop, lidar, sensor -> stop, lidar, sensor; asked nothing
a drive does not overtake what a thread carries
    stand, go -> go; say raw 40, raw 41, stand, go; now -> raw 40; done -> raw 41, go; violations nothing
what waits for the bus is bounded and motion finds a place
    stand, go -> go; say 65 x [raw 40]; raw 200 ! 64 commands wait for the bus; stand -> 65 x [raw 40], stand
raw needs the lease like motion and acquires it
    raw 40 ! connected; stand, raw 40 -> raw 40
a flush that fails does not stop what waits
    stand, go -> go; bus-fails; raw 40, stand -> raw 40, stand
motion that waited for the bus is not sent when its time is over: the deadman
    stand, go -> go; bus-blocked; say raw 40, raw 41, go; wait 1.25; bus-freed; done -> raw 40; stand -> stand
motion that waited for the bus is not sent when its time is over: a refusal
    stand, go -> go; bus-blocked; say raw 40, raw 41, go; refused neutral_first 1; bus-freed; done -> raw 40
    stand -> stand
neutral that waited for the bus is sent however late
    stand, go -> go; bus-blocked; say raw 40, go, stand; wait 2; bus-freed; done -> raw 40, stand
commands that need no lease are bounded for each program
    say 50 x [lidar]; lidar ! more than 50 commands a second; wait 0.1; say lidar; program 2; say 50 x [lidar]
the light is told only when it changes
    stand unlit -> nothing; go unlit -> go; go lit, go lit, go unlit, go unlit -> go lit, go, go unlit, go
a light switched on by a refused command is told with the next
    stand, go -> go; wait 1.25; go lit ! deadman; stand lit -> stand lit
a light that was on before a lease is told with every new one
    stand lit, go lit -> go lit; stand lit -> stand; somebody-stops; shown; done -> nothing; stand lit, go lit -> go lit
turning the wheels is neutral to a program that steers [steers]
    drive turn=0.5 -> nothing; asked nothing; drive forward=0.5 turn=0.5 -> drive forward=0.5 turn=0.5
    drive turn=-0.5 -> drive turn=-0.5
wheels are set only when nothing need be said first [steers]
    stand, go -> go; wait 1.25; drive turn=-0.5 lit, drive turn=-0.5 lit -> stand lit, drive turn=-0.5
    violations nothing
turning is motion to a program that does not steer
    drive turn=0.5 ! connected
the mode is told to a robot before the motion, and alone moves nothing [modes]
    stand, mode manual -> nothing; asked nothing; go -> mode manual, go
a robot of another protocol is told no mode [modes]
    other-robot; stand, mode manual, go -> go; mode none -> nothing; state free
a robot of another protocol is not taken to move by itself, but can be driven [modes]
    other-robot; say stand; mode autonomous ! this robot has no autonomous mode; done -> nothing; asked nothing
    go -> go
mode none is told and gives the robot back [modes]
    stand, mode manual, go -> mode manual, go; mode none -> mode none; asked acquire release; state free
    go ! control mode is none
mode none is told although another command is still on its way [modes]
    stand, mode autonomous -> mode autonomous; mode manual, go, mode none -> mode manual, mode none; violations nothing
    state free
mode none while the answer is awaited gives back what was granted [modes]
    stand, mode manual, go, mode none -> nothing; asked acquire release; state free; active False
a stop ends the drive and neutral must come
    stand, go -> go; somebody-stops; shown; done -> nothing; told not driving: the lease has ended (stop)
    go ! the lease has ended (stop): centre the joystick first; done -> nothing; asked acquire renew; stand, go -> go
    holder hq.toy.1
a takeover is noticed and told once
    stand, go -> go; operator-takes-over; shown; done -> nothing; shown; done -> nothing
    told not driving: the lease has ended (taken over by operator); active False
the gateway going away ends the drive and is nothing to an idle program
    gateway-lost; told nothing; stand, go -> go; gateway-lost; gateway-lost
    told not driving: the robot's gateway is gone; go ! the robot's gateway is gone: centre the joystick first
what a listener tells of refusals is nothing to a program whoever it names
    stand, go -> go; refused neutral_first 1 hq.toy; done -> nothing; told nothing; asked acquire; go -> go
what was refused to a program of this name before is not told
    refused busy 4; told drive: busy; program 1; refused busy 4; told nothing; refused busy 5; told drive: busy
what a controller set once is repeated while it lives [holds]
    left 0, left 5 -> left 5; tick 40 -> 40 x [left 5]; holder hq.toy.1; violations nothing; left 0 -> left 0
    tick -> nothing
what other programs set is not repeated
    stand, go -> go; tick -> nothing
# A controller that turns about one wheel says 0 for it all the time: a stop would not outlast that.
one motor at rest is no neutral while another is still set [holds]
    left 0, left 5 -> left 5; right 0 -> right 0; somebody-stops; shown; done -> nothing
    10 x (left 5 ! the lease has ended; tick 1 right 0 -> nothing); asked acquire renew; left 0, left 5 -> left 5
# A controller puts its arm where it belongs when it starts, and never says 0 of that.
a motor that was set once before the robot was had is not held and does not keep the others back [holds]
    arm 0.2 ! connected; say left 0; left 5 ! connected; wait 1.25; left 0, left 5 -> left 5; tick -> left 5
what was set before the deadman does not move again by itself [holds]
    left 0, left 5 -> left 5; right 5 -> right 5; wait 1.25; tick -> nothing; left 0 -> left 0; tick -> nothing
# The robot was another one for a while: a drive that was never ended is not waited for.
a controller of wheels may become one of motors [holds]
    stand, go -> go; somebody-stops; shown; done -> nothing; wait 1.25; left 0, left 5 -> left 5; somebody-stops; shown
    done -> nothing; wait 1.25; stand, go -> go
neutral for the time of the lease gives the robot back
    stand, go -> go; tick 26 stand; held True; tick 2; state free; active False; told nothing; go -> go; holder hq.toy.1
silence lets the motion lapse and gives the robot back
    stand, go -> go; tick 31; state free; active False; go ! deadman
a program that went gives the robot back at once
    stand, go -> go; close; close; active False; done -> nothing; asked acquire release; state free; tokens nothing
a program that went while it asked gives the robot back when it is granted
    say stand, go; close; close; active True; done -> nothing; asked acquire release; state free; tokens nothing
a program that went while it asked in vain leaves nothing
    operator-drives; say stand, go; close; done -> nothing; holder operator; tokens nothing
a program that never asked leaves without a word
    close; done -> nothing; asked nothing
"""


@scripts(SCRIPTS)
async def test_what_a_program_says_becomes_of_it(scene: Scene, special: str, script: str) -> None:
    scene.program_is("1", special)
    await scene.play(script)


async def test_every_motor_there_can_be_is_set_and_held(scene: Scene) -> None:
    motors = ", ".join(f"m{number} 1" for number in range(255))
    await scene.play(f"program 1 holds; say m0 0; {motors} -> {motors}; tick -> {motors}")


async def test_what_is_asked_for_names_the_program_its_deadman_and_its_token(scene: Scene) -> None:
    await scene.play(DRIVES)
    asked = Acquire(who="hq.toy.1", deadman_s=DEADMAN_S, alive="hq.toy.1", t=round(scene.now * 1000))
    assert scene.gateway.requests == [asked]


async def test_a_robot_that_must_hear_neutral_first_makes_the_program_say_it(scene: Scene) -> None:
    await scene.play(DRIVES)
    await scene.play("busy busy: map; say go; shown; told drive: busy: map: send a neutral drive first")
    await scene.play("go ! motion was refused: centre the joystick first; stand, go -> stand, go")


async def test_mode_autonomous_keeps_the_lease_while_anything_is_heard(scene: Scene) -> None:
    await scene.play("program 1 modes; stand, mode autonomous -> mode autonomous")
    for _ in range(200):
        scene.program.intent.heard(scene.now + ATTEND_S)
        await scene.play("tick")
    assert 15 <= scene.gateway.asked.count("renew") <= 21, "once in a third of the lease"
    await scene.play("holder hq.toy.1; tick 31; state free")


async def test_a_lease_shorter_than_usual_is_given_back_sooner(scene: Scene) -> None:
    scene.authority.machine.lease_s = 1.0
    await scene.play(f"{DRIVES}; tick 7; held True; tick; held False")


async def test_a_program_that_goes_while_the_robot_is_being_given_back_leaves_it_free(scene: Scene) -> None:
    await scene.play(f"{DRIVES}; wait 2.99; say stand; wait 0.01; now -> stand")
    scene.program.tick()
    await scene.play("close; done -> nothing; state free; tokens nothing")


async def test_a_refusal_that_bears_no_name_is_told_to_who_has_just_given_such_a_command(scene: Scene) -> None:
    both = ("lidar", "text")
    for number, script in enumerate(("told nothing; say lidar", "told lidar: no; wait 1", "told nothing"), 1):
        scene.show(*(Refusal(who=None, command=what, code=Code.BUSY, reason="no", count=number) for what in both))
        await scene.play(script)


async def test_many_programs_and_keys_leave_nothing(scene: Scene) -> None:
    for number in range(50):
        await scene.play(f"program {number}; {DRIVES}; close; done -> nothing; tokens nothing")
    for number in range(2 * PUBLISHERS):
        scene.bridge.put(topics.CMD_SENSOR(f"s{number}"), SensorSetting(value=1.0))
    assert most_kept(scene.bridge) == PUBLISHERS
    assert len(scene.bus.values("fleet/r1/@cmd/sensor/*")) == 2 * PUBLISHERS
    scene.bridge.close()
