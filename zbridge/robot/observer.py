"""What somebody outside of this process must know to stop the robot if this process dies: links, stops, motion.

An observer is told of every change; it asks the device for the rest. Knows no process and no supervisor.
"""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from zbridge.control.authority import Authority
from zbridge.control.context import RobotContext
from zbridge.errors import Refused
from zbridge.protocol.session import Datagram, State
from zbridge.robot.connection import Links, Resume
from zbridge.transport import Link
from zbridge.wire.frames import Partial


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


class ObservedRobot:
    """One robot as an observer sees it. aside: whether another gateway serves it while this one's link is kept."""

    def __init__(self, context: RobotContext, links: Links, authority: Authority) -> None:
        self.aside = False
        self._context = context
        self._links = links
        self._authority = authority

    def __repr__(self) -> str:
        return f"<ObservedRobot {self._context.keys.robot} {self.state}>"

    @property
    def driven(self) -> bool:
        """Whether a program drives the robot, or told it to move by itself."""
        return self._authority.motion.driven or self._authority.motion.moving

    @property
    def state(self) -> str:
        """The state of the robot, as on ``status``."""
        return self._links.first.state

    @property
    def stalled(self) -> bool:
        """Whether the robot's link accepts no bytes."""
        conversation = self._links.first.conversation
        return conversation is not None and conversation.blocked

    def last_stop(self) -> LastStop:
        """Return what stops the robot now; see :class:`LastStop`."""
        context, driven, state = self._context, self.driven, self.state
        session = context.robot.driving
        if self.aside or session is None or session.state is not State.ESTABLISHED:
            return LastStop(driven, state=state)
        frames: Iterable[bytes] = ()
        try:
            frames = context.robot.stop_frames()
        except Refused:
            pass
        except Exception as error:
            context.faults.note("stop", error)
        stop = tuple(StopFrame(bytes(frame), type(frame) is Datagram) for frame in frames)
        return LastStop(driven, stop, session.outbox.gap_s, state)

    def boundary(self, name: str) -> Boundary:
        """Return where the outgoing stream of the link of this name stands; see :class:`Boundary`."""
        conversation = self._links.conversation(name)
        return Boundary(conversation is not None and not conversation.stalled)

    def partial(self, name: str, most_bytes: int) -> Partial | None:
        """Return the incomplete frame that came by the link of this name; see :data:`Resume`."""
        conversation = self._links.conversation(name)
        return conversation.session.partial(most_bytes) if conversation is not None else None


class Observer:
    """Is told what happens to the links of one robot; override what concerns you, and return at once."""

    def began(self, device: ObservedRobot) -> None:
        """Start: the device serves its robot."""

    def ended(self) -> None:
        """End: the device has left its robot."""

    def linked(self, name: str, link: Link, up: bool) -> None:
        """Note that the link of this name is up, or that it is being closed."""

    def read(self, name: str, resume: Resume) -> None:
        """Note that the bytes of a read of this link have been cut into frames."""

    def changed(self, *, at_once: bool = False) -> None:
        """Note that :meth:`ObservedRobot.last_stop` may give something else from now on. Called for every command.

        at_once: after a command on which the way to stop the robot may depend, as its mode.
        """

    def published(self) -> None:
        """Note that a key that keeps its last value was published for the first time."""
