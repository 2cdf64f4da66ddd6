"""Maps as HQ programs can take them: square, of an announced size, small enough for what carries them. Sans-IO.

Source: "Packets" (map bytes) and "The gateway as robot" of the protocol page.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from zbridge.errors import EncodeError
from zbridge.fleet.messages import Cells, Map

TCP_BYTES = 2199
"""Bytes of the longest packet that HQ programs take by TCP: they lose those of 2.2 kB and more."""
UDP_BYTES = 60_000
"""Bytes of the longest packet that passes by UDP."""
_AROUND = 10
"""Bytes of a map packet that are no cells: header and count."""
_CELL_M = (1e-6, 1e6)
"""Sides of a cell, metres, that can be calculated with; whatever is on the bus."""
_MOST_UNITS = 2**31 - 1
_OCCUPIED = 2


class Geometry(msgspec.Struct, frozen=True):
    """A square grid as it is announced: SLAMMapSize and SLAMMapIntervall, in the robot's unit of length."""

    size: int
    interval: int

    @property
    def side(self) -> int:
        """Cells along a side."""
        return self.size // self.interval


def most_side(packet_bytes: int) -> int:
    """Give the side of the largest map that fits a packet."""
    return math.isqrt(packet_bytes - _AROUND)


def announceable(grid: Map, unit_m: float, most: int) -> Geometry:
    """Choose what to announce for a map: its own cells where they are whole units and few enough, else larger ones.

    Raises EncodeError where its cells are of no size that can be announced.
    """
    _check(grid)
    extent = max(grid.rows, grid.columns) * grid.cell / unit_m
    interval = max(1, math.ceil(round(grid.cell / unit_m, 6)))
    while math.ceil(round(extent / interval, 6)) > most:
        interval = max(interval + 1, math.ceil(extent / most))
    side = max(1, math.ceil(round(extent / interval, 6)))
    if side * interval > _MOST_UNITS:
        raise EncodeError(f"map of {side} x {interval} units")
    return Geometry(side * interval, interval)


def squared(grid: Map, most: int) -> bytes:
    """Give the cells, x-major, of the smallest square around a map, with at most so many cells along a side."""
    side = max(grid.rows, grid.columns)
    fitting = max(1, min(side, most))
    return resampled(grid, fitting, grid.cell * side / fitting)


def resampled(grid: Map, side: int, cell_m: float) -> bytes:
    """Give a map's cells, x-major, on a square grid of other cells that begins where the map does.

    A cell is an obstacle where any it covers is, else free where any is, else unknown; so is what lies outside.
    One that lies across a border counts where it ends. Raises EncodeError where the map's cells are of no size.
    """
    cells: Cells = np.zeros((side, side), np.uint8)
    if grid.cells.size:
        _check(grid)
        ratio = cell_m / grid.cell
        rows, row_starts = _starts(grid.rows, side, ratio)
        columns, column_starts = _starts(grid.columns, side, ratio)
        covered = grid.cells[:rows, :columns]
        if covered.size and covered.max() > _OCCUPIED:
            covered = np.where(covered > _OCCUPIED, np.uint8(0), covered)
        pooled = np.maximum.reduceat(np.maximum.reduceat(covered, row_starts, axis=0), column_starts, axis=1)
        cells[: len(row_starts), : len(column_starts)] = pooled
    return np.ascontiguousarray(cells.T).tobytes()


def _check(grid: Map) -> None:
    if not _CELL_M[0] <= grid.cell <= _CELL_M[1]:
        raise EncodeError(f"map with cells of {grid.cell:g} m")


def _starts(count: int, side: int, ratio: float) -> tuple[int, np.ndarray[tuple[int], np.dtype[np.intp]]]:
    """Say how many of ``count`` cells ``side`` larger (or smaller) ones cover, and where each of those begins."""
    starts = np.floor(np.round(np.arange(side) * ratio, 6)).astype(np.intp)
    covered = min(count, math.ceil(round(side * ratio, 6)))
    return covered, starts[starts < covered]
