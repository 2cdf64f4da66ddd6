"""One end of the socket between two processes of a host: whole messages, and file descriptors beside them.

Never waits: a message that finds no room is not sent. A message holds at most :data:`MESSAGE_BYTES`.
"""

from __future__ import annotations

import array
import os
import socket
from collections.abc import Sequence

import msgspec

from zbridge.host.messages import Message

MESSAGE_BYTES = 64 * 1024
DESCRIPTORS = 4
"""Most file descriptors of one message."""
_DESCRIPTOR = array.array("i")
_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(Message).decode


class Post:
    """One end. Its socket keeps messages apart, and shows the end of the other process."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._socket = end
        self.unsent = 0
        """Messages that found no room."""

    def __repr__(self) -> str:
        return f"<Post {self.fileno()}>"

    @classmethod
    def pair(cls) -> tuple[Post, socket.socket]:
        """Make an end, and the far end for another process."""
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return cls(near), far

    @classmethod
    def inherited(cls, descriptor: int) -> Post:
        """Make an end of an inherited descriptor."""
        return cls(socket.socket(fileno=descriptor))

    def fileno(self) -> int:
        """Give the descriptor; -1 once it is closed."""
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
        except ConnectionResetError:  # it ended with a message of ours unread: what it told before follows
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
