"""Ends, or freezes, a gateway's process at a step of a restart, exactly there.

A test's fork server calls :func:`watch` before it forks: gateways then have a channel that knows the steps. Whoever
measures writes an order (:class:`Order`) to the folder; the process that comes to this step carries it out, once, and
notes when.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from zbridge.app.handover.channel import Go, HandoverChannel, HandoverState, Hello, Message, Up
from zbridge.app.handover.processes import PROCESSES
from zbridge.protocol.session import Role
from zbridge.transport import Conversation, Parcel

M = TypeVar("M")


class Of(StrEnum):
    """Which process."""

    PREDECESSOR = "predecessor"
    SUCCESSOR = "successor"


BEFORE_HELLO, AFTER_HELLO, AFTER_GIVEN, AFTER_UP = "before hello", "after hello", "after given", "after up"
BEFORE_GO, AFTER_GO, FIRST_READ = "before go", "after go", "after the first read"
STEPS: dict[Of, tuple[str, ...]] = {
    Of.PREDECESSOR: (BEFORE_HELLO, AFTER_HELLO, AFTER_GIVEN, AFTER_UP, BEFORE_GO, AFTER_GO),
    Of.SUCCESSOR: (BEFORE_HELLO, AFTER_HELLO, AFTER_GIVEN, AFTER_UP, AFTER_GO, FIRST_READ),
}
"""The steps of a restart, as each process comes to them."""


class Order(NamedTuple):
    """End (SIGKILL) or freeze (SIGSTOP) a process of a robot when it comes to a step."""

    of: Of
    step: str
    number: int = signal.SIGKILL

    def write(self, folder: Path, robot: str) -> None:
        new = folder / f"{robot}.new"
        new.write_text(f"{self.of}|{self.step}|{int(self.number)}")
        new.rename(folder / f"{robot}.order")

    @staticmethod
    def carried_out(folder: Path, robot: str) -> float:
        """Tell when it was carried out, on the monotonic clock; 0: not yet."""
        with contextlib.suppress(FileNotFoundError):
            return float((folder / f"{robot}.at").read_text())
        return 0.0


# In the gateway's process

_folder, _robot, _has_gone = Path(), "", False


def watch(folder: Path) -> None:
    """Let all gateways that are forked from here know their steps."""
    global _folder
    _folder = folder
    PROCESSES.pair = _pair  # type: ignore[method-assign]
    PROCESSES.channel = _Incoming  # type: ignore[method-assign,assignment]
    received = Conversation.received

    def noted(self: Conversation, data: bytes) -> None:
        received(self, data)
        if _has_gone and self.session.role is Role.HQ:  # the robot's, not an HQ program's
            _come(Of.SUCCESSOR, FIRST_READ)

    Conversation.received = noted  # type: ignore[method-assign]


def be(robot: str) -> None:
    """Be the gateway of a robot."""
    global _robot
    _robot = robot


def _come(of: Of, step: str) -> None:
    order = _folder / f"{_robot}.order"
    with contextlib.suppress(FileNotFoundError):
        wanted, at, number = order.read_text().split("|")
        if (wanted, at) == (of, step):
            order.unlink()
            new = _folder / f"{_robot}.at.new"
            new.write_text(str(time.monotonic()))
            new.rename(_folder / f"{_robot}.at")
            os.kill(os.getpid(), int(number))


def _pair() -> tuple[HandoverChannel, socket.socket]:
    near, far = socket.socketpair()
    return _Outgoing(near), far


class _Outgoing(HandoverChannel):
    def _send(self, message: Message, parcel: Parcel | None) -> None:
        if isinstance(message, Go):
            _come(Of.PREDECESSOR, BEFORE_GO)
        super()._send(message, parcel)
        if isinstance(message, HandoverState | Go):
            _come(Of.PREDECESSOR, AFTER_GIVEN if isinstance(message, HandoverState) else AFTER_GO)

    def _receive(self, kind: type[M], timeout_s: float | None) -> M:
        if kind is Hello:
            _come(Of.PREDECESSOR, BEFORE_HELLO)
        message = super()._receive(kind, timeout_s)
        if kind in (Hello, Up):
            _come(Of.PREDECESSOR, AFTER_HELLO if kind is Hello else AFTER_UP)
        return message


class _Incoming(HandoverChannel):
    def _send(self, message: Message, parcel: Parcel | None) -> None:
        if isinstance(message, Hello):
            _come(Of.SUCCESSOR, BEFORE_HELLO)
        super()._send(message, parcel)
        if isinstance(message, Hello | Up):
            _come(Of.SUCCESSOR, AFTER_HELLO if isinstance(message, Hello) else AFTER_UP)

    def _receive(self, kind: type[M], timeout_s: float | None) -> M:
        message: Any = super()._receive(kind, timeout_s)
        if kind is HandoverState:
            _come(Of.SUCCESSOR, AFTER_GIVEN)
        if kind is Go:
            global _has_gone
            _come(Of.SUCCESSOR, AFTER_GO)
            _has_gone = True
        return message
