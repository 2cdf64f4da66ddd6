"""One listener for HQ programs of TCP/UDP: its clients, what it announces to them, and what it answers. Sans-IO.

Source: "The gateway as robot" and "Settings and version negotiation" of the protocol page.
"""

from __future__ import annotations

from typing import Any

import msgspec

from gateways.tcpudp.hq.client import HqClient
from gateways.tcpudp.hq.commands import commands
from gateways.tcpudp.hq.display import Display, ascii_text, no_map
from gateways.tcpudp.hq.options import HqOptions
from gateways.tcpudp.maps import Geometry
from gateways.tcpudp.messages import DebugMessage, Packet
from gateways.tcpudp.settings import ROBOT_BLOCKS, Feature, RobotSettings13, Settings
from gateways.tcpudp.translate import NAME
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage, Map, Mode
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.protocol import ClientIds, EncodeError, HqSide, Limits, Metrics, Send, Telemetry, newest

DEADMAN_S = 1.3
"""Deployed HQ programs repeat the position of their stick every 0.5 s."""
CLIENTS = range(2, 256)
"""Client ids; 1 is the server's."""


class TcpUdpHq(HqSide):
    """One listener."""

    name = NAME
    hands_over = True
    deadman_s = DEADMAN_S
    follows = ("pose", "map", "text", "lidar", "camera", f"raw/{NAME}")

    def __init__(self, options: HqOptions, view: RobotView, metrics: Metrics | None = None) -> None:
        self.options = options
        self.view = view
        self.datagrams = options.udp
        self._display = Display(options, view)

    # Clients

    def numbers(self, clients: int) -> ClientIds:
        return ClientIds(CLIENTS, self.options.quiet_s)

    def initial_commands(self) -> tuple[Telemetry, ...]:
        """A client drives only after it has sent control mode 2 or 3."""
        return ((topics.CMD_MODE, Mode("none")),)

    def session(self, number: int, bounds: Limits) -> HqClient:
        geometry = self._display.geometry()
        bounds = msgspec.structs.replace(bounds, gap_s=self.options.gap_s)
        return HqClient(bounds, self._settings(geometry), number, self.options, geometry)

    def begin(self, session: HqClient, now: float) -> None:
        known = ROBOT_BLOCKS[newest((session.version or "",), known=ROBOT_BLOCKS) or "1.1"]
        has = self.view.features if self.view.protocol == NAME else None
        session.left_out.update(f"feature {name}" for name in has or () if not hasattr(known, name))
        for topic, message in ((topics.MAP, self.view.map), (topics.POSE, self.view.pose)):
            try:
                send = self.show(topic, message) if message is not None else None
                if send is not None:
                    send(session, now)
            except EncodeError:  # the other one is shown all the same
                session.left_out[topic.path] += 1

    def _settings(self, geometry: Geometry) -> Settings:
        """Announce what the robot has, as far as the newest version listed has a flag for it."""
        has = self._features()
        block = ROBOT_BLOCKS[newest(self.options.versions, known=ROBOT_BLOCKS) or "1.1"]
        flags: dict[str, Any] = {feature.value: feature in has for feature in Feature if hasattr(block, feature.value)}
        if block is RobotSettings13:
            flags |= {"slam_map_size": geometry.size, "slam_map_interval": geometry.interval}
        return msgspec.convert({**flags, "udp": self.options.udp}, block)

    def _features(self) -> set[Feature]:
        """Return the robot's features: all if nobody has seen it yet; Joystick if it is of another protocol."""
        view = self.view
        if view.protocol is None:
            return set(Feature)
        if view.protocol != NAME:
            return {Feature.JOYSTICK} | ({Feature.SLAM_MAP} if view.map is not None else set())
        has = {Feature(name) for name in view.features or () if name in _FEATURES}
        if Feature.LIDAR in has and view.version in ("1.1", "1.2"):  # these have no flag of their own for the map
            has.add(Feature.SLAM_MAP)
        return has

    # What is shown

    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        return self._display.show(topic, message)

    def answer(self, session: HqClient, topic: Topic, message: FleetMessage | None, now: float) -> None:
        missing = None
        if topic is topics.RPC_MAP:
            grid = message or self.view.map or no_map()
            missing = "map" if isinstance(grid, Map) and not grid.cells.size else None
            send = self.show(topics.MAP, grid)
        elif (known := message or self.view.pose) is not None:
            send = self.show(topics.POSE, known)
        else:
            missing, send = "position", None
        if send is not None:
            send(session, now)
        if missing is not None:
            self.tell(session, f"the robot's {missing} is not known", now)

    def tell(self, session: HqClient, text: str, now: float) -> None:
        session.send(DebugMessage(ascii_text(text)))

    # What is understood

    def take(self, session: HqClient, message: Packet) -> tuple[Telemetry, ...]:
        return commands(session, message, self.options)


_FEATURES = {feature.value for feature in Feature}
