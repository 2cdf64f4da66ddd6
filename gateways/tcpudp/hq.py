"""What HQ programs of the TCP/UDP package protocol are shown of any robot, and what they command. Sans-IO.

Source: "The gateway as robot", "Translation" and "Settings and version negotiation" of the protocol page.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from gateways.tcpudp.maps import (
    TCP_BYTES,
    UDP_BYTES,
    Frame,
    Geometry,
    announceable,
    check,
    most_side,
    resampled,
    squared,
)
from gateways.tcpudp.messages import (
    PACKETS,
    ChatMessage,
    ClientControllMode,
    ClientGetPosition,
    ClientGetSLAMMap,
    ClientJoystickMove,
    ClientJoystickRotate,
    ClientJoystickStop,
    ClientLidarMode,
    ClientMoveAI,
    ClientSimulatedLidarData,
    DebugMessage,
    OpaquePacket,
    Packet,
    ServerCamMode,
    ServerGetSimulatedLidarData,
    ServerLidarStatus,
    ServerPosition,
    ServerSLAMMap,
    encode_packet,
)
from gateways.tcpudp.session import CLIENT_PORT, RobotSession
from gateways.tcpudp.settings import ROBOT_BLOCKS, Feature, RobotSettings13, Settings
from gateways.tcpudp.translate import NAME, OFF, ON, Angle, Length, PacketId, Scale
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Map, Mode, Pose, Query, Raw, Scan, Switch, Text
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.protocol import Datagram, EncodeError, HqSide, Limits, Metrics, ProtocolError, Send, Telemetry, newest

DEADMAN_S = 1.3
"""Deployed HQ programs repeat what their stick says every 0.5 s."""
CLIENTS = range(2, 256)
"""Client ids; 1 is the server's."""
TEXT_CHARACTERS = 1000
MOST_SIDE = most_side(UDP_BYTES)
_NEARLY = 1 + 1e-9
_MODES = {1: "none", 2: "manual", 3: "autonomous"}
_SIZES = ("1.3", "1.4")
"""Versions whose clients were told the size of the map."""
_ASKING = ("1.1",)
"""Versions whose first programs have no handlers for what nobody asked for ("The gateway as robot")."""
_ON_REQUEST = frozenset({ServerSLAMMap.spec.id, ServerPosition.spec.id})

VersionName = Literal["1.1", "1.2", "1.3", "1.4"]


class HqOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[[hq]] options`` of this protocol; the template of ``zbridge init`` explains each."""

    versions: Annotated[tuple[VersionName, ...], msgspec.Meta(min_length=1)] = ("1.1", "1.2", "1.3")
    udp: bool = True
    client_port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = CLIENT_PORT
    gap_s: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.01
    quiet_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 2.0
    known: tuple[PacketId, ...] = ()
    unasked: bool = False
    skip_map_flag: bool = False
    slam_map_size: Annotated[int, msgspec.Meta(ge=1, le=2**31 - 1)] = 1000
    slam_map_interval: Annotated[int, msgspec.Meta(ge=1, le=2**31 - 1)] = 10
    speed_full: Scale = 1.0
    turn_full: Scale = 1.0
    length_unit_m: Scale = 0.01
    heading_offset: Angle = math.pi / 2
    map_origin: tuple[Length, Length] | None = None

    def __post_init__(self) -> None:
        if self.slam_map_size < self.slam_map_interval:
            raise ValueError("slam_map_size is smaller than slam_map_interval: a map of no cells")


class HqClient(RobotSession):
    """The session of one client, the size of the map that it was told, and what it has asked for."""

    def __init__(self, bounds: Limits, settings: Settings, number: int, options: HqOptions, geometry: Geometry) -> None:
        self.geometry = geometry
        super().__init__(
            bounds,
            settings,
            number,
            options.versions,
            block=_without_map_flag(settings) if options.skip_map_flag else None,
            known=options.known,
            client_port=options.client_port,
        )
        self._unasked = options.unasked
        self._asked: set[int] = set()

    def establish(self, version: str, features: tuple[str, ...]) -> None:
        super().establish(version, features)
        if version in _ASKING and not self._unasked:
            self.known -= _ON_REQUEST - self._asked

    def asks(self, packet_id: int) -> None:
        """Take note that the client asked for a packet: it knows what to do with it."""
        self._asked.add(packet_id)
        self.known |= {packet_id}

    @property
    def by_udp(self) -> bool:
        """Whether datagrams were agreed, and get through."""
        return self.transport == "udp"

    def show(self, slot: str, packet_id: int, frame: bytes, now: float) -> None:
        """Let a frame stand until it is written, the newest of its slot, if the client knows the packet."""
        if packet_id in self.known:
            self.outbox.set(slot, (frame,), now)
        else:
            self.leave_out(packet_id)

    def leave_out(self, packet_id: int) -> None:
        """Count a packet that the client does not know."""
        spec = PACKETS.get(packet_id)
        name = f"{spec.name} ({packet_id})" if spec is not None else f"packet {packet_id}"
        self.left_out[f"{name} unasked" if packet_id in _ON_REQUEST else name] += 1


class TcpUdpHq(HqSide):
    """One listener."""

    name = NAME
    deadman_s = DEADMAN_S
    modes = True
    numbers = CLIENTS
    follows = ("pose", "map", "text", "lidar", "camera", f"raw/{NAME}")

    def __init__(self, options: HqOptions, view: RobotView, metrics: Metrics | None = None) -> None:
        self.options = options
        self.view = view
        self.datagrams = options.udp
        self.quiet_s = options.quiet_s
        self._unit_m = options.length_unit_m
        self._most_side = MOST_SIDE if options.udp else most_side(TCP_BYTES)
        self._last: dict[str, tuple[FleetMessage, Send | None]] = {}
        """What was shown last of each path: clients that come or ask later get the same bytes."""

    # Clients

    def session(self, number: int, bounds: Limits) -> HqClient:
        geometry = self._geometry()
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

    def _geometry(self) -> Geometry:
        if self.view.map is not None and self.view.map.cells.size:
            with contextlib.suppress(EncodeError):
                return announceable(self.view.map, self._unit_m, self._most_side, self._frame)
        size, interval = self.options.slam_map_size, self.options.slam_map_interval
        return Geometry(min(size, self._most_side * interval), interval)

    def _settings(self, geometry: Geometry) -> Settings:
        """Announce what the robot has, as far as the newest version listed has a flag for it.

        A robot of another protocol can be driven; of one that nobody has seen yet, all is announced.
        """
        has = self._features()
        block = ROBOT_BLOCKS[newest(self.options.versions, known=ROBOT_BLOCKS) or "1.1"]
        flags: dict[str, Any] = {feature.value: feature in has for feature in Feature if hasattr(block, feature.value)}
        if block is RobotSettings13:
            flags |= {"slam_map_size": geometry.size, "slam_map_interval": geometry.interval}
        return msgspec.convert({**flags, "udp": self.options.udp}, block)

    def _features(self) -> set[Feature]:
        view = self.view
        if view.protocol is None:
            return set(Feature)
        if view.protocol != NAME:
            return {Feature.JOYSTICK} | ({Feature.SLAM_MAP} if view.map is not None else set())
        has = {Feature(name) for name in view.features or () if name in _FEATURES}
        if Feature.LIDAR in has and view.version in ("1.1", "1.2"):  # which have no flag of their own for the map
            has.add(Feature.SLAM_MAP)
        return has

    # The robot, shown

    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        translate = _SHOWN.get(topic.path)
        if translate is None:
            return None
        last, send = self._last.get(topic.path, (None, None))
        if last is not message:
            send = translate(self, message)
            self._last[topic.path] = message, send
        return send

    def _pose(self, message: Pose) -> Send:
        if not math.isfinite(message.x + message.y + message.heading):
            raise EncodeError(f"position {message.x:g}, {message.y:g}, {message.heading:g}")
        heading_deg = math.degrees(message.heading - self.options.heading_offset)
        return _to_all("pose", ServerPosition(message.x / self._unit_m, message.y / self._unit_m, heading_deg))

    def _map(self, message: Map) -> Send:
        """Show a map as each client takes it: as large as it was announced, or as what carries it allows."""
        frames: dict[tuple[Geometry | None, int], tuple[bytes, Datagram]] = {}
        larger: set[tuple[Geometry | None, int]] = set()

        def send(session: HqClient, now: float) -> None:
            most = most_side(UDP_BYTES if session.by_udp else TCP_BYTES)
            announced = session.version in _SIZES and session.geometry.side <= most
            key = (session.geometry if announced else None, most)
            if key not in frames:
                cells, to_scale = self._cells(message, *key)
                frame = encode_packet(ServerSLAMMap(cells), session.sender_id)
                frames[key] = (frame, Datagram(frame))
                larger.update(() if to_scale else (key,))
            if key in larger:
                session.left_out["map to scale"] += 1
            session.show("map", ServerSLAMMap.spec.id, frames[key][session.by_udp], now)

        return send

    def _cells(self, grid: Map, geometry: Geometry | None, most: int) -> tuple[bytes, bool]:
        """Give a map's cells, and whether they are as large as was announced: the whole map is shown in any case."""
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
    def _frame(self) -> Frame:
        return Frame(own=self.view.protocol in (NAME, None), origin=self.options.map_origin)

    def _lidar(self, message: Switch) -> Send:
        return _to_all("lidar", ServerLidarStatus(ON if message.on else OFF))

    def _camera(self, message: Switch) -> Send:
        return _to_all("camera", ServerCamMode(ON if message.on else OFF))

    def _text(self, message: Text) -> Send | None:
        if message.kind == "request":
            return _request
        return _once(DebugMessage(_ascii(message.text))) if message.text else None

    def _raw(self, message: Raw) -> Send | None:
        """Pass on what the robot said in packets that no fleet message holds."""
        spec = PACKETS.get(message.id)
        if spec is not None and spec.packet is ChatMessage:
            return _once(ChatMessage(message.body))
        return _once(OpaquePacket(message.id, message.body)) if spec is None else None

    def answer(self, session: HqClient, topic: Topic, message: FleetMessage | None, now: float) -> None:
        if topic is topics.RPC_MAP:
            send = self.show(topics.MAP, message or self.view.map or _NO_MAP)
        else:
            known = message or self.view.pose
            send = self.show(topics.POSE, known) if known is not None else None
        if send is None:
            self.tell(session, "the robot's position is not known", now)
        else:
            send(session, now)

    def tell(self, session: HqClient, text: str, now: float) -> None:
        session.send(DebugMessage(_ascii(text)))

    # What clients command

    def take(self, session: HqClient, message: Packet) -> tuple[Telemetry, ...]:
        translate = _TAKEN.get(type(message), TcpUdpHq._take_raw)
        return translate(self, session, message)

    def _take_move(self, session: HqClient, message: ClientJoystickMove) -> tuple[Telemetry, ...]:
        speed = message.speed / self.options.speed_full
        forward, left = message.y * speed, 0.0 - message.x * speed
        if not math.isfinite(forward + left):
            raise ProtocolError(f"clientJoystickMove {message.x:g}, {message.y:g} at {message.speed:g}")
        scale = max(1.0, math.hypot(forward, left))
        return ((topics.CMD_DRIVE, Drive(forward=forward / scale, left=left / scale)),)

    def _take_rotate(self, session: HqClient, message: ClientJoystickRotate) -> tuple[Telemetry, ...]:
        if not math.isfinite(message.speed):
            raise ProtocolError(f"clientJoystickRotate at {message.speed:g}")
        turn = max(-1.0, min(1.0, 0.0 - message.speed / self.options.turn_full))
        return ((topics.CMD_DRIVE, Drive(turn=turn)),)

    def _take_stop(self, session: HqClient, message: ClientJoystickStop) -> tuple[Telemetry, ...]:
        return ((topics.CMD_DRIVE, Drive()),)

    def _take_mode(self, session: HqClient, message: ClientControllMode) -> tuple[Telemetry, ...]:
        if message.mode not in _MODES:
            raise ProtocolError(f"control mode {message.mode}, expected 1 (none), 2 (joystick) or 3 (AI)")
        return ((topics.CMD_MODE, Mode(_MODES[message.mode])),)  # type: ignore[arg-type]

    def _take_lidar(self, session: HqClient, message: ClientLidarMode) -> tuple[Telemetry, ...]:
        if message.mode not in (ON, OFF):
            raise ProtocolError(f"lidar mode {message.mode}, expected {ON} (on) or {OFF} (off)")
        return ((topics.CMD_LIDAR, Switch(message.mode == ON)),)

    def _take_text(self, session: HqClient, message: DebugMessage) -> tuple[Telemetry, ...]:
        return ((topics.CMD_TEXT, Text(message.text, sender=session.name)),) if message.text else ()

    @np.errstate(all="ignore")  # absurd numbers are points the scan does not have
    def _take_scan(self, session: HqClient, message: ClientSimulatedLidarData) -> tuple[Telemetry, ...]:
        """Take simulated lidar data: a turn of ranges counter-clockwise from straight ahead, 0 where there is none."""
        count = len(message.ranges)
        if not count:
            raise ProtocolError("simulated lidar data without a range")
        ranges = np.asarray(message.ranges, np.float32) * np.float32(self._unit_m)
        ranges[~(np.isfinite(ranges) & (ranges > 0))] = np.nan
        most = float(np.nanmax(ranges, initial=0.0))
        return ((topics.CMD_SCAN, Scan(0.0, 2 * math.pi / count, 0.0, most, ranges)),)

    def _ask_map(self, session: HqClient, message: ClientGetSLAMMap) -> tuple[Telemetry, ...]:
        session.asks(ServerSLAMMap.spec.id)
        return ((topics.RPC_MAP, Query()),)

    def _ask_pose(self, session: HqClient, message: ClientGetPosition) -> tuple[Telemetry, ...]:
        session.asks(ServerPosition.spec.id)
        return ((topics.RPC_POSE, Query()),)

    def _take_raw(self, session: HqClient, message: Packet) -> tuple[Telemetry, ...]:
        if isinstance(message, OpaquePacket):
            raw = Raw(message.id, message.body)
        else:
            raw = Raw(message.spec.id, message.spec.codec.encode(message))
        return ((topics.CMD_RAW(NAME), raw),)


_FEATURES = {feature.value for feature in Feature}
_NO_MAP = Map(0, 0, 1.0, (0.0, 0.0), np.zeros((0, 0), np.uint8))


def _to_all(slot: str, packet: Packet) -> Send:
    """Encode a packet once for every client; one that datagrams may carry, in both forms."""
    frame = encode_packet(packet, RobotSession.sender_id)
    datagram = Datagram(frame) if _may_go_by_datagram(packet) else frame

    def send(session: HqClient, now: float) -> None:
        session.show(slot, packet.spec.id, datagram if session.by_udp else frame, now)

    return send


def _may_go_by_datagram(packet: Packet) -> bool:
    return packet.spec.carrier.value == "udp*"


def _once(packet: Packet) -> Send:
    """Encode a packet once; it is queued, and nothing replaces it."""
    frame = encode_packet(packet, RobotSession.sender_id)
    if len(frame) > TCP_BYTES:
        raise EncodeError(f"packet of {len(frame)} bytes, HQ programs take {TCP_BYTES} by TCP")
    packet_id = frame[5]

    def send(session: HqClient, now: float) -> None:
        if packet_id in session.known:
            session.outbox.put(frame)
        else:
            session.leave_out(packet_id)

    return send


_REQUEST = encode_packet(ServerGetSimulatedLidarData(), RobotSession.sender_id)


def _request(session: HqClient, now: float) -> None:
    """Ask those for simulated lidar data that announced it."""
    if Feature.LIDAR_SIM in (session.client.features if session.client is not None else ()):
        session.show("request", ServerGetSimulatedLidarData.spec.id, _REQUEST, now)
    else:
        session.leave_out(ServerGetSimulatedLidarData.spec.id)


def _ascii(text: str) -> str:
    """Give a text as the protocol's strings hold it, and not too long for one packet."""
    return text.encode("ascii", "backslashreplace").decode()[:TEXT_CHARACTERS]


def _without_map_flag(settings: Settings) -> bytes:
    """Leave out the byte that some HQ programs of version 1.3 skip when they read the settings."""
    block = settings.encode()
    place = list(Feature).index(Feature.SLAM_MAP)
    return block[:place] + block[place + 1 :] if isinstance(settings, RobotSettings13) else block


_SHOWN: dict[str, Callable[[TcpUdpHq, Any], Send | None]] = {
    topics.POSE.path: TcpUdpHq._pose,
    topics.MAP.path: TcpUdpHq._map,
    topics.LIDAR.path: TcpUdpHq._lidar,
    topics.CAMERA.path: TcpUdpHq._camera,
    topics.TEXT.path: TcpUdpHq._text,
    topics.RAW(NAME).path: TcpUdpHq._raw,
}
_TAKEN: dict[type[Packet], Callable[[TcpUdpHq, HqClient, Any], tuple[Telemetry, ...]]] = {
    ClientJoystickMove: TcpUdpHq._take_move,
    ClientJoystickRotate: TcpUdpHq._take_rotate,
    ClientJoystickStop: TcpUdpHq._take_stop,
    ClientControllMode: TcpUdpHq._take_mode,
    ClientLidarMode: TcpUdpHq._take_lidar,
    DebugMessage: TcpUdpHq._take_text,
    ClientSimulatedLidarData: TcpUdpHq._take_scan,
    ClientGetSLAMMap: TcpUdpHq._ask_map,
    ClientGetPosition: TcpUdpHq._ask_pose,
    ClientMoveAI: TcpUdpHq._take_raw,
    ChatMessage: TcpUdpHq._take_raw,
}
