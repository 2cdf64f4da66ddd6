"""One TCP/UDP HQ program: its session, how frames are queued for it, and its packets as fleet commands. Sans-IO.

Source: "Towards HQ programs" and "Translation of commands" of the protocol page. Packets that no fleet message holds
become raw commands.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

from gateways.tcpudp import messages as packets
from gateways.tcpudp.maps import TCP_BYTES, Geometry
from gateways.tcpudp.options import NAME, TcpUdpHqOptions
from gateways.tcpudp.session.robot_role import RobotRole
from gateways.tcpudp.settings import Feature, RobotSettings13, Settings
from gateways.tcpudp.telemetry import OFF, ON
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Mode, Query, Raw, Scan, Switch, Text
from zbridge.protocol import Datagram, EncodeError, Limits, ProtocolError, Send, Telemetry

_ASKING = ("1.1",)
"""Versions whose first programs need to have asked for a packet ("What crashes a peer" in ``fragile-robots.md``)."""
_ON_REQUEST = frozenset({packets.ServerSLAMMap.spec.id, packets.ServerPosition.spec.id})


class TcpUdpClient(RobotRole):
    """The session with one HQ program, in which the gateway plays the robot, and the packets that the program knows.

    geometry: of the map that the program was announced.
    """

    kept: ClassVar[dict[str, Any]] = {"geometry": Geometry, "_asked": set[int]}

    def __init__(
        self, limits: Limits, settings: Settings, client_id: int, options: TcpUdpHqOptions, geometry: Geometry
    ) -> None:
        self.geometry = geometry
        super().__init__(
            limits,
            settings,
            client_id,
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
        """Record that the client asked for a packet, so that it has a handler for it."""
        self._asked.add(packet_id)
        self.known |= {packet_id}

    @property
    def by_udp(self) -> bool:
        """Whether datagrams were agreed on and reach the client."""
        return self.transport == "udp"

    def show(self, slot: str, packet_id: int, frame: bytes, now: float) -> None:
        """Queue a frame as the newest of its slot, if the client knows the packet; count it otherwise."""
        if packet_id in self.known:
            self.outbox.set(slot, (frame,), now)
        else:
            self.leave_out(packet_id)

    def leave_out(self, packet_id: int) -> None:
        """Count a packet that the client does not know."""
        spec = packets.PACKETS.get(packet_id)
        name = f"{spec.name} ({packet_id})" if spec is not None else f"packet {packet_id}"
        self.left_out[f"{name} unasked" if packet_id in _ON_REQUEST else name] += 1


def newest_of(slot: str, packet: packets.Packet) -> Send:
    """Encode a packet once for all clients, to be queued as the newest of its slot, by datagram where it may be."""
    frame = packets.encode_packet(packet, RobotRole.sender_id)
    datagram = Datagram(frame) if packet.spec.carrier is packets.Carrier.UDP_IF_AGREED else frame

    def send(session: TcpUdpClient, now: float) -> None:
        session.show(slot, packet.spec.id, datagram if session.by_udp else frame, now)

    return send


def each_once(packet: packets.Packet) -> Send:
    """Encode a packet once for all clients, to be queued behind others; nothing replaces it.

    Raises EncodeError if it is longer than programs take by TCP.
    """
    frame = packets.encode_packet(packet, RobotRole.sender_id)
    if len(frame) > TCP_BYTES:
        raise EncodeError(f"packet of {len(frame)} bytes, HQ programs take {TCP_BYTES} by TCP")
    packet_id = frame[5]

    def send(session: TcpUdpClient, now: float) -> None:
        if packet_id in session.known:
            session.outbox.put(frame)
        else:
            session.leave_out(packet_id)

    return send


def _without_map_flag(settings: Settings) -> bytes:
    """Leave out the byte that some HQ programs of version 1.3 skip when they read the settings."""
    block = settings.encode()
    place = list(Feature).index(Feature.SLAM_MAP)
    return block[:place] + block[place + 1 :] if isinstance(settings, RobotSettings13) else block


Commands = tuple[Telemetry, ...]


def _move(client: TcpUdpClient, packet: packets.ClientJoystickMove, options: TcpUdpHqOptions) -> Commands:
    speed = packet.speed / options.speed_full
    forward, left = packet.y * speed, 0.0 - packet.x * speed
    if not math.isfinite(forward + left):
        raise ProtocolError(f"clientJoystickMove {packet.x:g}, {packet.y:g} at {packet.speed:g}")
    scale = max(1.0, math.hypot(forward, left))
    return ((topics.CMD_DRIVE, Drive(forward=forward / scale, left=left / scale)),)


def _rotate(client: TcpUdpClient, packet: packets.ClientJoystickRotate, options: TcpUdpHqOptions) -> Commands:
    if not math.isfinite(packet.speed):
        raise ProtocolError(f"clientJoystickRotate at {packet.speed:g}")
    turn = max(-1.0, min(1.0, 0.0 - packet.speed / options.turn_full))
    return ((topics.CMD_DRIVE, Drive(turn=turn)),)


def _stop(client: TcpUdpClient, packet: packets.ClientJoystickStop, options: TcpUdpHqOptions) -> Commands:
    return ((topics.CMD_DRIVE, Drive()),)


def _mode(client: TcpUdpClient, packet: packets.ClientControllMode, options: TcpUdpHqOptions) -> Commands:
    if packet.mode not in _MODES:
        raise ProtocolError(f"control mode {packet.mode}, expected 1 (none), 2 (joystick) or 3 (AI)")
    return ((topics.CMD_MODE, _MODES[packet.mode]),)


def _lidar(client: TcpUdpClient, packet: packets.ClientLidarMode, options: TcpUdpHqOptions) -> Commands:
    if packet.mode not in (ON, OFF):
        raise ProtocolError(f"lidar mode {packet.mode}, expected {ON} (on) or {OFF} (off)")
    return ((topics.CMD_LIDAR, Switch(packet.mode == ON)),)


def _text(client: TcpUdpClient, packet: packets.DebugMessage, options: TcpUdpHqOptions) -> Commands:
    return ((topics.CMD_TEXT, Text(packet.text, sender=client.name)),) if packet.text else ()


def _scan(client: TcpUdpClient, packet: packets.ClientSimulatedLidarData, options: TcpUdpHqOptions) -> Commands:
    """Translate simulated lidar data: one turn of ranges counter-clockwise from straight ahead, 0 = no measurement."""
    count = len(packet.ranges)
    if not count:
        raise ProtocolError("simulated lidar data without a range")
    import numpy as np

    with np.errstate(all="ignore"):  # ranges that overflow are points the scan does not have
        ranges_m = np.asarray(packet.ranges, np.float32) * np.float32(options.length_unit_m)
        ranges_m[~(np.isfinite(ranges_m) & (ranges_m > 0))] = np.nan
        most_m = float(np.nanmax(ranges_m, initial=0.0))
    return ((topics.CMD_SCAN, Scan(0.0, 2 * math.pi / count, 0.0, most_m, ranges_m)),)


def _ask_map(client: TcpUdpClient, packet: packets.ClientGetSLAMMap, options: TcpUdpHqOptions) -> Commands:
    client.asks(packets.ServerSLAMMap.spec.id)
    return ((topics.RPC_MAP, Query()),)


def _ask_pose(client: TcpUdpClient, packet: packets.ClientGetPosition, options: TcpUdpHqOptions) -> Commands:
    client.asks(packets.ServerPosition.spec.id)
    return ((topics.RPC_POSE, Query()),)


def raw_command(client: TcpUdpClient, packet: packets.Packet, options: TcpUdpHqOptions) -> Commands:
    """Pass on a packet that no fleet message holds."""
    return ((topics.CMD_RAW(NAME), Raw(*packet.raw())),)


_MODES = {1: Mode("none"), 2: Mode("manual"), 3: Mode("autonomous")}
TRANSLATE: dict[type[packets.Packet], Callable[[TcpUdpClient, Any, TcpUdpHqOptions], Commands]] = {
    packets.ClientJoystickMove: _move,
    packets.ClientJoystickRotate: _rotate,
    packets.ClientJoystickStop: _stop,
    packets.ClientControllMode: _mode,
    packets.ClientLidarMode: _lidar,
    packets.DebugMessage: _text,
    packets.ClientSimulatedLidarData: _scan,
    packets.ClientGetSLAMMap: _ask_map,
    packets.ClientGetPosition: _ask_pose,
}
"""The translation of each packet; all others are raw commands. They raise ProtocolError for one without a meaning."""
