"""What somebody outside must know to stop a robot whose gateway dies, and how the next gateway continues."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import AsyncIterator
from typing import Any

import msgspec
import pytest

from tests.clock import scene_of
from tests.proofs import packed
from tests.robot.scene import COMMANDS, SETTINGS, STOP, Rig, TimedLink, established, serving
from zbridge.protocol.kept import Budget
from zbridge.robot.observer import Boundary, LastStop, Observer, StopFrame
from zbridge.transport import Parcel
from zbridge.transport.conversation import Conversation
from zbridge.wire.frames import Partial

pytestmark = pytest.mark.jumping

NONE = COMMANDS["none"][2]
LEFT = COMMANDS["left"][2]
AT_REST = LastStop(False, (StopFrame(STOP),), 0.01, "established")
POSITION = bytes.fromhex("0e0000000137") + struct.pack("<3f", 100.0, 0.0, 0.0)
"""Packet 55 of the protocol page: 1 m to the right, in centimetres."""
LIDAR_ON = bytes.fromhex("060000000133 01000000")
"""Packet 51: the lidar is on."""
rig = scene_of(established)


class Notes(Observer):
    """An observer that keeps what it is told."""

    def __init__(self) -> None:
        self.told: list[Any] = []
        self.device: Any = None
        self.at_once: list[bool] = []

    def changed(self, *, at_once: bool = False) -> None:
        self.at_once.append(at_once)

    def began(self, device: Any) -> None:
        self.device = device
        self.told.append("began")

    def ended(self) -> None:
        self.told.append("ended")

    def linked(self, name: str, link: Any, up: bool) -> None:
        self.told.append((name, up))

    def read(self, name: str, resume: Any) -> None:
        self.told.append(("read", resume(100)))


async def test_the_stop_of_a_robot_is_known_once_it_is_established() -> None:
    async with serving(hold=False) as rig:
        assert rig.device.observed.last_stop() == LastStop(state="handshaking")
        await rig.establish()
        assert rig.device.observed.last_stop() == AT_REST
        rig.goes()
        assert rig.device.observed.last_stop().frames == ()


async def test_a_robot_that_is_driven_or_drives_itself_counts_as_driven(rig: Rig) -> None:
    assert not rig.device.observed.driven
    rig.command("drive", {"left": 1.0})
    assert rig.device.observed.driven
    await rig.play("neutral 0.1")
    assert not rig.device.observed.driven
    await rig.play("autonomous 0.5")
    last = rig.device.observed.last_stop()
    assert last.driven
    assert [frame.data for frame in last.frames] == [NONE, STOP]


async def test_an_observer_is_told_at_once_of_a_command_that_may_change_how_the_robot_is_stopped() -> None:
    notes = Notes()
    async with established(observer=notes) as rig:
        for words, at_once in [("left", False), ("autonomous", True), ("left", False), ("raw", True), ("text", False)]:
            notes.at_once = []
            await rig.play(words)
            assert notes.at_once == [at_once], words


async def test_an_observer_is_told_of_the_link_and_of_every_read() -> None:
    notes = Notes()
    async with serving(observer=notes) as rig:
        rig.sends(SETTINGS[:7])
        rig.sends(SETTINGS[7:])
        rig.goes()
    part, whole = ("read", Partial(SETTINGS[:7])), ("read", Partial())
    assert notes.told[:5] == ["began", ("robot", True), part, whole, ("robot", False)]
    assert notes.told[-1] == "ended"


async def test_a_link_that_holds_bytes_back_may_stand_within_a_frame(rig: Rig) -> None:
    assert rig.device.observed.boundary("robot") == Boundary()
    rig.link.ready = False
    assert rig.device.observed.boundary("robot") == Boundary(outgoing=False)
    assert rig.device.observed.boundary("another") == Boundary(outgoing=False)
    assert rig.device.observed.partial("another", 100) is None


async def test_a_robot_that_is_not_established_leaves_nothing_to_go_on_with() -> None:
    async with serving(hold=False) as rig:
        assert rig.device.deposit(Parcel(), Budget(1000)) is None
        await rig.establish()
        assert rig.device.deposit(Parcel(), Budget(1000)) is not None


def deposited(rig: Rig, budget: Budget) -> Any:
    """Carry what a device deposits as it is carried to another process."""
    return msgspec.msgpack.decode(msgspec.msgpack.encode(rig.device.deposit(Parcel(), budget)))


@contextlib.asynccontextmanager
async def heir_of(deposit: Any, *partials: Partial) -> AsyncIterator[Rig]:
    """Run the device of another process, which attaches a link when it has taken over."""

    async def attach(address: object, state: object, parcel: Parcel, conversation: Conversation) -> None:
        link = TimedLink(heir.loop, str(address))
        heir.links.append(link)
        heir.conversations.append(conversation)
        conversation.attached(link)

    async def begin() -> None:
        assert heir.links == [], "no connection is touched before the word to go"

    heir = Rig(attach=attach)
    await heir.device.restore(deposit, Parcel(), partials)
    task = asyncio.ensure_future(heir.device.run(begin))
    await heir.settle()
    yield heir
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


async def test_who_goes_on_sends_the_stop_first_and_nothing_of_what_waited(rig: Rig) -> None:
    rig.command("drive", {"left": 1.0})
    rig.command("text", {"text": "hi"})
    async with heir_of(deposited(rig, Budget(1000))) as heir:
        await asyncio.sleep(5.0)
        assert heir.last("status")["state"] == "established"
        assert len(heir.link.written) >= 5
        assert set(heir.link.written) == {STOP}
        assert heir.hold()["ok"]
        heir.command("drive", {"left": 1.0})
        await asyncio.sleep(0.2)
        assert heir.link.written[-1] == LEFT


async def test_who_goes_on_publishes_again_what_the_dead_process_had_published_last(rig: Rig) -> None:
    rig.sends(LIDAR_ON)
    lidar = rig.bus.values("fleet/r1/lidar")[-1]
    async with heir_of(deposited(rig, Budget(1000))) as heir:
        assert heir.bus.values("fleet/r1/lidar") == [lidar], "a listener of the same process asked too early"


async def test_nobody_is_given_the_lease_before_the_word_to_go(rig: Rig) -> None:
    heir, go = Rig(), asyncio.Event()
    await heir.device.restore(deposited(rig, Budget(1000)), Parcel())
    task = asyncio.ensure_future(heir.device.run(go.wait))
    await asyncio.sleep(0.1)
    (reply,) = heir.ask("control/acquire/driver", packed({"who": "driver"})).replies
    assert str(reply.error) == "another process takes the robot over"
    go.set()
    await asyncio.sleep(0.1)
    assert heir.hold()["ok"]
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


async def test_a_large_published_value_is_left_out_of_a_deposit_and_its_key_stays(rig: Rig) -> None:
    size = len(rig.bus.values("fleet/r1/status")[-1])
    budget = Budget(size - 1)
    async with heir_of(deposited(rig, budget)) as heir:
        assert budget.left_out["status"] == size
        assert "status" in heir.device.publishers.known
    assert deposited(rig, Budget(size))["published"][0][1] is not None


async def test_the_rest_of_a_frame_whose_beginning_was_lost_is_skipped_and_the_next_one_read(rig: Rig) -> None:
    async with heir_of(deposited(rig, Budget(1000)), Partial(skip=5)) as heir:
        heir.sends(b"\0\0\0")
        heir.sends(b"\0\0" + POSITION)
        assert heir.last("pose")["x"] == pytest.approx(1.0)
