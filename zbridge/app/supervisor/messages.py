"""What a supervisor, its fork server and its gateway processes tell each other; file descriptors travel beside them.

A process of an older or newer version may be at the other end: fields are only added, with defaults.
"""

from __future__ import annotations

import msgspec

from zbridge.robot.observer import Boundary, LastStop

PAGE_BYTES = 256
"""Size of the shared page, a byte for each link."""


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
    """A page of memory that both processes see; its descriptor comes along. Byte n is 1 while link n is between frames.

    The byte is 0 from before a read until its bytes are handled: then a successor could not go on reading.
    """


class Kept(msgspec.Struct, frozen=True, tag="kept"):
    """What a successor needs to go on if this process dies (:class:`Given` of the handover), as MessagePack.

    sockets: the numbers of the links and of their descriptors, in the order of the parcel. Empty: nobody could go on.
    """

    given: bytes = b""
    sockets: tuple[tuple[int, int], ...] = ()


class WantSuccessor(msgspec.Struct, frozen=True, tag="successor"):
    """Start a process that takes this gateway over; the far end of its socket comes along. :class:`Started` answers."""


class Succeeded(msgspec.Struct, frozen=True, tag="succeeded"):
    """The successor has taken over; this process ends by itself."""


FromGateway = Beat | Opened | Closed | Shared | Kept | WantSuccessor | Succeeded


class Started(msgspec.Struct, frozen=True, tag="started"):
    """The successor was started; reason: why it was not."""

    reason: str | None = None


class Fork(msgspec.Struct, frozen=True, tag="fork"):
    """Fork a gateway: its end of the post comes along, then the socket from which it takes over, if it does."""

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
