"""The fragile controller against an external one written by hand: every byte here is read off the protocol page."""

import ast
import asyncio
import contextlib
import logging
import math
import random
import struct
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gateways.wc2ec.conformance.fragile_robot import FragileWebotsController
from gateways.wc2ec.conformance.machine import JudgedWebots
from gateways.wc2ec.conformance.parser import DEFAULT, DeviceKind, Dialect, ExternalReader, SimulatedDevice, Wc2EcTimes
from tests.conformance.scene import LONG_S, Peer, Scene, bounded, serving, table, until
from zbridge.protocol import Address

QUICK = Wc2EcTimes(step_s=0.005, register_s=0.0, part_s=5)
"""As quick as a test, and patient where patience is not what it is about."""
DIALECTS: tuple[Dialect, ...] = ("deployed", "draft")
DEVICES = [
    *((37, number, f"ds{number}") for number in range(8)),
    (53, 8, "left wheel motor"),
    (53, 9, "right wheel motor"),
    (46, 10, "lift"),
]
NAMES = {
    "FORWARD": "82 35 08 00 00 00 00 00 00 f8 3f",
    "STAND": "82 35 08 00 00 00 00 00 00 00 00",
    "LIFT": "82 2e 0a 00 00 00 00 00 00 d0 3f",
    "ENABLE": "80 00 02",
    "DISABLE": "81 00 02",
    "CHANGE": "82 00 01 02 00 00 00 00 00 00 f8 3f",
    "SET": "83 00 03" + "00 00 00 00 00 00 f8 3f" * 3,
    "SET1": "83 00 03 00 00 00 00 00 00 f8 3f",
    "NAN": "00 00 00 00 00 00 f8 7f",
    "INFINITY": "00 00 00 00 00 00 f0 ff",
    "ONE": "00 00 00 00 00 00 f0 3f",
    "ZERO": "00 00 00 00 00 00 00 00",
}
"""The left wheel motor to 1.5 rad/s, the lift to 0.25 m; value 2 of light sensor 1 to 1.5, all of sensor 3."""


class External(Peer):
    """The few habits of an external controller."""

    send = Peer.send_bytes

    async def registrations(self) -> list[tuple[int, int, str]]:
        registered = []
        for _ in range(11):
            command, node_type, number, length = await self.read(4)
            assert command == 0
            registered.append((node_type, number, (await self.read(length)).decode()))
        return registered

    async def measurement(self) -> tuple[int, int, int, float]:
        command, node_type, number, value = struct.unpack("<BBBd", await self.read(11))
        return command, node_type, number, value


class Talk(Scene):
    """A conversation with the controller, and what is to be seen of it afterwards."""

    names = NAMES

    async def meet(self, _: str) -> None:
        """Connect, and wait for the registrations of the dialect that has any."""
        await self.connect("")
        await until(lambda: self.judge.registered, self.judge)

    async def noted(self, words: str) -> None:
        """Exactly one violation, which begins so."""
        (violation,) = self.judge.violations
        assert violation.startswith(words)

    async def got(self, row: str) -> None:
        """The newest command, as a tuple."""
        assert self.judge.received[-1][1:] == ast.literal_eval(row)

    async def enabled(self, numbers: str) -> None:
        assert self.judge.robot.enabled == {int(number) for number in numbers.split()}

    async def configured(self, values: str) -> None:
        assert self.judge.robot.configuration == dict(enumerate(ast.literal_eval(values)))

    async def motor(self, name_and_velocity: str) -> None:
        name, _, velocity = name_and_velocity.rpartition(" ")
        await until(lambda: self.judge.motors[name].velocity == float(velocity), self.judge.motors)

    async def alive(self, _: str) -> None:
        assert self.judge.alive

    async def stuck(self, _: str) -> None:
        assert self.judge.stuck

    async def data(self, count: str) -> None:
        """It continues measuring."""
        for _ in range(int(count)):
            assert (await self.peer.measurement())[0] == 1

    async def registrations(self, _: str) -> None:
        assert await self.peer.registrations() == DEVICES

    async def until_kept(self, count: str) -> None:
        await until(lambda: self.judge.received and self.judge.received[-1][3] == 2, self.judge.received)
        assert len(self.judge.violations) == len(self.judge.received) == int(count)

    async def cut(self, _: str) -> None:
        await self.judge.cut()


@contextlib.asynccontextmanager
async def facing(controller: FragileWebotsController) -> AsyncIterator[Talk]:
    async with serving(controller, External, Talk) as talk:
        yield talk


def quick(dialect: Dialect = "deployed", **options: Any) -> FragileWebotsController:
    return bounded(FragileWebotsController, {"dialect": dialect, "times": QUICK, **options})


JUDGES: dict[str, dict[str, Any]] = {
    "deployed": {},
    "draft": {"dialect": "draft"},
    "draft of 1": {"dialect": "draft", "values": 1},
    "slow": {"times": Wc2EcTimes(step_s=0.005, register_s=0.3)},
    "hasty": {"times": Wc2EcTimes(step_s=0.005, register_s=0.0, part_s=0.05)},
    "many devices": {
        "devices": [
            SimulatedDevice(f"{number:03}" + "x" * 200, number, 37, DeviceKind.DISTANCE) for number in range(255)
        ],
        "times": Wc2EcTimes(step_s=0.0, register_s=0.0, send_s=0.1),
    },
    "keeps 2": {"dialect": "draft", "keep": 2},
}


@table(
    """
    the motors are set, and the lift goes to its place | deployed | meet; > FORWARD LIFT; heard 2
        ; got (130, 46, 10, 0.25); motor left wheel motor 1.5; motor right wheel motor 0; > STAND
        ; motor left wheel motor 0; ok
    a draft controller says nothing unasked | draft | meet; > CHANGE; heard 1; got (130, 0, 1, (2.0, 1.5)); nothing; ok
    sensors of the draft can be changed and set | draft | meet; > CHANGE SET; heard 2; got (131, 0, 3, (1.5, 1.5, 1.5))
        ; configured [[0, 0, 0], [0, 0, 1.5], [0, 0, 0], [1.5, 1.5, 1.5]]; ok
    a sensor type may have another number of values | draft of 1 | meet; > SET1; heard 1; got (131, 0, 3, (1.5,)); ok
    what is needless in the draft is an event | draft | meet; > DISABLE ENABLE ENABLE; heard 3; ok; told 2
        ; ? light sensor 2 disabled that was not enabled; ? light sensor 2 enabled again
    no number to a motor | deployed | meet; > FORWARD 823508 NAN LIFT; heard 3
        ; noted nan to motor 'left wheel motor': 82 35 08; motor left wheel motor 1.5; alive
    no number to the lift | deployed | meet; > 822e0a INFINITY LIFT; heard 2; noted -inf to motor 'lift': 82 2e 0a
    a sensor that is not there | draft | meet; > DISABLE 80 00 04 ENABLE; heard 3
        ; noted command 128 to light sensor 4, which is not there: 80 00 04; enabled 2
    a value that is not there | draft | meet; > 82 00 01 03 ZERO ENABLE; heard 2; noted value 3 of 3: 82 00 01 03
        ; enabled 2
    a value that is no number | draft | meet; > 83 00 01 ONE INFINITY ONE; heard 1
        ; noted a configuration value that is no number, (1.0, -inf, 1.0)
        ; configured [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    a command before the last registration | slow | connect; > FORWARD; heard 1; registrations; data 1; > FORWARD
        ; heard 2; noted a command before the last registration: 82 35 08
    a part that nothing follows, once | hasty | meet; > FORWARD 82350800; ! part of a command, and no more for 0.0
        ; wait 0.1; !!  s: 82 35 08 00; > 000000000000f83f; heard 2
    an end within a command | deployed | meet; > 82 35 08 00; shut; over; alive
        ; noted the connection ended within a command: 82 35 08 00
    an unknown command alone | deployed | meet; > 83 00; ! unknown command 131; > FORWARD; heard 2
        ; noted unknown command 131: 83 00; motor left wheel motor 1.5; alive
    a command of the other half alone | deployed | meet; > 00 35 08
        ; ! command 0, which is of the controller's half: 00 35 08; alive
    an unknown command of the draft alone | draft | meet; > 84 00 00; ! unknown command 132: 84 00 00; > ENABLE; heard 2
        ; alive
    an unknown type of the draft alone | draft | meet; > 80 01 00; ! unknown sensor type 1: 80 01 00; > ENABLE; heard 2
        ; alive
    an unknown command after a valid one | deployed | meet; > FORWARD 81
        ; died unknown command 129, after a valid one in the same read: it loops for ever: 81; eof
    a command of the other half after a valid one | deployed | meet; > FORWARD 7f
        ; died command 127, which is of the controller's half, after a valid one in the same read: it loops for ever
    an unknown type of the draft after a valid one | draft | meet; > ENABLE 82 35
        ; died unknown sensor type 53, after a valid one in the same read: it loops for ever: 82 35; eof
    an unknown command after the end of a split one | deployed | meet; > FORWARD 8235; heard 1; > 08 ONE 84
        ; died unknown command 132, after a valid one in the same read
    a 130 to nobody | deployed | connect; registrations; > 82 35 0b ONE FORWARD; data 80; motor left wheel motor 0
        ; stuck; !! 130 to number 11, which is not registered: every later command is stuck: 82 35 0b 00; heard 1
        ; > FORWARD 84; data 80; !! is stuck; heard 1; close; over; alive
    a 130 to a sensor | deployed | meet; > 82 25 00 ONE; ! 130 to 'ds0', which is no motor; stuck
    a 130 to a motor of another type | deployed | meet; > 82 2e 08 ONE
        ; ! 130 to type 46 number 8: 'left wheel motor' is of type 53; stuck
    it is gone when the external controller is | deployed | meet; > FORWARD; heard 1; shut; over; eof; refused; ok
        ; told 1; ? the external controller left the robot moving: closed
    a reset is an end | draft | connect; > CHANGE; heard 1; reset; over; ok; told 1
        ; ? the external controller left the robot at rest:
    one who closes before all is read | deployed | connect; registrations; close; over; ok; told 1
    one who reads nothing | many devices | connect; over; ok; told 1; ? the external controller read nothing for 0.1 s
    a second connection is an event and never answered | deployed | meet; again; ? second connection, from 127.0.0.1:
        ; nothing; back; > LIFT; heard 1; got (130, 46, 10, 0.25); ok
    many connections are bounded | deployed | meet; crowd 20
    a simulation that is cut | deployed | cut; meet; cut; over; eof; ok; told 1; ? the controller cut the connection
    no more than is kept | keeps 2 | meet; > 80 00 07 80 00 07 80 00 07 ENABLE; until_kept 2
    """,
    JUDGES,
)
async def test_what_an_external_controller_may_do_and_what_not(options: dict[str, Any], steps: list[str]) -> None:
    async with facing(quick(**options)) as talk:
        await talk.play(steps)


async def test_an_external_controller_that_behaves_is_not_reproached() -> None:
    async with facing(quick()) as talk:
        await talk.play(["connect", "registrations"])
        for _ in range(3):
            round_of_data = [await talk.peer.measurement() for _ in range(8)]
            assert [one[:3] for one in round_of_data] == [(1, 37, number) for number in range(8)]
            assert all(0 <= value <= 1000 for *_, value in round_of_data)
        await talk.play(["> " + "FORWARD LIFT " * 100, "heard 200"])
        for byte in talk.raw("FORWARD"):
            await talk.play([f"> {byte:02x}", "wait 0.006"])
        await talk.play(["heard 201", "got (130, 53, 8, 1.5)", "ok"])


async def test_a_draft_controller_sends_data_of_enabled_sensors_only() -> None:
    async with facing(quick("draft")) as talk:
        await talk.play(["meet", "> ENABLE"])
        for _ in range(5):
            command, node_type, number, value = await talk.peer.measurement()
            assert (command, node_type, number, value > 0) == (0, 0, 2, True)
        await talk.play(["> DISABLE 80 00 00", "heard 3", "enabled 0"])
        async with asyncio.timeout(LONG_S):
            while (await talk.peer.measurement())[2] == 2:
                pass
        assert {(await talk.peer.measurement())[2] for _ in range(5)} == {0}
        await talk.play(["quiet"])


@pytest.mark.parametrize(
    ("dialect", "words"), [("deployed", ["FORWARD", "LIFT"]), ("draft", ["ENABLE", "CHANGE", "SET", "DISABLE"])]
)
def test_the_cut_does_not_depend_on_the_reads(dialect: Dialect, words: list[str]) -> None:
    data = [bytes.fromhex(NAMES[word]) for word in words]
    stream = b"".join(data)
    for size in range(1, len(stream) + 1):
        reader = ExternalReader(dialect, DEFAULT[dialect], 3)
        taken = [one for at in range(0, len(stream), size) for one in reader.take(stream[at : at + size])]
        assert [(one.raw, one.problem) for one in taken] == [(raw, "") for raw in data]
        assert reader.rest == b""


def test_random_bytes_never_make_the_judge_raise() -> None:
    rng = random.Random(5)
    for number in range(600):
        reader = ExternalReader(DIALECTS[number % 2], DEFAULT[DIALECTS[number % 2]], 3)
        for size in (1, 7, 60):
            for one in reader.take(bytes(rng.choices(b"\x80\x81\x82\x83\x00\x01\x08\x35\x7f\xff", k=size))):
                assert one.raw


@pytest.mark.parametrize(("left", "right", "turn"), [(2, 2, 0), (1, 2, 1), (2, 1, -1)])
def test_it_drives_as_its_wheels_turn_and_sees_the_wall_that_it_nears(left: float, right: float, turn: int) -> None:
    robot = JudgedWebots(DEFAULT["deployed"], random.Random(1), 3)
    robot.place.x, robot.place.y, robot.place.heading = 4.0, 0.0, 0.0
    before = [value for _, value in robot.measure()]
    assert (before[0], before[4]) == (pytest.approx(500.0), 1000.0)
    for name, value in (("left wheel motor", left), ("right wheel motor", right), ("lift", -0.1)):
        robot.motors[name].set(value)
    for _ in range(50):
        robot.step(0.02)
    assert robot.place.x > 4.05
    assert robot.measure()[0][1] < before[0]
    assert (robot.place.heading > 0.01) - (robot.place.heading < -0.01) == turn
    assert math.isclose(robot.motors["lift"].position, -0.1)


async def test_the_program_ends_with_its_external_controller_and_says_why(capsys, caplog) -> None:
    for said, words in (("", "the external controller left the robot at rest: closed"), ("ENABLE 84", "died: unknown")):
        bound: asyncio.Future[tuple[Address, ...]] = asyncio.get_running_loop().create_future()
        controller = FragileWebotsController("draft", seed=3, times=QUICK)
        task = asyncio.create_task(controller.simulate((Address("127.0.0.1", 0),), bound.set_result))
        talk = Talk(None, External((await bound)[0].port), task)
        with contextlib.closing(talk.peer):
            await talk.play(["connect", f"> {said}", "shut", "over"])
        assert capsys.readouterr().out.startswith(words)
    assert [record.levelno for record in caplog.records if "violation" in record.message] == [logging.ERROR]


def test_a_controller_that_cannot_be_is_refused() -> None:
    two = [SimulatedDevice("a", 0, 37, DeviceKind.DISTANCE), SimulatedDevice("a", 1, 37, DeviceKind.DISTANCE)]
    for dialect, devices, words in (
        ("morse", [], "no such controller"),
        ("deployed", [SimulatedDevice("a", 255, 37, DeviceKind.DISTANCE)], "out of range"),
        ("deployed", [SimulatedDevice("ä" * 128, 0, 37, DeviceKind.DISTANCE)], "a name of 256 bytes"),
        ("deployed", two, "one name or number"),
        ("draft", [SimulatedDevice("a", 0, 37, DeviceKind.LIGHT)], "light sensors only"),
    ):
        with pytest.raises(ValueError, match=words):
            FragileWebotsController(dialect, devices=devices)  # type: ignore[arg-type]
