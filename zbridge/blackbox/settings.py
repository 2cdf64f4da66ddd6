"""``[blackbox]`` of a robot's file, or of ``host.toml``."""

from __future__ import annotations

from typing import Annotated

import msgspec


class BlackBoxSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[blackbox]``: the last minutes of the robot on disk, kept after an incident.

    minutes: that are kept before a cause. keep: most incidents of a robot; older ones are deleted. dir: of the files;
    left out: ``blackbox`` in the folder of latched stops. fsync: wait for the disk after each write, so that lost power
    loses no more than a killed process.
    """

    minutes: Annotated[float, msgspec.Meta(ge=0.5, le=60.0)] = 5.0
    keep: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 20
    dir: Annotated[str, msgspec.Meta(min_length=1)] | None = None
    fsync: bool = False

    @property
    def segments(self) -> int:
        """The number of segments that are kept before a cause, with the one that is being written."""
        return round(self.minutes * 60 / SEGMENT_S) + 1


SEGMENT_S = 10.0
"""Seconds of a segment."""
