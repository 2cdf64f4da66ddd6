"""What a supervisor, its fork server and its gateway processes tell each other; file descriptors travel beside them.

A process of an older or newer version may be at the other end: fields are only added, with defaults.
"""

from __future__ import annotations

import msgspec

from zbridge.robot.observer import Boundary, LastStop


class Beat(msgspec.Struct, frozen=True, tag="beat"):
    """The event loop of a gateway turns. streams: where the streams of its links stand, by the links' numbers.

    Told once a second, five times while the robot is driven, and at once when ``last`` becomes another one.
    """

    last: LastStop = LastStop()
    streams: dict[int, Boundary] = {}
    hands_over: bool = False


class Opened(msgspec.Struct, frozen=True, tag="opened"):
    """A link to the robot is up, or has one socket more: its descriptors come along, the stream first.

    drives: this link takes the stop.
    """

    link: int
    name: str
    drives: bool = True


class Closed(msgspec.Struct, frozen=True, tag="closed"):
    """A link is closed: the peer sees its end only when the duplicate is closed too."""

    link: int


class Shared(msgspec.Struct, frozen=True, tag="shared"):
    """The memory that both processes see (:mod:`zbridge.host.memory`); its descriptor comes along."""


class Kept(msgspec.Struct, frozen=True, tag="kept"):
    """A deposit was written to the shared memory: what a successor needs if this process dies, as MessagePack
    (:class:`Given` of the handover).

    sockets: the numbers of the links and of their descriptors, in the order of the parcel. area, size: where it is in
    the memory. Without sockets nobody could resume.
    """

    sockets: tuple[tuple[int, int], ...] = ()
    area: int = -1
    size: int = 0


class WantSuccessor(msgspec.Struct, frozen=True, tag="successor"):
    """Start a process that takes this gateway over; the far end of its socket comes along. :class:`Started` answers."""


class Succeeded(msgspec.Struct, frozen=True, tag="succeeded"):
    """From now on the successor has the robot, whatever happens to it; this process ends by itself.

    Told before the successor hears of it. A process that dies before it has told this has not handed over.
    """


FromGateway = Beat | Opened | Closed | Shared | Kept | WantSuccessor | Succeeded


class Started(msgspec.Struct, frozen=True, tag="started"):
    """The successor was started; reason: why it was not."""

    reason: str | None = None


class Fork(msgspec.Struct, frozen=True, tag="fork"):
    """Fork a gateway. Descriptors come along: its end of the post, the content of its file, and the socket from which
    it takes over, if it does.
    """

    file: str
    robot: str
    verbose: bool = False


class Forked(msgspec.Struct, frozen=True, tag="forked"):
    """The answer: the process id. pid 0: it could not be forked, for this reason."""

    pid: int
    reason: str | None = None


class Ready(msgspec.Struct, frozen=True, tag="ready"):
    """The fork server has imported everything and has one thread. threads: how many it has, if there are more."""

    threads: int = 1


Message = FromGateway | Started | Fork | Forked | Ready
