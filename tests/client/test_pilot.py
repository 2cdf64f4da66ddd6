"""The pilot: the lease asked for, driven by, lost and given back, for one stick."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

import pytest

from tests.client import World
from zbridge.client.pilot import STALE_S, Pilot
from zbridge.control.events import StopCause
from zbridge.errors import LeaseLost, NeutralFirst, NotReady, RateLimited, ZbridgeError
from zbridge.fleet.messages import Drive, Mode, Motor
from zbridge.lease.stick import Stick, StickRules

pytestmark = pytest.mark.jumping
FIRST, SECOND, THIRD = (Drive(forward=forward) for forward in (0.1, 0.2, 0.3))
BY_MOTION = StickRules(deadman_s=0.5, keeps=False, idle_s=1.0)
BY_HAND = StickRules(deadman_s=0.5)


class Scene:
    """One robot, and the pilot."""

    def __init__(self, *, served: bool = True) -> None:
        self.world = World(served=served)
        self.ended: list[ZbridgeError | None] = []
        self.turn = asyncio.Lock()
        self.pilot = self.make(BY_MOTION)

    def make(self, rules: StickRules, who: str = "ann") -> Pilot:
        @contextlib.asynccontextmanager
        async def control():
            async with self.world.robot.control(who, deadman_s=0.5, wait_s=2.0) as self.driver:
                yield self.driver

        self.pilot = Pilot(Stick(rules), control, on_end=self.ended.append, turn=self.turn)
        return self.pilot

    @property
    def driven(self) -> list[Drive]:
        return self.world.gateway.driven

    @property
    def holder(self) -> str | None:
        return self.world.gateway.control.holder

    async def held(self) -> None:
        self.pilot.drive(FIRST)
        await asyncio.sleep(0.1)
        assert self.driven == [FIRST]
        assert self.holder == "ann"


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    scene = Scene()
    yield scene
    await scene.pilot.close()
    assert scene.holder is None


async def test_while_the_lease_is_held_a_command_is_sent_within_the_call(scene: Scene) -> None:
    await scene.held()
    for drive in (SECOND, THIRD, Drive()):
        scene.pilot.drive(drive)
    assert scene.driven == [FIRST, SECOND, THIRD, Drive()]


async def test_before_it_is_held_the_newest_command_waits_for_it(scene: Scene) -> None:
    scene.pilot.drive(FIRST)
    scene.pilot.drive(SECOND)
    assert scene.driven == []
    await asyncio.sleep(0.1)
    assert scene.driven == [SECOND]


async def test_a_command_does_not_wait_for_long() -> None:
    scene = Scene(served=False)
    scene.make(BY_HAND).drive(FIRST)
    await asyncio.sleep(STALE_S)
    scene.world.gateway.serve()
    await asyncio.sleep(1.0)
    assert scene.holder == "ann"
    assert scene.driven == []
    await scene.pilot.close()


async def test_a_command_that_waits_is_withdrawn_by_a_stop(scene: Scene) -> None:
    scene.pilot.drive(FIRST)
    scene.pilot.require_neutral("stop")
    with pytest.raises(NeutralFirst, match="stop: centre the joystick first"):
        scene.pilot.drive(SECOND)
    await asyncio.sleep(0.1)
    assert scene.driven == []


async def test_two_pilots_ask_one_after_the_other_and_nothing_goes_by_a_lease_that_is_given_back(scene: Scene) -> None:
    await scene.held()
    scene.pilot.release()
    other = scene.make(BY_MOTION, "bob")
    other.drive(SECOND)
    other.drive(THIRD)
    assert scene.driven == [FIRST], "not by the lease that is given back"
    await asyncio.sleep(0.2)
    assert scene.driven[-1] == THIRD
    assert SECOND not in scene.driven
    assert scene.holder == "bob"
    assert scene.ended == [None]


async def test_motion_during_the_release_acquires_anew(scene: Scene) -> None:
    await scene.held()
    scene.pilot.release()
    scene.pilot.drive(SECOND)
    await asyncio.sleep(0.2)
    assert (scene.holder, scene.driven[-1]) == ("ann", SECOND)


@pytest.mark.parametrize("drive", [FIRST, Drive()])
async def test_silence_releases_the_robot_in_its_time(scene: Scene, drive: Drive) -> None:
    await scene.held()
    scene.pilot.drive(drive)
    await asyncio.sleep(0.35 if drive.moving else 0.85)
    assert scene.holder == "ann"
    await asyncio.sleep(0.2)
    assert scene.holder is None
    assert scene.ended == [None]
    assert (scene.pilot.stick.needs_neutral is not None) == drive.moving


async def test_a_command_that_the_robot_refuses_ends_the_lease_and_is_not_tried_again(scene: Scene) -> None:
    await scene.held()
    scene.world.machine.refusal = "no legs"
    scene.pilot.drive(SECOND)
    scene.world.machine.refusal = None
    await asyncio.sleep(0.1)  # the refusal is shown
    scene.pilot.drive(THIRD)
    await asyncio.sleep(0.5)
    assert scene.driven[-1] != THIRD
    assert [str(error).endswith("no legs") for error in scene.ended] == [True]
    assert scene.holder is None
    with pytest.raises(NeutralFirst, match="no legs"):
        scene.pilot.drive(THIRD)


async def test_a_lease_that_is_kept_outlasts_a_refusal_which_is_raised(scene: Scene) -> None:
    scene.make(BY_HAND)
    await scene.held()
    scene.world.machine.refusal = "no legs"
    scene.pilot.drive(SECOND)
    scene.world.machine.refusal = None
    await asyncio.sleep(0.1)
    with pytest.raises(NotReady, match="no legs"):
        scene.pilot.drive(THIRD)
    scene.pilot.drive(THIRD)
    assert (scene.driven[-1], scene.holder, scene.ended) == (THIRD, "ann", [])


async def test_a_lease_that_is_kept_outlasts_the_deadman_and_then_neutral_is_needed(scene: Scene) -> None:
    scene.make(BY_HAND)
    await scene.held()
    await asyncio.sleep(0.6)
    with pytest.raises(NeutralFirst, match="deadman"):
        scene.pilot.drive(SECOND)
    scene.pilot.drive(Drive())
    scene.pilot.drive(SECOND)
    assert scene.driven == [FIRST, Drive(), SECOND]


async def test_neutral_that_the_gateway_demands_is_demanded_of_the_stick(scene: Scene) -> None:
    scene.make(BY_HAND)
    await scene.held()
    scene.world.gateway.enforcer.require_neutral("the link stalled", StopCause.LINK_STALLED, stops=True)
    scene.pilot.drive(SECOND)
    await asyncio.sleep(0.1)
    with pytest.raises(NeutralFirst, match="send a neutral drive first"):
        scene.pilot.drive(SECOND)
    with pytest.raises(NeutralFirst, match="motion was refused: centre the joystick first"):
        scene.pilot.drive(SECOND)
    scene.pilot.drive(Drive())
    scene.pilot.drive(THIRD)
    assert scene.driven == [FIRST, Drive(), THIRD]


async def test_the_lease_is_taken_without_motion_and_kept_while_the_stick_rests(scene: Scene) -> None:
    scene.make(BY_HAND).take()
    scene.pilot.take()
    await asyncio.sleep(60.0)
    assert (scene.holder, scene.driven, len(scene.world.gateway.questions("acquire"))) == ("ann", [], 1)


@pytest.mark.parametrize("rules", [BY_MOTION, BY_HAND])
async def test_a_lease_that_is_lost_is_told_once_and_nothing_is_sent_by_it(scene: Scene, rules: StickRules) -> None:
    scene.make(rules)
    await scene.held()
    await scene.world.others.stop()
    driven = len(scene.driven)
    with contextlib.suppress(NeutralFirst):
        scene.pilot.drive(SECOND)
    await asyncio.sleep(0.3)
    with pytest.raises(NeutralFirst, match="the lease has ended"):
        scene.pilot.drive(SECOND)
    assert len(scene.driven) == driven
    assert [type(error) for error in scene.ended] == [LeaseLost]


async def test_a_lease_that_is_not_granted_is_told_once(scene: Scene) -> None:
    async with scene.world.others.control("bob"):
        scene.pilot.drive(FIRST)
        await asyncio.sleep(0.1)
        assert "r1 is held by bob" in str(scene.ended)
        with pytest.raises(NeutralFirst, match="r1 is held by bob"):
            scene.pilot.drive(FIRST)
    assert len(scene.ended) == 1


async def test_a_bus_that_breaks_under_a_command_ends_the_lease(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    await scene.held()

    def broken(*_: object) -> bool:
        raise OSError("no bus")

    monkeypatch.setattr(scene.driver, "now", broken)
    scene.pilot.drive(SECOND)
    await asyncio.sleep(0.5)
    assert len(scene.ended) == 1
    assert "no bus" in str(scene.ended)
    assert scene.holder is None


async def test_a_mode_keeps_the_lease_and_drives_do_not_overtake_it(scene: Scene) -> None:
    mode = asyncio.ensure_future(scene.pilot.set_mode("manual"))
    scene.pilot.drive(FIRST)
    scene.pilot.drive(SECOND)
    await mode
    await asyncio.sleep(0.1)
    assert scene.world.machine.commands == [("mode", Mode("manual")), ("drive", SECOND)]
    scene.pilot.drive(Drive())
    await asyncio.sleep(60.0)
    assert (scene.holder, scene.pilot.mode) == ("ann", "manual")
    await scene.pilot.set_mode("none")
    await asyncio.sleep(1.2)
    assert (scene.holder, scene.ended) == (None, [None])


async def test_single_motors_are_moved_by_the_lease_and_need_neutral_as_drives_do(scene: Scene) -> None:
    scene.make(BY_HAND)
    scene.pilot.motor("left wheel", 2.0)
    await asyncio.sleep(0.1)
    scene.pilot.motor("left wheel", 0.0)
    scene.pilot.require_neutral("stop")
    with pytest.raises(NeutralFirst, match="stop"):
        scene.pilot.motor("left wheel", 2.0)
    scene.pilot.rest()
    scene.pilot.motor("lift", 0.1)
    moved = [(name, command.value) for name, command in scene.world.machine.commands if isinstance(command, Motor)]
    assert moved == [("motor/left%20wheel", 2.0), ("motor/left%20wheel", 0.0), ("motor/lift", 0.1)]
    assert scene.holder == "ann"


async def test_modes_that_wait_are_bounded_and_end_with_the_lease() -> None:
    scene = Scene(served=False)
    waiting = [asyncio.ensure_future(scene.pilot.set_mode("manual")) for _ in range(8)]
    await asyncio.sleep(0.1)
    with pytest.raises(RateLimited, match="too many changes of the mode"):
        await scene.pilot.set_mode("manual")
    await scene.pilot.close()
    outcomes = await asyncio.gather(*waiting, return_exceptions=True)
    assert {str(outcome) for outcome in outcomes} == {"the robot was released"}
