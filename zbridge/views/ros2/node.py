"""One robot as a node of ROS: its topics, worked for only while somebody listens; its services, and its cmd_vel."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterable
from functools import partial

from zbridge.bus import Bus, Handle, Sample
from zbridge.client import Fleet
from zbridge.fleet import topics
from zbridge.fleet.messages import Devices, FleetMessage
from zbridge.fleet.topics import KeySpace, is_concrete
from zbridge.ros2.rmw_zenoh import LATCHED, Kind
from zbridge.views.live_robots import OnDemandSubscriptions, read_payload
from zbridge.views.ros2.outlets import Outlet, RosSide
from zbridge.views.ros2.pictures import TOPICS, RosPictures, RosTopic
from zbridge.views.ros2.services import Services
from zbridge.views.ros2.settings import RobotBody
from zbridge.views.ros2.teleop import NAME, Teleop

NODE = "zbridge"
"""The name of each robot's node, in the robot's namespace."""
DIAGNOSED_S = 1.0
"""Seconds between two diagnostics."""
_FIXED = frozenset(topic.name for topic in TOPICS)
"""The topics that every robot has; the others are those of its sensors."""


class RobotNode:
    """Declares one robot on ROS's side. bus: the fleet's. own: the name in our certificate for it; None: we have none.

    drive: whether to subscribe to cmd_vel, and so to drive the robot.
    """

    def __init__(
        self, side: RosSide, bus: Bus, keys: KeySpace, body: RobotBody, *, drive: bool, own: str | None = None
    ) -> None:
        self.robot = keys.robot
        self._side = side
        self._bus = bus
        self._keys = keys
        self._lock = threading.Lock()
        """Guards ``_pictures`` and ``_listened``: streams come on Zenoh's threads, all else on the event loop's."""
        self._pictures = RosPictures(keys.robot, side.types, body, side.metrics)
        self._malformed = side.metrics.count("ros2_malformed")
        self.node = side.node(f"/{self._pictures.frames.prefix}", NODE)
        self._outlets: dict[str, list[Outlet]] = {}
        self._listened: dict[str, set[Outlet]] = {}
        """The outlets of each topic that somebody listens to; topics without one are left out."""
        self._subscribed = OnDemandSubscriptions(self._subscribe_to)
        self._paths: dict[str, tuple[str, ...]] = {}
        self._timer: asyncio.TimerHandle | None = None
        self._closed = False
        self._handles: list[Handle] = [side.bus.announce(self.node.token())]
        robot = Fleet(bus, keys.realm, own)[keys.robot]
        control_key = keys.key(topics.CONTROL.path)
        self.teleop = Teleop(side, self.node, robot, body, bus, control_key, own or NAME) if drive else None
        self._services = Services(side, self.node, robot, drive=drive, on_stop=self._on_stop)
        self._declare(TOPICS)
        for name, message in self._pictures.fixed(time.time_ns()):
            for outlet in self._outlets[name]:
                outlet.put(message)
        self._handles.append(bus.subscribe(keys.key(topics.DEVICES.path), self._on_devices, history=True))

    def __repr__(self) -> str:
        return f"<RobotNode {self.node.full_name}, {sorted(self._listened)}>"

    async def close(self) -> None:
        """Give the robot back, and take everything back that was declared; idempotent."""
        self._closed = True
        if self._timer is not None:
            self._timer.cancel()
        outlets = [outlet for of_topic in self._outlets.values() for outlet in of_topic]
        for handle in (*self._handles, *outlets):
            handle.close()
        self._subscribed.need(set())
        self._services.close()
        if self.teleop is not None:
            await self.teleop.close()

    def _declare(self, ros_topics: Iterable[RosTopic]) -> None:
        for topic in ros_topics:
            if topic.name in self._outlets:
                continue
            names = [f"{self.node.namespace}/{topic.name}"] + ([f"/{topic.name}"] if topic.everywhere else [])
            self._paths[topic.name] = topic.paths
            self._outlets[topic.name] = [self._outlet(topic, name) for name in names]

    def _outlet(self, topic: RosTopic, name: str) -> Outlet:
        endpoint = self._side.endpoint(self.node, Kind.PUBLISHER, name, topic.type_name, topic.qos)
        kept = topic.qos.depth if topic.qos == LATCHED else 0
        return Outlet(self._side, endpoint, partial(self._on_listened, topic.name), kept=kept)

    # On demand

    def _on_listened(self, name: str, outlet: Outlet, anybody: bool) -> None:
        if self._closed or outlet not in self._outlets.get(name, ()):  # it was told of before it was closed
            return
        with self._lock:
            listened = self._listened.setdefault(name, set())
            (listened.add if anybody else listened.discard)(outlet)
            if not listened:
                del self._listened[name]
        self._subscribe()
        if name == "diagnostics" and anybody and self._timer is None:
            self._diagnose()

    def _subscribe(self) -> None:
        """Subscribe on the fleet's bus to what the topics that are listened to need, and to nothing else."""
        self._subscribed.need({path for name in self._listened for path in self._paths[name]})

    def _subscribe_to(self, path: str) -> Handle:
        topic = topics.find(path) if is_concrete(path) else None
        history = topic is not None and topic.qos.keeps_last
        return self._bus.subscribe(self._keys.key(path), self._receive, history=history, direct=not history)

    def _receive(self, sample: Sample) -> None:
        path = self._keys.path(sample.key)
        topic = topics.find(path)
        if topic is None:
            return
        message: FleetMessage | None = read_payload(
            topic.message, sample.payload, self._malformed, arrays=topic is not topics.SCAN
        )
        if message is None:
            return
        with self._lock:
            listened = self._listened
            pictures = self._pictures.make(path, message, time.time_ns(), listened)
            due = [(made, outlet) for name, made in pictures for outlet in listened.get(name, ())]
        for made, outlet in due:
            outlet.put(made)

    def _on_devices(self, sample: Sample) -> None:
        devices = read_payload(Devices, sample.payload, self._malformed)
        if devices is None or self._closed:
            return
        with self._lock:
            sensors = self._pictures.sensors(devices.devices)
        for name in self._outlets.keys() - {topic.name for topic in sensors} - _FIXED:  # the robot has them no more
            for outlet in self._outlets.pop(name):
                outlet.close()
            with self._lock:
                self._listened.pop(name, None)
            del self._paths[name]
        self._subscribe()
        self._declare(sensors)

    def _diagnose(self) -> None:
        """Tell once a second, while somebody listens."""
        self._timer = None
        if self._closed:
            return
        outlets = self._listened.get("diagnostics")
        if outlets:
            more = [self.teleop.diagnostics()] if self.teleop is not None else []
            with self._lock:
                message = self._pictures.diagnostics(more, time.time_ns())
            for outlet in outlets:
                outlet.put(message)
            self._timer = asyncio.get_running_loop().call_later(DIAGNOSED_S, self._diagnose)

    def _on_stop(self) -> None:
        if self.teleop is not None:
            self.teleop.stopped("the robot was stopped")
