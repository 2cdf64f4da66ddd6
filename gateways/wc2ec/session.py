"""Sessions of WC2EC in both roles and both dialects. Sans-IO.

Source: "Links", "Handshake" and "Versions and dialects" of the protocol page. The Webots controller of the field
registers its devices first: that is the handshake. The draft has none.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

from gateways.wc2ec.messages import (
    MAX_FRAME,
    RegisterSensor,
    SensorData,
    Wc2EcDialect,
    Wc2EcMessage,
    frame_end,
    read,
    write,
)
from zbridge.protocol import EncodeError, Limits, Role, Session, State

HANDSHAKE_S = 5.0
NO_DEVICE = "no device was registered"
SETTLE_S = 0.1
"""Seconds after a registration without another one or data: then the registrations are complete."""

_BOUNDS = Limits(frame_bytes=MAX_FRAME, handshake_s=HANDSHAKE_S)


class Wc2EcSession(Session[Wc2EcMessage]):
    """Both roles. ``values``: configuration values of a sensor; the framing depends on it.

    bounds: what a listener demands of its clients.
    """

    def __init__(self, dialect: Wc2EcDialect, *, values: int = 0, bounds: Limits = _BOUNDS) -> None:
        self.dialect = dialect
        peer = Role.ROBOT if self.role is Role.HQ else Role.HQ
        self.frame_end = frame_end(dialect, peer, values=values)
        super().__init__(bounds)

    def encode(self, message: Wc2EcMessage) -> bytes:
        if self.dialect not in message.commands:
            raise EncodeError(f"{type(message).__name__} has no place in dialect {self.dialect.value}")
        return write(message, self.dialect)

    def decode(self, frame: bytes) -> Wc2EcMessage:
        return read(frame, self.dialect)

    def accept(self, message: Wc2EcMessage, now: float) -> bool:
        return True


class ExternalRole(Wc2EcSession):
    """We play the external controller towards a Webots controller."""

    kept: ClassVar[dict[str, Any]] = {"_settled_at": float}
    role = Role.HQ
    silent_s = math.inf  # a simulation that is paused says nothing

    def __init__(self, dialect: Wc2EcDialect) -> None:
        super().__init__(dialect)
        self._settled_at = math.inf

    def opened(self, now: float) -> None:
        if self.dialect is Wc2EcDialect.DRAFT:
            self.establish("", ())

    def overdue(self) -> str:
        return f"connected, but {NO_DEVICE} within {self.limits.handshake_s:g} s"

    def accept(self, message: Wc2EcMessage, now: float) -> bool:
        if self.state is State.HANDSHAKING:
            if isinstance(message, RegisterSensor):
                self.lift_limit()
                self._settled_at = now + SETTLE_S
            elif isinstance(message, SensorData):
                self._settle()
        return True

    def timers(self) -> float:
        return self._settled_at

    def on_timer(self, now: float) -> None:
        self._settle()

    def _settle(self) -> None:
        self._settled_at = math.inf
        if self.state is State.HANDSHAKING:
            self.establish("", ())


class ControllerRole(Wc2EcSession):
    """We play the Webots controller towards an external one."""

    role = Role.ROBOT

    def opened(self, now: float) -> None:
        self.establish("", ())
