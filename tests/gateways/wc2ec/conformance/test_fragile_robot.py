"""The fragile controller against an external one written by hand: every byte here is read off the protocol page."""

import ast
import asyncio
import contextlib
import logging
import math
import random
import socket
import struct
import time
from collections.abc import AsyncIterator
from typing import Any, ClassVar

import pytest

from gateways.wc2ec.conformance import parser
from gateways.wc2ec.conformance.fragile_robot import FragileController, simulate_fragile
from gateways.wc2ec.conformance.machine import Motor, Robot
from gateways.wc2ec.conformance.parser import DEFAULT, Device, Dialect, Kind, Reader, Times
from tests.conformance.scene import LONG_S, Peer, Scene, scripts, serving, until

QUICK = Times(step_s=0.005, register_s=0.0, part_s=5)
"""As quick as a test, and patient where patience is not what it is about."""
DIALECTS: tuple[Dialect, ...] = ("deployed", "draft")
FORWARD = bytes.fromhex("82 35 08 00 00 00 00 00 00 f8 3f")
"""The left wheel motor to 1.5 rad/s."""
LIFT = bytes.fromhex("82 2e 0a 00 00 00 00 00 00 d0 3f")
"""The lift to 0.25 m."""
ENABLE, DISABLE = bytes.fromhex("80 00 02"), bytes.fromhex("81 00 02")
CHANGE = bytes.fromhex("82 00 01 02 00 00 00 00 00 00 f8 3f")
"""Configuration value 2 of light sensor 1 to 1.5."""
SET = bytes.fromhex("83 00 03") + bytes.fromhex("00 00 00 00 00 00 f8 3f") * 3
GOOD: dict[Dialect, bytes] = {"deployed": FORWARD, "draft": ENABLE}
NAN, INFINITY = bytes.fromhex("00 00 00 00 00 00 f8 7f"), bytes.fromhex("00 00 00 00 00 00 f0 ff")
ONE = bytes.fromhex("00 00 00 00 00 00 f0 3f")


class External(Peer):
    """The few habits of an external controller."""

    send = Peer.send_bytes

    async def registrations(self, count: int = 11) -> list[tuple[int, int, str]]:
        registered = []
        for _ in range(count):
            command, node_type, number, length = await self.read(4)
            assert command == 0
            registered.append((node_type, number, (await self.read(length)).decode()))
        return registered

    async def measurement(self) -> tuple[int, int, int, float]:
        command, node_type, number, value = struct.unpack("<BBBd", await self.read(11))
        return command, node_type, number, value


@contextlib.asynccontextmanager
async def facing(controller: FragileController) -> AsyncIterator[tuple[External, "asyncio.Task[None]"]]:
    async with serving(controller, External, Scene) as scene:
        try:
            yield scene.peer, scene.task
        finally:  # before the connection is closed, which would be an event
            scene.task.cancel()
            await asyncio.wait([scene.task])


@contextlib.asynccontextmanager
async def connected(controller: FragileController) -> AsyncIterator[External]:
    """Connect, and wait for the registrations of the dialect that has any."""
    async with facing(controller) as (external, _):
        await external.connect()
        await until(lambda: controller.registered, controller)
        yield external


def quick(dialect: Dialect = "deployed", **options: Any) -> FragileController:
    return FragileController(dialect, **{"times": QUICK, **options})


async def heard(controller: FragileController, count: int) -> None:
    await until(lambda: len(controller.received) >= count, controller.received)


async def over(task: "asyncio.Task[None]") -> None:
    async with asyncio.timeout(LONG_S):
        await task


# An external controller that behaves


async def test_an_external_controller_that_behaves_is_not_reproached() -> None:
    controller = quick()
    async with facing(controller) as (external, task):
        await external.connect()
        assert await external.registrations() == [
            *((37, number, f"ds{number}") for number in range(8)),
            (53, 8, "left wheel motor"),
            (53, 9, "right wheel motor"),
            (46, 10, "lift"),
        ]
        for _ in range(3):
            round_of_data = [await external.measurement() for _ in range(8)]
            assert [one[:3] for one in round_of_data] == [(1, 37, number) for number in range(8)]
            assert all(0 <= value <= 1000 for *_, value in round_of_data)
        await external.send(FORWARD + LIFT)
        await heard(controller, 2)
        assert [fields for _, *fields in controller.received] == [[130, 53, 8, 1.5], [130, 46, 10, 0.25]]
        stamps = [seconds for seconds, *_ in controller.received]
        assert stamps == sorted(stamps)
        external.close()
        await over(task)
    assert controller.violations == []
    assert controller.alive


async def test_an_external_controller_may_say_nothing() -> None:
    controller = FragileController("deployed", times=Times(part_s=0.05))
    async with connected(controller) as external:
        await external.registrations()
        start = time.monotonic()
        for _ in range(8 * 10):
            await external.measurement()
        assert time.monotonic() - start > 0.1
    assert controller.violations == controller.events == []


async def test_a_draft_controller_sends_data_of_enabled_sensors_only() -> None:
    controller = quick("draft")
    async with connected(controller) as external:
        await external.send(ENABLE)
        for _ in range(5):
            command, node_type, number, value = await external.measurement()
            assert (command, node_type, number) == (0, 0, 2)
            assert value > 0
        await external.send(DISABLE + bytes.fromhex("80 00 00"))
        async with asyncio.timeout(LONG_S):
            while (await external.measurement())[2] == 2:
                pass
        assert {(await external.measurement())[2] for _ in range(5)} == {0}
        assert controller.robot.enabled == {0}
    assert [fields for _, *fields in controller.received] == [[128, 0, 2, None], [129, 0, 2, None], [128, 0, 0, None]]
    assert controller.violations == controller.events == []


@pytest.mark.parametrize(("dialect", "data"), [("deployed", FORWARD), ("draft", CHANGE)])
async def test_a_command_may_be_split_anywhere_and_many_may_share_a_read(dialect: Dialect, data: bytes) -> None:
    controller = quick(dialect)
    async with connected(controller) as external:
        await external.send(data * 100)
        await heard(controller, 100)
        for number in data:
            await external.send(bytes([number]))
            await asyncio.sleep(0.006)
        await heard(controller, 101)
    assert len({tuple(fields) for _, *fields in controller.received}) == 1
    assert controller.violations == []


@pytest.mark.parametrize(
    ("dialect", "data"), [("deployed", [FORWARD, LIFT]), ("draft", [ENABLE, CHANGE, SET, DISABLE])]
)
def test_the_cut_does_not_depend_on_the_reads(dialect: Dialect, data: list[bytes]) -> None:
    stream = b"".join(data)
    for size in range(1, len(stream) + 1):
        reader = Reader(dialect, DEFAULT[dialect], 3)
        taken = [one for at in range(0, len(stream), size) for one in reader.take(stream[at : at + size])]
        assert [one.raw for one in taken] == data
        assert not any(one.problem for one in taken)
        assert reader.rest == b""


# What it says


def test_its_messages_are_those_of_the_recording() -> None:
    """Bytes of ``wc2ec-deployed.hex``."""
    wheel = Device("wheel1", 0, 53, Kind.ROTATIONAL)
    assert parser.registration(wheel).hex() == "00350006776865656c31"
    sensor = Device("dist_c", 6, 37, Kind.DISTANCE)
    assert parser.registration(sensor).hex() == "00250606646973745f63"
    assert parser.measurement("deployed", sensor, 1000.0).hex() == "0125060000000000408f40"
    assert parser.measurement("deployed", sensor, -1.0).hex() == "012506000000000000f0bf"
    assert parser.measurement("draft", DEFAULT["draft"][2], 1.0).hex() == "000002000000000000f03f"


def test_what_is_sent_together_is_cut_anywhere() -> None:
    rng = random.Random(1)
    cuts = [parser.pieces(FORWARD, rng) for _ in range(200)]
    assert all(b"".join(parts) == FORWARD and all(parts) for parts in cuts)
    assert {len(parts) for parts in cuts} == {1, 2, 3}
    assert {len(parts[0]) for parts in cuts} == set(range(1, len(FORWARD) + 1))


async def test_other_devices_may_be_set() -> None:
    devices = [
        Device("a" * 255, 254, 38, Kind.DISTANCE, reading=-1.0),
        Device("turm/ä", 0, 99, Kind.OTHER),
        Device("", 7, 60, Kind.ROTATIONAL),
    ]
    controller = quick(devices=devices)
    async with connected(controller) as external:
        assert await external.registrations(3) == [(38, 254, "a" * 255), (99, 0, "turm/ä"), (60, 7, "")]
        assert [await external.measurement() for _ in range(3)] == [(1, 38, 254, -1.0)] * 3
        await external.send(bytes.fromhex("82 3c 07") + ONE)
        await heard(controller, 1)
    assert controller.motors[""].velocity == 1.0
    assert controller.violations == []


# How it moves


async def test_the_motors_tell_what_they_were_set_to() -> None:
    controller = quick()
    async with connected(controller) as external:
        await external.send(FORWARD + LIFT)
        await heard(controller, 2)
        left, right, lift = (controller.motors[name] for name in ("left wheel motor", "right wheel motor", "lift"))
        assert (left.velocity, left.target, left.commands) == (1.5, 1.5, 1)
        assert (right.velocity, right.commands) == (0.0, 0)
        assert controller.robot.moving
        await until(lambda: 0 < lift.velocity <= 0.2, lift)
        await external.send(FORWARD[:3] + bytes(8))
        await until(lambda: not controller.robot.moving, controller.motors)
        await until(lambda: lift.position == 0.25 and lift.velocity == 0, lift)
    assert repr(lift) == "<Motor 'lift' 0 at 0.25, set to 0.25>"
    assert controller.violations == []


@pytest.mark.parametrize(("left", "right", "turn"), [(2, 2, 0), (1, 2, 1), (2, 1, -1)])
def test_it_drives_as_its_wheels_turn(left: float, right: float, turn: int) -> None:
    robot = Robot(DEFAULT["deployed"], random.Random(1), 3)
    robot.place.x = robot.place.y = robot.place.heading = 0.0
    robot.motors["left wheel motor"].set(left)
    robot.motors["right wheel motor"].set(right)
    for _ in range(50):
        robot.step(0.02)
    assert robot.place.x > 0.05
    assert (robot.place.heading > 0.01) - (robot.place.heading < -0.01) == turn


def test_it_sees_the_wall_that_it_nears() -> None:
    robot = Robot(DEFAULT["deployed"], random.Random(1), 3)
    robot.place.x, robot.place.y, robot.place.heading = 4.0, 0.0, 0.0
    before = {device.name: value for device, value in robot.measure()}
    assert math.isclose(before["ds0"], 500.0)
    assert before["ds4"] == 1000.0
    for motor in list(robot.motors.values())[:2]:
        motor.set(10.0)
    robot.step(0.5)
    assert math.isclose(robot.measure()[0][1], 375.0)


def test_a_linear_motor_goes_back_as_well() -> None:
    motor = Motor(DEFAULT["deployed"][-1])
    motor.set(-0.1)
    for _ in range(30):
        motor.step(0.02)
    assert math.isclose(motor.position, -0.1)
    motor.step(0.0)
    assert math.isclose(motor.position, -0.1)


# What it notes, survives and dies of


class Talk(Scene):
    """A conversation with the controller, and what is to be seen of it afterwards."""

    names: ClassVar[dict[str, str]] = {
        "FORWARD": FORWARD.hex(),
        "LIFT": LIFT.hex(),
        "ENABLE": ENABLE.hex(),
        "DISABLE": DISABLE.hex(),
        "CHANGE": CHANGE.hex(),
        "SET": SET.hex(),
        "NAN": NAN.hex(),
        "INFINITY": INFINITY.hex(),
        "ONE": ONE.hex(),
        "ZERO": bytes(8).hex(),
    }

    async def meet(self, _: str) -> None:
        """Connect, and wait for the registrations of the dialect that has any."""
        await self.connect("")
        await until(lambda: self.judge.registered, self.judge)

    async def noted(self, words: str) -> None:
        """Exactly this violation, or one that begins so where it ends in three dots."""
        (violation,) = self.judge.violations
        assert violation.startswith(words[:-3]) if words.endswith("...") else violation == words

    async def got(self, row: str) -> None:
        """The newest command, as a tuple."""
        assert self.judge.received[-1][1:] == ast.literal_eval(row)

    async def first(self, row: str) -> None:
        assert self.judge.received[0][1:] == ast.literal_eval(row)

    async def events(self, events: str) -> None:
        assert self.judge.events == [event for event in events.split(" / ") if event]

    async def enabled(self, numbers: str) -> None:
        assert self.judge.robot.enabled == {int(number) for number in numbers.split()}

    async def configured(self, configuration: str) -> None:
        assert self.judge.robot.configuration == ast.literal_eval(configuration)

    async def motor(self, name_and_commands: str) -> None:
        """A motor has this velocity."""
        name, _, velocity = name_and_commands.rpartition(" ")
        assert self.judge.motors[name].velocity == float(velocity)

    async def alive(self, _: str) -> None:
        assert self.judge.alive

    async def stuck(self, _: str) -> None:
        assert self.judge.stuck

    async def data(self, count: str) -> None:
        """It goes on measuring."""
        for _ in range(int(count)):
            assert (await self.peer.measurement())[0] == 1

    async def registrations(self, _: str) -> None:
        assert len(await self.peer.registrations()) == 11

    async def twice(self, _: str) -> None:
        assert self.judge.violations == [f"a command before the last registration: {FORWARD.hex(' ')}"] * 2


DRAFT: dict[str, Any] = {"dialect": "draft"}
UNSET = "{0: [0, 0, 0], 1: [0, 0, 0], 2: [0, 0, 0], 3: [0, 0, 0]}"
LOST = [
    ("deployed", "80 35 08", "unknown command 128: 80 35 08"),
    ("deployed", "81", "unknown command 129: 81"),
    ("deployed", "83 00", "unknown command 131: 83 00"),
    ("deployed", "ff", "unknown command 255: ff"),
    ("deployed", "00 35 08", "command 0, which is of the controller's half: 00 35 08"),
    ("deployed", "01", "command 1, which is of the controller's half: 01"),
    ("deployed", "7f", "command 127, which is of the controller's half: 7f"),
    ("draft", "84 00 00", "unknown command 132: 84 00 00"),
    ("draft", "00 00 00", "command 0, which is of the controller's half: 00 00 00"),
    ("draft", "80 01 00", "unknown sensor type 1: 80 01 00"),
    ("draft", "82 35", "unknown sensor type 53: 82 35"),
]


@scripts(
    {
        "a draft controller says nothing unasked": (DRAFT, ["meet", "> CHANGE", "heard 1", "nothing"]),
        "sensors of the draft can be changed and set": (
            DRAFT,
            ["meet", "> CHANGE SET", "heard 2", "first (130, 0, 1, (2.0, 1.5))", "got (131, 0, 3, (1.5, 1.5, 1.5))"]
            + ["configured {0: [0, 0, 0], 1: [0, 0, 1.5], 2: [0, 0, 0], 3: [1.5, 1.5, 1.5]}", "ok"],
        ),
        "a sensor type may have another number of values": (
            {**DRAFT, "values": 1},
            ["meet", f"> {SET[:11].hex()} DISABLE", "heard 2", "first (131, 0, 3, (1.5,))", "ok"],
        ),
        "what is needless in the draft is an event": (
            DRAFT,
            ["meet", "> DISABLE ENABLE ENABLE", "heard 3", "ok"]
            + ["events light sensor 2 disabled that was not enabled / light sensor 2 enabled again"],
        ),
        **{
            f"a motor is not set to what is no number, {data}": (
                {},
                [
                    "meet",
                    f"> FORWARD {data} LIFT",
                    "heard 3",
                    f"noted {words}...",
                    "motor left wheel motor 1.5",
                    "alive",
                ],
            )
            for data, words in (
                ("823508 NAN", "nan to motor 'left wheel motor': 82 35 08 00 00 00 00 00 00 f8 7f"),
                ("823508 INFINITY", "-inf to motor 'left wheel motor': 82 35 08"),
                ("822e0a NAN", "nan to motor 'lift': 82 2e 0a"),
            )
        },
        **{
            f"a bad command of the draft is noted and ignored, {data}": (
                DRAFT,
                [
                    "meet",
                    f"> DISABLE {data} ENABLE",
                    "heard 3",
                    f"noted {words}...",
                    "enabled 2",
                    f"configured {UNSET}",
                ],
            )
            for data, words in (
                ("80 00 04", "command 128 to light sensor 4, which is not there: 80 00 04"),
                ("81 00 ff", "command 129 to light sensor 255, which is not there: 81 00 ff"),
                ("82 00 04 00 ZERO", "command 130 to light sensor 4, which is not there"),
                ("83 00 09 ZERO ZERO ZERO", "command 131 to light sensor 9, which is not there"),
                ("82 00 01 03 ZERO", "value 3 of 3: 82 00 01 03 00 00"),
                ("82 00 01 00 NAN", "a configuration value that is no number, (nan,)"),
                ("83 00 01 ONE INFINITY ONE", "a configuration value that is no number, (1.0, -inf, 1.0)"),
            )
        },
        "a command before the last registration is noted": (
            {"times": Times(step_s=0.005, register_s=0.3)},
            ["connect", "> FORWARD FORWARD", "heard 2", "registrations", "data 1", "> FORWARD", "heard 3", "twice"]
            + ["motor left wheel motor 1.5"],
        ),
        "a part that nothing follows is noted once": (
            {"times": Times(step_s=0.005, register_s=0.0, part_s=0.05)},
            ["meet", "> FORWARD 82350800", "! part of a command, and no more for 0.0", "wait 0.1", "!!  s: 82 35 08 00"]
            + [f"> {FORWARD[4:].hex()}", "heard 2"],
        ),
        **{
            f"an end within a command is noted, {dialect}": (
                {"dialect": dialect},
                ["meet", f"> {part.hex()}", "shut", "over", "alive"]
                + [f"noted the connection ended within a command: {part.hex(' ')}"],
            )
            for dialect, part in (("deployed", FORWARD[:10]), ("draft", SET[:26]))
        },
        **{
            f"an unknown command alone is noted and the read thrown away, {dialect} {data}": (
                {"dialect": dialect},
                ["meet", f"> {data}", f"! {words}", f"> {GOOD[dialect].hex()}", "heard 2", f"noted {words}", "alive"]
                + [f"first {(*[*bytes.fromhex(data), -1, -1][:3], None)}"],
            )
            for dialect, data, words in LOST
        },
        **{
            f"an unknown command after a valid one in the same read kills, {dialect} {data}": (
                {"dialect": dialect},
                ["meet", f"> {GOOD[dialect].hex()} {data}"]
                + [f"died {words.replace(': ', ', after a valid one in the same read: it loops for ever: ')}", "eof"],
            )
            for dialect, data, words in LOST
        },
        "the end of a split command counts as a valid one": (
            {},
            ["meet", f"> FORWARD {FORWARD[:5].hex()}", "heard 1", f"> {FORWARD[5:].hex()} 84"]
            + ["died unknown command 132, after a valid one in the same read"],
        ),
        **{
            f"after a 130 to no motor every later command is stuck, {header}": (
                {},
                ["connect", "registrations", f"> LIFT {header} ONE FORWARD", f"! {words}"]
                + [f"> FORWARD 84 {FORWARD[:4].hex()}", "data 80", f"!! {words}", "stuck", "heard 2"]
                + ["motor left wheel motor 0", "close", "over", "alive"],
            )
            for header, words in (
                ("82 35 0b", "130 to number 11, which is not registered: every later command is stuck: 82 35 0b 00"),
                ("82 35 ff", "130 to number 255, which is not registered"),
                ("82 25 00", "130 to 'ds0', which is no motor"),
                ("82 35 07", "130 to 'ds7', which is no motor"),
                ("82 2e 08", "130 to type 46 number 8: 'left wheel motor' is of type 53"),
                ("82 35 0a", "130 to type 53 number 10: 'lift' is of type 46"),
            )
        },
        "it is gone when the external controller is": (
            {},
            ["meet", "> FORWARD", "heard 1", "shut", "over", "eof", "refused", "ok"]
            + ["events the external controller left the robot moving: closed"],
        ),
        "a reset is an end": (
            DRAFT,
            [
                "connect",
                "> CHANGE",
                "heard 1",
                "reset",
                "over",
                "told 1",
                "? the external controller left the robot at rest: ",
            ],
        ),
        "a second connection is an event and never answered": (
            {},
            [
                "meet",
                "again",
                "> FORWARD",
                "? second connection, from 127.0.0.1:",
                "nothing",
                "back",
                "> LIFT",
                "heard 1",
            ]
            + ["got (130, 46, 10, 0.25)", "ok"],
        ),
        "many connections are bounded": ({}, ["meet", "crowd 20"]),
    }
)
async def test_what_an_external_controller_may_do_and_what_not(options: dict[str, Any], steps: list[str]) -> None:
    async with serving(quick(**options), External, Talk) as talk:
        await talk.play(steps)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_random_bytes_never_make_the_judge_raise(dialect: Dialect) -> None:
    rng = random.Random(5)
    for _ in range(300):
        reader = Reader(dialect, DEFAULT[dialect], 3)
        for size in (1, 7, 60):
            for one in reader.take(bytes(rng.choices(b"\x80\x81\x82\x83\x00\x01\x08\x35\x7f\xff", k=size))):
                assert one.raw


# The connection


async def test_a_reset_while_it_sends_is_an_end() -> None:
    controller = quick()
    async with facing(controller) as (external, task):
        await external.connect()
        await external.registrations()
        external.close()  # with unread data: a reset
        await over(task)
    assert len(controller.events) == 1
    assert controller.violations == []


async def test_an_external_controller_that_reads_nothing_ends_it() -> None:
    devices = [Device(f"{number:03}" + "x" * 200, number, 37, Kind.DISTANCE) for number in range(255)]
    controller = quick(devices=devices, times=Times(step_s=0.0, register_s=0.0, send_s=0.1))
    async with facing(controller) as (external, task):
        external.tcp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        await external.connect()
        await over(task)
    assert controller.events == ["the external controller read nothing for 0.1 s"]
    assert controller.violations == []


async def test_a_simulation_can_be_cut() -> None:
    controller = quick()
    async with facing(controller) as (external, task):
        await controller.cut()
        await external.connect()
        await external.registrations()
        await controller.cut()
        await over(task)
        await external.read_to_the_end()
        await controller.cut()
        assert controller.events == ["the controller cut the connection"]
        assert controller.violations == []


async def test_what_is_kept_is_bounded() -> None:
    noted: list[str] = []
    controller = quick("draft", keep=2, note=noted.append)
    async with connected(controller) as external:
        await external.send(bytes.fromhex("80 00 07") * 3 + ENABLE * 4)
        await until(lambda: controller.received and controller.received[-1][3] == 2, controller.received)
        await until(lambda: len(controller.events) == 2, controller.events)
        assert len(controller.violations) == len(controller.received) == 2
        assert len(noted) == 3


# As a process


async def simulating(dialect: Dialect) -> "tuple[asyncio.Task[None], int]":
    port: asyncio.Future[int] = asyncio.get_running_loop().create_future()
    task = asyncio.create_task(
        simulate_fragile("127.0.0.1", 0, dialect=dialect, seed=3, ready=port.set_result, times=QUICK)
    )
    return task, await port


async def test_the_simulator_ends_with_its_external_controller(capsys: pytest.CaptureFixture[str]) -> None:
    task, port = await simulating("deployed")
    with contextlib.closing(External(port)) as external:
        await external.connect()
        assert len(await external.registrations()) == 11
        external.tcp.shutdown(socket.SHUT_WR)
        await over(task)
    assert capsys.readouterr().out == "the external controller left the robot at rest: closed\n"


async def test_the_simulator_logs_violations_and_says_what_it_died_of(caplog, capsys) -> None:
    task, port = await simulating("draft")
    with contextlib.closing(External(port)) as external:
        await external.connect()
        await external.send(ENABLE + b"\x84")
        await over(task)
    assert capsys.readouterr().out.startswith("died: unknown command 132, after a valid one in the same read")
    assert [record.levelno for record in caplog.records if "violation" in record.message] == [logging.ERROR]


async def test_the_simulator_can_be_stopped() -> None:
    task, port = await simulating("deployed")
    with contextlib.closing(External(port)) as external:
        await external.connect()
        await external.registrations()
        task.cancel()
        await external.read_to_the_end()
    with pytest.raises(asyncio.CancelledError):
        await task


async def test_a_port_in_use_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(OSError, match="in use"):
        await quick().serve("127.0.0.1", taken.getsockname()[1], print)


BAD_DEVICES: list[tuple[Any, list[Device], str]] = [
    ("morse", [], "no such controller"),
    ("deployed", [Device("a", 255, 37, Kind.DISTANCE)], "out of range"),
    ("deployed", [Device("a", 0, 256, Kind.DISTANCE)], "out of range"),
    ("deployed", [Device("ä" * 128, 0, 37, Kind.DISTANCE)], "a name of 256 bytes"),
    ("deployed", [Device("a", 0, 37, Kind.DISTANCE), Device("a", 1, 37, Kind.DISTANCE)], "one name or number"),
    ("deployed", [Device("a", 0, 37, Kind.DISTANCE), Device("b", 0, 53, Kind.ROTATIONAL)], "one name or number"),
    ("draft", [Device("a", 0, 37, Kind.LIGHT)], "light sensors only"),
    ("draft", [Device("a", 0, 0, Kind.ROTATIONAL)], "light sensors only"),
]


@pytest.mark.parametrize(("dialect", "devices", "words"), BAD_DEVICES)
def test_a_controller_that_cannot_be_is_refused(dialect: Any, devices: list[Device], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        FragileController(dialect, devices=devices)


def test_a_seed_gives_the_same_robot() -> None:
    one, two = (FragileController("deployed", seed=5) for _ in range(2))
    assert repr(one) == repr(two) == "<FragileController deployed listening violations=0 alive=True>"
    assert one.robot.measure() == two.robot.measure()
