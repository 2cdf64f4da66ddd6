"""What HQ programs of TCP/UDP say, as fleet commands and queries. Sans-IO.

Source: "Translation" of the protocol page. Packets that no fleet message holds become raw commands.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from gateways.tcpudp.hq.client import HqClient
from gateways.tcpudp.hq.options import HqOptions
from gateways.tcpudp.messages import (
    ClientControllMode,
    ClientGetPosition,
    ClientGetSLAMMap,
    ClientJoystickMove,
    ClientJoystickRotate,
    ClientJoystickStop,
    ClientLidarMode,
    ClientSimulatedLidarData,
    DebugMessage,
    OpaquePacket,
    Packet,
    ServerPosition,
    ServerSLAMMap,
)
from gateways.tcpudp.translate import NAME, OFF, ON
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Mode, Query, Raw, Scan, Switch, Text
from zbridge.protocol import ProtocolError, Telemetry

Commands = tuple[Telemetry, ...]


def commands(client: HqClient, packet: Packet, options: HqOptions) -> Commands:
    """Translate a packet of a client; raise ProtocolError if it has no meaning."""
    translate = _TRANSLATE.get(type(packet))
    return translate(client, packet, options) if translate is not None else _raw(packet)


def _move(client: HqClient, packet: ClientJoystickMove, options: HqOptions) -> Commands:
    speed = packet.speed / options.speed_full
    forward, left = packet.y * speed, 0.0 - packet.x * speed
    if not math.isfinite(forward + left):
        raise ProtocolError(f"clientJoystickMove {packet.x:g}, {packet.y:g} at {packet.speed:g}")
    scale = max(1.0, math.hypot(forward, left))
    return ((topics.CMD_DRIVE, Drive(forward=forward / scale, left=left / scale)),)


def _rotate(client: HqClient, packet: ClientJoystickRotate, options: HqOptions) -> Commands:
    if not math.isfinite(packet.speed):
        raise ProtocolError(f"clientJoystickRotate at {packet.speed:g}")
    turn = max(-1.0, min(1.0, 0.0 - packet.speed / options.turn_full))
    return ((topics.CMD_DRIVE, Drive(turn=turn)),)


def _stop(client: HqClient, packet: ClientJoystickStop, options: HqOptions) -> Commands:
    return ((topics.CMD_DRIVE, Drive()),)


def _mode(client: HqClient, packet: ClientControllMode, options: HqOptions) -> Commands:
    if packet.mode not in _MODES:
        raise ProtocolError(f"control mode {packet.mode}, expected 1 (none), 2 (joystick) or 3 (AI)")
    return ((topics.CMD_MODE, _MODES[packet.mode]),)


def _lidar(client: HqClient, packet: ClientLidarMode, options: HqOptions) -> Commands:
    if packet.mode not in (ON, OFF):
        raise ProtocolError(f"lidar mode {packet.mode}, expected {ON} (on) or {OFF} (off)")
    return ((topics.CMD_LIDAR, Switch(packet.mode == ON)),)


def _text(client: HqClient, packet: DebugMessage, options: HqOptions) -> Commands:
    return ((topics.CMD_TEXT, Text(packet.text, sender=client.name)),) if packet.text else ()


def _scan(client: HqClient, packet: ClientSimulatedLidarData, options: HqOptions) -> Commands:
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


def _ask_map(client: HqClient, packet: ClientGetSLAMMap, options: HqOptions) -> Commands:
    client.asks(ServerSLAMMap.spec.id)
    return ((topics.RPC_MAP, Query()),)


def _ask_pose(client: HqClient, packet: ClientGetPosition, options: HqOptions) -> Commands:
    client.asks(ServerPosition.spec.id)
    return ((topics.RPC_POSE, Query()),)


def _raw(packet: Packet) -> Commands:
    if isinstance(packet, OpaquePacket):
        raw = Raw(packet.id, packet.body)
    else:
        raw = Raw(packet.spec.id, packet.spec.codec.encode(packet))
    return ((topics.CMD_RAW(NAME), raw),)


_MODES = {1: Mode("none"), 2: Mode("manual"), 3: Mode("autonomous")}
_TRANSLATE: dict[type[Packet], Callable[[HqClient, Any, HqOptions], Commands]] = {
    ClientJoystickMove: _move,
    ClientJoystickRotate: _rotate,
    ClientJoystickStop: _stop,
    ClientControllMode: _mode,
    ClientLidarMode: _lidar,
    DebugMessage: _text,
    ClientSimulatedLidarData: _scan,
    ClientGetSLAMMap: _ask_map,
    ClientGetPosition: _ask_pose,
}
