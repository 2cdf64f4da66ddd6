"""The robots of the bus, live: offers their channels, and subscribes on the bus to what viewers subscribed to.

A robot's channels are there while its gateway is. The readings of sensors that nobody announced are found while
somebody looks at the channel ``/<robot>/sensors``, which shows all of them.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Collection, Mapping
from typing import Any

import msgspec

from zbridge.bus import Bus, Handle, Sample
from zbridge.client.fleet_model import FleetModel
from zbridge.errors import BusError
from zbridge.fleet import topics
from zbridge.fleet.messages import Devices, FleetMessage, Reading, Switch
from zbridge.fleet.topics import KeySpace, Topic, split_key, unescape
from zbridge.metrics import Metrics
from zbridge.views.foxglove.commands import RobotCommands
from zbridge.views.foxglove.hub import Hub
from zbridge.views.foxglove.source import ViewerSource
from zbridge.views.live_robots import ROBOTS, OnDemandSubscriptions, read_payload
from zbridge.views.pictures import FoxglovePictures, ViewerChannel, channels_of, sources_of
from zbridge.views.schemas import json_schema

SENSORS = 1024
"""Most sensors of one robot that have a channel."""
_SENSORS = "sensors"
_ALL_SENSORS = "sensor/*"
_OFFERED = tuple(
    topic.path
    for topic in vars(topics).values()
    if isinstance(topic, Topic) and topic.delivery in (topics.Delivery.STREAM, topics.Delivery.STATE)
)
"""The paths that every robot may have."""
_SWITCHES = (topics.LIDAR, topics.CAMERA)
"""What robots tell of their parameters."""
_ASK_S = 0.3


class NamedReading(Reading, frozen=True):
    """A reading, and the name of its sensor."""

    sensor: str = ""


class _Shown:
    """One robot that is shown: its pictures, and what is subscribed to on the bus for it."""

    def __init__(self, keys: KeySpace, subscribe: Callable[[_Shown, str], Handle]) -> None:
        self.keys = keys
        self.pictures = FoxglovePictures(keys.robot)
        self.offered: dict[str, ViewerChannel] = {}
        self.wanted: set[str] = set()
        """Paths of the channels that somebody subscribed to."""
        self.subscribed = OnDemandSubscriptions(lambda source: subscribe(self, source))
        self.sensors = 0


class LiveSource(ViewerSource):
    """Shows the robots of a realm. robots: names of those that are shown, empty for all."""

    def __init__(
        self, hub: Hub, bus: Bus, realm: str, robots: frozenset[str], commands: RobotCommands, metrics: Metrics
    ) -> None:
        super().__init__(hub, commands)
        self.capabilities = ("clientPublish", "services", "parameters", "parametersSubscribe")
        self._bus = bus
        self._realm = realm
        self._robots = robots
        self._commands = commands
        self._shown: dict[str, _Shown] = {}
        self._handles: list[Handle] = []
        self._watching: list[Handle] = []
        self._watchers = 0
        self._malformed = metrics.count("foxglove_malformed")
        self._model = FleetModel(bus, realm, self._on_robot, malformed=self._malformed)
        self._left_out = metrics.count("foxglove_channels_left_out")
        hub.on_wanted = self._on_wanted

    def __repr__(self) -> str:
        return f"<LiveSource {self._realm}, {len(self._shown)} robots>"

    def start(self) -> None:
        self._handles = [
            self._bus.subscribe(f"{self._realm}/*/{topics.DEVICES.path}", self._on_devices, history=True),
        ]
        self._model.open()

    async def close(self) -> None:
        """End all that is held and declared; idempotent."""
        handles, self._handles, self._watching = [*self._handles, *self._watching], [], []
        self._model.close()
        for handle in handles:
            handle.close()
        for name in list(self._shown):
            self._hide(name)
        await self._commands.close()

    # Robots come and go

    def _on_robot(self, name: str) -> None:
        """Show or hide a robot as the model of the fleet has it; warn of what is wrong with it."""
        robot = self._model.robots[name]
        if robot.alive and name not in self._shown and (not self._robots or name in self._robots):
            if len(self._shown) >= ROBOTS:
                self._left_out.value += 1
                return
            self._show(name)
        elif not robot.alive and name in self._shown:
            self._hide(name)
        if name in self._shown:
            self.hub.warn(f"latched.{name}", f"{name}: {robot.stopped_by}" if robot.stopped_by else None)
            self.hub.warn(f"state.{name}", f"{name}: {robot.missing}" if robot.missing else None)

    def _show(self, name: str) -> None:
        self._shown[name] = shown = _Shown(KeySpace(self._realm, name), self._subscribe)
        channels = {channel.path: channel for path in _OFFERED for channel in channels_of(name, path)}
        channels[_SENSORS] = ViewerChannel(f"/{name}/{_SENSORS}", _SENSORS, json_schema(NamedReading))
        self._offer(shown, channels.values())
        self._commands.robot_came(name)

    def _hide(self, name: str) -> None:
        shown = self._shown[name]
        self._commands.robot_left(name)
        self.hub.warn(f"latched.{name}", None)
        self.hub.warn(f"state.{name}", None)
        self.hub.withdraw([channel.topic for channel in shown.offered.values()])
        del self._shown[name]
        shown.subscribed.need(set())

    def _offer(self, shown: _Shown, channels: Collection[ViewerChannel]) -> None:
        shown.offered.update((channel.path, channel) for channel in channels)
        self._left_out.value += self.hub.offer(channels)

    def _on_devices(self, sample: Sample) -> None:
        """Offer a channel for each sensor that a robot announces."""
        shown = self._shown.get(sample.key.split("/")[1])
        if shown is not None and (devices := read_payload(Devices, sample.payload, self._malformed)) is not None:
            for device in devices.devices:
                self._found(shown, topics.SENSOR(device.name).path)

    def _found(self, shown: _Shown, path: str) -> None:
        if path not in shown.offered and shown.sensors < SENSORS:
            shown.sensors += 1
            self._offer(shown, channels_of(shown.keys.robot, path))

    # Work on demand

    def _on_wanted(self, channel: ViewerChannel, wanted: bool) -> None:
        """Subscribe on the bus to what the wanted channels of this robot are drawn from, and to nothing else.

        While ``/<robot>/sensors`` is wanted, one subscription with a wildcard replaces those to single sensors.
        """
        shown = self._shown.get(channel.topic.split("/")[1])
        if shown is None:
            return
        if wanted:
            shown.wanted.add(channel.path)
        else:
            shown.wanted.discard(channel.path)
        needed = {source for path in shown.wanted for source in sources_of(shown.offered[path])}
        if _SENSORS in shown.wanted:
            single = {source for source in needed if source.startswith("sensor/")}
            needed = (needed - single - {_SENSORS}) | {_ALL_SENSORS}
        shown.subscribed.need(needed)

    def _subscribe(self, shown: _Shown, source: str) -> Handle:
        topic = topics.find(source)
        history = topic is not None and topic.qos.keeps_last
        return self._bus.subscribe(shown.keys.key(source), lambda sample: self._receive(shown, sample), history=history)

    def _receive(self, shown: _Shown, sample: Sample) -> None:
        path = shown.keys.path(sample.key)
        topic = topics.find(path)
        if topic is None:
            return
        message: FleetMessage | None = read_payload(topic.message, sample.payload, self._malformed)
        if message is None:
            return
        now_ns = time.time_ns()
        if isinstance(message, Reading) and _SENSORS in shown.wanted:
            self._found(shown, path)
            named = NamedReading(**msgspec.structs.asdict(message), sensor=unescape(path.rpartition("/")[2]))
            self.hub.publish(f"/{shown.keys.robot}/{_SENSORS}", now_ns, msgspec.json.encode(named))
        for picture in shown.pictures.draw(topic, message, now_ns, shown.wanted):
            self.hub.publish(picture.channel.topic, now_ns, picture.payload)

    # Parameters

    async def parameters(self, names: tuple[str, ...], *, ask: bool = True) -> Mapping[str, Any]:
        if ask and not self._watching:
            with contextlib.suppress(BusError):
                for topic in _SWITCHES:
                    for answer in await self._bus.ask(f"{self._realm}/*/{topic.path}", timeout_s=_ASK_S):
                        if answer.error is None:
                            self._on_switch(Sample(answer.key, answer.payload))
        return self._commands.parameters(names)

    def watch_parameters(self, watched: bool) -> None:
        """Subscribe to the switches of robots while somebody watches parameters."""
        self._watchers += 1 if watched else -1
        if self._watchers and not self._watching:
            self._watching = [
                self._bus.subscribe(f"{self._realm}/*/{topic.path}", self._on_switch, history=True)
                for topic in _SWITCHES
            ]
        elif not self._watchers:
            while self._watching:
                self._watching.pop().close()

    def _on_switch(self, sample: Sample) -> None:
        split = split_key(sample.key)
        if split is not None and (switch := read_payload(Switch, sample.payload, self._malformed)) is not None:
            self._commands.noted(split[1], split[2], switch.on)
