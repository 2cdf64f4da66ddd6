"""Commands that the network held up, and a machine that was suspended: what the robot is sent, and what is shown."""

from __future__ import annotations

import asyncio
from typing import Any

import msgpack
import pytest

from tests.proofs import Holder, packed
from tests.robot.scene import COMMANDS, NEUTRAL, WORDS, Rig
from tests.robot.test_device import established
from zbridge.bus import Sample

pytestmark = pytest.mark.jumping

MAX_AGE_S = 0.4


class Dating:
    """A program that dates what it sends, by a clock of its own; what it sends is on its way for a while."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        answer = rig.ask("control/takeover/ann", packed({"who": "ann", "t": self.t})).replies[0]
        lease = msgpack.unpackb(answer.payload)
        assert lease["max_age_s"] == MAX_AGE_S
        self.held = Holder.of(lease)

    @property
    def t(self) -> int:
        return round(self._rig.loop.time() * 1000) + 77_000

    async def says(self, word: str, way_s: float = 0.0) -> None:
        """Give a command now; it arrives ``way_s`` later."""
        name, fields, _ = COMMANDS[word]
        payload = packed(fields)
        attachment = self.held.attachment(name, payload, self.t)
        await asyncio.sleep(way_s)
        self._rig.driver.put(name, payload, attachment)
        await self._rig.settle()


def clocks(suspended: list[float] | None = None) -> dict[str, Any]:
    loop = asyncio.get_running_loop()
    return {"raw_ms": lambda: loop.time() * 1000, "suspended_s": lambda: sum(suspended or ())}


def words(rig: Rig) -> list[str]:
    return [WORDS.get(frame, frame.hex()) for frame in rig.written()]


@pytest.mark.parametrize(("word", "command"), [("left", "drive"), ("autonomous", "mode"), ("raw", "raw/tcpudp")])
async def test_what_may_move_the_robot_is_not_sent_late_and_its_sender_is_shown_why(word: str, command: str) -> None:
    async with established(**clocks()) as rig:
        ann = Dating(rig)
        await ann.says("neutral")
        await asyncio.sleep(1.5)
        rig.forget_written()
        await ann.says(word, 0.9)
        await rig.settle()
        assert words(rig) == []
        await asyncio.sleep(0.1)
        (refusal,) = rig.last("control")["refusals"]
        assert (refusal["who"], refusal["command"], refusal["code"]) == ("ann", command, "stale")
        assert refusal["reason"] == "the command is too old: the network delayed it"
        assert rig.metrics.total("refused", code="stale") == 1
        await ann.says(word)
        assert words(rig) == [word], "the next one is in time"


@pytest.mark.parametrize(("word", "packet"), [("neutral", "stop"), ("none", "none"), ("manual", "manual")])
async def test_what_ends_motion_is_sent_however_late(word: str, packet: str) -> None:
    async with established(**clocks()) as rig:
        ann = Dating(rig)
        await ann.says("left")
        await asyncio.sleep(0.1)
        rig.forget_written()
        await ann.says(word, 1.0)
        await asyncio.sleep(0.02)
        assert packet in words(rig)
        assert "refusals" not in rig.last("control") or rig.last("control")["refusals"] == []


async def test_neutral_and_push_that_waited_in_a_cut_move_nothing() -> None:
    async with established(deadman_s=0.5, **clocks()) as rig:
        ann, waiting = Dating(rig), list[Sample]()
        for _ in range(20):
            await ann.says("left")
            await asyncio.sleep(0.05)
        for tick in range(46):  # 2.3 s
            name, fields, _ = COMMANDS["left"]
            payload = packed(NEUTRAL if tick % 10 == 3 else fields)
            waiting.append(Sample("fleet/r1/@cmd/drive", payload, ann.held.attachment(name, payload, ann.t)))
            await asyncio.sleep(0.05)
        rig.forget_written()
        for sample in waiting[:-9]:  # the rest is in time, and comes when neutral is required already
            rig.driver.put("drive", sample.payload, sample.attachment)
        await asyncio.sleep(0.3)
        assert set(words(rig)) <= {"stop"}
        await ann.says("left")
        assert "left" not in words(rig)
        await ann.says("neutral")
        await asyncio.sleep(0.02)
        await ann.says("left")
        assert words(rig)[-1] == "left"


async def test_a_machine_that_was_suspended_stops_the_robot_before_it_reads_what_waited() -> None:
    suspended = [0.0]
    async with established(**clocks(suspended)) as rig:
        ann = Dating(rig)
        await ann.says("left")
        await asyncio.sleep(0.1)
        rig.forget_written()
        suspended[0] = 3600.0
        await ann.says("turn")
        await asyncio.sleep(0.02)
        assert words(rig)[:1] == ["stop"]
        assert "turn" not in words(rig)
        await asyncio.sleep(0.1)
        assert rig.last("control")["state"] == "stopped"
        assert [refusal["code"] for refusal in rig.last("control")["refusals"]] == ["lease_ended"]


async def test_a_read_from_the_robot_shows_that_the_machine_was_suspended_too() -> None:
    suspended = [0.0]
    async with established(**clocks(suspended)) as rig:
        ann = Dating(rig)
        await ann.says("left")
        await asyncio.sleep(0.1)
        rig.forget_written()
        suspended[0] = 5.0
        rig.sends(bytes.fromhex("0e000000 01 37 00000000 00000000 00000000"))
        assert words(rig)[:1] == ["stop"]
        assert rig.device.observed.driven is False
