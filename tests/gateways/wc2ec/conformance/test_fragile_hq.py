"""The fragile external controller against a Webots controller written by hand: bytes off the page and a capture."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gateways.wc2ec.conformance.fragile_hq import FragileController, simulate_fragile_hq
from tests.captures import stream
from tests.conformance.scene import LONG_S, Listening, Scene, calling, until

WHEEL1 = bytes.fromhex("00 35 00 06 77 68 65 65 6c 31")
SLIDER = bytes.fromhex("00 2e 04 0e 73 6c 69 64 65 72 5f 63 75 72 62 5f 6c 66")
MID_FRONT = bytes.fromhex("00 25 06 06 6d 69 73 74 5f 66")
REGISTRATIONS = WHEEL1 + SLIDER + MID_FRONT
"""Three of those of the capture ``wc2ec-deployed.hex``."""
DATA = bytes.fromhex("01 25 06 00 00 00 00 00 40 8f 40")
"""1000 from mist_f, of the same capture."""
LIGHT = bytes.fromhex("00 00 02 00 00 00 00 00 00 f8 3f")
"""1.5 from light sensor 2, in the draft."""
ERROR = bytes.fromhex("7f 00 00")


class Webots(Listening):
    send = Listening.send_bytes


@contextlib.asynccontextmanager
async def facing(controller: FragileController) -> AsyncIterator[tuple[Webots, "asyncio.Task[None]"]]:
    async with calling(controller, Webots(), Scene) as scene:
        await scene.peer.accept()
        await controller.connected.wait()
        yield scene.peer, scene.task


async def after(data: bytes, **options: Any) -> FragileController:
    """Send this, close, and give the controller as it is then."""
    controller = FragileController(**options)
    async with facing(controller) as (webots, task), asyncio.timeout(LONG_S):
        await webots.send(data)
        webots.close()
        await task
    return controller


# A Webots controller that behaves


@pytest.mark.parametrize("size", [1, 3, 7, 1000])
async def test_registrations_and_data_may_come_split_or_joined(size: int) -> None:
    controller = FragileController()
    sent = REGISTRATIONS + DATA + DATA
    async with facing(controller) as (webots, task):
        for start in range(0, len(sent), size):
            await webots.send(sent[start : start + size])
            await asyncio.sleep(0)
        await until(lambda: controller.counts.get(6) == 2, controller)
        assert not task.done()
    assert controller.violations == []
    assert controller.devices == {0: (53, "wheel1"), 4: (46, "slider_curb_lf"), 6: (37, "mist_f")}
    assert controller.motors == {"wheel1": 0, "slider_curb_lf": 4}
    assert controller.values == {6: 1000.0}
    assert [one[1:] for one in controller.received[2:4]] == [(0, 37, 6, "mist_f"), (1, 37, 6, 1000.0)]
    assert controller.alive


async def test_the_capture_has_no_violation() -> None:
    controller = await after(stream("wc2ec-deployed.hex", source=27515))
    assert controller.violations == []
    assert len(controller.devices) == 12
    assert set(controller.values) == {6, 7, 8, 9, 10, 11}
    assert controller.values[10] == -1.0


async def test_a_device_that_appears_later_is_an_event() -> None:
    controller = await after(WHEEL1 + MID_FRONT + DATA + SLIDER)
    assert controller.violations == []
    assert controller.events == ["'slider_curb_lf' registered after data", "the controller closed: EOF"]


async def test_error_is_harmless() -> None:
    controller = await after(ERROR + WHEEL1)
    assert controller.violations == []
    assert controller.events[0] == "error: 7f 00 00"
    assert controller.motors == {"wheel1": 0}


async def test_the_end_of_the_connection_is_an_event() -> None:
    controller = await after(REGISTRATIONS)
    assert controller.violations == []
    assert controller.events == ["the controller closed: EOF"]
    assert controller.alive


async def test_a_draft_sensor_sends_while_it_is_enabled() -> None:
    controller = FragileController(dialect="draft", flight_s=0.0)
    async with facing(controller) as (webots, _):
        await controller.enable(2)
        assert await webots.read(3) == bytes.fromhex("80 00 02")
        await webots.send(LIGHT)
        await until(lambda: controller.counts.get(2) == 1, controller)
        assert controller.violations == []
        await controller.disable(2)
        assert await webots.read(3) == bytes.fromhex("81 00 02")
        await webots.send(LIGHT)
        await until(lambda: controller.counts.get(2) == 2, controller)
    assert controller.violations == [f"data of sensor 2, which is not enabled: {LIGHT.hex(' ')}"]
    assert controller.values == {2: 1.5}


async def test_draft_data_may_be_in_flight_after_the_disable() -> None:
    controller = FragileController(dialect="draft", flight_s=60)
    async with facing(controller) as (webots, _):
        await controller.enable(2)
        await controller.disable(2)
        await webots.send(LIGHT)
        await until(lambda: controller.counts.get(2), controller)
    assert controller.violations == []


# A Webots controller that does not


@pytest.mark.parametrize(
    ("dialect", "data", "words"),
    [
        ("deployed", DATA, "data of number 6, which is not registered: 01 25 06"),
        ("deployed", MID_FRONT + b"\x01\x35" + DATA[2:], "data of type 53: 'mist_f' was registered with type 37"),
        ("deployed", WHEEL1 + bytes.fromhex("00 25 00 01 61"), "number 0 registered again, 'wheel1' before"),
        ("deployed", bytes.fromhex("00 25 ff 01 61"), "number 255 is no device index: 00 25 ff 01 61"),
        ("deployed", bytes.fromhex("00 25 01 00"), "a device without a name: 00 25 01 00"),
        ("deployed", REGISTRATIONS + DATA[:5], "the connection ended within a message: 01 25 06 00 00"),
        ("deployed", WHEEL1[:-1], "the connection ended within a message: 00 35 00 06"),
        ("draft", LIGHT, "data of sensor 2, which is not enabled"),
    ],
)
async def test_what_the_page_forbids_is_a_violation(dialect: str, data: bytes, words: str) -> None:
    told: list[str] = []
    controller = await after(data, dialect=dialect, note=told.append)
    assert len(controller.violations) == 1
    assert controller.violations[0].startswith(words)
    assert told == controller.violations
    assert controller.alive


@pytest.mark.parametrize(
    ("dialect", "data", "words"),
    [
        ("deployed", REGISTRATIONS + WHEEL1, "'wheel1' registered again: 00 35 00 06"),
        ("deployed", WHEEL1 + bytes.fromhex("00 25 01") + WHEEL1[3:], "'wheel1' registered again: 00 25 01"),
        ("deployed", REGISTRATIONS + b"\x02", "unknown command 2: 02"),
        ("deployed", b"\x7e\x00\x00", "unknown command 126"),
        ("deployed", b"\x82" + DATA[1:], "command 130, which is of the external controller's half"),
        ("draft", b"\x01" + LIGHT[1:], "unknown command 1"),
        ("draft", ERROR, "unknown command 127"),
        ("draft", b"\x80\x00\x02", "command 128, which is of the external controller's half"),
        ("draft", b"\x00\x01" + LIGHT[2:], "unknown sensor type 1"),
    ],
)
async def test_what_ends_the_task_kills(dialect: str, data: bytes, words: str) -> None:
    controller = FragileController(dialect=dialect)  # type: ignore[arg-type]
    async with facing(controller) as (webots, task), asyncio.timeout(LONG_S):
        await webots.send(data)
        await task
        with contextlib.suppress(ConnectionError):
            assert await webots.recv() == b""
    assert not controller.alive
    assert controller.death.startswith(words)
    assert controller.death in controller.violations
    assert controller.events == [f"died: {controller.death}"]


async def test_a_measurement_that_is_no_number_is_an_event() -> None:
    controller = await after(MID_FRONT + DATA[:3] + bytes.fromhex("00 00 00 00 00 00 f8 7f"))
    assert controller.violations == []
    assert controller.events[0] == "nan measured by number 6"


async def test_a_reset_is_an_event_too() -> None:
    controller = FragileController()
    async with facing(controller) as (webots, task), asyncio.timeout(LONG_S):
        webots.reset()
        await task
    assert controller.violations == []
    assert "ConnectionResetError" in controller.events[0]


# Commands


@pytest.mark.parametrize("split", [False, True])
async def test_a_motor_is_set_by_name_or_number(split: bool) -> None:
    controller = FragileController(split=split)
    async with facing(controller) as (webots, _):
        await webots.send(REGISTRATIONS + DATA)
        await controller.set("wheel1", 1.5)
        await controller.set(4, 0.25)
        assert await webots.read(22) == bytes.fromhex(
            "82 35 00 00 00 00 00 00 00 f8 3f" + "82 2e 04 00 00 00 00 00 00 d0 3f"
        )
        with pytest.raises(KeyError):
            await controller.set("wheel9", 1.0)


async def test_it_does_nothing_before_the_first_data() -> None:
    controller = FragileController()
    async with facing(controller) as (webots, _):
        await webots.send(REGISTRATIONS)
        await until(lambda: len(controller.devices) == 3, controller)
        task = asyncio.create_task(controller.set("wheel1", 1.5))
        await asyncio.sleep(0.02)
        assert (controller.ready.is_set(), task.done()) == (False, False)
        await webots.send(DATA)
        assert await webots.read(11) == bytes.fromhex("82 35 00 00 00 00 00 00 00 f8 3f")
        await task
        assert controller.ready.is_set()


async def test_one_that_never_got_ready_has_no_connection_when_that_is_over() -> None:
    controller = FragileController()
    async with facing(controller) as (webots, _):
        await webots.send(REGISTRATIONS)
        await until(lambda: len(controller.devices) == 3, controller)
        task = asyncio.create_task(controller.set("wheel1", 1.5))
        await asyncio.sleep(0)
        webots.close()
        with pytest.raises(ConnectionError):
            await task


async def test_a_split_command_goes_in_four_writes() -> None:
    controller = FragileController(split=True)
    sizes: list[int] = []
    async with facing(controller) as (webots, _):
        await webots.send(WHEEL1 + MID_FRONT + DATA)
        task = asyncio.create_task(controller.set(0, 1.5))
        while sum(sizes) < 11:
            sizes.append(len(await webots.recv()))
        await task
    assert sizes[0] == 1
    assert len(sizes) > 1


async def test_configuration_values_of_the_draft() -> None:
    controller = FragileController(dialect="draft")
    async with facing(controller) as (webots, _):
        await controller.change(1, 2, 1.5)
        assert await webots.read(12) == bytes.fromhex("82 00 01 02 00 00 00 00 00 00 f8 3f")
        await controller.configure(3, [1.5, 1.5])
        assert await webots.read(19) == bytes.fromhex("83 00 03" + "00 00 00 00 00 00 f8 3f" * 2)


async def test_each_dialect_has_its_own_commands() -> None:
    with pytest.raises(ValueError, match="no command of dialect draft"):
        await FragileController(dialect="draft").set(0, 1.0)
    with pytest.raises(ValueError, match="no command of dialect deployed"):
        await FragileController().enable(0)
    with pytest.raises(ConnectionError):
        await FragileController(dialect="draft").enable(0)
    with pytest.raises(ValueError, match="no such controller"):
        FragileController(dialect="morse")  # type: ignore[arg-type]


# Its life


async def test_it_leaves_when_it_is_told_to() -> None:
    controller = FragileController()
    async with facing(controller) as (webots, task), asyncio.timeout(LONG_S):
        await webots.send(REGISTRATIONS)
        await until(lambda: len(controller.devices) == 3, controller)
        await controller.end()
        assert await webots.recv() == b""
        await task
        await controller.end()
    assert controller.events == ["the external controller left"]
    assert controller.violations == []


async def test_lists_are_bounded() -> None:
    controller = await after(DATA * 10, keep=3)
    assert (len(controller.violations), len(controller.received), controller.counts) == (3, 3, {6: 10})


async def test_nobody_listening_is_an_error() -> None:
    webots = Webots()
    webots.close()
    with pytest.raises(ConnectionRefusedError):
        await FragileController().run("127.0.0.1", webots.port)


async def test_the_program_logs_and_prints_what_it_died_of(capsys, caplog) -> None:
    webots = Webots()
    task = asyncio.create_task(simulate_fragile_hq("127.0.0.1", webots.port, dialect="deployed", split=True))
    async with asyncio.timeout(LONG_S):
        await webots.accept()
        await webots.send(DATA + b"\x09")
        await task
    webots.close()
    assert capsys.readouterr().out == "died: unknown command 9: 09\n"
    assert [record.message.split(":")[1] for record in caplog.records] == [
        " data of number 6, which is not registered",
        " unknown command 9",
    ]
