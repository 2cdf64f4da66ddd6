"""The fragile external controller against a Webots controller written by hand: bytes off the page and a capture."""

import ast
import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gateways.wc2ec.conformance.fragile_hq import FragileExternalController
from tests.captures import stream
from tests.conformance.scene import LONG_S, Listening, Scene, bounded, calling, table, until

NAMES = {
    "WHEEL1": "00 35 00 06 77 68 65 65 6c 31",
    "SLIDER": "00 2e 04 0e 73 6c 69 64 65 72 5f 63 75 72 62 5f 6c 66",
    "MIST_F": "00 25 06 06 6d 69 73 74 5f 66",
    "DATA": "01 25 06 00 00 00 00 00 40 8f 40",
    "LIGHT": "00 00 02 00 00 00 00 00 00 f8 3f",
    "ERROR": "7f 00 00",
}
"""Three registrations and 1000 of mist_f, as in ``wc2ec-deployed.hex``; 1.5 of light sensor 2, in the draft."""


class Webots(Listening):
    send = Listening.send_bytes


class Talk(Scene):
    """A conversation with the external controller, and what is to be seen of it afterwards."""

    names = NAMES

    async def commands(self, call: str) -> None:
        """Let it command: ``set wheel1 1.5``, ``enable 2``."""
        name, *values = call.split()
        await getattr(self.judge, name)(*(ast.literal_eval(value) for value in values))

    async def begins(self, call: str) -> None:
        self.commanding = asyncio.create_task(self.commands(call))

    async def piece(self, text: str) -> None:
        """What the next read gives."""
        assert await self.peer.recv() == self.raw(text)

    async def knows(self, motors: str) -> None:
        await until(lambda: self.judge.motors == ast.literal_eval(motors), self.judge.motors)

    async def count(self, number_and_count: str) -> None:
        number, count = map(int, number_and_count.split())
        await until(lambda: self.judge.counts.get(number) == count, self.judge.counts)

    async def bytewise(self, text: str) -> None:
        for byte in self.raw(text):
            await self.peer.send_bytes(bytes((byte,)))
            await asyncio.sleep(0)

    async def noted(self, words: str) -> None:
        """Exactly one violation, which begins so."""
        (violation,) = self.judge.violations
        assert violation.startswith(words)

    async def kept(self, count: str) -> None:
        assert len(self.judge.violations) == len(self.judge.received) == int(count)

    async def alive(self, _: str) -> None:
        assert self.judge.alive

    async def eof(self, _: str) -> None:
        with contextlib.suppress(ConnectionError):
            assert await self.peer.recv() == b""


@contextlib.asynccontextmanager
async def facing(controller: FragileExternalController) -> AsyncIterator[Talk]:
    async with calling(controller, Webots(), Talk) as talk:
        await talk.peer.accept()
        await controller.connected.wait()
        yield talk


@table(
    """
    registrations and data may be joined | deployed | > WHEEL1 SLIDER MIST_F DATA DATA; count 6 2; quiet
        ; knows {"wheel1": 0, "slider_curb_lf": 4}
    registrations and data may be split | deployed | bytewise WHEEL1 SLIDER MIST_F DATA DATA; count 6 2; quiet
        ; knows {"wheel1": 0, "slider_curb_lf": 4}
    a device that appears later is an event | deployed | > WHEEL1 MIST_F DATA SLIDER
        ; ? 'slider_curb_lf' registered after data; told 1; ok
    error is harmless | deployed | > ERROR WHEEL1; ? error: 7f 00 00; knows {"wheel1": 0}; ok
    the end of the connection is an event | deployed | > WHEEL1; close; over; ? the controller closed: EOF; told 1; ok
    a reset is an event | deployed | reset; over; ? ConnectionResetError; ok
    a measurement that is no number is an event | deployed | > MIST_F 01 25 06 00 00 00 00 00 00 f8 7f
        ; ? nan measured by number 6; ok
    a draft sensor sends while it is enabled | draft | commands enable 2; < 80 00 02; > LIGHT; count 2 1; quiet
        ; commands disable 2; < 81 00 02; > LIGHT; count 2 2; noted data of sensor 2, which is not enabled: 00 00 02
    draft data may be in flight after the disable | patient draft | commands enable 2; commands disable 2; > LIGHT
        ; count 2 1; quiet
    data of nobody | deployed | > DATA; !! data of number 6, which is not registered: 01 25 06
    data of another type | deployed | > MIST_F 01 35 06 00 00 00 00 00 40 8f 40
        ; !! data of type 53: 'mist_f' was registered with type 37
    a number again | deployed | > WHEEL1 00 25 00 01 61; !! number 0 registered again, 'wheel1' before
    a number too large | deployed | > 00 25 ff 01 61; !! number 255 is no device index: 00 25 ff 01 61
    a name of nothing | deployed | > 00 25 01 00; !! a device without a name: 00 25 01 00
    an end within data | deployed | > WHEEL1 MIST_F 01 25 06 00 00; close; over; alive
        ; noted the connection ended within a message: 01 25 06 00 00
    an end within a registration | deployed | > 00 35 00 06 77; close; over; alive
        ; noted the connection ended within a message: 00 35 00 06
    data nobody asked for | draft | > LIGHT; !! data of sensor 2, which is not enabled
    a device again | deployed | > WHEEL1 SLIDER WHEEL1; died 'wheel1' registered again: 00 35 00 06; eof; told 1
    a name again | deployed | > WHEEL1 00 25 01 06 77 68 65 65 6c 31; died 'wheel1' registered again: 00 25 01; eof
    an unknown command | deployed | > WHEEL1 02; died unknown command 2: 02; eof
    a command of its own half | deployed | > 82 25 06; died command 130, which is of the external controller's half; eof
    an unknown command of the draft | draft | > 7f 00 00; died unknown command 127; eof
    a command of the other dialect | draft | > 01 00 02; died unknown command 1; eof
    an unknown type of the draft | draft | > 00 01 02; died unknown sensor type 1; eof
    a motor is set by name or number | deployed | > WHEEL1 SLIDER MIST_F DATA; commands set "wheel1" 1.5
        ; commands set 4 0.25; < 82 35 00 00 00 00 00 00 00 f8 3f; < 82 2e 04 00 00 00 00 00 00 d0 3f
    a command may go in several writes | split | > WHEEL1 MIST_F DATA; begins set 0 1.5; piece 82
        ; < 35 00 00 00 00 00 00 00 f8 3f
    configuration values of the draft | draft | commands change 1 2 1.5; < 82 00 01 02 00 00 00 00 00 00 f8 3f
        ; commands configure 3 [1.5,1.5]; < 83 00 03 00 00 00 00 00 00 f8 3f 00 00 00 00 00 00 f8 3f
    it leaves when it is told to | deployed | > WHEEL1; knows {"wheel1": 0}; commands end; eof; over; commands end
        ; ? the external controller left; told 1; ok
    no more than is kept | keeps 3 | > DATA DATA DATA DATA; count 6 4; alive; kept 3
    """,
    {
        "deployed": {},
        "draft": {"dialect": "draft", "flight_s": 0.0},
        "patient draft": {"dialect": "draft", "flight_s": 60.0},
        "split": {"split": True},
        "keeps 3": {"keep": 3},
    },
)
async def test_what_a_webots_controller_may_do_and_what_not(options: dict[str, Any], steps: list[str]) -> None:
    async with facing(bounded(FragileExternalController, options)) as talk:
        await talk.play(steps)


async def test_the_capture_has_no_violation() -> None:
    controller = FragileExternalController()
    async with facing(controller) as talk:
        await talk.peer.send_bytes(stream("wc2ec-deployed.hex", source=27515))
        await talk.play(["close", "over", "ok"])
    assert len(controller.devices) == 12
    assert set(controller.values) == {6, 7, 8, 9, 10, 11}
    assert controller.values[10] == -1.0


async def test_it_does_nothing_before_the_first_data_nor_after_an_end() -> None:
    for step in ("> MIST_F DATA", "close"):
        controller = FragileExternalController()
        async with facing(controller) as talk:
            await talk.play(["> WHEEL1", 'knows {"wheel1": 0}'])
            task = asyncio.create_task(controller.set("wheel1", 1.5))
            await asyncio.sleep(0.02)
            assert (controller.ready.is_set(), task.done()) == (False, False)
            await talk.play([step])
            if step == "close":
                with pytest.raises(ConnectionError):
                    await task
            else:
                await talk.expect("82 35 00 00 00 00 00 00 00 f8 3f")
                await task


async def test_each_dialect_has_its_own_commands() -> None:
    with pytest.raises(ValueError, match="no command of dialect draft"):
        await FragileExternalController(dialect="draft").set(0, 1.0)
    with pytest.raises(ValueError, match="no command of dialect deployed"):
        await FragileExternalController().enable(0)
    with pytest.raises(ConnectionError):
        await FragileExternalController(dialect="draft").enable(0)
    with pytest.raises(ValueError, match="no such controller"):
        FragileExternalController(dialect="morse")  # type: ignore[arg-type]


async def test_the_program_logs_and_prints_what_it_died_of(capsys, caplog) -> None:
    webots = Webots()
    task = asyncio.create_task(FragileExternalController(split=True).simulate("127.0.0.1", webots.port, None))
    async with asyncio.timeout(LONG_S):
        await webots.accept()
        await webots.send(bytes.fromhex(NAMES["DATA"]) + b"\x09")
        await task
    webots.close()
    assert capsys.readouterr().out.endswith("\ndied: unknown command 9: 09\n")
    assert [record.message.split(":")[1] for record in caplog.records] == [
        " data of number 6, which is not registered",
        " unknown command 9",
    ]
