"""What the enforcer does in time: a robot whose gateway was frozen is stopped before anything else is written."""

from __future__ import annotations

import asyncio
import contextlib
import time

import pytest

from tests.client import Machine
from tests.fake_bus import FakeBus
from tests.proofs import numbered
from zbridge.bus import Sample
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.context import ProtocolFaults, RobotContext
from zbridge.control.enforcer import SUSPENDED_S, Enforcer
from zbridge.control.events import CommandSender, StopCause
from zbridge.control.faults import OpenFaults
from zbridge.control.motion_limits import MotionLimits
from zbridge.control.settings import LEAST_IDLE_STOP_S
from zbridge.control.standstill import Standstill
from zbridge.errors import NeutralFirst, RateLimited
from zbridge.fleet import payload as payloads
from zbridge.fleet.lease_messages import Acquire
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Motor, Raw, Stop, Text
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics

PATH = "@cmd/drive"
DEADMAN_S = 0.5
FORWARD = Drive(forward=1.0)
LATCHING = payloads.encode(Stop(latch=True, id=bytes(16), who="bob", reason="wet floor"))


class Rig:
    def __init__(self, limits: MotionLimits | None = None, idle_stop_s: float = 0.0) -> None:
        self.now, self.suspended_s = 100.0, 7200.0
        self.machine = Machine()
        self.shown: list[FleetMessage] = []
        self.metrics = Metrics()
        self.authority = Authority(3.0, DEADMAN_S, numbered())
        self.open_faults = open_faults = OpenFaults()
        context = RobotContext(
            self.machine,
            KeySpace("fleet", "r1"),
            FakeBus(),
            self.metrics,
            open_faults,
            ProtocolFaults("r1"),
            publish=lambda topic, message: self.shown.append(message),
            pump=lambda: None,
            clock=lambda: self.now,
            clock_ns=time.time_ns,
            suspended_s=lambda: self.suspended_s,
        )
        self.standstill = Standstill(context, self.authority, idle_stop_s)
        self.enforcer = Enforcer(context, self.authority, self.standstill, Audit("r1", lambda line: None), limits)
        assert self.authority.acquire(Acquire(who="a"), self.now).ok
        self.enforcer.settle()

    def drive(self) -> Drive | Motor:
        """Drive at full speed; return what the robot was told."""
        permitted = self.enforcer.permit(FORWARD, self.now)
        self.enforcer.moved(PATH, permitted, self.now, CommandSender("a", self.now), moving=permitted.moving)
        self.enforcer.settle()
        return permitted


async def test_a_gateway_frozen_past_the_deadman_stops_the_robot_before_it_writes_anything(monkeypatch) -> None:
    rig = Rig()
    rig.drive()
    with monkeypatch.context() as patch:
        patch.setattr(rig.authority, "expire", pytest.fail)
        rig.now += DEADMAN_S - 0.01
        rig.enforcer.keep_time()  # nothing is due: the authority is not asked
    rig.now += 1.0
    rig.enforcer.keep_time()
    assert rig.machine.stops == 1
    with pytest.raises(NeutralFirst):
        rig.enforcer.permit(FORWARD, rig.now)


async def test_a_robot_learns_whether_somebody_ordered_its_stop(monkeypatch) -> None:
    rig, asked = Rig(), []
    monkeypatch.setattr(rig.machine, "stop", lambda now, until: asked.append("stop"))
    monkeypatch.setattr(rig.machine, "rest", lambda now, until: asked.append("rest"))
    rig.standstill.stop(ordered=False)  # as for a new connection
    rig.drive()
    rig.now += DEADMAN_S + 0.1
    rig.enforcer.keep_time()
    rig.enforcer.stop_commanded(Sample("fleet/r1/@cmd/stop", b""))
    rig.enforcer.stop_commanded(Sample("fleet/r1/@cmd/stop", LATCHING))
    rig.standstill.stop(ordered=False)  # a latch is in force
    assert asked == ["rest", "rest", "stop", "stop", "stop"]


@pytest.mark.parametrize("latched", [False, True])
async def test_a_robot_that_nobody_drives_is_stopped_by_order_while_a_latch_is_in_force(monkeypatch, latched) -> None:
    rig, asked = Rig(idle_stop_s=LEAST_IDLE_STOP_S), []
    if latched:
        rig.enforcer.stop_commanded(Sample("fleet/r1/@cmd/stop", LATCHING))
        rig.now += 10.0
    monkeypatch.setattr(rig.machine, "stop", lambda now, until: asked.append("stop"))
    monkeypatch.setattr(rig.machine, "rest", lambda now, until: asked.append("rest"))
    rig.standstill.begin()
    await asyncio.sleep(LEAST_IDLE_STOP_S * 1.5)
    rig.standstill.close()
    assert asked == ["stop" if latched else "rest"]


@pytest.mark.parametrize("cause", ["deadman", "latch"])
async def test_a_robot_is_stopped_before_anything_hears_of_the_fault(cause: str) -> None:
    rig, heard = Rig(), []
    rig.drive()

    def occurred(code: str, text: str) -> None:
        heard.append((code, rig.machine.stops))
        raise OSError("the black box fails")

    rig.open_faults.occurred = occurred
    with contextlib.suppress(OSError):
        if cause == "deadman":
            rig.now += DEADMAN_S + 0.1
            rig.enforcer.keep_time()
        else:
            rig.enforcer.stop_commanded(Sample("fleet/r1/@cmd/stop", LATCHING))
    assert heard == [("deadman" if cause == "deadman" else "latched", 1)]


async def test_a_machine_that_was_suspended_stops_its_robot_and_ends_the_lease_before_anything_is_read() -> None:
    rig = Rig()
    rig.drive()
    rig.suspended_s += SUSPENDED_S / 2  # within what two readings of clocks may differ by
    rig.enforcer.keep_time()
    assert (rig.machine.stops, rig.authority.state) == (0, "held")
    rig.suspended_s += 3600.0
    rig.enforcer.keep_time()
    assert (rig.machine.stops, rig.authority.state) == (1, "stopped")
    rig.enforcer.keep_time()
    assert rig.machine.stops == 1, "once"


async def test_motion_that_was_stopped_while_it_was_written_is_not_counted_as_motion() -> None:
    rig = Rig()
    rig.enforcer.require_neutral("the robot's link stalled", StopCause.LINK_STALLED, stops=True)
    with pytest.raises(NeutralFirst):
        rig.enforcer.moved(PATH, FORWARD, rig.now, CommandSender("a", rig.now), moving=True)
    assert not rig.authority.motion.moving


async def test_limits_refuse_what_comes_too_often_and_slow_what_grows_too_fast_from_what_was_sent() -> None:
    rig = Rig()
    assert [rig.drive() for _ in range(10)] == [FORWARD] * 10, "without limits nothing is refused"
    rig = Rig(MotionLimits(rate_hz=4.0, slew_per_s=1.0))
    told = []
    for _ in range(2):
        told.append(rig.drive())
        rig.now += 0.25
    assert told == [Drive(forward=0.25), Drive(forward=0.5)]
    assert rig.metrics.count("drives_slowed").value == 2
    rig.enforcer.stop("stop", StopCause.COMMAND)
    rig.authority.acquire(Acquire(who="a"), rig.now)
    assert rig.drive() == Drive(forward=0.25), "a robot that was stopped begins from standing"
    rig.drive()
    with pytest.raises(RateLimited):
        rig.drive()


async def test_a_stop_ends_the_lease_and_is_counted_and_shown_and_the_next_one_is_folded() -> None:
    rig = Rig()
    rig.drive()
    rig.enforcer.stop_commanded(Sample("fleet/r1/@cmd/stop", b""))
    assert (rig.machine.stops, rig.authority.state) == (1, "stopped")
    assert rig.metrics.count("stops", cause="command").value == 1
    assert rig.shown[-1].state == "stopped"  # type: ignore[attr-defined]
    assert rig.enforcer.admission("fleet/r1/@cmd/stop", None, 0, bytes) is None


@pytest.mark.parametrize(
    ("command", "moves"),
    [(Raw(id=21, body=b""), True), (Mode("autonomous"), True), (Mode("manual"), False), (Text("hi"), False)],
    ids=["raw", "autonomous", "manual", "text"],
)
async def test_what_may_move_a_robot_by_itself_is_noted(command: FleetMessage, moves: bool) -> None:
    rig = Rig()
    rig.enforcer.commanded(command)
    assert rig.authority.motion.moving is moves


async def test_after_its_end_nothing_that_still_arrives_sets_a_timer() -> None:
    scene = Rig()
    scene.enforcer.close()
    scene.shown.clear()
    scene.enforcer.authority.refuse("drive", NeutralFirst("the gateway has ended"), "a")
    scene.enforcer.settle()
    await asyncio.sleep(0.2)
    assert scene.shown == []
