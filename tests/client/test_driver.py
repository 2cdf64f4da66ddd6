"""The lease as a program holds it: got, kept, numbered, lost and given back, against a gateway's own authority."""

from __future__ import annotations

import asyncio
import contextlib
import getpass
import math
import re
import socket
import traceback
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Any

import msgpack
import pytest

from tests.client import LEASE_S, Gateway, numbered_tokens, settle, subscriptions, tokens
from tests.proofs import lease, proof
from zbridge.bus import Answer, Handle, IncomingQuery, Publisher, Sample
from zbridge.bus.fake import FakeBus
from zbridge.client import Driver, Fleet, Robot
from zbridge.client.driver import RETRY_S, default_who
from zbridge.errors import (
    BusError,
    Code,
    Held,
    LeaseLost,
    Malformed,
    NeutralFirst,
    NotReady,
    Refused,
    TooFast,
    Unsupported,
)
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control, Drive, Lease, Mode, Motor, Raw
from zbridge.fleet.topics import Congestion, Topic

pytestmark = pytest.mark.jumping

ME = "ann@here"
MINE = "operator.ann%40here.mine"
"""The liveliness token of this program."""
REFUSED = "no legs"
SEEN_S = 0.06
"""Within this a refusal shows on ``control``."""

Command = Callable[[Driver], Any]
COMMANDS: dict[str, Command] = {
    "drive": lambda drive: drive(forward=0.5),
    "neutral": lambda drive: drive(),
    "during": lambda drive: drive.during(1.0, forward=0.5),
    "motor": lambda drive: drive.motor("arm", 1.0),
    "mode": lambda drive: drive.mode("manual"),
    "raw": lambda drive: drive.raw("tcpudp", 7, b"abc"),
}
every_command = pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)


class World:
    """One robot with its gateway, and two programs."""

    def __init__(self, bus: FakeBus | None = None, *, served: bool = True, lease_s: float = LEASE_S) -> None:
        self.loop = asyncio.get_running_loop()
        self.bus = bus or FakeBus()
        self.gateway = Gateway(self.bus, lease_s=lease_s)
        self.mine = self.bus.join("mine") if bus is None else bus
        self.robot: Robot = Fleet(self.mine)["r1"]
        self.others: Robot = Fleet(self.bus.join("others"))["r1"]
        if served:
            self.gateway.serve()

    @property
    def machine(self) -> Any:
        return self.gateway.machine

    async def refused(self, drive: Driver) -> None:
        """Have the robot refuse one command of this driver, and everybody see it."""
        self.machine.refusal = REFUSED
        await drive(forward=0.5)
        self.machine.refusal = None
        await asyncio.sleep(SEEN_S)

    def garble(self, topic: Topic) -> Handle:
        """Have somebody answer a question with nonsense, before the gateway does."""
        nonsense = self.bus.answer(f"fleet/r1/{topic.path}", lambda question: question.answer(b"\xc1"))
        queryables = self.bus._shared.queryables
        queryables.insert(0, queryables.pop())
        return nonsense


@contextlib.asynccontextmanager
async def driving(**wishes: Any) -> AsyncIterator[tuple[World, Driver]]:
    """Hold the lease of a robot."""
    world = World()
    async with world.robot.control(ME, **wishes) as drive:
        yield world, drive


# Getting the lease


async def test_the_lease_is_held_while_the_context_lasts() -> None:
    world = World()
    assert world.gateway.control.state == "free"
    async with world.robot.control(ME, priority=3) as drive:
        shown = world.gateway.control
        assert (shown.state, shown.holder, shown.priority) == ("held", ME, 3)
        assert (drive.who, drive.robot, drive.loss) == (ME, "r1", None)
        assert not drive.lost.is_set()
        assert repr(drive) == "<Driver of r1 holding>"
    assert world.gateway.control.state == "free"
    assert repr(drive) == "<Driver of r1 lost>"


async def test_who_is_user_at_host_unless_said_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(getpass, "getuser", lambda: "ann")
    monkeypatch.setattr(socket, "gethostname", lambda: "here")
    world = World()
    async with world.robot.control() as drive:
        assert drive.who == "ann@here"
        assert world.gateway.control.holder == "ann@here"


@pytest.mark.parametrize("error", [KeyError("uid not found"), OSError("no username")])
def test_a_user_without_a_name_has_one_nevertheless(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody() -> str:
        raise error

    monkeypatch.setattr(getpass, "getuser", nobody)
    assert default_who() == f"somebody@{socket.gethostname()}"


async def test_a_liveliness_token_tells_while_the_program_lives() -> None:
    world = World()
    async with world.robot.control(ME):
        assert tokens(world.bus) == [MINE]
        (token,) = numbered_tokens(world.bus)
        world.mine._shared.tell(f"fleet/r1/@alive/{token}", False)
        assert world.gateway.control.state == "stopped", "the lease names the token"
    assert tokens(world.bus) == []


async def test_the_token_is_there_before_the_lease_is_asked_for() -> None:
    world = World(served=False)
    there: list[list[str]] = []
    world.bus.answer("fleet/r1/@rpc/control/acquire/*", lambda question: there.append(tokens(world.bus)))
    world.gateway.serve()
    async with world.robot.control(ME):
        assert there == [[MINE]]


async def test_the_end_of_an_earlier_token_that_is_heard_of_late_does_not_end_the_lease() -> None:
    world = World()
    async with world.robot.control(ME):
        (earlier,) = numbered_tokens(world.bus)
    async with world.robot.control(ME) as drive:
        world.mine._shared.tell(f"fleet/r1/@alive/{earlier}", False)
        assert world.gateway.control.state == "held"
        await drive(forward=0.1)
        assert drive.loss is None


async def test_the_lease_is_asked_for_in_the_programs_own_name() -> None:
    world = World()
    async with world.robot.control(ME):
        pass
    async with world.robot.control("op1.laptop", name="op1", takeover=True):
        assert tokens(world.bus) == ["operator.op1.mine"]
        assert world.gateway.control.holder == "op1.laptop"
    assert [path for _, path in world.gateway.asked if path.count("/") == 3] == [
        "@rpc/control/acquire/ann%40here",
        "@rpc/control/takeover/op1",
    ]


async def test_a_name_that_is_not_ones_own_is_refused_at_once() -> None:
    world = World()
    with pytest.raises(Malformed, match=r"^r1: who = 'op2': expected 'op1', or that and '\.suffix'$"):
        await world.robot.control("op2", name="op1").__aenter__()
    assert tokens(world.bus) == []


async def test_a_gateway_that_comes_later_is_waited_for() -> None:
    world = World(served=False)
    world.loop.call_later(4.0, world.gateway.serve)
    asked_at = world.loop.time()
    async with world.robot.control(ME):
        assert 4.0 <= world.loop.time() - asked_at <= 4.0 + 2 * RETRY_S
        assert world.gateway.control.holder == ME


@pytest.mark.parametrize(("wishes", "wait_s"), [({}, 5.0), ({"wait_s": 1.5}, 1.5)])
async def test_a_gateway_that_does_not_come_is_waited_for_so_long(wishes: dict[str, float], wait_s: float) -> None:
    world = World(served=False)
    asked_at = world.loop.time()
    with pytest.raises(BusError, match=rf"^r1: no gateway answered within {wait_s:g} s$"):
        await world.robot.control(ME, **wishes).__aenter__()  # type: ignore[arg-type]
    assert world.loop.time() - asked_at == pytest.approx(wait_s, abs=2 * RETRY_S)
    assert tokens(world.bus) == []
    assert subscriptions(world.bus, "fleet/r1/control") == 0


async def test_held_names_the_holder_at_once() -> None:
    async with driving(priority=2) as (world, drive):
        asked_at = world.loop.time()
        with pytest.raises(Held, match=r"^r1 is held by ann@here \(priority 2\), [23]\.\d s left$") as held:
            await world.others.control("bob@there", priority=2).__aenter__()
        assert held.value.holder == ME
        assert world.loop.time() == asked_at
        assert tokens(world.bus) == [MINE]
        await drive(forward=0.5)
        assert drive.loss is None


async def test_the_lease_is_free_for_the_next_one() -> None:
    world = World()
    async with world.robot.control(ME):
        pass
    async with world.others.control("bob@there") as drive:
        await drive(forward=0.5)
        assert world.gateway.control.holder == "bob@there"
        assert world.gateway.driven == [Drive(forward=0.5)]


@pytest.mark.parametrize(
    ("wishes", "reason"),
    [
        ({"lease_s": 0.001}, r"^r1: lease_s = 0\.001: expected at least 0\.01$"),
        ({"deadman_s": -1.0}, r"^r1: deadman_s = -1: expected at least 0\.01$"),
        ({"deadman_s": math.nan}, r"^r1: deadman_s = nan: expected at least 0\.01$"),
    ],
)
async def test_a_bad_wish_is_refused_at_once_with_the_reason(wishes: dict[str, Any], reason: str) -> None:
    world = World()
    asked_at = world.loop.time()
    with pytest.raises(Refused, match=reason) as refused:
        await world.robot.control(ME, **wishes).__aenter__()
    assert not isinstance(refused.value, Held)
    assert world.loop.time() == asked_at
    assert tokens(world.bus) == []


async def test_wishes_reach_the_authority() -> None:
    async with driving(lease_s=1.0, deadman_s=0.3) as (world, drive):
        assert world.gateway.control.expires_in_s == pytest.approx(1.0)
        await drive(forward=0.5)
        driven_at = world.loop.time()
        await asyncio.sleep(0.29)
        assert world.machine.stops == 0
        await asyncio.sleep(0.02)
        assert world.machine.stops == 1, f"the deadman, {world.loop.time() - driven_at:g} s"
        assert drive.loss is None


async def test_motion_lasts_half_a_second_by_default() -> None:
    async with driving() as (world, drive):
        await drive(forward=0.5)
        await asyncio.sleep(0.49)
        assert world.machine.stops == 0
        await asyncio.sleep(0.02)
        assert world.machine.stops == 1


async def test_a_cancelled_wait_for_the_lease_leaves_nothing_behind() -> None:
    world = World(served=False)
    waiting = asyncio.create_task(world.robot.control(ME).__aenter__())
    await asyncio.sleep(1.0)
    assert tokens(world.bus) == [MINE]
    waiting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await waiting
    assert tokens(world.bus) == []
    assert subscriptions(world.bus, "fleet/r1/control") == 0


# Commands


async def test_commands_reach_the_robot_with_proofs_and_rising_numbers() -> None:
    async with driving() as (world, drive):
        sent: list[Sample] = []
        world.bus.subscribe("fleet/*/@cmd/**", sent.append)
        await drive(forward=0.5, left=-0.25, turn=1.0)
        await drive(turn=-1.0, light=True)
        await drive.mode("autonomous")
        await drive.motor("left arm", 1.5)
        await drive.raw("tcpudp", 7, b"abc")
        await drive()
        assert world.machine.commands == [
            ("drive", Drive(forward=0.5, left=-0.25, turn=1.0)),
            ("drive", Drive(turn=-1.0, light=True)),
            ("mode", Mode("autonomous")),
            ("motor/left%20arm", Motor(1.5)),
            ("raw/tcpudp", Raw(id=7, body=b"abc")),
            ("drive", Drive()),
        ]
        held = lease(1)
        assert [msgpack.unpackb(sample.attachment or b"") for sample in sent] == [
            {"lease": held.lease, "seq": number, "proof": proof(held.token, sample.key, number, sample.payload)}
            for number, sample in enumerate(sent, 1)
        ]
        assert not any(held.token in (sample.attachment or b"") + sample.payload for sample in sent)


@pytest.mark.parametrize("name", ["forward", "left", "turn"])
@pytest.mark.parametrize("value", [1.001, -1.001, math.inf, -math.inf, math.nan])
async def test_what_is_no_fraction_of_full_scale_is_a_value_error_and_is_not_sent(name: str, value: float) -> None:
    async with driving() as (world, drive):
        for work in (drive(**{name: value}), drive.during(1.0, **{name: value})):
            with pytest.raises(ValueError, match=rf"^{name} = {value!r}: expected -1 to 1$"):
                await work
        assert world.machine.commands == []
        assert drive.loss is None


async def test_full_scale_is_allowed() -> None:
    async with driving() as (world, drive):
        await drive(forward=1.0, left=-1.0, turn=1)
        assert world.gateway.driven == [Drive(forward=1.0, left=-1.0, turn=1.0)]


async def test_an_unknown_mode_is_a_value_error_and_is_not_sent() -> None:
    async with driving() as (world, drive):
        with pytest.raises(ValueError, match=r"^mode = 'fast': expected 'none', 'manual' or 'autonomous'$"):
            await drive.mode("fast")
        assert world.machine.commands == []


async def test_during_repeats_for_its_time_and_then_stands() -> None:
    async with driving(deadman_s=0.2) as (world, drive):
        began = world.loop.time()
        await drive.during(2.0, forward=0.5, left=0.25, turn=-0.5)
        assert world.loop.time() - began == pytest.approx(2.0, abs=0.001)
        *moved, last = world.gateway.driven
        assert last == Drive()
        assert set(moved) == {Drive(forward=0.5, left=0.25, turn=-0.5)}
        assert 38 <= len(moved) <= 42
        assert world.machine.stops == 0, "commanded anew before the deadman"


async def test_during_no_time_only_stands() -> None:
    async with driving() as (world, drive):
        await drive.during(0.0, forward=0.5)
        assert world.gateway.driven == [Drive()]


async def test_during_ends_where_the_lease_is_lost() -> None:
    async with driving() as (world, drive):
        world.loop.call_later(1.0, world.gateway.give, "bob@there")
        world.loop.call_later(1.0, lambda: world.gateway.enforcer.stop("stop"))
        began = world.loop.time()
        with pytest.raises(LeaseLost):
            await drive.during(10.0, forward=0.5)
        assert world.loop.time() - began < 1.2
        assert world.machine.stops == 1


class SlowBus(FakeBus):
    """Hands over like Zenoh's: what may be dropped goes at once, what may not goes by way of a queue."""

    def __init__(self, zid: str, shared: Any) -> None:
        super().__init__(zid, shared)
        self.queue: deque[Callable[[], object]] = deque()

    def publisher(self, key: str, topic: Topic) -> Publisher:
        publisher = super().publisher(key, topic)
        return _Queued(publisher, self.queue) if topic.qos.congestion is Congestion.BLOCK else publisher

    async def flush(self) -> None:
        await asyncio.sleep(0.01)
        while self.queue:
            self.queue.popleft()()


class _Queued:
    def __init__(self, publisher: Publisher, queue: deque[Callable[[], object]]) -> None:
        self.key = publisher.key
        self.close = publisher.close
        self._publisher = publisher
        self._queue = queue

    def put(self, payload: bytes, attachment: bytes | None = None) -> bool:
        self._queue.append(lambda: self._publisher.put(payload, attachment))
        return True


async def test_no_command_overtakes_another_however_they_are_given() -> None:
    world = World(FakeBus())
    robot = Fleet(SlowBus("slow", world.bus._shared))["r1"]
    async with robot.control(ME) as drive:
        await drive.mode("manual")
        await drive(forward=0.5)
        await asyncio.gather(
            drive.motor("arm", 1.0), drive(forward=0.25), drive.raw("tcpudp", 7), drive.mode("none"), drive()
        )
        assert [name for name, _ in world.machine.commands] == [
            "mode",
            "drive",
            "motor/arm",
            "drive",
            "raw/tcpudp",
            "mode",
            "drive",
        ]
        assert world.gateway.control.refusals == ()


async def test_commands_of_a_new_lease_are_taken_although_they_count_anew() -> None:
    world = World()
    for _ in range(2):
        async with world.robot.control(ME) as drive:
            await drive(forward=0.5)
            await drive()
    assert len(world.gateway.driven) == 4
    assert world.gateway.control.refusals == ()


# Keeping the lease


async def test_a_malformed_answer_does_not_end_the_renewals() -> None:
    async with driving() as (world, drive):
        nonsense = world.garble(topics.RPC_RENEW)
        await asyncio.sleep(LEASE_S / 2)
        assert world.gateway.questions("renew")
        nonsense.close()
        await asyncio.sleep(3 * LEASE_S)
        assert drive.loss is None
        assert world.gateway.control.state == "held"


# Losing the lease


async def lost(world: World, drive: Driver, within_s: float) -> str:
    """Wait for the event, and give what every command says from then on."""
    began = world.loop.time()
    await asyncio.wait_for(drive.lost.wait(), within_s)
    assert world.loop.time() - began <= within_s
    assert drive.loss is not None
    before = len(world.machine.commands)
    for command in COMMANDS.values():
        with pytest.raises(LeaseLost) as raised:
            await command(drive)
        assert str(raised.value) == str(drive.loss)
    assert len(world.machine.commands) == before
    assert repr(drive) == "<Driver of r1 lost>"
    return str(drive.loss)


async def test_a_stop_ends_the_lease_and_the_program_hears_of_it() -> None:
    async with driving() as (world, drive):
        await drive(forward=0.5)
        await world.others.stop()
        assert await lost(world, drive, 0.1) == "r1: the lease has ended (stop)"


async def test_a_takeover_names_the_new_holder() -> None:
    async with driving() as (world, drive):
        await drive(forward=0.5)
        async with world.others.control("bob@there", takeover=True) as bobs:
            said = await lost(world, drive, 0.1)
            assert said == "r1: the lease has ended (taken over by bob@there); held by bob@there"
            await bobs(forward=0.25)
            assert world.gateway.driven[-1] == Drive(forward=0.25)
            assert world.machine.stops == 1


async def test_a_loss_has_the_holder_and_a_code_for_programs() -> None:
    async with driving() as (world, drive):
        async with world.others.control("bob@there", takeover=True):
            await asyncio.wait_for(drive.lost.wait(), 0.1)
            for _ in range(2):
                with pytest.raises(LeaseLost) as loss:
                    await drive(forward=0.5)
                assert (loss.value.code, loss.value.holder) == (Code.LEASE_ENDED, "bob@there")
        await asyncio.sleep(0)


async def test_a_higher_priority_is_given_the_robot_and_named() -> None:
    async with driving(priority=1) as (world, drive), world.others.control("bob@there", priority=2):
        assert "held by bob@there" in await lost(world, drive, 0.1)


async def test_a_takeover_by_a_program_of_the_same_name_is_a_loss_and_no_refusal() -> None:
    async with driving() as (world, drive), world.others.control(ME, takeover=True):
        with pytest.raises(LeaseLost):
            await drive.during(1.0, forward=0.5)


async def test_the_refusals_of_a_program_of_the_same_name_that_lost_its_lease_are_not_raised() -> None:
    async with driving() as (world, first), world.others.control(ME, takeover=True) as second:
        with contextlib.suppress(Refused):
            await first(forward=0.5)
        await asyncio.sleep(SEEN_S)
        await second(forward=0.25)
        assert world.gateway.driven == [Drive(forward=0.25)]


async def test_a_gateway_that_is_gone_is_noticed_when_the_lease_must_have_run_out() -> None:
    async with driving() as (world, drive):
        await asyncio.sleep(10.0)
        renewed_at = world.gateway.questions("renew")[-1]
        await world.gateway.vanish()
        await asyncio.wait_for(drive.lost.wait(), 2 * LEASE_S)
        assert LEASE_S <= world.loop.time() - renewed_at <= LEASE_S * 5 / 3
        assert str(drive.loss) == "r1: the gateway does not answer"
        with pytest.raises(LeaseLost, match="does not answer"):
            await drive(forward=0.5)


async def test_what_others_do_to_control_is_no_loss() -> None:
    async with driving() as (world, drive):
        world.gateway.put(topics.CONTROL, b"\xc1")
        world.gateway.publish(topics.CONTROL, Control(state="stopped"))
        world.gateway.publish(topics.CONTROL, Control(state="held", holder="bob@there"))
        await asyncio.sleep(0.1)
        assert drive.loss is None, "the gateway was asked, and it knows better"
        assert 1 <= len(world.gateway.questions("renew")) <= 3
        await drive(forward=0.5)
        assert len(world.gateway.driven) == 1


async def test_whoever_repeats_our_commands_makes_us_neither_raise_nor_stop() -> None:
    async with driving() as (world, drive):
        overheard: list[Sample] = []
        watching = world.bus.subscribe("fleet/*/@cmd/**", overheard.append)
        for _ in range(3):
            await drive(forward=0.5)
        watching.close()
        for sample in overheard:
            world.bus.publisher(sample.key, topics.CMD_DRIVE).put(sample.payload, sample.attachment)
        await asyncio.sleep(SEEN_S)
        assert [(refusal.who, refusal.code, refusal.count) for refusal in world.gateway.control.refusals] == [
            (None, "out_of_order", 3)
        ]
        await drive(forward=0.25)
        assert len(world.gateway.driven) == 4


async def test_what_a_listener_says_it_refused_in_our_name_is_nothing_to_us() -> None:
    async with driving() as (world, drive):
        for refusal in (NotReady("offline"), LeaseLost("gone"), Held("held by bob"), NeutralFirst("stop")):
            world.gateway.authority.refuse("drive", refusal, ME, by="hq.forger")
            world.gateway.authority.refuse("stop", refusal, None, by="hq.forger")
        world.gateway.enforcer.settle()
        await asyncio.sleep(SEEN_S)
        asked = len(world.gateway.questions("renew"))
        await drive(forward=0.5)
        assert len(world.gateway.driven) == 1
        assert len(world.gateway.questions("renew")) == asked
        await world.others.stop()


async def test_after_a_loss_nothing_is_asked_or_declared_any_more() -> None:
    async with driving() as (world, drive):
        await world.others.stop()
        await asyncio.wait_for(drive.lost.wait(), 0.1)
        asked = len(world.gateway.asked)
        await asyncio.sleep(3 * LEASE_S)
    assert len(world.gateway.asked) == asked, "neither renewed nor released"
    assert tokens(world.bus) == []
    assert subscriptions(world.bus, "fleet/r1/control") == 0


async def test_a_loop_that_only_drives_hears_of_its_loss() -> None:
    """It never waits for anything but its own commands."""
    async with driving() as (world, drive):
        world.loop.call_later(0.0, lambda: world.gateway.enforcer.stop("stop"))
        sent = 0
        with contextlib.suppress(LeaseLost):
            while sent < 100:
                await drive(forward=0.5)
                sent += 1
        assert sent < 10


async def test_the_traceback_of_a_loss_does_not_grow_with_every_command() -> None:
    async with driving() as (world, drive):
        await world.others.stop()
        await drive.lost.wait()
        for _ in range(100):
            with pytest.raises(LeaseLost):
                await drive()
        assert drive.loss is not None
        assert len(traceback.extract_tb(drive.loss.__traceback__)) < 10


# Refusals


@every_command
async def test_a_refusal_is_raised_by_the_next_command(command: Command) -> None:
    async with driving() as (world, drive):
        await world.refused(drive)
        with pytest.raises(Refused, match=f"^r1: drive: {REFUSED}$") as raised:
            await command(drive)
        assert not isinstance(raised.value, LeaseLost)
        assert drive.loss is None


async def test_a_refusal_that_others_pushed_out_of_sight_is_raised_when_it_happens_again() -> None:
    async with driving() as (world, drive):
        for _ in range(3):
            await world.refused(drive)
            with pytest.raises(Refused, match=REFUSED):
                await drive()
        for number in range(20):
            world.gateway.refuse("drive", f"reason {number}", "bob@there")
        await asyncio.sleep(0.1)
        assert ME not in {refusal.who for refusal in world.gateway.control.refusals}
        await world.refused(drive)
        with pytest.raises(Refused, match=REFUSED):
            await drive()


async def test_a_neutral_is_sent_although_a_refusal_is_raised() -> None:
    async with driving() as (world, drive):
        await drive(forward=0.5)
        world.machine.refusal = REFUSED
        await drive.motor("arm", 1.0)
        world.machine.refusal = None
        await asyncio.sleep(SEEN_S)
        with pytest.raises(Refused, match=f"^r1: motor/arm: {REFUSED}$"):
            await drive()
        assert world.gateway.driven == [Drive(forward=0.5), Drive()]


@pytest.mark.parametrize(
    ("command", "work"),
    [
        ("mode", lambda drive: drive.mode("manual")),
        ("motor/arm", lambda drive: drive.motor("arm", 1.0)),
        ("raw/tcpudp", lambda drive: drive.raw("tcpudp", 7)),
    ],
)
async def test_the_refusal_says_which_command_it_was(command: str, work: Command) -> None:
    async with driving() as (world, drive):
        world.machine.refusal = REFUSED
        await work(drive)
        await asyncio.sleep(SEEN_S)
        with pytest.raises(Refused, match=f"^r1: {command}: {REFUSED}$"):
            await drive()


async def test_what_the_robot_left_out_of_a_command_is_raised_too() -> None:
    async with driving() as (world, drive):
        world.machine.left_out = "light: this robot has none"
        await drive(forward=0.5, light=True)
        await asyncio.sleep(SEEN_S)
        assert world.gateway.driven == [Drive(forward=0.5, light=True)]
        with pytest.raises(Refused, match=r"^r1: drive: light: this robot has none$"):
            await drive()


async def test_a_light_left_out_of_a_neutral_is_raised() -> None:
    async with driving() as (world, drive):
        world.machine.left_out = "light: this robot has none"
        await drive(light=True)
        await asyncio.sleep(SEEN_S)
        with pytest.raises(Refused, match=r"^r1: drive: light: this robot has none$"):
            await drive()


@pytest.mark.parametrize(
    ("command", "who"),
    [("drive", "bob@there"), ("drive", None), ("acquire", ME), ("stop", ME), ("light", None), ("camera", ME)],
)
async def test_what_was_not_our_command_is_not_our_refusal(command: str, who: str | None) -> None:
    async with driving() as (world, drive):
        world.gateway.refuse(command, REFUSED, who)
        await asyncio.sleep(SEEN_S)
        assert world.gateway.control.refusals
        await drive(forward=0.5)
        assert len(world.gateway.driven) == 1


async def test_refusals_of_before_the_lease_are_not_raised() -> None:
    world = World()
    world.gateway.refuse("drive", REFUSED, ME)
    world.gateway.refuse("drive", REFUSED, ME)
    await asyncio.sleep(SEEN_S)
    async with world.robot.control(ME) as drive:
        world.gateway.enforcer.beat()
        await asyncio.sleep(SEEN_S)
        await drive(forward=0.5)
        await world.refused(drive)
        with pytest.raises(Refused, match=REFUSED):
            await drive()


async def test_during_ends_with_the_refusal_of_its_commands() -> None:
    async with driving() as (world, drive):
        world.machine.refusal = REFUSED
        began = world.loop.time()
        with pytest.raises(Refused, match=REFUSED):
            await drive.during(10.0, forward=0.5)
        assert world.loop.time() - began < 0.2


async def test_motion_after_the_deadman_is_refused_and_neutral_makes_it_possible() -> None:
    async with driving(deadman_s=0.2) as (world, drive):
        await drive(forward=0.5)
        await asyncio.sleep(1.0)
        assert world.machine.stops == 1
        await drive(forward=0.5)
        await asyncio.sleep(SEEN_S)
        with pytest.raises(Refused, match="r1: drive: deadman: send a neutral drive first"):
            await drive(forward=0.5)
        await drive()
        await drive(forward=0.25)
        assert world.gateway.driven == [Drive(forward=0.5), Drive(), Drive(forward=0.25)]


@pytest.mark.parametrize(
    ("refusal", "kind"),
    [
        (NotReady("offline"), NotReady),
        (NotReady("busy: map", Code.BUSY), NotReady),
        (NotReady("gateway stopped", Code.CLOSING), NotReady),
        (Unsupported("no legs"), Unsupported),
        (NeutralFirst("deadman: send a neutral drive first"), NeutralFirst),
        (TooFast("more than 50 a second"), TooFast),
        (Malformed("Drive: expected a map"), Malformed),
    ],
)
async def test_a_refusal_is_raised_as_the_class_of_its_code(refusal: Refused, kind: type[Refused]) -> None:
    async with driving() as (world, drive):
        world.gateway.authority.refuse("drive", refusal, ME)
        world.gateway.enforcer.settle()
        await asyncio.sleep(SEEN_S)
        with pytest.raises(kind) as raised:
            await drive(forward=0.5)
        assert (type(raised.value), raised.value.code) == (kind, refusal.code)
        assert str(raised.value) == f"r1: drive: {refusal}"


@pytest.mark.parametrize(
    ("answer", "kind", "text"),
    [
        (Lease(ok=False, holder="bob", reason="held by bob (priority 0)", code="held"), Held, "r1 is held by bob"),
        (Lease(ok=False, reason="who = '': expected a name", code="malformed"), Malformed, "r1: who = ''"),
        (Lease(ok=False, reason="not this one", code="unsupported"), Unsupported, "r1: not this one"),
        (Lease(ok=False, reason="of a gateway to come", code="too_late"), Unsupported, "r1: of a gateway to come"),
        (Lease(ok=False), Unsupported, "r1: no reason given"),
    ],
)
async def test_a_lease_that_is_denied_is_raised_by_its_code_and_not_by_its_words(answer, kind, text) -> None:
    world = World(served=False)
    world.bus.answer("fleet/r1/@rpc/control/acquire/*", lambda question: question.answer(payloads.encode(answer)))
    with pytest.raises(kind, match=re.escape(text)) as raised:
        await world.robot.control(ME).__aenter__()
    assert type(raised.value) is kind
    assert raised.value.holder == answer.holder


@pytest.mark.parametrize("code", [Code.RATE, Code.NOT_READY, Code.CLOSING])
async def test_a_lease_that_cannot_be_given_for_now_is_asked_for_again(code: Code) -> None:
    world = World(served=False)
    asked: list[IncomingQuery] = []

    def answer(question: IncomingQuery) -> None:
        asked.append(question)
        question.answer(payloads.encode(Lease(ok=False, reason="later", code=code)))

    closing = world.bus.answer("fleet/r1/@rpc/control/acquire/*", answer)
    world.loop.call_later(1.0, closing.close)
    world.loop.call_later(1.0, world.gateway.serve)
    async with world.robot.control(ME):
        assert len(asked) >= 5


# Giving the lease back


class Wrong(Exception):
    """What a program may raise."""


@pytest.mark.parametrize("error", [Wrong, KeyboardInterrupt, SystemExit, asyncio.CancelledError])
async def test_the_lease_is_given_back_when_the_program_raises(error: type[BaseException]) -> None:
    world = World()

    async def program() -> None:
        async with world.robot.control(ME) as drive:
            await drive(forward=0.5)
            raise error

    with pytest.raises(error):
        await program()
    assert world.gateway.control.state == "free"
    assert len(world.gateway.questions("release")) == 1
    assert world.machine.stops == 1, "it moved"
    assert tokens(world.bus) == []
    assert subscriptions(world.bus, "fleet/r1/control") == 0


async def test_a_robot_that_stands_is_given_back_without_a_stop() -> None:
    async with driving() as (world, drive):
        await drive(forward=0.5)
        await drive()
    assert world.gateway.control.state == "free"
    assert world.machine.stops == 0


async def test_a_malformed_answer_to_the_release_is_no_error_of_the_program() -> None:
    async with driving() as (world, _):
        world.garble(topics.RPC_RELEASE)
    assert world.gateway.control.state == "free"


async def test_a_cancelled_program_gives_the_lease_back() -> None:
    world = World()

    async def program() -> None:
        async with world.robot.control(ME) as drive:
            await drive.during(100.0, forward=0.5)

    task = asyncio.create_task(program())
    await asyncio.sleep(1.0)
    assert world.gateway.control.holder == ME
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await settle()
    assert world.gateway.control.state == "free"
    assert world.machine.stops == 1
    assert tokens(world.bus) == []


async def test_nothing_runs_on_when_the_lease_was_given_back() -> None:
    world = World()
    before = asyncio.all_tasks()
    async with world.robot.control(ME):
        await settle()
    await settle()
    assert asyncio.all_tasks() == before
    assert world.gateway.questions("renew") == []


class SlowToAsk(FakeBus):
    """Takes its time with every question, and counts the publishers that are open."""

    publishers = 0

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        await asyncio.sleep(0.1)
        return await super().ask(key_expr, payload, timeout_s=timeout_s)

    def publisher(self, key: str, topic: Topic) -> Publisher:
        publisher = super().publisher(key, topic)
        self.publishers += 1
        publisher.close = self._closed  # type: ignore[method-assign]
        return publisher

    def _closed(self) -> None:
        self.publishers -= 1


async def test_a_program_cancelled_while_it_gives_the_lease_back_has_given_it_back() -> None:
    world = World()
    bus = SlowToAsk("slow", world.bus._shared)

    async def program() -> None:
        async with Fleet(bus)["r1"].control(ME) as drive:
            await drive(forward=0.5)

    task = asyncio.create_task(program())
    await asyncio.sleep(0.25)
    assert world.gateway.driven == [Drive(forward=0.5)]
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await asyncio.sleep(0.2)
    assert len(world.gateway.questions("release")) == 1


async def test_what_was_declared_for_commands_is_taken_back() -> None:
    world = World()
    bus = SlowToAsk("slow", world.bus._shared)
    async with Fleet(bus)["r1"].control(ME) as drive:
        for command in COMMANDS.values():
            await command(drive)
        assert bus.publishers == 4, "one for each key"
    assert bus.publishers == 0


@every_command
async def test_a_driver_is_of_no_use_after_its_context(command: Command) -> None:
    async with driving() as (world, drive):
        pass
    with pytest.raises(LeaseLost, match=r"^r1: released$"):
        await command(drive)
    assert world.machine.commands == []


async def test_a_gateway_that_is_gone_is_not_waited_for_in_vain() -> None:
    async with driving() as (world, _):
        await world.gateway.vanish()
        left_at = world.loop.time()
    assert world.loop.time() - left_at <= 1.5
