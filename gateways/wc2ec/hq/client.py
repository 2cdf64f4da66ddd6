"""The session of one external controller. Sans-IO."""

from __future__ import annotations

import math
from typing import Any, ClassVar

from gateways.wc2ec.messages import Dialect, SetValue, Wc2EcMessage
from gateways.wc2ec.session import ControllerRole
from zbridge.protocol import Limits

LEFT, RIGHT = "left", "right"
"""The motors of a robot that has none of its own."""


class HqClient(ControllerRole):
    """One controller: which devices it was told, which it enabled (draft), and how it set the two wheels."""

    kept: ClassVar[dict[str, Any]] = {
        "registered": set[int],
        "enabled": set[int],
        "wheels": dict[str, float],
        "fresh": set[str],
        "joined_at": float,
        "said_at": float,
    }
    handled = frozenset({SetValue})

    def __init__(self, dialect: Dialect, *, values: int, bounds: Limits) -> None:
        super().__init__(dialect, values=values, bounds=bounds)
        self.registered: set[int] = set()
        self.enabled: set[int] = set()
        self.wheels = {LEFT: 0.0, RIGHT: 0.0}
        self.fresh: set[str] = set()
        """The wheels that were set since the last drive."""
        self.joined_at = math.inf
        """When the values set so far become a drive, at the latest."""
        self.said_at = -math.inf
        """When the last value came."""

    def accept(self, message: Wc2EcMessage, now: float) -> bool:
        self.said_at = now
        return super().accept(message, now)
