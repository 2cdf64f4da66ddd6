"""Where a robot is that does not say so: its speed and turn rate added up. Sans-IO; errors grow with the way."""

from __future__ import annotations

import math

from zbridge.fleet.messages import Pose
from zbridge.views.ros2.shapes import Speeds

LONGEST_S = 3.0
"""Nothing is added up over a longer pause: nobody knows what happened."""
SPREAD_PER_M = 4.0
"""The variance of the result grows by so many times that of a pose with each metre or radian."""


class Reckoning:
    """Adds up from the first motion on. spread: how many times larger the variance is than that of a pose."""

    def __init__(self) -> None:
        self.pose = Pose(0.0, 0.0, 0.0)
        self.spread = 1.0
        self._at_ns: int | None = None

    def __repr__(self) -> str:
        return f"<Reckoning {self.pose.x:.2f} {self.pose.y:.2f} {self.pose.heading:.2f}>"

    def add(self, speeds: Speeds, stamp_ns: int) -> Pose | None:
        """Add a motion that was measured at ``stamp_ns``; None where it has no speed or no turn rate."""
        if speeds.forward_mps is None or speeds.turn_radps is None:
            return None
        before, self._at_ns = self._at_ns, stamp_ns
        passed_s = (stamp_ns - before) / 1e9 if before is not None else 0.0
        if 0.0 < passed_s <= LONGEST_S:
            way, turned = speeds.forward_mps * passed_s, speeds.turn_radps * passed_s
            middle = self.pose.heading + turned / 2
            self.pose = Pose(
                self.pose.x + way * math.cos(middle),
                self.pose.y + way * math.sin(middle),
                math.remainder(self.pose.heading + turned, math.tau),
            )
            self.spread = min(self.spread + SPREAD_PER_M * (abs(way) + abs(turned)), 1e6)
        return self.pose
