"""What viewers tell robots of a played fleet: who drives, for how long, and what is refused."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Iterable
from typing import Any

import pytest

from zbridge.errors import BusError, Held, Malformed, NeutralFirst, Refused, Unsupported
from zbridge.fleet.messages import Drive
from zbridge.views.foxglove.commands import DEADMAN_S, PAUSE_S, QUIET_S, RobotCommands
from zbridge.views.foxglove.hub import Hub
from zbridge.views.foxglove.requests import ClientChannel, Scale

pytestmark = pytest.mark.jumping

CMD_VEL = ClientChannel(1, "/r1/cmd_vel", "json", "geometry_msgs/Twist")
STOP = ClientChannel(2, "/r1/stop", "json")


class Driver:
    """Holds a robot; notes what it is told."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.loss: Exception | None = None
        self.lost = asyncio.Event()

    def now(self, drive: Drive, topic: object) -> bool:
        self._robot.done.append((drive.forward, drive.left, drive.turn))
        return True

    async def mode(self, mode: str) -> None:
        if self._robot.refuses is not None:
            raise self._robot.refuses
        self._robot.done.append(("mode", mode))

    def lose(self, loss: Exception) -> None:
        self.loss = loss
        self.lost.set()


class Robot:
    """One robot. refuses: what it answers to everything; grants: lets the lease be had."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.done: list[Any] = []
        self.drivers: list[str] = []
        self.driver: Driver | None = None
        self.refuses: Exception | None = None
        self.grants = asyncio.Event()
        self.grants.set()

    @contextlib.asynccontextmanager
    async def control(self, who: str, *, name: str, deadman_s: float, wait_s: float) -> AsyncIterator[Driver]:
        assert (name, deadman_s) == ("foxglove", DEADMAN_S)
        await self.grants.wait()
        if self.refuses is not None:
            raise self.refuses
        self.drivers.append(who)
        self.driver = Driver(self)
        try:
            yield self.driver
        finally:
            self.driver = None

    async def unlatch(self) -> None:
        self.done.append("unlatch")

    async def set_light(self, on: bool) -> None:
        self.done.append(("light", on))

    async def set_lidar(self, on: bool) -> None:
        self.done.append(("lidar", on))

    async def set_camera(self, on: bool) -> None:
        self.done.append(("camera", on))


class PlayedFleet:
    """Two robots, and what all of them were told. outcome: of each robot."""

    def __init__(self) -> None:
        self.robots = {name: Robot(name) for name in ("r1", "r2")}
        self.done: list[tuple[Any, ...]] = []
        self.outcome: Refused | BusError | None = None
        self.answers = asyncio.Event()
        self.answers.set()

    def __getitem__(self, name: str) -> Robot:
        return self.robots[name]

    async def stop(self, names: Iterable[str] | None = None) -> dict[str, Any]:
        self.done.append(("stop", names))
        await self.answers.wait()
        return {"r1": self.outcome}

    async def latch(self, names: Iterable[str] | None, reason: str | None) -> dict[str, Any]:
        self.done.append(("latch", names, reason))
        return {"r1": self.outcome}

    async def unlatch(self) -> dict[str, Any]:
        self.done.append(("unlatch",))
        return {"r1": self.outcome}


class Viewer:
    def __init__(self, name: str = "foxglove.ann.1", *, may_drive: bool = True) -> None:
        self.name, self.may_drive = name, may_drive
        self.said: list[Any] = []
        self.warned: list[str] = []
        self.changed: dict[str, Any] = {}

    def say(self, message: str | bytes) -> None:
        self.said.append(json.loads(message))

    def warn(self, text: str) -> None:
        self.warned.append(text)

    def show(self, subscription: int, message: bytes) -> None:
        """There are no channels."""

    def ended(self, subscription: int) -> None:
        """There are no channels."""

    def parameters_changed(self, values: Any) -> None:
        self.changed.update(values)


class Scene:
    """Two robots, and a viewer that may drive them."""

    def __init__(self) -> None:
        self.hub, self.fleet, self.viewer = Hub(), PlayedFleet(), Viewer()
        self.hub.join(self.viewer)
        scales = {"": Scale(2.0, 4.0), "r2": Scale(1.0, 1.0)}
        self.commands = RobotCommands(self.hub, self.fleet, scales, "foxglove")  # type: ignore[arg-type]
        for name in self.fleet.robots:
            self.commands.robot_came(name)
        self.r1 = self.fleet["r1"]

    def twist(self, forward: float, turn: float = 0.0, viewer: Viewer | None = None) -> None:
        payload = json.dumps({"linear": {"x": forward}, "angular": {"z": turn}}).encode()
        self.commands.published(viewer or self.viewer, CMD_VEL, payload)

    async def call(self, name: str, viewer: Viewer | None = None, **asked: Any) -> None:
        number = {service.name: service.id for service in self.commands.services()}[name]
        payload = json.dumps(asked).encode() if asked else b""
        assert await self.commands.call(viewer or self.viewer, number, payload) == b'{"ok":true}'


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    made = Scene()
    yield made
    made.fleet.answers.set()
    made.r1.grants.set()
    await made.commands.close()
    assert made.r1.driver is None


async def soon() -> None:
    await asyncio.sleep(0.001)


# Driving


async def test_a_robot_with_a_scale_of_its_own_drives_by_it(scene: Scene) -> None:
    channel = ClientChannel(3, "/r2/cmd_vel", "json", "geometry_msgs/Twist")
    scene.commands.published(scene.viewer, channel, b'{"linear":{"x":0.5}}')
    await soon()
    assert scene.fleet["r2"].done == [(0.5, 0.0, 0.0)]


async def test_a_twist_drives_in_the_name_of_the_viewer_and_silence_gives_the_robot_back(scene: Scene) -> None:
    scene.twist(1.0, turn=-1.0)
    await soon()
    assert (scene.r1.drivers, scene.r1.done) == (["foxglove.ann.1"], [(0.5, 0.0, -0.25)])
    for _ in range(5):
        await asyncio.sleep(PAUSE_S - 0.1)
        scene.twist(1.0)
    await soon()
    assert (len(scene.r1.drivers), len(scene.r1.done)) == (1, 6), "one lease"
    await asyncio.sleep(PAUSE_S + 0.01)
    assert scene.r1.driver is None
    scene.twist(0.0)
    await soon()
    assert scene.r1.driver is None, "a zero needs no robot"
    scene.twist(0.5)
    await soon()
    assert len(scene.r1.drivers) == 2


async def test_the_newest_twist_wins_and_one_that_waited_for_the_lease_too_long_moves_nothing(scene: Scene) -> None:
    scene.r1.grants.clear()
    scene.twist(1.0)
    await asyncio.sleep(0.1)
    scene.twist(2.0)
    await soon()
    scene.r1.grants.set()
    await soon()
    assert scene.r1.done == [(1.0, 0.0, 0.0)]
    await asyncio.sleep(2 * PAUSE_S)
    scene.r1.grants.clear()
    scene.twist(1.0)
    await asyncio.sleep(PAUSE_S + 0.1)
    scene.r1.grants.set()
    await soon()
    assert len(scene.r1.done) == 1


async def test_after_a_stop_a_stick_that_is_still_pushed_moves_nothing(scene: Scene) -> None:
    scene.twist(1.0)
    await soon()
    scene.commands.published(scene.viewer, STOP, b"{}")
    with pytest.raises(NeutralFirst, match="r1 was stopped; release the control for a second, then drive"):
        scene.twist(1.0)
    await soon()
    assert scene.fleet.done == [("stop", ["r1"])]
    scene.twist(0.0)
    scene.twist(1.0)
    scene.commands.published(scene.viewer, STOP, b"{}")
    await asyncio.sleep(QUIET_S + 0.1)
    scene.twist(1.0)


@pytest.mark.parametrize("error", [Held("r1 is driven by bob", holder="bob"), BusError("away")])
async def test_why_a_viewer_does_not_get_the_robot_is_told_and_it_owes_a_zero(scene: Scene, error: Exception) -> None:
    scene.r1.refuses = error
    scene.twist(1.0)
    await soon()
    assert scene.viewer.warned == [str(error)]
    with pytest.raises(NeutralFirst, match=str(error)):
        scene.twist(1.0)


async def test_a_fault_of_ours_is_told_too(scene: Scene) -> None:
    scene.r1.refuses = ValueError("what")
    scene.twist(1.0)
    await soon()
    assert "what" in scene.viewer.warned[0]
    scene.r1.refuses = None
    scene.twist(0.0)
    scene.twist(1.0)
    await soon()
    assert scene.r1.driver is not None


async def test_a_lease_that_is_lost_ends_the_drive_at_once(scene: Scene) -> None:
    scene.twist(1.0)
    await soon()
    assert scene.r1.driver is not None
    scene.r1.driver.lose(Held("bob took it over", holder="bob"))
    await soon()
    assert scene.r1.driver is None
    assert scene.viewer.warned == ["bob took it over"]


NOT_DRIVEN: dict[str, tuple[ClientChannel, type[Exception], str]] = {
    "another topic": (ClientChannel(1, "/r1/goal", "json", "x"), Unsupported, "expected /<robot>/cmd_vel or /<robot>/"),
    "no robot": (ClientChannel(1, "/cmd_vel", "json", "x"), Unsupported, "expected /<robot>/cmd_vel"),
    "an unknown robot": (ClientChannel(1, "/r9/cmd_vel", "json", "geometry_msgs/Twist"), Unsupported, "no robot 'r9'"),
    "another encoding": (ClientChannel(1, "/r1/stop", "cdr", "x"), Unsupported, "encoding 'cdr': expected 'json'"),
    "another schema": (
        ClientChannel(1, "/r1/cmd_vel", "json", "x"),
        Unsupported,
        "schema 'x': expected 'geometry_msgs",
    ),
    "no twist": (CMD_VEL, Malformed, "Twist"),
}


@pytest.mark.parametrize("name", NOT_DRIVEN)
async def test_what_is_no_twist_for_a_robot_is_refused(scene: Scene, name: str) -> None:
    channel, kind, told = NOT_DRIVEN[name]
    with pytest.raises(kind, match=told):
        scene.commands.published(scene.viewer, channel, b"{")
    await soon()
    assert (scene.r1.drivers, scene.fleet.done) == ([], [])


async def test_the_end_of_a_channel_and_of_a_viewer_gives_the_robot_back(scene: Scene) -> None:
    scene.twist(1.0)
    await soon()
    scene.commands.unpublished(scene.viewer, STOP)
    await soon()
    assert scene.r1.driver is not None, "the channel of stops drives nothing"
    scene.commands.unpublished(scene.viewer, CMD_VEL)
    await soon()
    assert scene.r1.driver is None
    scene.twist(1.0)
    await soon()
    await scene.commands.left(Viewer())
    assert scene.r1.driver is not None, "another one has left"
    await scene.commands.left(scene.viewer)
    assert scene.r1.driver is None


# Stops


async def test_anybody_may_stop_and_latch_and_only_drivers_do_the_rest(scene: Scene) -> None:
    looking = Viewer("foxglove.bob.2", may_drive=False)
    scene.commands.published(looking, STOP, b"")
    await soon()
    for name in ("/r1/stop", "/stop"):
        await scene.call(name, looking)
    await scene.call("/r1/latch", looking, reason="smoke")
    await scene.call("/latch", looking, reason=7)
    assert scene.fleet.done == [
        ("stop", ["r1"]),
        ("stop", ["r1"]),
        ("stop", ["r1", "r2"]),
        ("latch", ["r1"], "smoke"),
        ("latch", None, None),
    ]
    for name in ("/r1/unlatch", "/unlatch", "/r1/light", "/r1/mode"):
        with pytest.raises(Unsupported, match="you may look and stop, not drive"):
            await scene.call(name, looking, on=True, mode="manual")
    with pytest.raises(Unsupported, match="you may look and stop, not drive"):
        scene.twist(1.0, viewer=looking)
    assert scene.r1.done == []
    await scene.call("/r1/unlatch")
    await scene.call("/unlatch")
    assert (scene.r1.done, scene.fleet.done[-1]) == (["unlatch"], ("unlatch",))


async def test_a_stop_that_is_not_confirmed_is_told_to_who_asked(scene: Scene) -> None:
    scene.fleet.outcome = BusError("no answer of r1")
    for name in ("/r1/stop", "/stop", "/latch", "/unlatch"):
        with pytest.raises(BusError, match="no answer of r1"):
            await scene.call(name)
    scene.commands.published(scene.viewer, STOP, b"")
    await soon()
    assert scene.viewer.warned == ["no answer of r1"]


async def test_stops_that_come_while_one_is_on_its_way_are_one_more(scene: Scene) -> None:
    scene.fleet.answers.clear()
    for _ in range(50):
        scene.commands.published(scene.viewer, STOP, b"")
    await soon()
    assert len(scene.fleet.done) == 1
    scene.fleet.answers.set()
    await soon()
    assert len(scene.fleet.done) == 2
    scene.commands.published(scene.viewer, STOP, b"")
    await soon()
    assert len(scene.fleet.done) == 3


@pytest.mark.parametrize("name", ["/r1/latch", "/latch", "/r1/stop", "/stop"])
async def test_who_drives_a_robot_that_is_stopped_owes_a_zero(scene: Scene, name: str) -> None:
    scene.twist(1.0)
    await soon()
    await scene.call(name)
    with pytest.raises(NeutralFirst):
        scene.twist(1.0)


async def test_the_stop_of_another_robot_costs_a_driver_nothing(scene: Scene) -> None:
    scene.twist(1.0)
    await soon()
    await scene.call("/r2/stop")
    scene.twist(1.0)


# Services and parameters


async def test_switches_are_called_and_set_and_their_values_told(scene: Scene) -> None:
    for what in ("light", "lidar", "camera"):
        await scene.call(f"/r1/{what}", on=True)
        await scene.commands.set_parameter(scene.viewer, f"r1.{what}", False)
        assert scene.viewer.changed[f"r1.{what}"] is False
    assert scene.r1.done == [(what, on) for what in ("light", "lidar", "camera") for on in (True, False)]
    assert scene.commands.parameters(("r1.light", "r9.light")) == {"r1.light": False}
    assert len(scene.commands.parameters(())) == 10


async def test_a_parameter_stops_a_robot_when_it_is_true(scene: Scene) -> None:
    await scene.commands.set_parameter(scene.viewer, "r1.stop", False)
    assert scene.fleet.done == []
    await scene.commands.set_parameter(scene.viewer, "r1.stop", True)
    assert scene.fleet.done == [("stop", ["r1"])]


async def test_what_is_no_service_parameter_or_value_is_refused(scene: Scene) -> None:
    with pytest.raises(Unsupported, match="there is no service 999"):
        await scene.commands.call(scene.viewer, 999, b"")
    number = {service.name: service.id for service in scene.commands.services()}["/r1/light"]
    with pytest.raises(Malformed, match="/r1/light"):
        await scene.commands.call(scene.viewer, number, b"[")
    nested: list[Any] = []
    for _ in range(5000):  # Python 3.13 reads as many
        nested = [nested]
    for value in (1, None, "on", [], {}, nested, "x" * 1000):
        with pytest.raises(Malformed, match=r"light = .*: expected one of True, False") as raised:
            await scene.commands.set_parameter(scene.viewer, "r1.light", value)
        assert len(str(raised.value)) < 100
    with pytest.raises(Malformed, match="mode = 'fast': expected one of 'none', 'manual', 'autonomous'"):
        await scene.commands.set_parameter(scene.viewer, "r1.mode", "fast")
    for name, told in (("r1.speed", "no such parameter"), ("r9.light", "no robot 'r9'"), ("light", "no robot ''")):
        with pytest.raises(Unsupported, match=told):
            await scene.commands.set_parameter(scene.viewer, name, True)


async def test_the_services_and_parameters_of_a_robot_come_and_go_with_it(scene: Scene) -> None:
    offered = [each["name"] for said in scene.viewer.said for each in said.get("services", ())]
    assert {"/r1/stop", "/r1/latch", "/r1/unlatch", "/r1/light", "/r1/mode"} < set(offered)
    assert scene.viewer.changed["r1.mode"] == "none"
    gone = {service.id for service in scene.commands.services() if service.name.startswith("/r1/")}
    scene.commands.robot_left("r1")
    assert (scene.viewer.said[-1]["op"], set(scene.viewer.said[-1]["serviceIds"])) == ("unadvertiseServices", gone)
    assert not any(service.name.startswith("/r1/") for service in scene.commands.services())
    assert "/stop" in {service.name for service in scene.commands.services()}
    scene.viewer.changed.clear()
    scene.commands.noted("r1", "light", True)
    assert (scene.viewer.changed, scene.commands.parameters(("r1.light",))) == ({}, {})
    scene.commands.noted("r2", "light", False)
    assert scene.viewer.changed == {}, "as it was"


# Modes


async def test_a_mode_holds_the_robot_until_it_is_none_again(scene: Scene) -> None:
    await scene.call("/r1/mode", mode="manual")
    assert scene.viewer.changed["r1.mode"] == "manual"
    await asyncio.sleep(100.0)
    assert scene.r1.driver is not None
    await scene.call("/r1/mode", mode="none")
    await asyncio.sleep(PAUSE_S + 0.01)
    assert scene.r1.driver is None
    assert scene.r1.done == [("mode", "manual"), ("mode", "none")]
    assert scene.viewer.changed["r1.mode"] == "none"


async def test_a_robot_that_another_viewer_drives_is_not_set_to_a_mode(scene: Scene) -> None:
    scene.twist(1.0)
    await soon()
    other = Viewer("foxglove.bob.2")
    with pytest.raises(Held, match=r"r1 is driven by foxglove\.ann\.1"):
        await scene.call("/r1/mode", other, mode="manual")
    await scene.call("/r1/mode", mode="manual")
    await scene.commands.left(scene.viewer)
    assert scene.viewer.changed["r1.mode"] == "none", "the mode ends with the lease"
    await scene.call("/r1/mode", other, mode="manual")
    assert scene.r1.drivers == ["foxglove.ann.1", "foxglove.bob.2"]


async def test_a_mode_that_is_refused_is_told_and_leaves_none(scene: Scene) -> None:
    scene.r1.refuses = Unsupported("this robot has no modes")
    with pytest.raises(Unsupported, match="no modes"):
        await scene.call("/r1/mode", mode="manual")
    assert scene.commands.parameters(("r1.mode",)) == {"r1.mode": "none"}
