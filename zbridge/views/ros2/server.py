"""Opens both buses, and makes a node of each robot whose gateway lives, until cancelled."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable

from zbridge.app.endpoint import serve_metrics
from zbridge.bus import Bus, BusSettings, open_bus
from zbridge.bus.tls.files import own_name
from zbridge.errors import BusError, ConfigError
from zbridge.fleet.topics import KeySpace
from zbridge.log import Log
from zbridge.metrics import Metrics
from zbridge.ros2.rmw_zenoh import ros_name
from zbridge.ros2.types import types_of
from zbridge.tasks import Tasks
from zbridge.views.live_robots import ROBOTS, watch_robots
from zbridge.views.ros2.node import RobotNode
from zbridge.views.ros2.outlets import RosSide
from zbridge.views.ros2.settings import Ros2Plan

log = Log("zbridge.ros2")

HIDDEN_AFTER_S = 2.0
"""A robot whose gateway is away for less keeps its node."""


async def serve(plan: Ros2Plan, bus: BusSettings, metrics: Metrics, on_ready: Callable[[View], None]) -> None:
    """Show robots until cancelled; raise BusError or ConfigError. on_ready: called when robots are looked for."""
    types = types_of(plan.distro)
    async with contextlib.AsyncExitStack() as stack:
        fleet = await open_bus(bus, metrics, wait_for_peers=True, realm=plan.realm, threads=False)
        stack.push_async_callback(fleet.close)
        try:
            ros = await open_bus(plan.router, metrics.labelled(bus="ros"), timestamps=True, threads=False)
        except BusError as error:
            where = ", ".join(plan.router.connect)
            raise BusError(f"{error}: no ROS router at {where}: `ros2 run rmw_zenoh_cpp rmw_zenohd`") from error
        stack.push_async_callback(ros.close)
        require_two_routers(fleet, ros, plan)
        view = View(plan, fleet, RosSide(ros, plan.domain, types, metrics), own_name(bus.tls))
        stack.push_async_callback(view.close)
        if plan.endpoint is not None:
            await stack.enter_async_context(serve_metrics(plan.endpoint, metrics))
        view.start()
        on_ready(view)
        await asyncio.Event().wait()


def require_two_routers(fleet: Bus, ros: Bus, plan: Ros2Plan) -> None:
    """Raise ConfigError if both sessions are at one router: a fleet's rules do not know ROS's keys."""
    if set(fleet.routers()) & set(ros.routers()) or fleet.zid in ros.routers():
        where = ", ".join(plan.router.connect)
        raise ConfigError(
            f"ros = {where}: the same router as the fleet's. Both default to port 7447: give one another port, "
            "and say where with --ros or --connect"
        )


class View:
    """The robots of a realm as nodes. own: our name on the fleet's bus, if a certificate says one."""

    def __init__(self, plan: Ros2Plan, fleet: Bus, side: RosSide, own: str | None) -> None:
        self._own = own
        self._plan = plan
        self._fleet = fleet
        self._side = side
        self.nodes: dict[str, RobotNode] = {}
        self._leaving: dict[str, asyncio.TimerHandle] = {}
        self._closing = Tasks()
        self._left_out = side.metrics.count("ros2_robots_left_out")

    def __repr__(self) -> str:
        return f"<View of {sorted(self.nodes)}>"

    def start(self) -> None:
        watch_robots(self._fleet, self._plan.realm, self._plan.robots, self._on_gateway)
        self._side.bus.watch_connected(self._on_connected)

    async def close(self) -> None:
        """Give all robots back."""
        for timer in self._leaving.values():
            timer.cancel()
        nodes, self.nodes = list(self.nodes.values()), {}
        await asyncio.gather(*(node.close() for node in nodes), *self._closing.running, return_exceptions=True)

    def _on_connected(self, up: bool) -> None:
        if not up:
            log.warning("ros_router_lost", "ROS's router is gone: robots driven from ROS are stopped")
        for node in self.nodes.values():
            if node.teleop is not None:
                node.teleop.connected(up)

    def _on_gateway(self, robot: str, alive: bool) -> None:
        timer = self._leaving.pop(robot, None)
        if timer is not None:
            timer.cancel()
        if alive and robot not in self.nodes:
            self._show(robot)
        elif not alive and robot in self.nodes:
            self._leaving[robot] = asyncio.get_running_loop().call_later(HIDDEN_AFTER_S, self._hide, robot)

    def _show(self, robot: str) -> None:
        taken = next((node.robot for node in self.nodes.values() if ros_name(node.robot) == ros_name(robot)), None)
        if taken is not None or len(self.nodes) >= ROBOTS:
            self._left_out.value += 1
            why = f"its name in ROS is {taken}'s" if taken is not None else f"more than {ROBOTS} robots"
            log.warning("robot_not_shown", "{robot} is not shown: {reason}", robot=robot, reason=why)
            return
        keys, plan = KeySpace(self._plan.realm, robot), self._plan
        self.nodes[robot] = RobotNode(self._side, self._fleet, keys, plan.body(robot), drive=plan.drive, own=self._own)
        log.info("robot_shown", "{robot} is {node}", robot=robot, node=self.nodes[robot].node.full_name)

    def _hide(self, robot: str) -> None:
        self._leaving.pop(robot, None)
        node = self.nodes.pop(robot, None)
        if node is not None:
            self._closing.start(self._close(node))

    async def _close(self, node: RobotNode) -> None:
        with contextlib.suppress(BusError):
            await node.close()
        log.info("robot_hidden", "{robot} is gone", robot=node.robot)
