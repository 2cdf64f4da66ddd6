"""A viewer's ``geometry_msgs/Twist`` as a fraction of what a robot can do; and when it may move the robot. Sans-IO."""

from __future__ import annotations

import math
from collections.abc import Mapping

import msgspec

from zbridge.errors import Malformed
from zbridge.fleet.messages import Drive

QUIET_S = 1.0
"""Silence after which a viewer may move a robot again that was taken from it."""


class Scale(msgspec.Struct, frozen=True):
    """The speeds of a robot at full scale: m/s over ground, and rad/s."""

    speed_full_mps: float = 1.0
    turn_full_radps: float = 1.0


class Scales(msgspec.Struct, frozen=True):
    """The scales of robots by name, and of all others."""

    others: Scale = Scale()
    robots: Mapping[str, Scale] = {}

    def of(self, robot: str) -> Scale:
        """Return the scale of a robot."""
        return self.robots.get(robot, self.others)


class _Vector(msgspec.Struct, frozen=True):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class _Twist(msgspec.Struct, frozen=True):
    linear: _Vector = _Vector()
    angular: _Vector = _Vector()


_decoder = msgspec.json.Decoder(_Twist)


def read_twist(payload: bytes, scale: Scale) -> Drive:
    """Read a Twist in JSON; raise Malformed. Above full scale all parts are scaled down alike: the curve stays."""
    try:
        twist = _decoder.decode(payload)
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise Malformed(f"Twist: {error}") from error
    parts = (
        twist.linear.x / scale.speed_full_mps,
        twist.linear.y / scale.speed_full_mps,
        twist.angular.z / scale.turn_full_radps,
    )
    if not all(map(math.isfinite, parts)):
        raise Malformed("Twist: expected finite numbers")
    most = max(1.0, *map(abs, parts))
    forward, left, turn = (max(-1.0, min(1.0, part / most)) for part in parts)
    return Drive(forward=forward, left=left, turn=turn)


class Debt:
    """What a viewer owes before it may move a robot: nothing, or a zero or a second of silence.

    It owes after the robot was stopped or taken from it: whose stick is still pushed must not move the robot anew.
    """

    def __init__(self) -> None:
        self.why: str | None = None
        """Why it owes; None while it does not."""
        self._heard_at = -math.inf

    def __repr__(self) -> str:
        return f"<Debt {self.why}>"

    def owe(self, why: str) -> None:
        """The robot was stopped, or taken from the viewer."""
        self.why = why

    def pays(self, *, moving: bool, now: float) -> bool:
        """Take a Twist; return whether it may be carried out."""
        quiet = now - self._heard_at >= QUIET_S
        self._heard_at = now
        if not moving or quiet:
            self.why = None
        return self.why is None
