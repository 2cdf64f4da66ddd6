"""Packets of a robot to fleet messages, with all units and axes. Sans-IO.

Source: "Translation from the robot" and "Limits" (a map in parts) of the protocol page. The robot's axes are x right
and y forward, lengths in its own unit (centimetres), headings in degrees; the fleet's are those of REP 103.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

from gateways.tcpudp import messages as packets
from gateways.tcpudp.maps import known_cells
from gateways.tcpudp.options import NAME, TcpUdpOptions
from gateways.tcpudp.session.hq_role import HqRole
from gateways.tcpudp.settings import RobotSettings13, Settings
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage, Map, Pose, Raw, Switch, Text
from zbridge.protocol import Form, Kept, ProtocolError, Spare, Telemetry, Translate

ON, OFF = 1, 2
MAX_SIDE = 2048
"""Cells along a side of the largest map that is put together from parts."""
_RADIANS = math.pi / 180


class TelemetryTranslator(Kept):
    """Translates what one robot sends; puts maps together that come in parts. Made anew for each robot, not session."""

    kept: ClassVar[dict[str, Any]] = {
        "_parts": Spare(Form(lambda parts: parts, lambda raw: None if raw is None else bytearray(raw))),
        "_parts_ns": int,
        "_parts_from": str | None,
        "_map_awaited": bool,
    }

    def __init__(self, options: TcpUdpOptions) -> None:
        self._options = options
        self._session: HqRole | None = None
        self._parts: bytearray | None = None
        """The cells of the map that came in parts on this connection."""
        self._parts_ns = 0
        self._parts_from: str | None = None
        """The version of the robot, if it sends its map in parts."""
        self._map_awaited = False
        self._unit_m = options.length_unit_m
        self._heading_offset = options.heading_offset

    def begin(self, session: HqRole) -> None:
        """Begin with a new connection."""
        self._session = session
        self._parts = None

    def translator(self, kind: type) -> Translate:
        """Return the function that translates packets of one class."""
        return partial(_TELEMETRY.get(kind, TelemetryTranslator._raw), self)

    def known_map(self) -> FleetMessage | None:
        """Return the map of the parts received on this connection, None if there is none; later cells win."""
        if self._parts is None:
            return None
        ((_, shown),) = self._map(packets.ServerSLAMMap(bytes(self._parts)), self._parts_ns)
        return shown

    @property
    def sends_parts(self) -> bool:
        """True if the robot sends its map in parts: its handler of 52 is empty ("Limits")."""
        return self._parts_from is not None and self._session is not None and self._parts_from == self._session.version

    def await_map(self) -> None:
        """Publish the map with its next part, not only with the last: a query waits."""
        self._map_awaited = True

    # Packets

    def _pose(self, message: packets.ServerPosition, stamp_ns: int) -> tuple[Telemetry, ...]:
        x, y, heading = message.x * self._unit_m, message.y * self._unit_m, message.heading_deg * _RADIANS
        return ((topics.POSE, Pose(x, y, heading + self._heading_offset, stamp_ns=stamp_ns)),)

    def _map(self, message: packets.ServerSLAMMap, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Turn x-major cells (index = x * side + y) into rows of y; cells other than 0, 1, 2 become unknown."""
        import numpy as np

        self._map_awaited = False
        settings = self._session.settings if self._session is not None else None
        values = message.cells
        side = _side(len(values), settings)
        cell = self._cell_m(settings)
        cells = known_cells(np.frombuffer(values, np.uint8)).reshape(side, side).T
        half = -side * cell / 2
        origin = self._options.map_origin or (half, half)
        return ((topics.MAP, Map(side, side, cell, origin, cells, stamp_ns=stamp_ns)),)

    def _map_part(self, message: packets.ServerSLAMMapPart, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Enter a part, cut at the end of the map. Give the map with its last part, or if a query waits."""
        assert self._session is not None
        self._parts_from = self._session.version
        side = announced_side(self._session.settings)
        if side == 0:
            raise ProtocolError("map part of a robot that announces no map size")
        if self._parts is None or len(self._parts) != side * side:
            self._parts = bytearray(side * side)
        cells = message.cells[: max(0, len(self._parts) - message.start)]
        self._parts[message.start : message.start + len(cells)] = cells
        self._parts_ns = stamp_ns
        if message.end < len(self._parts) and not self._map_awaited:
            return ()
        return self._map(packets.ServerSLAMMap(bytes(self._parts)), stamp_ns)

    def _cell_m(self, settings: Settings | None) -> float:
        interval = settings.slam_map_interval if isinstance(settings, RobotSettings13) else 0
        return interval * self._unit_m if interval > 0 else self._options.map_cell_m

    def _text(self, message: packets.DebugMessage, stamp_ns: int) -> tuple[Telemetry, ...]:
        return ((topics.TEXT, Text(message.text, "debug", stamp_ns=stamp_ns)),)

    def _request(self, message: packets.ServerGetSimulatedLidarData, stamp_ns: int) -> tuple[Telemetry, ...]:
        return ((topics.TEXT, Text("simulated lidar data", "request", stamp_ns=stamp_ns)),)

    def _lidar(self, message: packets.ServerLidarStatus, stamp_ns: int) -> tuple[Telemetry, ...]:
        return ((topics.LIDAR, _switch(message.mode, stamp_ns)),)

    def _camera(self, message: packets.ServerCamMode, stamp_ns: int) -> tuple[Telemetry, ...]:
        return ((topics.CAMERA, _switch(message.mode, stamp_ns)),)

    def _raw(self, message: packets.Packet, stamp_ns: int) -> tuple[Telemetry, ...]:
        """Pass on unchanged what no fleet message holds."""
        return ((topics.RAW(NAME), Raw(*message.raw(), stamp_ns=stamp_ns)),)


def announced_side(settings: Settings | None) -> int:
    """Return the cells along a side of the map as the robot announces them; 0 for none or an absurd number."""
    if not isinstance(settings, RobotSettings13) or settings.slam_map_interval <= 0:
        return 0
    side = settings.slam_map_size // settings.slam_map_interval
    return side if 0 < side <= MAX_SIDE else 0


def _side(cells: int, settings: Settings | None) -> int:
    """Find the side of a square map: size / interval if that fits the body, else the root of its length."""
    announced = announced_side(settings)
    if announced and announced * announced == cells:
        return announced
    side = math.isqrt(cells)
    if side * side != cells:
        raise ProtocolError(f"map of {cells} cells is not square")
    return side


def _switch(mode: int, stamp_ns: int) -> Switch:
    if mode not in (ON, OFF):
        raise ProtocolError(f"mode {mode}, expected {ON} (on) or {OFF} (off)")
    return Switch(mode == ON, stamp_ns=stamp_ns)


_TELEMETRY: dict[type[packets.Packet], Callable[[TelemetryTranslator, Any, int], tuple[Telemetry, ...]]] = {
    packets.ServerPosition: TelemetryTranslator._pose,
    packets.ServerSLAMMap: TelemetryTranslator._map,
    packets.ServerSLAMMapPart: TelemetryTranslator._map_part,
    packets.DebugMessage: TelemetryTranslator._text,
    packets.ServerGetSimulatedLidarData: TelemetryTranslator._request,
    packets.ServerLidarStatus: TelemetryTranslator._lidar,
    packets.ServerCamMode: TelemetryTranslator._camera,
}
