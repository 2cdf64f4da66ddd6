"""The socket between two processes of a host: whole messages, and file descriptors beside them.

A supervisor, its fork server and its gateway processes talk over such channels. A process of an older or newer version
may be at the other end: fields are only added, with defaults. A channel never waits: a message that finds no room is
not sent. A message holds at most :data:`MESSAGE_BYTES`.
"""

from __future__ import annotations

import array
import contextlib
import os
import socket
from collections.abc import Iterator, Sequence

import msgspec

from zbridge.blackbox import BlackBoxSettings
from zbridge.robot.observer import Boundary, LastStop

MESSAGE_BYTES = 64 * 1024
DESCRIPTORS = 4
"""Most file descriptors of one message."""
_DESCRIPTOR = array.array("i")


class Heartbeat(msgspec.Struct, frozen=True, tag="beat"):
    """The event loop of a gateway runs. streams: the boundaries of the streams of its links, by the links' numbers.

    Sent once a second, five times while the robot is driven, and at once when ``last`` becomes another one.
    missing: why the gateway is of no use now.
    """

    last: LastStop = LastStop()
    streams: dict[int, Boundary] = {}
    hands_over: bool = False
    missing: tuple[str, ...] = ()


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


class Deposited(msgspec.Struct, frozen=True, tag="kept"):
    """A deposit was written to the shared memory: what a successor needs if this process dies.

    It is MessagePack (:class:`HandoverState` of the handover).
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

    Sent before the successor is notified. A process that dies before it has sent this has not handed over.
    """


class MetricsRead(msgspec.Struct, frozen=True, tag="metrics"):
    """The metrics of a gateway, which :class:`ReadMetrics` asked for; memory with them comes along.

    The memory has MessagePack, a list of :class:`~zbridge.metrics.exposition.FamilyLines`.
    """

    number: int


FromGateway = Heartbeat | Opened | Closed | Shared | Deposited | WantSuccessor | Succeeded | MetricsRead


class ReadMetrics(msgspec.Struct, frozen=True, tag="read metrics"):
    """To a gateway: somebody wants to see your metrics. number: of the question, for the answer."""

    number: int


class Started(msgspec.Struct, frozen=True, tag="started"):
    """The successor was started; reason: why it was not."""

    reason: str | None = None


class Fork(msgspec.Struct, frozen=True, tag="fork"):
    """Fork a gateway.

    Descriptors come along: its end of the channel, the content of its file, and the socket from which it takes over, if
    it does. log_format, log_level: of its log, unless its file says it; empty: not said. blackbox: of its black box,
    unless its file says it. died: how the process before it ended, if it did not end in order; hung: it was killed
    because it sent no heartbeat.
    """

    file: str
    robot: str
    verbose: bool = False
    log_format: str = ""
    log_level: str = ""
    blackbox: BlackBoxSettings | None = None
    died: str = ""
    hung: bool = False


class Forked(msgspec.Struct, frozen=True, tag="forked"):
    """The answer: the process id. pid 0: it could not be done, for this reason."""

    pid: int
    reason: str | None = None


class Rehearse(msgspec.Struct, frozen=True, tag="rehearse"):
    """Be a supervisor in place of another one, short of running; its state comes along. :class:`Forked` answers."""


class Ready(msgspec.Struct, frozen=True, tag="ready"):
    """The fork server has imported everything and has one thread. threads: how many it has, if there are more."""

    threads: int = 1


Message = FromGateway | ReadMetrics | Started | Fork | Forked | Rehearse | Ready
_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(Message).decode


class FdChannel:
    """One end. Its socket keeps messages apart, and shows the end of the other process."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._socket = end
        self.unsent = 0
        """Messages that found no room."""

    def __repr__(self) -> str:
        return f"<FdChannel {self.fileno()}>"

    @classmethod
    def pair(cls) -> tuple[FdChannel, socket.socket]:
        """Make an end, and the far end for another process."""
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return cls(near), far

    @classmethod
    def inherited(cls, descriptor: int) -> FdChannel:
        return cls(socket.socket(fileno=descriptor))

    def fileno(self) -> int:
        """Return the descriptor; -1 once it is closed."""
        return self._socket.fileno()

    def send(self, message: Message, descriptors: Sequence[int] = ()) -> bool:
        """Send a message; False if there is no room, or nobody at the other end."""
        data = _encode(message)
        try:
            if descriptors:
                socket.send_fds(self._socket, [data], list(descriptors), socket.MSG_NOSIGNAL)
            else:
                self._socket.send(data, socket.MSG_NOSIGNAL)
        except OSError:
            self.unsent += 1
            return False
        return True

    def receive(self) -> tuple[Message, list[int]] | None:
        """Take the next message, and its descriptors, which the caller has to close.

        None: the other end is closed. Raises BlockingIOError while there is no message, and ValueError for one that
        cannot be read; its descriptors are closed.
        """
        try:
            data, sent = self._receive()
        except ConnectionResetError:  # it ended with a message of ours unread: what it sent before follows
            try:
                data, sent = self._receive()
            except ConnectionError:
                return None
        if not data:
            return None
        descriptors = _descriptors(sent)
        try:
            return _decode(data), descriptors
        except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            close_all(descriptors)
            raise ValueError(str(error)) from error

    def _receive(self) -> tuple[bytes, list[tuple[int, int, bytes]]]:
        # socket.recv_fds ignores its flags in Python 3.11.
        data, sent, _, _ = self._socket.recvmsg(
            MESSAGE_BYTES, socket.CMSG_LEN(DESCRIPTORS * _DESCRIPTOR.itemsize), socket.MSG_CMSG_CLOEXEC
        )
        return data, sent

    def close(self) -> None:
        """Close this end; idempotent."""
        self._socket.close()


def _descriptors(sent: Sequence[tuple[int, int, bytes]]) -> list[int]:
    found = array.array("i")
    for level, kind, data in sent:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            found.frombytes(data[: len(data) - len(data) % found.itemsize])
    return list(found)


def close_all(descriptors: Sequence[int]) -> None:
    """Close file descriptors."""
    for descriptor in descriptors:
        os.close(descriptor)


@contextlib.contextmanager
def in_memory(name: str, content: bytes) -> Iterator[int]:
    """Write bytes to memory, and give its descriptor while the context lasts. Raises OSError."""
    with os.fdopen(os.memfd_create(name), "wb", buffering=0) as file:
        file.write(content)  # memory takes all of it, or nothing
        yield file.fileno()
