"""One listener for HQ programs of TCP/UDP: its clients, its answers, and what it shows them of any robot. Sans-IO.

Every packet is encoded once for all clients. The session of a client and its commands are in :mod:`.hq_client`.
Source: "Towards HQ programs", "Translation from the robot" and "Versions and dialects" of the protocol page.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from functools import cache
from typing import Any

import msgspec

from gateways.tcpudp import messages as packets
from gateways.tcpudp.hq_client import TRANSLATE, TcpUdpClient, each_once, newest_of, raw_command
from gateways.tcpudp.maps import (
    TCP_BYTES,
    UDP_BYTES,
    Geometry,
    MapFrame,
    announceable,
    check,
    most_side,
    resampled,
    squared,
)
from gateways.tcpudp.options import NAME, TcpUdpHqOptions
from gateways.tcpudp.session.robot_role import RobotRole
from gateways.tcpudp.settings import ROBOT_BLOCKS, Feature, RobotSettings13, Settings
from gateways.tcpudp.telemetry import OFF, ON
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage, Map, Mode, Pose, Raw, Switch, Text
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.protocol import ClientIds, Datagram, EncodeError, HqSide, Limits, Metrics, Send, Telemetry, newest

DEADMAN_S = 1.3
"""Legacy HQ programs repeat the position of their stick every 0.5 s."""
CLIENTS = range(2, 256)
"""Client ids; 1 is the server's."""
TEXT_CHARACTERS = 1000
_NEARLY = 1 + 1e-9
_SIZES = ("1.3", "1.4")
"""Versions whose clients are announced the size of the map."""
_FEATURES = {feature.value for feature in Feature}


class TcpUdpHq(HqSide):
    """One listener."""

    name = NAME
    hands_over = True
    deadman_s = DEADMAN_S
    follows = ("pose", "map", "text", "lidar", "camera", f"raw/{NAME}")

    def __init__(self, options: TcpUdpHqOptions, view: RobotView, metrics: Metrics | None = None) -> None:
        self.options = options
        self.view = view
        self.datagrams = options.udp
        self._unit_m = options.length_unit_m
        self._most_side = most_side(UDP_BYTES if options.udp else TCP_BYTES)
        self._last: dict[str, tuple[FleetMessage, Send | None]] = {}
        """What was shown last of each path: clients that connect or ask later get the same bytes."""

    # Clients

    def numbers(self, clients: int) -> ClientIds:
        return ClientIds(CLIENTS, self.options.quiet_s)

    def initial_commands(self) -> tuple[Telemetry, ...]:
        """Return mode none: a client drives only after it has sent control mode 2 or 3."""
        return ((topics.CMD_MODE, Mode("none")),)

    def session(self, number: int, bounds: Limits) -> TcpUdpClient:
        geometry = self._geometry()
        bounds = msgspec.structs.replace(bounds, gap_s=self.options.gap_s)
        return TcpUdpClient(bounds, self._settings(geometry), number, self.options, geometry)

    def begin(self, session: TcpUdpClient, now: float) -> None:
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
        translate = _SHOWN.get(topic.path)
        if translate is None:
            return None
        last, send = self._last.get(topic.path, (None, None))
        if last is not message:
            send = translate(self, message)
            self._last[topic.path] = message, send
        return send

    def answer(self, session: TcpUdpClient, topic: Topic, message: FleetMessage | None, now: float) -> None:
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

    def tell(self, session: TcpUdpClient, text: str, now: float) -> None:
        session.send(packets.DebugMessage(ascii_text(text)))

    def _geometry(self) -> Geometry:
        """Choose the geometry that a new client is announced: of the robot's map, else of the options."""
        if self.view.map is not None and self.view.map.cells.size:
            with contextlib.suppress(EncodeError):
                return announceable(self.view.map, self._unit_m, self._most_side, self._frame)
        size, interval = self.options.slam_map_size, self.options.slam_map_interval
        return Geometry(min(size, self._most_side * interval), interval)

    def _pose(self, message: Pose) -> Send:
        if not math.isfinite(message.x + message.y + message.heading):
            raise EncodeError(f"position {message.x:g}, {message.y:g}, {message.heading:g}")
        heading_deg = math.degrees(message.heading - self.options.heading_offset)
        return newest_of(
            "pose", packets.ServerPosition(message.x / self._unit_m, message.y / self._unit_m, heading_deg)
        )

    def _map(self, message: Map) -> Send:
        """Show a map to each client in the size that it was announced, or that fits its transport."""
        frames: dict[tuple[Geometry | None, int], tuple[bytes, Datagram]] = {}
        larger: set[tuple[Geometry | None, int]] = set()

        def send(session: TcpUdpClient, now: float) -> None:
            most = most_side(UDP_BYTES if session.by_udp else TCP_BYTES)
            announced = session.version in _SIZES and session.geometry.side <= most
            key = (session.geometry if announced else None, most)
            if key not in frames:
                cells, to_scale = self._cells(message, *key)
                frame = packets.encode_packet(packets.ServerSLAMMap(cells), session.sender_id)
                frames[key] = (frame, Datagram(frame))
                larger.update(() if to_scale else (key,))
            if key in larger:
                session.left_out["map to scale"] += 1
            session.show("map", packets.ServerSLAMMap.spec.id, frames[key][session.by_udp], now)

        return send

    def _cells(self, grid: Map, geometry: Geometry | None, most: int) -> tuple[bytes, bool]:
        """Return the cells of the whole map, and whether they have the announced size.

        geometry: what was announced; None: the map's own. most: cells along a side at most.
        """
        if not grid.cells.size:
            return b"", True
        check(grid)
        frame = self._frame
        size_m = frame.size_m(grid)
        if geometry is None:
            if frame.own and frame.origin is None:
                return squared(grid, most), True
            side = max(1, min(most, math.ceil(round(size_m / grid.cell, 6))))
            cell_m = max(grid.cell, size_m / side)
            return resampled(grid, side, cell_m, frame.begin(grid, side * cell_m)), True
        side, cell_m = geometry.side, geometry.interval * self._unit_m
        to_scale = size_m <= side * cell_m * _NEARLY
        cell_m = cell_m if to_scale else size_m / side
        return resampled(grid, side, cell_m, frame.begin(grid, side * cell_m)), to_scale

    @property
    def _frame(self) -> MapFrame:
        return MapFrame(own=self.view.protocol in (NAME, None), origin=self.options.map_origin)

    def _lidar(self, message: Switch) -> Send:
        return newest_of("lidar", packets.ServerLidarStatus(ON if message.on else OFF))

    def _camera(self, message: Switch) -> Send:
        return newest_of("camera", packets.ServerCamMode(ON if message.on else OFF))

    def _text(self, message: Text) -> Send | None:
        if message.kind == "request":
            return _request
        return each_once(packets.DebugMessage(ascii_text(message.text))) if message.text else None

    def _raw(self, message: Raw) -> Send | None:
        """Pass on packets of the robot that no fleet message holds."""
        spec = packets.PACKETS.get(message.id)
        if spec is not None and spec.packet is packets.ChatMessage:
            return each_once(packets.ChatMessage(message.body))
        return each_once(packets.OpaquePacket(message.id, message.body)) if spec is None else None

    # What is understood

    def take(self, session: TcpUdpClient, message: packets.Packet) -> tuple[Telemetry, ...]:
        return TRANSLATE.get(type(message), raw_command)(session, message, self.options)


@cache
def no_map() -> Map:
    """Return the map of a robot that has none."""
    import numpy as np

    return Map(0, 0, 1.0, (0.0, 0.0), np.zeros((0, 0), np.uint8))


def ascii_text(text: str) -> str:
    """Return a text as the protocol's strings hold it, cut to the length of one packet."""
    return text.encode("ascii", "backslashreplace").decode()[:TEXT_CHARACTERS]


def _request(session: TcpUdpClient, now: float) -> None:
    """Ask a client that announced simulated lidar data for it."""
    if Feature.LIDAR_SIM in (session.client.features if session.client is not None else ()):
        session.show("request", packets.ServerGetSimulatedLidarData.spec.id, _REQUEST, now)
    else:
        session.leave_out(packets.ServerGetSimulatedLidarData.spec.id)


_REQUEST = packets.encode_packet(packets.ServerGetSimulatedLidarData(), RobotRole.sender_id)
_SHOWN: dict[str, Callable[[TcpUdpHq, Any], Send | None]] = {
    topics.POSE.path: TcpUdpHq._pose,
    topics.MAP.path: TcpUdpHq._map,
    topics.LIDAR.path: TcpUdpHq._lidar,
    topics.CAMERA.path: TcpUdpHq._camera,
    topics.TEXT.path: TcpUdpHq._text,
    topics.RAW(NAME).path: TcpUdpHq._raw,
}
