"""What the enforcer does in time: a robot whose gateway was frozen is stopped before anything else is written."""

from __future__ import annotations

import time
from typing import Any

import pytest

from tests.client import Machine
from tests.proofs import numbered
from zbridge.bus.fake import FakeBus
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.conditions import Conditions
from zbridge.control.context import RobotContext
from zbridge.control.enforcer import Enforcer
from zbridge.control.faults import Faults
from zbridge.control.motion_limits import MotionLimits
from zbridge.control.standstill import Standstill
from zbridge.errors import NeutralFirst, TooFast
from zbridge.fleet.messages import Acquire, Drive, FleetMessage, Mode, Raw, Text
from zbridge.fleet.topics import KeySpace, Topic
from zbridge.metrics import Metrics

PATH = "@cmd/drive"
DEADMAN_S = 0.5
FORWARD = Drive(forward=1.0)


class Rig:
    def __init__(self, limits: MotionLimits | None = None) -> None:
        self.now = 100.0
        self.machine = Machine()
        self.shown: list[FleetMessage] = []
        self.metrics = Metrics()
        self.authority = Authority(3.0, DEADMAN_S, numbered())
        context = RobotContext(
            self.machine,
            KeySpace("fleet", "r1"),
            FakeBus(),
            self.metrics,
            Conditions(),
            Faults("r1"),
            publish=self._publish,
            pump=lambda: None,
            clock=lambda: self.now,
            clock_ns=time.time_ns,
        )
        standstill = Standstill(context, self.authority, 0.0)
        self.enforcer = Enforcer(context, self.authority, standstill, Audit("r1", lambda line: None), limits)
        assert self.authority.acquire(Acquire(who="a"), self.now).ok
        self.enforcer.settle()

    def _publish(self, topic: Topic, message: FleetMessage) -> None:
        self.shown.append(message)

    def drive(self) -> None:
        permitted = self.enforcer.permit(FORWARD, self.now)
        self.enforcer.moved(PATH, permitted, self.now, moving=permitted.moving)
        self.enforcer.settle()


@pytest.fixture
async def rig() -> Any:
    made = Rig()
    yield made
    made.enforcer.close()


@pytest.fixture
async def limited() -> Any:
    made = Rig(MotionLimits(rate_hz=1.0))
    yield made
    made.enforcer.close()


async def test_keeping_time_before_the_deadline_asks_nothing_of_the_authority(rig, monkeypatch) -> None:
    rig.drive()
    monkeypatch.setattr(rig.authority, "expire", pytest.fail)
    rig.now += DEADMAN_S - 0.01
    rig.enforcer.keep_time()
    assert rig.machine.stops == 0


async def test_a_gateway_frozen_past_the_deadman_stops_the_robot_before_it_writes_anything(rig: Rig) -> None:
    rig.drive()
    rig.now += DEADMAN_S + 1.0
    rig.enforcer.keep_time()
    assert rig.machine.stops == 1
    with pytest.raises(NeutralFirst):
        rig.enforcer.permit(FORWARD, rig.now)


async def test_motion_that_was_stopped_while_it_was_written_is_not_counted_as_motion(rig: Rig) -> None:
    rig.enforcer.hold_back("the robot's link took nothing", stops=True)
    with pytest.raises(NeutralFirst):
        rig.enforcer.moved(PATH, FORWARD, rig.now, moving=True)
    assert not rig.authority.moving


async def test_limits_refuse_what_comes_too_often_and_without_limits_nothing_is(limited: Rig, rig: Rig) -> None:
    for _ in range(10):
        rig.drive()
    limited.drive()
    limited.drive()
    with pytest.raises(TooFast):
        limited.drive()


async def test_a_stop_ends_the_lease_and_is_counted_and_shown(rig: Rig) -> None:
    rig.drive()
    rig.enforcer.stop_commanded()
    assert (rig.machine.stops, rig.authority.state) == (1, "stopped")
    assert rig.metrics.count("control", what="stopped").value == 1
    assert rig.shown[-1].state == "stopped"  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("command", "moves"),
    [(Raw(id=21, body=b""), True), (Mode("autonomous"), True), (Mode("manual"), False), (Text("hi"), False)],
    ids=lambda value: type(value).__name__,
)
async def test_what_may_move_a_robot_by_itself_is_noted(command: FleetMessage, moves: bool) -> None:
    rig = Rig()
    rig.enforcer.commanded(command)
    assert rig.authority.moving is moves
