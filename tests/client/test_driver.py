"""The lease as a program holds it: got, kept, numbered, lost and given back, against a gateway's own authority."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import getpass
import math
import re
import socket
import traceback
from collections.abc import AsyncIterator, Callable
from typing import Any
from unittest import mock

import msgpack
import pytest

import tests.client
from tests.client import LEASE_S, numbered_tokens, raw_ms, settle, subscriptions, tokens
from tests.fake_bus import FakeBus
from tests.proofs import lease
from zbridge.bus import Answer, Handle, Publisher, Sample
from zbridge.client import Driver, Fleet, Robot
from zbridge.client.driver import default_who
from zbridge.control.events import StopCause
from zbridge.errors import (
    BusError,
    BusRefused,
    Code,
    Held,
    LeaseLost,
    Malformed,
    NeutralFirst,
    NotReady,
    Refused,
    Unsupported,
)
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Lease
from zbridge.fleet.messages import Control, Drive, Mode, Motor, Raw
from zbridge.fleet.processes import Membership
from zbridge.fleet.topics import Congestion, Topic
from zbridge.lease.lease_client import RETRY_S

pytestmark = pytest.mark.jumping

ME, BOB = "ann@here", "bob@there"
MINE = "operator.ann%40here.mine"
"""The liveliness token of this program."""
REFUSED = "no legs"
SEEN_S = 0.06
"""Within this a refusal shows on ``control``."""


async def now(drive: Driver) -> None:
    """Send a drive as a callback does."""
    assert drive.now(Drive(forward=0.5))


COMMANDS: dict[str, Callable[[Driver], Any]] = {
    "drive": lambda drive: drive(forward=0.5),
    "motor/arm": lambda drive: drive.motor("arm", 1.0),
    "mode": lambda drive: drive.mode("manual"),
    "raw/tcpudp": lambda drive: drive.raw("tcpudp", 7, b"abc"),
    "neutral": lambda drive: drive(),
    "during": lambda drive: drive.during(1.0, forward=0.5),
    "now": now,
}


class World(tests.client.World):
    """One robot with its gateway, and two programs."""

    @property
    def state(self) -> str:
        return self.gateway.control.state

    async def refused(self, drive: Driver, command: str = "drive") -> None:
        """Have the robot refuse one command of this driver, and everybody see it."""
        self.machine.refusal = REFUSED
        await COMMANDS[command](drive)
        self.machine.refusal = None
        await asyncio.sleep(SEEN_S)

    def garble(self, topic: Topic) -> Handle:
        """Have somebody answer a question with nonsense, before the gateway does."""
        nonsense = self.bus.answer(f"fleet/r1/{topic.path}", lambda question: question.answer(b"\xc1"))
        queryables = self.bus.network.queryables
        queryables.insert(0, queryables.pop())
        return nonsense

    def assert_nothing_is_left(self) -> None:
        assert tokens(self.bus) == []
        assert subscriptions(self.bus, "fleet/r1/control") == 0


@contextlib.asynccontextmanager
async def driving(**wishes: Any) -> AsyncIterator[tuple[World, Driver]]:
    """Hold the lease of a robot."""
    world = World()
    async with world.robot.control(ME, **wishes) as drive:
        yield world, drive


async def denied(robot: Robot, who: str = ME, **wishes: Any) -> Exception:
    """Ask for the lease in vain, and give what was raised."""
    with pytest.raises((Refused, BusError)) as raised:
        await robot.control(who, **wishes).__aenter__()
    return raised.value


# Getting the lease


async def test_the_lease_is_held_while_the_context_lasts() -> None:
    world = World()
    before = asyncio.all_tasks()
    async with world.robot.control(ME, priority=3) as drive:
        shown = world.gateway.control
        assert (shown.state, shown.holder, shown.priority) == ("held", ME, 3)
        assert (drive.who, drive.robot, drive.loss) == (ME, "r1", None)
        assert not drive.lost.is_set()
    assert world.state == "free"
    await settle()
    assert asyncio.all_tasks() == before
    world.assert_nothing_is_left()
    for command in COMMANDS.values():
        with pytest.raises(LeaseLost, match=r"^r1: released$"):
            await command(drive)
    assert world.machine.commands == []


async def test_who_is_user_at_host_unless_said_otherwise_and_asks_in_its_own_name() -> None:
    world = World()
    host = mock.patch.object(socket, "gethostname", return_value="here")
    with host, mock.patch.object(getpass, "getuser", return_value="ann"):
        async with world.robot.control() as drive:
            assert drive.who == world.gateway.control.holder == "ann@here"
    async with world.robot.control("op1.laptop", name="op1", takeover=True):
        assert tokens(world.bus) == ["operator.op1.mine"]
        assert world.gateway.control.holder == "op1.laptop"
    paths = [path for _, path in world.gateway.asked if path.count("/") == 3]
    assert paths == ["@rpc/control/acquire/ann%40here", "@rpc/control/takeover/op1"]
    for error in (KeyError("uid not found"), OSError("no username")):
        with host, mock.patch.object(getpass, "getuser", side_effect=error):
            assert default_who() == "somebody@here"


async def test_a_liveliness_token_tells_while_the_program_lives_and_is_there_before_the_lease() -> None:
    world = World(served=False)
    there: list[list[str]] = []
    world.bus.answer("fleet/r1/@rpc/control/acquire/*", lambda question: there.append(tokens(world.bus)))
    world.gateway.serve()
    async with world.robot.control(ME):
        assert there == [[MINE]]
        (earlier,) = numbered_tokens(world.bus)
    async with world.robot.control(ME) as drive:
        (token,) = numbered_tokens(world.bus)
        world.bus.network.notify(f"fleet/r1/@alive/{earlier}", False)
        assert world.state == "held", "the end of an earlier token that is heard of late"
        await drive(forward=0.1)
        world.bus.network.notify(f"fleet/r1/@alive/{token}", False)
        assert world.state == "stopped"


@pytest.mark.parametrize(
    ("wishes", "reason"),
    [
        ({"lease_s": 0.001}, "r1: lease_s = 0.001: expected at least 0.01"),
        ({"deadman_s": -1.0}, "r1: deadman_s = -1: expected at least 0.01"),
        ({"deadman_s": math.nan}, "r1: deadman_s = nan: expected at least 0.01"),
        ({"name": "op2"}, "r1: who = 'ann@here': expected 'op2', or that and '.suffix'"),
    ],
)
async def test_a_bad_wish_is_refused_at_once_with_the_reason(wishes: dict[str, Any], reason: str) -> None:
    world = World()
    asked_at = world.loop.time()
    error = await denied(world.robot, **wishes)
    assert (type(error), str(error)) == (Malformed, reason)
    assert world.loop.time() == asked_at
    world.assert_nothing_is_left()


CERTIFIED: list[tuple[dict[str, Any], str, str]] = [
    # what is asked for; the holder, or why there is none; the key
    ({}, "op1", "acquire/op1"),
    ({"who": "op1"}, "op1", "acquire/op1"),
    ({"who": "op1.laptop"}, "op1.laptop", "acquire/op1"),
    ({"who": "op1.laptop", "name": "op1"}, "op1.laptop", "acquire/op1"),
    ({"takeover": True}, "op1", "takeover/op1"),
    ({"who": "op2"}, "who = 'op2': the certificate of this program says 'op1': expected that, or 'op1.suffix'", ""),
    ({"who": "op12"}, "who = 'op12': the certificate of this program says 'op1': expected that, or 'op1.suffix'", ""),
    ({"name": "op2"}, "name = 'op2': the certificate of this program says 'op1': expected that, or 'op1.suffix'", ""),
]


@pytest.mark.parametrize(("wishes", "said", "asked"), CERTIFIED)
async def test_with_a_certificate_a_program_asks_in_its_name_and_in_no_other(
    wishes: dict[str, Any], said: str, asked: str
) -> None:
    world = World()
    robot = Fleet(world.bus, name="op1", clock_ms=raw_ms)["r1"]
    if not asked:
        with pytest.raises(Malformed) as raised:
            await robot.control(**wishes).__aenter__()
        assert (str(raised.value), world.gateway.asked) == (said, [])
        return
    async with robot.control(**wishes):
        assert world.gateway.control.holder == said
        assert [path for _, path in world.gateway.asked] == [f"@rpc/control/{asked}"]
        (token,) = tokens(world.bus)
        assert token == f"operator.op1.{world.bus.zid}"


@pytest.mark.parametrize(
    ("role", "takeover", "told"),
    [
        ("viewer", False, "r1: viewer.ann may not drive it: that takes the role operator or supervisor or hq in"),
        ("operator", True, "r1: operator.ann may not take it over: that takes the role supervisor in"),
        ("operator", False, "r1: no answer within 5 s: no gateway, or the router's rules forbid it"),
    ],
)
async def test_who_lacks_the_role_is_told_at_once_and_others_that_rules_may_forbid_it(
    role: str, takeover: bool, told: str
) -> None:
    world = World(served=False)
    member = payloads.encode(Membership(name="ann", role=role))
    world.bus.answer("fleet/@bus/whoami/ann", lambda question: question.answer(member))
    began_at, robot = world.loop.time(), Fleet(world.bus.join("ann"), name="ann", clock_ms=raw_ms)["r1"]
    error = await denied(robot, "ann", takeover=takeover)
    assert str(error).startswith(told)
    assert isinstance(error, BusRefused) == ("may not" in told)
    waited_s = 0.0 if "may not" in told else 5.0
    assert world.loop.time() - began_at == pytest.approx(waited_s, abs=2 * RETRY_S)
    world.assert_nothing_is_left()


@pytest.mark.parametrize(("wishes", "wait_s"), [({}, 5.0), ({"wait_s": 1.5}, 1.5)])
async def test_a_gateway_that_does_not_come_is_waited_for_so_long(wishes: dict[str, float], wait_s: float) -> None:
    world = World(served=False)
    asked_at = world.loop.time()
    assert str(await denied(world.robot, **wishes)) == f"r1: no gateway answered within {wait_s:g} s"
    assert world.loop.time() - asked_at == pytest.approx(wait_s, abs=2 * RETRY_S)
    world.assert_nothing_is_left()
    with pytest.raises(TimeoutError):  # a wait that is cancelled leaves nothing behind either
        await asyncio.wait_for(world.robot.control(ME).__aenter__(), 1.0)
    world.assert_nothing_is_left()


async def test_held_names_the_holder_at_once_and_the_next_one_gets_the_robot() -> None:
    async with driving(priority=2) as (world, drive):
        asked_at = world.loop.time()
        held = await denied(world.others, BOB, priority=2)
        assert re.fullmatch(r"r1 is held by ann@here \(priority 2\), [23]\.\d s left", str(held))
        assert isinstance(held, Held)
        assert held.holder == ME
        assert world.loop.time() == asked_at
        assert tokens(world.bus) == [MINE]
        await drive(forward=0.5)
        assert drive.loss is None
    async with world.others.control(BOB) as bobs:
        await bobs(forward=0.25)
        assert world.gateway.control.holder == BOB
        assert world.gateway.driven == [Drive(forward=0.5), Drive(forward=0.25)], "although it counts anew"


@pytest.mark.parametrize(("wishes", "deadman_s"), [({"lease_s": 1.0, "deadman_s": 0.3}, 0.3), ({}, 0.5)])
async def test_motion_lasts_as_long_as_wished_and_half_a_second_by_default(wishes, deadman_s: float) -> None:
    async with driving(**wishes) as (world, drive):
        assert world.gateway.control.expires_in_s == pytest.approx(wishes.get("lease_s", LEASE_S))
        await drive(forward=0.5)
        await asyncio.sleep(deadman_s - 0.01)
        assert world.machine.stops == 0
        await asyncio.sleep(0.02)
        assert world.machine.stops == 1
        assert drive.loss is None


@pytest.mark.parametrize(
    ("answer", "kind", "text"),
    [
        (Lease(ok=False, holder="bob", reason="held by bob (priority 0)", code="held"), Held, "r1 is held by bob"),
        (Lease(ok=False, reason="who = '': expected a name", code="malformed"), Malformed, "r1: who = ''"),
        (Lease(ok=False, reason="of a gateway to come", code="too_late"), Unsupported, "r1: of a gateway to come"),
        (Lease(ok=False), Unsupported, "r1: no reason given"),
    ],
)
async def test_a_lease_that_is_denied_is_raised_by_its_code_and_not_by_its_words(answer, kind, text) -> None:
    world = World(served=False)
    world.bus.answer("fleet/r1/@rpc/control/acquire/*", lambda question: question.answer(payloads.encode(answer)))
    error = await denied(world.robot)
    assert type(error) is kind
    assert str(error).startswith(text)
    assert error.holder == answer.holder


# Commands


async def test_commands_reach_the_robot_with_rising_numbers_and_without_the_token() -> None:
    async with driving() as (world, drive):
        sent: list[Sample] = []
        world.bus.subscribe("fleet/*/@cmd/**", sent.append)
        await drive(forward=1.0, left=-1.0, turn=1)
        await drive(turn=-0.5, light=True)
        await drive.mode("autonomous")
        await drive.motor("left arm", 1.5)
        await drive.raw("tcpudp", 7, b"abc")
        assert world.machine.commands == [
            ("drive", Drive(forward=1.0, left=-1.0, turn=1.0)),
            ("drive", Drive(turn=-0.5, light=True)),
            ("mode", Mode("autonomous")),
            ("motor/left%20arm", Motor(1.5)),
            ("raw/tcpudp", Raw(id=7, body=b"abc")),
        ]
        assert [msgpack.unpackb(sample.attachment or b"")["seq"] for sample in sent] == [1, 2, 3, 4, 5]
        assert not any(lease(1).token in (sample.attachment or b"") + sample.payload for sample in sent)


async def test_what_is_no_fraction_of_full_scale_or_no_mode_is_a_value_error_and_is_not_sent() -> None:
    async with driving() as (world, drive):
        for name, value in (("forward", 1.001), ("forward", -1.001), ("left", math.inf), ("turn", math.nan)):
            for work in (drive(**{name: value}), drive.during(1.0, **{name: value})):
                with pytest.raises(ValueError, match=rf"^{name} = {value!r}: expected -1 to 1$"):
                    await work
        with pytest.raises(ValueError, match=r"^mode = 'fast': expected 'none', 'manual' or 'autonomous'$"):
            await drive.mode("fast")
        assert world.machine.commands == []
        assert drive.loss is None


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
        await drive.during(0.0, forward=0.5)
        assert world.gateway.driven[-1] == Drive()
        assert len(world.gateway.driven) == len(moved) + 2
    assert (world.state, world.machine.stops) == ("free", 0), "a robot that stands is given back without a stop"


class SlowBus(FakeBus):
    """Hands over like Zenoh's: what may be dropped goes at once, what may not goes by way of a queue.

    Takes its time with every question, and counts the publishers that are open.
    """

    publishers = 0

    def __init__(self, world: World) -> None:
        super().__init__("slow", world.bus.network)
        self.queue: list[Callable[[], object]] = []

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        await asyncio.sleep(0.1)
        return await super().ask(key_expr, payload, timeout_s=timeout_s)

    def publisher(self, key: str, topic: Topic) -> Publisher:
        publisher = mock.Mock(wraps=super().publisher(key, topic), key=key)
        publisher.close.side_effect = self._closed
        self.publishers += 1
        if topic.qos.congestion is Congestion.BLOCK:
            put = publisher.put
            publisher.put = lambda *sample: self.queue.append(lambda: put(*sample))
        return publisher

    def _closed(self) -> None:
        self.publishers -= 1

    async def flush(self) -> None:
        await asyncio.sleep(0.01)
        while self.queue:
            self.queue.pop(0)()


async def test_no_command_overtakes_another_however_they_are_given_and_all_keys_are_given_up() -> None:
    world = World()
    bus = SlowBus(world)
    async with Fleet(bus, clock_ms=raw_ms)["r1"].control(ME) as drive:
        await drive.mode("manual")
        await drive(forward=0.5)
        await asyncio.gather(
            drive.motor("arm", 1.0), drive(forward=0.25), drive.raw("tcpudp", 7), drive.mode("none"), drive()
        )
        names = ["mode", "drive", "motor/arm", "drive", "raw/tcpudp", "mode", "drive"]
        assert [name for name, _ in world.machine.commands] == names
        assert world.gateway.control.refusals == ()
        assert bus.publishers == 4, "one for each key"
    assert bus.publishers == 0


# Losing the lease


@contextlib.asynccontextmanager
async def stopped(world: World) -> AsyncIterator[None]:
    await world.others.stop()
    yield


@pytest.mark.parametrize(
    ("end", "reason", "holder"),
    [
        (stopped, "stop", None),
        (lambda world: world.others.control(BOB, takeover=True), "taken over by bob@there", BOB),
        (lambda world: world.others.control(BOB, priority=2), "taken over by bob@there", BOB),
        (lambda world: world.others.control(ME, takeover=True), "taken over by ann@here", ME),
    ],
    ids=["stop", "takeover", "higher priority", "takeover by a program of the same name"],
)
async def test_a_loss_is_told_at_once_and_by_every_command_and_nothing_is_asked_any_more(end, reason, holder) -> None:
    async with driving(priority=1) as (world, drive):
        await drive(forward=0.5)
        async with end(world):
            await asyncio.wait_for(drive.lost.wait(), 0.1)
            said = f"r1: the lease has ended ({reason})" + (f"; held by {holder}" if holder else "")
            asked, taken = len(world.gateway.asked), len(world.machine.commands)
            for command in [*COMMANDS.values()] * 10:
                with pytest.raises(LeaseLost) as raised:
                    await command(drive)
                assert (str(raised.value), str(drive.loss)) == (said, said)
                assert (raised.value.code, raised.value.holder) == (Code.LEASE_ENDED, holder)
                assert not raised.value.expired
            assert len(world.machine.commands) == taken
            assert world.machine.stops >= 1
            assert drive.loss is not None
            assert len(traceback.extract_tb(drive.loss.__traceback__)) < 10, "it does not grow with every command"
        if end is stopped:
            await asyncio.sleep(3 * LEASE_S)
            assert len(world.gateway.asked) == asked, "neither renewed nor released"
    world.assert_nothing_is_left()


@pytest.mark.parametrize("error", [LeaseLost, Refused])
async def test_during_ends_where_the_lease_is_lost_or_its_commands_are_refused(error: type[Refused]) -> None:
    async with driving() as (world, drive):
        began = world.loop.time()
        refuse = functools.partial(setattr, world.machine, "refusal", REFUSED)
        stop = functools.partial(world.gateway.enforcer.stop, "stop", StopCause.COMMAND)
        world.loop.call_later(1.0, stop if error is LeaseLost else refuse)
        with pytest.raises(error):
            await drive.during(10.0, forward=0.5)
        assert world.loop.time() - began < 1.2


@pytest.mark.parametrize("late_s", [0.0, 0.1])
async def test_a_program_that_was_paused_moves_the_robot_again_only_after_a_neutral_that_it_sends(
    late_s: float,
) -> None:
    """late_s: how long it takes the news of refusals to come."""
    async with driving() as (world, drive):
        await drive(forward=0.5)
        await asyncio.sleep(1.0)  # longer than its deadman
        stops = world.machine.stops
        assert stops >= 1
        with pytest.raises(NeutralFirst, match="r1: drive: "):
            await drive.during(1.0, forward=0.6)
        await asyncio.sleep(1.0)
        assert world.gateway.driven == [Drive(forward=0.5)], "nothing is sent by itself"
        with contextlib.suppress(NeutralFirst):
            await drive(forward=0.6)
        await asyncio.sleep(late_s)
        await drive.neutral()
        assert world.gateway.driven[-1] == Drive()
        await drive.during(0.2, forward=0.7)
        assert Drive(forward=0.6) not in world.gateway.driven
        assert Drive(forward=0.7) in world.gateway.driven
    with pytest.raises(LeaseLost):
        await drive.neutral()


async def test_a_neutral_hides_no_refusal_of_another_cause() -> None:
    async with driving() as (world, drive):
        await world.refused(drive)
        with pytest.raises(NotReady, match=REFUSED):
            await drive.neutral()
        await drive.neutral()


async def test_a_loop_that_only_drives_hears_of_its_loss() -> None:
    """It never waits for anything but its own commands."""
    async with driving() as (world, drive):
        world.loop.call_later(0.0, world.gateway.enforcer.stop, "stop", StopCause.COMMAND)
        with contextlib.suppress(LeaseLost):
            for _ in range(10):
                await drive(forward=0.5)
        assert drive.loss is not None


async def test_the_refusals_of_a_program_of_the_same_name_that_lost_its_lease_are_not_raised() -> None:
    async with driving() as (world, first), world.others.control(ME, takeover=True) as second:
        with contextlib.suppress(Refused):
            await first(forward=0.5)
        await asyncio.sleep(SEEN_S)
        await second(forward=0.25)
        assert world.gateway.driven == [Drive(forward=0.25)]


async def test_a_gateway_that_is_gone_is_noticed_when_the_lease_must_have_run_out_and_not_waited_for() -> None:
    async with driving() as (world, drive):
        await asyncio.sleep(10.0)
        renewed_at = world.gateway.questions("renew")[-1]
        await world.gateway.vanish()
        await asyncio.wait_for(drive.lost.wait(), 2 * LEASE_S)
        assert LEASE_S <= world.loop.time() - renewed_at <= LEASE_S * 5 / 3
        with pytest.raises(LeaseLost, match=r"^r1: the gateway does not answer$") as lost:
            await drive(forward=0.5)
        assert lost.value.expired
    async with driving() as (world, _):
        await world.gateway.vanish()
        left_at = world.loop.time()
    assert world.loop.time() - left_at <= 1.5


async def test_malformed_answers_do_not_end_the_renewals_and_are_no_error_of_the_program() -> None:
    async with driving() as (world, drive):
        nonsense = world.garble(topics.RPC_RENEW)
        await asyncio.sleep(LEASE_S / 2)
        assert world.gateway.questions("renew")
        nonsense.close()
        await asyncio.sleep(3 * LEASE_S)
        assert drive.loss is None
        assert world.state == "held"
        world.garble(topics.RPC_RELEASE)
    assert world.state == "free"


# What others may say


async def test_what_others_say_on_control_and_whoever_repeats_our_commands_makes_us_neither_raise_nor_stop() -> None:
    async with driving() as (world, drive):
        world.gateway.put(topics.CONTROL, b"\xc1")
        world.gateway.publish(topics.CONTROL, Control(state="stopped"))
        world.gateway.publish(topics.CONTROL, Control(state="held", holder=BOB))
        await asyncio.sleep(0.1)
        assert drive.loss is None, "the gateway was asked, and it knows better"
        assert 1 <= len(world.gateway.questions("renew")) <= 3
        overheard: list[Sample] = []
        with contextlib.closing(world.bus.subscribe("fleet/*/@cmd/**", overheard.append)):
            for _ in range(3):
                await drive(forward=0.5)
        for sample in overheard:
            world.bus.publisher(sample.key, topics.CMD_DRIVE).put(sample.payload, sample.attachment)
        await asyncio.sleep(SEEN_S)
        (refusal,) = world.gateway.control.refusals
        assert (refusal.who, refusal.code, refusal.count) == (None, "out_of_order", 3)
        await drive(forward=0.25)
        assert len(world.gateway.driven) == 4


async def test_what_was_not_our_command_or_what_a_listener_says_it_refused_is_not_our_refusal() -> None:
    async with driving() as (world, drive):
        for command, who in (("drive", BOB), ("drive", None), ("acquire", ME), ("stop", ME), ("light", None)):
            world.gateway.refuse(command, NotReady(REFUSED), who)
        for refusal in (NotReady("offline"), LeaseLost("gone"), Held("held by bob"), NeutralFirst("stop")):
            world.gateway.refuse("drive", refusal, ME, by="hq.forger")
            world.gateway.refuse("stop", refusal, None, by="hq.forger")
        await asyncio.sleep(SEEN_S)
        asked = len(world.gateway.questions("renew"))
        await drive(forward=0.5)
        assert len(world.gateway.driven) == 1
        assert len(world.gateway.questions("renew")) == asked
        await world.others.stop()


# Refusals


async def test_a_refusal_says_which_command_it_was_and_is_raised_by_the_next_whichever_that_is() -> None:
    async with driving() as (world, drive):
        for refused in ("drive", "motor/arm", "mode", "raw/tcpudp"):
            for following, command in COMMANDS.items():
                await world.refused(drive, refused)
                with pytest.raises(Refused, match=f"^r1: {refused}: {REFUSED}$") as raised:
                    await command(drive)
                assert (type(raised.value), raised.value.code) == (NotReady, Code.NOT_READY), following
        assert drive.loss is None
        assert {command for name, command in world.machine.commands} == {Drive()}, "a neutral is sent all the same"


async def test_a_refusal_that_others_pushed_out_of_sight_is_raised_when_it_happens_again() -> None:
    async with driving() as (world, drive):
        for others in (0, 20):
            for number in range(others):
                world.gateway.refuse("drive", NotReady(f"reason {number}"), BOB)
            await asyncio.sleep(0.1)
            assert ME not in {refusal.who for refusal in world.gateway.control.refusals}
            await world.refused(drive)
            with pytest.raises(Refused, match=REFUSED):
                await drive()


async def test_refusals_of_before_the_lease_are_not_raised_but_what_the_robot_leaves_out_later() -> None:
    world = World()
    world.gateway.refuse("drive", NotReady(REFUSED), ME)
    world.gateway.refuse("drive", NotReady(REFUSED), ME)
    await asyncio.sleep(SEEN_S)
    async with world.robot.control(ME) as drive:
        world.gateway.enforcer.beat()
        await asyncio.sleep(SEEN_S)
        await drive(forward=0.5)
        world.machine.left_out = "light: this robot has none"
        await drive(light=True)
        await asyncio.sleep(SEEN_S)
        with pytest.raises(Refused, match=r"^r1: drive: light: this robot has none$"):
            await drive()


# Giving the lease back


class Wrong(Exception):
    """What a program may raise."""


@pytest.mark.parametrize("error", [Wrong, KeyboardInterrupt, asyncio.CancelledError])
async def test_the_lease_is_given_back_when_the_program_raises(error: type[BaseException]) -> None:
    world = World()

    async def program() -> None:
        async with world.robot.control(ME) as drive:
            await drive(forward=0.5)
            raise error

    with pytest.raises(error):
        await program()
    assert world.state == "free"
    assert len(world.gateway.questions("release")) == 1
    assert world.machine.stops == 1, "it moved"
    world.assert_nothing_is_left()


async def test_a_program_cancelled_while_it_drives_and_while_it_gives_the_lease_back_has_given_it_back() -> None:
    world = World()

    async def program() -> None:
        async with Fleet(SlowBus(world), clock_ms=raw_ms)["r1"].control(ME) as drive:
            await drive.during(100.0, forward=0.5)

    task = asyncio.create_task(program())
    await asyncio.sleep(1.0)
    assert world.gateway.control.holder == ME
    for _ in range(2):
        task.cancel()
        await settle()
    with pytest.raises(asyncio.CancelledError):
        await task
    await asyncio.sleep(0.2)
    assert len(world.gateway.questions("release")) == 1
    assert (world.state, world.machine.stops) == ("free", 1)
    world.assert_nothing_is_left()
