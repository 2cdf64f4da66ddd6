"""Packets to fleet messages and commands to packets, with all units and axes. Sans-IO.

Source: "Translation" and "The gateway as HQ" of the protocol page. The robot's axes are x right and y
forward, lengths in its own unit (centimetres), headings in degrees; the fleet's are those of REP 103.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from gateways.tcpudp.messages import (
    PACKETS,
    ChatMessage,
    ClientControllMode,
    ClientGetPosition,
    ClientGetSLAMMap,
    ClientJoystickMove,
    ClientJoystickRotate,
    ClientJoystickStop,
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
    ServerSLAMMapPart,
)
from gateways.tcpudp.session import HqSession, limits
from gateways.tcpudp.settings import Feature, RobotSettings13, Settings
from gateways.tcpudp.versions import ANNOUNCED
from zbridge.fleet import topics
from zbridge.fleet.messages import Cells, Drive, FleetMessage, Map, Mode, Pose, Raw, Scan, Switch, Text
from zbridge.fleet.topics import Topic
from zbridge.protocol import (
    Malformed,
    Metrics,
    NotReady,
    Outcome,
    ProtocolError,
    Refused,
    Robot,
    Telemetry,
    Translate,
    Unsupported,
)

NAME = "tcpudp"
ON, OFF = 1, 2
REPEAT_S = 0.25
"""Seconds after which a drive command is repeated while the robot moves."""
STOP_REPEAT_S = 0.1
"""Seconds between the repetitions of a stop: a late datagram can restart motion."""
SCAN_POINTS = 360
"""Points deployed robots take in simulated lidar data, one a degree."""
MAX_SIDE = 2048
"""Cells along a side of the largest map that is put together from parts."""
AUTONOMOUS = "autonomous"
_MODES = {"none": 1, "manual": 2, AUTONOMOUS: 3}
_MOTION = "motion"
_NOTHING = Outcome()
_OCCUPIED = 2
_RADIANS = math.pi / 180

FeatureName = Literal["udp", "cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map"]
PacketId = Annotated[int, msgspec.Meta(ge=0, le=255)]
Scale = Annotated[float, msgspec.Meta(gt=0, le=1e6)]
Angle = Annotated[float, msgspec.Meta(ge=-7, le=7)]
Length = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[device] options`` of this protocol; the template of ``zbridge init`` explains each."""

    udp: bool = True
    gap_s: Annotated[float, msgspec.Meta(ge=0, le=0.25)] = 0.01
    force: tuple[FeatureName | PacketId, ...] = ()
    announce: tuple[FeatureName, ...] = tuple(feature.value for feature in ANNOUNCED)
    combine: Literal["exclusive", "both"] = "exclusive"
    speed_full: Scale = 1.0
    turn_full: Scale = 1.0
    length_unit_m: Scale = 0.01
    heading_offset: Angle = math.pi / 2
    map_cell_m: Scale = 0.01
    map_origin: tuple[Length, Length] | None = None


class TcpUdpRobot(Robot):
    """One robot of the TCP/UDP package protocol, seen from its HQ."""

    def __init__(self, options: Options, links: int = 1, metrics: Metrics | None = None) -> None:
        self.options = options
        self.link_names = ("robot",)
        self._force = tuple(Feature(entry) if isinstance(entry, str) else entry for entry in options.force)
        self._announce = tuple(Feature(name) for name in options.announce)
        self._session: HqSession | None = None
        self._chosen: str | None = None
        """The mode that was commanded last."""
        self._paired_until = self._rests_until = -math.inf
        """How long a stop stands, and how long as a pair."""
        self._parts: bytearray | None = None
        self._parts_ns = 0
        self._parts_from: str | None = None
        """The version of the robot, if it sends its map in parts."""
        self._map_awaited = False
        self._unit_m = options.length_unit_m
        self._heading_offset = options.heading_offset

    @property
    def driving(self) -> HqSession | None:
        return self._session

    def session(self, link: str, peer: str) -> HqSession:
        self._session = HqSession(
            limits(self.options.gap_s),
            udp=self.options.udp,
            force=self._force,
            announce=self._announce,
            predecessor=self._session,
        )
        self._paired_until = self._rests_until = -math.inf
        self._parts = None
        return self._session

    # Packets to telemetry

    def translator(self, kind: type) -> Translate:
        return partial(_TELEMETRY.get(kind, TcpUdpRobot._raw), self)

    def _pose(self, message: ServerPosition, stamp_ns: int) -> tuple[Telemetry, ...]:
        unit_m = self._unit_m
        return (
            (
                topics.POSE,
                Pose(
                    message.x * unit_m,
                    message.y * unit_m,
                    message.heading_deg * _RADIANS + self._heading_offset,
                    stamp_ns=stamp_ns,
                ),
            ),
        )

    def _map(self, message: ServerSLAMMap, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Turn the x-major cells (index = x * side + y) into rows of y, cells that are not 0, 1, 2 into unknown."""
        self._map_awaited = False
        settings = self._session.settings if self._session is not None else None
        values = message.cells
        side = _side(len(values), settings)
        cell = self._cell_m(settings)
        cells = _known_cells(np.frombuffer(values, np.uint8)).reshape(side, side).T
        half = -side * cell / 2
        origin = self.options.map_origin or (half, half)
        return ((topics.MAP, Map(side, side, cell, origin, cells, stamp_ns=stamp_ns)),)

    def _map_part(self, message: ServerSLAMMapPart, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Put a part in its place, cut where the map ends; the last one makes a map, and one that is waited for."""
        session = self._connected()
        self._parts_from = session.version
        side = announced_side(session.settings)
        if side == 0:
            raise ProtocolError("map part of a robot that announces no map size")
        if self._parts is None or len(self._parts) != side * side:
            self._parts = bytearray(side * side)
        cells = message.cells[: max(0, len(self._parts) - message.start)]
        self._parts[message.start : message.start + len(cells)] = cells
        self._parts_ns = stamp_ns
        if message.end < len(self._parts) and not self._map_awaited:
            return ()
        return self._map(ServerSLAMMap(bytes(self._parts)), stamp_ns)

    def _cell_m(self, settings: Settings | None) -> float:
        interval = settings.slam_map_interval if isinstance(settings, RobotSettings13) else 0
        return interval * self._unit_m if interval > 0 else self.options.map_cell_m

    def _text(self, message: DebugMessage, stamp_ns: int) -> tuple[Telemetry, ...]:
        return ((topics.TEXT, Text(message.text, "debug", stamp_ns=stamp_ns)),)

    def _request(self, message: ServerGetSimulatedLidarData, stamp_ns: int) -> tuple[Telemetry, ...]:
        return ((topics.TEXT, Text("simulated lidar data", "request", stamp_ns=stamp_ns)),)

    def _lidar(self, message: ServerLidarStatus, stamp_ns: int) -> tuple[Telemetry, ...]:
        return ((topics.LIDAR, _switch(message.mode, stamp_ns)),)

    def _camera(self, message: ServerCamMode, stamp_ns: int) -> tuple[Telemetry, ...]:
        return ((topics.CAMERA, _switch(message.mode, stamp_ns)),)

    def _raw(self, message: Packet, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Pass on what no fleet message holds, as it came."""
        if isinstance(message, OpaquePacket):
            raw = Raw(message.id, message.body, stamp_ns=stamp_ns)
        else:
            raw = Raw(message.spec.id, message.spec.codec.encode(message), stamp_ns=stamp_ns)
        return ((topics.RAW(NAME), raw),)

    # Commands to packets

    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        carry_out = _COMMANDS.get(topic.path)
        if carry_out is None:
            raise Unsupported("a TCP/UDP robot has no such command")
        return carry_out(self, command, now) or _NOTHING

    def stop(self, now: float, until: float) -> None:
        """Send packet 13, in mode 3 the pair 1, 13; what was still to be sent again is not, unless this is routine."""
        session = self._connected()
        session.withdraw_autonomous()
        session.withdraw_raw()
        if until > now:
            session.send_nothing_again()
        self._rest(now, period_s=STOP_REPEAT_S, until=until, paired=session.autonomous, urgent=True)

    def known(self, topic: Topic) -> FleetMessage | None:
        """Give the map as far as it has come in parts; later cells replace those of the map before."""
        if topic is not topics.MAP or self._parts is None:
            return None
        ((_, shown),) = self._map(ServerSLAMMap(bytes(self._parts)), self._parts_ns)
        return shown

    def ask(self, topic: Topic) -> None:
        if topic is not topics.MAP:
            self._send(ClientGetPosition())
            return
        if self._parts_from is None or self._parts_from != self._connected().version:
            self._send(ClientGetSLAMMap())
        self._map_awaited = True  # of a robot that sends parts the next one is the answer: its handler of 52 is empty

    def _drive(self, command: Drive, now: float) -> Outcome:
        left_out = "light: a TCP/UDP robot has none" if command.light is not None else None
        if not command.moving:
            session, on_its_own = self._connected(), self._chosen == AUTONOMOUS
            if on_its_own:
                session.withdraw_autonomous()
            paired = on_its_own and session.autonomous
            self._rest(now, period_s=REPEAT_S, until=now + 1.0, paired=paired, urgent=paired)
            return Outcome(left_out=left_out)
        translation = math.hypot(command.forward, command.left)
        packets: list[Packet] = []
        if translation:
            speed = min(1.0, translation) * self.options.speed_full
            packets.append(ClientJoystickMove((0.0 - command.left) / translation, command.forward / translation, speed))
        if command.turn:
            packets.append(ClientJoystickRotate(-command.turn * self.options.turn_full))
        if len(packets) == 2 and self.options.combine == "exclusive":
            rotates = abs(command.turn) > translation
            packets = packets[1:] if rotates else packets[:1]
            left_out = f"{'forward and left' if rotates else 'turn'}: options.combine = 'exclusive'"
        session = self._connected()
        frames = tuple(session.encode(packet) for packet in packets)
        session.outbox.set(_MOTION, frames, now, period_s=REPEAT_S)
        self._rests_until = self._paired_until = -math.inf
        return Outcome(left_out=left_out) if left_out else _NOTHING

    def _mode(self, command: Mode, now: float) -> None:
        """Send the mode; a stop that stands ends where the robot is to move by itself, and is no pair in any other."""
        self._connected().choose_mode(_MODES[command.mode], now)
        self._chosen = command.mode
        if command.mode == AUTONOMOUS:
            if now < self._rests_until:
                self._connected().outbox.clear(_MOTION)
        elif now < self._paired_until:
            self._rest(now, period_s=STOP_REPEAT_S, until=self._paired_until, paired=False, urgent=False)

    def _switch_lidar(self, command: Switch, now: float) -> None:
        self._connected().switch_lidar(ON if command.on else OFF, now)

    def _switch_camera(self, command: Switch, now: float) -> None:
        raise Unsupported("no packet turns a camera on or off")

    def _say(self, command: Text, now: float) -> None:
        if command.kind != "debug":
            raise Unsupported(f"text of kind {command.kind!r}: only 'debug' has a packet; chat is opaque, send it raw")
        self._send(DebugMessage(command.text))

    def _feed_scan(self, command: Scan, now: float) -> Outcome:
        self._send(ClientSimulatedLidarData(polar_ranges(command, self._unit_m)))
        return Outcome(telemetry=((topics.SCAN, command),))

    def _send_raw(self, command: Raw, now: float) -> None:
        self._connected().send_raw(_raw_packet(command))

    def _send(self, message: Packet) -> None:
        self._connected().send(message)

    def _rest(self, now: float, *, period_s: float, until: float, paired: bool, urgent: bool) -> None:
        """Let packet 13 stand, ``paired`` with a mode 1 before it; raise Refused where it may not be sent."""
        session = self._connected()
        packets = (ClientControllMode(_MODES["none"]), ClientJoystickStop()) if paired else (ClientJoystickStop(),)
        session.outbox.set(_MOTION, _sendable(session, packets), now, period_s=period_s, until=until, urgent=urgent)
        self._rests_until, self._paired_until = until, until if paired else -math.inf

    def _connected(self) -> HqSession:
        if self._session is None:
            raise NotReady("offline")
        return self._session


def _sendable(session: HqSession, packets: Iterable[Packet]) -> tuple[bytes, ...]:
    """Write the packets that the robot may be sent; raise Refused where it may be sent none of them."""
    frames, refusal = [], None
    for packet in packets:
        try:
            frames.append(session.encode(packet))
        except Refused as refused:
            refusal = refused
    if refusal is not None and not frames:
        raise refusal
    return tuple(frames)


@np.errstate(all="ignore")  # absurd numbers are points the scan does not have
def polar_ranges(scan: Scan, unit_m: float) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Resample a scan to float32[360] in the robot's unit, index = degree counter-clockwise from straight ahead.

    Each degree takes the nearest point of the scan, 0 where the scan has none or it is invalid or out of range.
    """
    count = len(scan.ranges)
    polar = np.zeros(SCAN_POINTS, np.float32)
    if count == 0 or not scan.angle_increment or not math.isfinite(scan.angle_increment + scan.angle_min):
        return polar
    step = abs(scan.angle_increment)
    circle = 2 * math.pi / step
    offsets = np.radians(np.arange(SCAN_POINTS)) - scan.angle_min
    nearest = np.rint(np.mod(math.copysign(1.0, scan.angle_increment) * offsets, 2 * math.pi) / step)
    nearest = np.where(nearest >= circle - 0.5, 0.0, nearest)  # the point behind the last one is the first
    covered = nearest < count
    indices = nearest[covered].astype(np.int64)
    ranges = np.asarray(scan.ranges, np.float32)
    values = ranges[indices]
    usable = np.isfinite(values) & (values >= scan.range_min) & (values <= scan.range_max)
    lengths = values / np.float32(unit_m)
    polar[covered] = np.where(usable & np.isfinite(lengths), lengths, 0)
    return polar


def announced_side(settings: Settings | None) -> int:
    """Give the cells along a side of the map as the robot announces them; 0 where it does not, or absurdly."""
    if not isinstance(settings, RobotSettings13) or settings.slam_map_interval <= 0:
        return 0
    side = settings.slam_map_size // settings.slam_map_interval
    return side if 0 < side <= MAX_SIDE else 0


def _side(cells: int, settings: Settings | None) -> int:
    """Find the side of a square map: size / interval where that fits the body, else the root of its length."""
    announced = announced_side(settings)
    if announced and announced * announced == cells:
        return announced
    side = math.isqrt(cells)
    if side * side != cells:
        raise ProtocolError(f"map of {cells} cells is not square")
    return side


def _known_cells(cells: Cells) -> Cells:
    """Take cells that are none of 0, 1, 2 as unknown."""
    if cells.size == 0 or np.maximum.reduce(cells) <= _OCCUPIED:
        return cells
    return np.where(cells <= _OCCUPIED, cells, np.uint8(0))


def _switch(mode: int, stamp_ns: int) -> Switch:
    if mode not in (ON, OFF):
        raise ProtocolError(f"mode {mode}, expected {ON} (on) or {OFF} (off)")
    return Switch(mode == ON, stamp_ns=stamp_ns)


def _raw_packet(command: Raw) -> Packet:
    """Make the packet of a raw command; raise Refused where a fleet message holds it."""
    spec = PACKETS.get(command.id)
    if spec is None:
        if not 0 <= command.id <= 255:
            raise Malformed(f"packet id {command.id}, expected 0 to 255")
        return OpaquePacket(command.id, command.body)
    if spec.packet is ClientMoveAI:
        return ClientMoveAI(command.body)
    if spec.packet is ChatMessage:
        return ChatMessage(command.body)
    raise Unsupported(f"{spec.name} ({spec.id}) is not raw: use the command or query that holds it")


_TELEMETRY: dict[type[Packet], Callable[[TcpUdpRobot, Any, int], tuple[Telemetry, ...]]] = {
    ServerPosition: TcpUdpRobot._pose,
    ServerSLAMMap: TcpUdpRobot._map,
    ServerSLAMMapPart: TcpUdpRobot._map_part,
    DebugMessage: TcpUdpRobot._text,
    ServerGetSimulatedLidarData: TcpUdpRobot._request,
    ServerLidarStatus: TcpUdpRobot._lidar,
    ServerCamMode: TcpUdpRobot._camera,
}
_COMMANDS: dict[str, Callable[[TcpUdpRobot, Any, float], Outcome | None]] = {
    topics.CMD_DRIVE.path: TcpUdpRobot._drive,
    topics.CMD_MODE.path: TcpUdpRobot._mode,
    topics.CMD_LIDAR.path: TcpUdpRobot._switch_lidar,
    topics.CMD_CAMERA.path: TcpUdpRobot._switch_camera,
    topics.CMD_TEXT.path: TcpUdpRobot._say,
    topics.CMD_SCAN.path: TcpUdpRobot._feed_scan,
    topics.CMD_RAW(NAME).path: TcpUdpRobot._send_raw,
}
