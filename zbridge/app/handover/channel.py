"""The Unix stream socket between a gateway and its successor: messages, and descriptors behind one of them.

A message is its length (4 bytes, big-endian) and a MessagePack map with a ``type``. Descriptors follow in groups, each
with one byte. The calls block on threads of their own, so that the event loop never does; each has a time limit.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from typing import TypeVar

import msgspec

from zbridge.errors import HandoverError
from zbridge.protocol.kept import Exported
from zbridge.transport import Parcel
from zbridge.wire.frames import Partial

VERSION = 3
"""The version of :class:`HandoverState`. Increment it with every change of ``kept`` and of the maps around it."""
M = TypeVar("M")

MESSAGE_BYTES = 64 * 2**20
"""Most bytes of a message: a state with the largest map takes 4 MB."""
REASON_S = 0.2
"""Longest wait for the reason that the other process sent before it closed, seconds."""
SEND_S = 5.0
"""Longest time to send a message, seconds."""
_GROUP = 200
"""Most descriptors in one message; Linux accepts 253."""
_HEADER = 4
_ENDED = "the other process has ended"


class Hello(msgspec.Struct, tag="hello", frozen=True):
    """Successor: I have read the configuration and joined the bus; ``version``: of the state that I accept."""

    version: int
    pid: int


class HandoverState(msgspec.Struct, tag="given", frozen=True):
    """Gateway: nothing is read or written any more; take this over, and ``descriptors`` descriptors behind it.

    setup: what must be the same in both configurations. claim: on the robot, None if it is not owned. device: None
    where it is not served. listeners: in the order of the configuration; none of a gateway that died: the successor
    binds its own. metrics: numbers of sockets in the parcel. partials: of a gateway that died, the incomplete frame of
    each stream, in the order of the device's links.
    """

    version: int
    setup: Exported
    descriptors: int
    claim: Exported | None = None
    device: Exported | None = None
    listeners: tuple[Exported, ...] = ()
    metrics: tuple[int, ...] = ()
    partials: tuple[Partial, ...] = ()


class Up(msgspec.Struct, tag="up", frozen=True):
    """Successor: everything is taken over and declared; I read and write nothing before :class:`Go`."""


class Go(msgspec.Struct, tag="go", frozen=True):
    """Gateway: the successor has everything now."""


class Failed(msgspec.Struct, tag="failed", frozen=True):
    """Either: the handover failed, for this reason. The gateway resumes."""

    reason: str


Message = Hello | HandoverState | Up | Go | Failed
encode = msgspec.msgpack.Encoder().encode
decode = msgspec.msgpack.Decoder(Message).decode


class HandoverChannel:
    """One end of the socket. Raises HandoverError, with the other process's reason if it sent one."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        end.setblocking(True)

    def __repr__(self) -> str:
        return f"<HandoverChannel {self._socket.fileno()}>"

    async def send(self, message: Message, parcel: Parcel | None = None) -> None:
        """Send a message, and the descriptors of a parcel."""
        await asyncio.to_thread(self._send, message, parcel)

    async def receive(self, kind: type[M], timeout_s: float | None = None) -> M:
        """Wait for a message of this class; None: forever. Raise HandoverError for any other, and at the end."""
        return await asyncio.to_thread(self._receive, kind, timeout_s)

    async def receive_parcel(self, descriptors: int, timeout_s: float) -> Parcel:
        """Wait for the descriptors behind a message."""
        return await asyncio.to_thread(self._receive_parcel, descriptors, timeout_s)

    def send_now(self, message: Message) -> None:
        """Send a short message if the socket accepts it at once; expect no answer."""
        with contextlib.suppress(OSError, HandoverError):
            self._send(message, None)

    def close(self) -> None:
        """Close the channel, and wake who waits for it; idempotent."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()

    def _send(self, message: Message, parcel: Parcel | None) -> None:
        data = encode(message)
        try:
            self._socket.settimeout(SEND_S)
            self._socket.sendall(len(data).to_bytes(_HEADER, "big") + data)
            descriptors = parcel.descriptors if parcel is not None else []
            for start in range(0, len(descriptors), _GROUP):
                socket.send_fds(self._socket, [b"."], descriptors[start : start + _GROUP])
        except OSError as error:
            with contextlib.suppress(EndError, SilentError):
                self._receive(Failed, REASON_S)  # it may have sent its reason
            if isinstance(error, ConnectionError):
                raise EndError(_ENDED) from error
            raise HandoverError(f"the other process is stalled: {error}") from error

    def _receive(self, kind: type[M], timeout_s: float | None) -> M:
        try:
            self._socket.settimeout(timeout_s)
            size = int.from_bytes(self._read(_HEADER), "big")
            if size > MESSAGE_BYTES:
                raise HandoverError(f"message of {size} bytes exceeds {MESSAGE_BYTES}")
            message = decode(self._read(size))
        except TimeoutError as error:
            raise SilentError(f"the other process sent nothing for {timeout_s:g} s") from error
        except OSError as error:  # reset: it ended without reading our message
            raise EndError(_ENDED) from error
        except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
            raise HandoverError(f"the other process sent an invalid message: {error}") from error
        if isinstance(message, Failed):
            raise HandoverError(message.reason)
        if not isinstance(message, kind):
            raise HandoverError(f"received {type(message).__name__}, expected {kind.__name__}")
        return message

    def _read(self, size: int) -> bytes:
        data = bytearray()
        while len(data) < size:
            more = self._socket.recv(min(size - len(data), 2**20))
            if not more:
                raise EndError(_ENDED)
            data += more
        return bytes(data)

    def _receive_parcel(self, descriptors: int, timeout_s: float) -> Parcel:
        received: list[int] = []
        try:
            self._socket.settimeout(timeout_s)
            while len(received) < descriptors:
                data, group, _, _ = socket.recv_fds(self._socket, 1, _GROUP)
                received += group
                if not data or not group:
                    raise HandoverError(f"{len(received)} of {descriptors} descriptors were received")
        except (OSError, HandoverError) as error:
            Parcel(received).close()
            raise error if isinstance(error, HandoverError) else HandoverError(f"no descriptors: {error}") from error
        for descriptor in received:
            os.set_inheritable(descriptor, False)
        return Parcel(received)


class EndError(HandoverError):
    """The other process has ended without a reason."""


class SilentError(HandoverError):
    """The other process sent nothing in time."""
