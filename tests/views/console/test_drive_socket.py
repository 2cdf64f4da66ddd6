"""The raw socket by which a page drives: what is not fresh, not in order or not by right moves nothing."""

from __future__ import annotations

import asyncio
import contextlib
import json
import random
import string
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tests.client import Gateway
from tests.views.console.conftest import Scene
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Motor, Status
from zbridge.views.console import console, drive_link, seats
from zbridge.views.console.drive_link import BRIDGE_S, FRESH_S, GAP_S
from zbridge.views.console.seats import RELOAD_S

COMMANDS = ("stop", "drive", "mode", "motor")


class Driver:
    """A page that drives: answers each tick with its command, as long as it is not told to be silent."""

    def __init__(self, opened: ClientConnection) -> None:
        self._opened = opened
        self.command: dict[str, Any] = {}
        self.control: dict[str, Any] = {}
        self.seq = self.tick = self.ticks = 0
        self.repeats = True
        self.log: list[dict[str, Any]] = []
        self.reading = asyncio.create_task(self._read())

    async def say(self, **message: Any) -> None:
        await self._opened.send(json.dumps(message))

    async def drive(self, forward: float | None = None, **fields: Any) -> None:
        """Send a command now, and from then on at each tick."""
        if forward is not None:
            self.command = {"forward": forward}
        self.seq += 1
        await self.say(**{"do": "drive", "seq": self.seq, "tick": self.tick, **self.command, **fields})

    async def until(self, condition: Callable[[dict[str, Any]], Any], within_s: float = 5.0) -> None:
        """Wait until what the page knows of its control meets a condition."""
        async with asyncio.timeout(within_s):
            while not condition(self.control):  # noqa: ASYNC110
                await asyncio.sleep(0.005)

    async def take(self, **options: Any) -> None:
        """Take control, and centre the stick."""
        await self.say(do="take", **options)
        await self.until(lambda control: control.get("state") == "held")
        await self.drive(0.0)
        await self.until(lambda control: control["needs"] is None)

    async def _read(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            async for text in self._opened:
                message = json.loads(text)
                self.log.append(message)
                self.control = message.get("control", self.control)
                if "tick" in message:
                    self.tick, self.ticks = message["tick"], self.ticks + 1
                    if self.repeats:
                        await self.drive()


@contextlib.asynccontextmanager
async def opened(scene: Scene, robot: str = "r1") -> AsyncIterator[Driver]:
    async with scene.page(f"/drive/{robot}") as socket:
        driver = Driver(socket)
        try:
            yield driver
        finally:
            driver.reading.cancel()


@pytest.fixture
async def robot(scene: Scene) -> Gateway:
    gateway = scene.world.gateways["r1"]
    gateway.publish(topics.STATUS, Status("established", commands=COMMANDS))
    await asyncio.sleep(console.REFRESH_S + 0.1)  # the console has read it
    return gateway


async def soon(condition: Callable[[], Any], within_s: float = 5.0) -> None:
    async with asyncio.timeout(within_s):
        while not condition():  # noqa: ASYNC110
            await asyncio.sleep(0.005)


async def closed(socket: ClientConnection) -> None:
    """See that the server closes a socket."""
    async with asyncio.timeout(5):
        await socket.wait_closed()


def moves(robot: Gateway) -> list[FleetMessage]:
    """The commands that moved the robot."""
    return [command for _, command in robot.machine.commands if getattr(command, "moving", False)]


async def rests(robot: Gateway) -> None:
    """See that nothing moves the robot for a while."""
    count = len(moves(robot))
    await asyncio.sleep(0.4)
    assert len(moves(robot)) == count


async def test_control_is_taken_the_stick_centred_and_the_robot_driven_and_given_back(
    scene: Scene, robot: Gateway
) -> None:
    async with opened(scene) as driver:
        driver.command = {"forward": 0.5}
        await driver.say(do="take")
        await driver.until(lambda control: control.get("state") == "held")
        assert robot.control.holder is not None
        assert robot.control.holder.startswith("console.browser")
        assert driver.control["needs"] == "control was just taken"
        await driver.drive(0.5)
        await rests(robot)
        await driver.drive(0.0)
        await driver.until(lambda control: control["needs"] is None)
        await driver.drive(0.5)
        await soon(lambda: robot.driven[-1] == Drive(forward=0.5))
        await driver.say(do="give")
        await driver.until(lambda control: control["state"] == "none")
        await soon(lambda: robot.control.state == "free")
    assert robot.driven[-1] == Drive()


async def test_who_has_it_is_told_and_a_takeover_ends_the_other_stick(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as first, opened(scene) as second:
        await first.take()
        await first.drive(0.5)
        await second.say(do="take")
        await second.until(lambda control: "is held by console.browser" in (control.get("notice") or ""))
        assert second.control["state"] == "none"
        await second.take(takeover=True)
        await first.until(lambda control: control["state"] == "none")
        assert "held by" in first.control["notice"]
        await first.drive(0.7)
        await second.drive(0.2)
        await soon(lambda: robot.driven[-1] == Drive(forward=0.2))
        await rests_at(robot, Drive(forward=0.2))


async def rests_at(robot: Gateway, drive: Drive) -> None:
    """See that the robot is sent nothing else for a while."""
    count = len(robot.driven)
    await asyncio.sleep(0.4)
    assert set(robot.driven[count:]) <= {drive}


async def test_a_page_that_ends_stops_its_robot_at_once_and_keeps_the_lease_for_its_reload(
    scene: Scene, robot: Gateway
) -> None:
    async with opened(scene) as driver:
        await driver.take()
        await driver.drive(0.5)
        await soon(lambda: robot.driven[-1].moving)  # type: ignore[attr-defined]
        token = driver.control["token"]
    began = robot.authority
    await soon(lambda: robot.driven[-1] == Drive(), 0.1)
    assert robot.control.state == "held"
    assert robot.authority is began
    async with opened(scene) as again:
        again.command = {"forward": 0.5}
        await again.say(do="resume", token=token)
        await again.until(lambda control: control.get("state") == "held")
        assert again.control["needs"] == "the page was reloaded"
        assert again.control["token"] not in (None, token)
        await rests(robot)
        await again.drive(0.0)
        await again.until(lambda control: control["needs"] is None)
        await again.drive(0.3)
        await soon(lambda: robot.driven[-1] == Drive(forward=0.3))
        assert len(robot.questions("acquire")) == 1


async def test_a_copied_tab_gets_no_lease_and_voids_the_token(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver, opened(scene) as copy:
        await driver.take()
        token = driver.control["token"]
        await copy.say(do="resume", token=token)
        await copy.until(lambda control: control.get("notice") == "control was given up meanwhile")
        await driver.until(lambda control: control["token"] != token)
        assert driver.control["state"] == "held"
    async with opened(scene) as late:
        await late.say(do="resume", token=token)
        await late.until(lambda control: control.get("notice") == "control was given up meanwhile")
        assert robot.control.state == "held", "it still waits for the page with the new token"


async def test_control_waits_for_its_page_no_longer_than_it_may(
    scene: Scene, robot: Gateway, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(seats, "RELOAD_S", 0.3)
    assert RELOAD_S == 3.0
    async with opened(scene) as driver:
        await driver.take()
        token = driver.control["token"]
    await asyncio.sleep(0.1)
    assert robot.control.state == "held"
    await soon(lambda: robot.control.state == "free", 1.0)
    async with opened(scene) as late:
        await late.say(do="resume", token=token)
        await late.until(lambda control: control.get("notice") == "control was given up meanwhile")


async def test_a_token_is_of_one_robot(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await driver.take()
        token = driver.control["token"]
    async with opened(scene, "r2") as other:
        await other.say(do="resume", token=token)
        await other.until(lambda control: control.get("notice") == "control was given up meanwhile")


async def test_a_page_that_is_silent_is_bridged_then_stopped_and_must_centre(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await driver.take()
        await driver.drive(0.5)
        await soon(lambda: robot.driven[-1].moving)  # type: ignore[attr-defined]
        driver.repeats = False
        loop = asyncio.get_running_loop()
        began = loop.time()
        await soon(lambda: robot.driven[-1] == Drive(), 1.0)
        assert loop.time() - began > BRIDGE_S - 0.06, "a gap is bridged"
        await asyncio.sleep(GAP_S)
        driver.repeats = True
        await driver.drive()
        await driver.until(lambda control: control["needs"] is not None)
        await rests(robot)
        await driver.drive(0.0)
        await driver.until(lambda control: control["needs"] is None)
        await driver.drive(0.5)
        await soon(lambda: robot.driven[-1].moving)  # type: ignore[attr-defined]


async def test_a_page_that_is_silent_for_long_loses_control(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await driver.take()
        driver.repeats = False
        await driver.until(lambda control: control["state"] == "none")
        assert driver.control["notice"] == "the page was silent for too long"
        await soon(lambda: robot.control.state == "free")


async def test_an_old_command_stops_the_robot_and_needs_neutral(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await driver.take()
        await driver.drive(0.5)
        await soon(lambda: robot.driven[-1].moving)  # type: ignore[attr-defined]
        old = driver.tick
        await asyncio.sleep(FRESH_S + 0.1)
        driver.repeats = False
        await driver.drive(0.5, tick=old)
        await driver.until(lambda control: control["needs"] == "the connection to this page stalled")
        assert robot.driven[-1] == Drive()
        driver.repeats = True
        await rests(robot)


async def test_ticks_are_not_queued_for_a_page_that_does_not_answer(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        driver.repeats = False
        await driver.say(do="take")
        await asyncio.sleep(1.0)
        assert driver.ticks <= 8


@pytest.mark.parametrize("why", ["focus", "gamepad"])
async def test_regained_focus_and_changed_gamepads_need_neutral(scene: Scene, robot: Gateway, why: str) -> None:
    async with opened(scene) as driver:
        await driver.take()
        await driver.drive(0.5)
        await soon(lambda: robot.driven[-1].moving)  # type: ignore[attr-defined]
        driver.command = {"forward": 0.5, "epoch": 1, "why": why}
        await driver.until(lambda control: control["needs"] is not None)
        await rests(robot)
        assert robot.driven[-1] == Drive()


async def by_itself(scene: Scene, driver: Driver) -> Gateway:
    """Have a robot move by itself for a while; its page repeats neutral meanwhile."""
    robot = scene.world.gateways["r1"]
    await driver.take()
    await driver.say(do="mode", mode="autonomous")
    await driver.until(lambda control: control["mode"] == "autonomous")
    await asyncio.sleep(1.0)
    assert robot.machine.commands[-1] == ("mode", Mode("autonomous")), "neutral would end it"
    assert driver.control["mode"] == "autonomous"
    return robot


@pytest.mark.parametrize("ended_by", ["motion", "focus", "silence", "mode", "close"])
async def test_a_robot_moves_by_itself_while_its_page_is_there_and_neutral(
    scene: Scene, robot: Gateway, ended_by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"BRIDGE_S": 1.0, "FRESH_S": 1.5, "GAP_S": 1.5}.items():  # a busy machine is no silence
        monkeypatch.setattr(drive_link, name, value)
    async with opened(scene) as driver:
        await by_itself(scene, driver)
        if ended_by == "motion":
            await driver.drive(0.5)
            await driver.until(lambda control: control["needs"] == "the mode was autonomous")
        elif ended_by == "focus":
            driver.command = {"epoch": 1, "why": "focus"}
        elif ended_by == "silence":
            driver.repeats = False
        elif ended_by == "mode":
            await driver.say(do="mode", mode="none")
        if ended_by != "close":
            await driver.until(lambda control: control["mode"] == "none")
            assert driver.control["state"] == "held", "the lease stays"
            await soon(lambda: ("mode", Mode("none")) in robot.machine.commands)
    await soon(lambda: ("mode", Mode("none")) in robot.machine.commands)
    assert ("drive", Drive()) in robot.machine.commands[-3:] or ended_by == "mode"
    assert moves(robot) == []


async def test_a_robot_that_is_driven_stops_before_it_moves_by_itself(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await driver.take()
        await driver.drive(0.5)
        await soon(lambda: robot.driven[-1].moving)  # type: ignore[attr-defined]
        driver.command = {}
        await driver.say(do="mode", mode="autonomous")
        await driver.until(lambda control: control["mode"] == "autonomous")
        assert robot.machine.commands[-2:] == [("drive", Drive()), ("mode", Mode("autonomous"))]


async def test_a_robot_that_moves_by_itself_is_given_back_for_good(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await by_itself(scene, driver)
        await driver.say(do="give")
        await soon(lambda: robot.control.state == "free")
        await asyncio.sleep(0.5)
        assert (robot.control.state, driver.control["state"]) == ("free", "none")
        assert len(robot.questions("acquire")) == 1
        assert not robot.authority.motion.on_its_own


async def test_a_mode_that_the_robot_refuses_is_not_shown_as_in_force(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await driver.take()
        robot.machine.refusal = "it cannot"
        await driver.say(do="mode", mode="autonomous")
        await driver.until(lambda control: "it cannot" in (control["needs"] or control["notice"] or ""))
        assert driver.control["mode"] == "none"


async def test_a_mode_ends_with_what_the_robot_accepts(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await by_itself(scene, driver)
        robot.publish(topics.STATUS, Status("established", reason="busy", commands=("stop",)))
        await driver.until(lambda control: control["mode"] == "none")


async def test_a_mode_that_is_set_while_the_robot_is_driven_stops_it(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await driver.take()
        await driver.drive(0.5)
        await soon(lambda: robot.driven[-1].moving)  # type: ignore[attr-defined]
        driver.repeats = False
        await driver.say(do="mode", mode="manual")
        await soon(lambda: ("mode", Mode("manual")) in robot.machine.commands)
        assert robot.driven[-1] == Drive()


@pytest.mark.parametrize("commands", [("stop", "motor"), ("stop", "drive", "motor")])
async def test_a_motor_that_is_let_go_is_sent_zero_and_so_is_one_that_another_finger_held(
    scene: Scene, robot: Gateway, commands: tuple[str, ...]
) -> None:
    robot.publish(topics.STATUS, Status("established", commands=commands))
    await asyncio.sleep(console.REFRESH_S + 0.1)
    async with opened(scene) as driver:
        await driver.take()
        for name in ("arm", "wheel"):
            driver.command = {"motor": {"name": name, "value": 2.0}}
            await soon(lambda: (f"motor/{name}", Motor(2.0)) in robot.machine.commands)  # noqa: B023
        await soon(lambda: robot.machine.commands.count(("motor/arm", Motor(0.0))) == seats.ZEROS)
        driver.command = {}
        await soon(lambda: robot.machine.commands.count(("motor/wheel", Motor(0.0))) == seats.ZEROS)
        await soon(lambda: not robot.authority.motion.parts)
        assert robot.machine.commands.count(("motor/arm", Motor(0.0))) == seats.ZEROS


async def test_a_stop_by_anybody_ends_control_and_says_so(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await driver.take()
        await driver.drive(0.5)
        await scene.world.others.stop()
        await driver.until(lambda control: control["state"] == "none")
        assert "the lease has ended" in driver.control["notice"]
        await rests(robot)


async def test_drives_without_a_lease_repeated_numbers_and_foreign_ticks_move_nothing(
    scene: Scene, robot: Gateway
) -> None:
    async with opened(scene) as driver:
        for seq in range(1, 20):
            await driver.say(do="drive", seq=seq, tick=0, forward=1.0)
        await rests(robot)
        assert moves(robot) == []
        driver.seq = 100
        await driver.take()
        await driver.drive(0.4)
        await soon(lambda: robot.driven[-1].moving)  # type: ignore[attr-defined]
        await driver.say(do="drive", seq=driver.seq, tick=driver.tick, forward=1.0)
        await driver.say(do="drive", seq=1, tick=driver.tick, forward=1.0)
        await driver.drive(0.4)
        await asyncio.sleep(0.2)
        assert Drive(forward=1.0) not in robot.driven
        await driver.drive(0.4, tick=driver.tick + 1000)
        await driver.until(lambda control: control["needs"] == "the page named a tick that was never sent")


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        '{"do": "drive", "seq": 1}',
        '{"do": "drive", "seq": -1, "tick": 0}',
        '{"do": "drive", "seq": 1, "tick": 0, "forward": 1.5}',
        '{"do": "drive", "seq": 1, "tick": 0, "forward": NaN}',
        '{"do": "drive", "seq": 1e99, "tick": 0}',
        '{"do": "drive", "seq": 1, "tick": 0, "more": 0}',
        '{"do": "mode", "mode": "fast"}',
        b"\x00",
        "x" * 5000,
    ],
)
async def test_what_is_no_command_ends_this_socket_and_no_other(
    scene: Scene, robot: Gateway, text: str | bytes
) -> None:
    async with opened(scene) as driver:
        await driver.take()
        await driver.drive(0.3)
        async with scene.page("/drive/r1") as bad:
            await bad.send(text)
            await closed(bad)
        await soon(lambda: robot.driven[-1] == Drive(forward=0.3))


async def test_ten_thousand_random_messages_move_nothing(scene: Scene, robot: Gateway) -> None:
    chance = random.Random(30)
    words = ["drive", "take", "give", "resume", "mode", "x"]
    for _ in range(50):
        with contextlib.suppress(ConnectionClosed):
            async with scene.page("/drive/r1") as socket:
                for _ in range(200):
                    text: Any = "".join(chance.choices(string.printable, k=chance.randrange(60)))
                    if chance.random() < 0.8:
                        fields = {"seq": chance.randrange(99), "tick": chance.randrange(9), "forward": chance.random()}
                        some = dict(chance.sample(sorted(fields.items()), chance.randrange(4)))
                        text = json.dumps({"do": chance.choice(words), **some})
                    await socket.send(text)
    await soon(lambda: robot.control.state != "held")
    assert moves(robot) == []


async def test_a_page_that_sends_too_much_is_closed(scene: Scene, robot: Gateway) -> None:
    async with scene.page("/drive/r1") as socket:
        with contextlib.suppress(ConnectionClosed):
            for _ in range(1000):
                await socket.send('{"do": "give"}')
        await closed(socket)


async def test_what_a_robot_cannot_do_of_a_command_is_said_and_the_rest_moves_it(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await driver.take()
        robot.machine.left_out = "turn: it cannot"
        await driver.drive(0.5, turn=0.5)
        await driver.until(lambda control: "turn: it cannot" in (control["notice"] or ""))
        count = len(robot.driven)
        await soon(lambda: len(robot.driven) > count + 10)
        assert all(drive.forward == 0.5 for drive in robot.driven[count:])  # type: ignore[attr-defined]
        assert driver.control["needs"] is None
        robot.machine.left_out = None
        await driver.drive(0.0)
        await driver.until(lambda control: control["notice"] is None)


async def test_a_refused_command_stops_and_says_why(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await driver.take()
        await driver.drive(0.5)
        await soon(lambda: moves(robot))
        robot.machine.refusal = "it saves its map"
        await driver.until(lambda control: "it saves its map" in (control["needs"] or ""))
        robot.machine.refusal = None
        await rests(robot)


async def test_a_mode_and_single_motors_go_by_the_lease(scene: Scene, robot: Gateway) -> None:
    async with opened(scene) as driver:
        await driver.say(do="mode", mode="manual")
        await driver.take()
        await driver.say(do="mode", mode="manual")
        await driver.until(lambda control: control["mode"] == "manual")
        driver.command = {"motor": {"name": "left wheel", "value": 2.0}}
        await soon(lambda: ("motor/left%20wheel", Motor(2.0)) in robot.machine.commands)
        await driver.drive(0.0)
        await soon(lambda: robot.machine.commands[-1][1] == Drive())
        assert [command for name, command in robot.machine.commands if name == "mode"] == [Mode("manual")]


async def test_a_robot_that_accepts_motors_only_is_driven_by_them(scene: Scene, robot: Gateway) -> None:
    robot.publish(topics.STATUS, Status("established", commands=("stop", "motor")))
    await asyncio.sleep(console.REFRESH_S + 0.1)
    async with opened(scene) as driver:
        await driver.take()
        driver.command = {"motor": {"name": "lift", "value": 0.5}}
        await soon(lambda: ("motor/lift", Motor(0.5)) in robot.machine.commands)
        await driver.drive(0.0)
        await soon(lambda: robot.machine.commands[-1] == ("motor/lift", Motor(0.0)))
        await driver.drive(0.5)
        await driver.until(lambda control: control["notice"] == "r1 accepts no drive now")
    assert robot.driven == []


async def test_a_page_of_another_origin_and_one_too_many_are_refused(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InvalidStatus):
        async with scene.page("/drive/r1", origin="http://evil.example"):
            pytest.fail("it was accepted")
    with pytest.raises(InvalidStatus):
        async with scene.page("/drive/r%2A"):
            pytest.fail("it was accepted")
    monkeypatch.setattr(console, "DRIVES", 1)
    async with scene.page("/drive/r1"):
        with pytest.raises(InvalidStatus):
            async with scene.page("/drive/r1"):
                pytest.fail("it was accepted")
