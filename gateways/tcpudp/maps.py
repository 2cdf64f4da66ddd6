"""Resamples maps to what HQ programs can read: square, of the announced size, short enough for one packet. Sans-IO.

Source: "Translation from the robot" (map bytes) and "Towards HQ programs" of the protocol page.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import msgspec

from zbridge.fleet.messages import Cells, Map
from zbridge.protocol import EncodeError

if TYPE_CHECKING:
    import numpy as np

TCP_BYTES = 2199
"""Bytes of the longest packet that HQ programs read by TCP: they lose packets of 2.2 kB and more."""
UDP_BYTES = 60_000
"""Bytes of the longest packet that is sent by UDP."""
_AROUND = 10
"""Bytes of a map packet besides its cells: header and count."""
_CELL_M = (1e-6, 1e6)
"""Least and greatest side of a cell, metres, that is accepted from the bus."""
_MOST_UNITS = 2**31 - 1
_MOST_M = 1e9
_OCCUPIED = 2


class Geometry(msgspec.Struct, frozen=True):
    """A square grid as it is announced: SLAMMapSize and SLAMMapIntervall, both in the robot's unit of length."""

    size: int
    interval: int

    @property
    def side(self) -> int:
        """Cells along a side."""
        return self.size // self.interval


def most_side(packet_bytes: int) -> int:
    """Return the side, in cells, of the largest map that fits a packet."""
    return math.isqrt(packet_bytes - _AROUND)


class MapFrame(msgspec.Struct, frozen=True):
    """Where HQ programs assume a square grid to lie; the protocol does not define it.

    own: the map is of a robot of this protocol, whose programs expect its zero at the same fraction of the grid as
    before; else the grid is centred on zero. origin: x, y of the first cell, metres; it overrides both.
    """

    own: bool = False
    origin: tuple[float, float] | None = None

    def size_m(self, grid: Map) -> float:
        """Return the side, metres, of the smallest grid that holds the map; less if ``origin`` lies inside the map."""
        (x, y), width, height = grid.origin, grid.columns * grid.cell, grid.rows * grid.cell
        if self.origin is not None:
            return max(x + width - self.origin[0], y + height - self.origin[1], grid.cell)
        if self.own:
            return max(width, height)
        return 2 * max(abs(x), abs(x + width), abs(y), abs(y + height))

    def begin(self, grid: Map, size_m: float) -> tuple[float, float]:
        """Return where a grid of this size begins: x, y in metres from the map's first cell."""
        extents = (grid.columns * grid.cell, grid.rows * grid.cell)
        if self.origin is not None:
            x, y = self.origin
        elif self.own:
            fractions = (min(1.0, max(0.0, -at / extent)) for at, extent in zip(grid.origin, extents, strict=True))
            return tuple(fraction * (extent - size_m) for fraction, extent in zip(fractions, extents, strict=True))  # type: ignore[return-value]
        else:
            x = y = -size_m / 2
        return (x - grid.origin[0], y - grid.origin[1])


_OWN = MapFrame(own=True)


def announceable(grid: Map, unit_m: float, most: int, frame: MapFrame = _OWN) -> Geometry:
    """Return the geometry to announce for a map: its own cells if whole units and few enough, else larger ones.

    unit_m: the robot's unit of length. most: cells along a side at most. Raises EncodeError for cells of a size that
    cannot be announced.
    """
    check(grid)
    extent = frame.size_m(grid) / unit_m
    interval = max(1, math.ceil(round(grid.cell / unit_m, 6)))
    while math.ceil(round(extent / interval, 6)) > most:
        interval = max(interval + 1, math.ceil(extent / most))
    side = max(1, math.ceil(round(extent / interval, 6)))
    if side * interval > _MOST_UNITS:
        raise EncodeError(f"map of {side} x {interval} units")
    return Geometry(side * interval, interval)


def squared(grid: Map, most: int) -> bytes:
    """Return the cells, x-major, of the smallest square around a map; ``most``: cells along a side at most."""
    side = max(grid.rows, grid.columns)
    fitting = max(1, min(side, most))
    return resampled(grid, fitting, grid.cell * side / fitting)


def resampled(grid: Map, side: int, cell_m: float, begin: tuple[float, float] = (0.0, 0.0)) -> bytes:
    """Return a map's cells, x-major, on a square grid that begins ``begin`` metres from the map's first cell.

    side: cells of the grid along a side, ``cell_m`` metres each. A cell is an obstacle if any that it covers is, else
    free if any is, else unknown; cells outside the map are unknown. A cell across a border counts where it ends.
    Raises EncodeError as :func:`check`.
    """
    import numpy as np

    cells: Cells = np.zeros((side, side), np.uint8)
    if grid.cells.size:
        check(grid)
        ratio = cell_m / grid.cell
        x, y = begin
        rows, row_starts, row = _starts(grid.rows, side, ratio, y / grid.cell)
        columns, column_starts, column = _starts(grid.columns, side, ratio, x / grid.cell)
        covered = known_cells(grid.cells[:rows, :columns])
        if len(row_starts) and len(column_starts):
            pooled = np.maximum.reduceat(np.maximum.reduceat(covered, row_starts, axis=0), column_starts, axis=1)
            cells[row : row + len(row_starts), column : column + len(column_starts)] = pooled
    return np.ascontiguousarray(cells.T).tobytes()


def known_cells(cells: Cells) -> Cells:
    """Turn cells other than 0, 1, 2 into unknown."""
    import numpy as np

    if not cells.size or cells.max() <= _OCCUPIED:
        return cells
    return np.where(cells <= _OCCUPIED, cells, np.uint8(0))


def check(grid: Map) -> None:
    """Raise EncodeError for a map whose cells or origin are out of bounds."""
    if not _CELL_M[0] <= grid.cell <= _CELL_M[1] or not all(abs(at) <= _MOST_M for at in grid.origin):
        raise EncodeError(f"map with cells of {grid.cell:g} m at {grid.origin}")


def _starts(
    count: int, side: int, ratio: float, begin: float
) -> tuple[int, np.ndarray[tuple[int], np.dtype[np.intp]], int]:
    """Return along one axis: how many map cells the grid covers, where each grid cell begins, the first one inside.

    count: cells of the map. side: cells of the grid, each ``ratio`` map cells wide. begin: start of the grid, in map
    cells.
    """
    import numpy as np

    edges = np.round(begin + np.arange(side + 1) * ratio, 6)
    starts = np.floor(edges[:-1]).astype(np.intp)
    inside = (edges[1:] > 0) & (starts < count)
    covered = min(count, max(0, math.ceil(edges[-1])))
    first = int(np.argmax(inside)) if inside.any() else 0
    return covered, np.maximum(starts[inside & (starts < covered)], 0), first
