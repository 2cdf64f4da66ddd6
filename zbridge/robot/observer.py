"""What somebody outside of this process must know to stop the robot if this process dies: links, stops, motion.

An observer is told of every change; it asks the device for the rest. Knows no process and no supervisor.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import msgspec

from zbridge.transport import Link
from zbridge.wire.frames import Partial

Resume = Callable[[int], Partial | None]
"""``resume(most_bytes)``: the incomplete frame of a stream, by :meth:`zbridge.wire.frames.FrameBuffer.partial`."""


class StopFrame(msgspec.Struct, frozen=True, array_like=True):
    """One frame of a stop. datagram: it goes by datagram, not by the stream."""

    data: bytes
    datagram: bool = False


class LastStop(msgspec.Struct, frozen=True):
    """The stop that somebody else writes if this process dies now.

    driven: a program drives the robot, or told it to move by itself. frames: to be written ``gap_s`` seconds apart;
    none where the robot cannot be stopped now. state: as on ``status``.
    """

    driven: bool = False
    frames: tuple[StopFrame, ...] = ()
    gap_s: float = 0.0
    state: str = "offline"


class Boundary(msgspec.Struct, frozen=True):
    """Where the outgoing stream of a link stands. outgoing: every frame that was begun is with the kernel whole."""

    outgoing: bool = True


class Observed(Protocol):
    """A device, as an observer sees it."""

    @property
    def driven(self) -> bool:
        """Whether a program drives the robot, or told it to move by itself."""

    @property
    def state(self) -> str:
        """The state of the robot, as on ``status``."""

    def last_stop(self) -> LastStop:
        """Return what stops the robot now."""

    def boundary(self, name: str) -> Boundary:
        """Return where the outgoing stream of the link of this name stands."""

    def partial(self, name: str, most_bytes: int) -> Partial | None:
        """Return the incomplete frame that came by the link of this name; see :data:`Resume`."""


class Observer(Protocol):
    """Is told what happens to the links of one robot. All methods run on the event loop and return at once."""

    def began(self, device: Observed) -> None:
        """Start: the device serves its robot."""

    def ended(self) -> None:
        """End: the device has left its robot."""

    def linked(self, name: str, link: Link, up: bool) -> None:
        """Note that the link of this name is up, or that it is being closed."""

    def read(self, name: str, resume: Resume) -> None:
        """Note that the bytes of a read of this link have been cut into frames."""

    def changed(self, *, at_once: bool = False) -> None:
        """Note that :meth:`Observed.last_stop` may give something else from now on. Called for every command.

        at_once: after a command on which the way to stop the robot may depend, as its mode.
        """

    def published(self) -> None:
        """Note that a key that keeps its last value was published for the first time."""


class Nobody:
    """The observer of a robot that nobody else looks after."""

    def began(self, device: Observed) -> None:
        """Do nothing."""

    def ended(self) -> None:
        """Do nothing."""

    def linked(self, name: str, link: Link, up: bool) -> None:
        """Do nothing."""

    def read(self, name: str, resume: Resume) -> None:
        """Do nothing."""

    def changed(self, *, at_once: bool = False) -> None:
        """Do nothing."""

    def published(self) -> None:
        """Do nothing."""
