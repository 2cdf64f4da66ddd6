"""What a supervisor leaves to the code that takes its place in the same process: versioned MessagePack in memory.

Descriptors stand for themselves: they stay open while the code is replaced. Times are those of the monotonic clock,
which goes on. Fields are only added, with defaults; any other change raises :data:`VERSION`.
"""

from __future__ import annotations

import os

import msgspec

from zbridge.errors import HandoverError
from zbridge.host.messages import Kept
from zbridge.host.watchdog import HeartState
from zbridge.robot.observer import Boundary, LastStop
from zbridge.toml import FILE_BYTES

VERSION = 1
"""The form of :class:`SupervisorState`."""
STATE_BYTES = 64 * 1024 * 1024
"""Largest state that is read."""


class LinkState(msgspec.Struct, frozen=True):
    """The duplicates of one link's sockets, by their descriptors."""

    link: int
    name: str
    drives: bool
    boundary: Boundary
    stream: int | None = None
    datagrams: int | None = None


class ProcessState(msgspec.Struct, frozen=True):
    """A running gateway process. post, page: descriptors, page that of the shared memory. began: when it was forked."""

    pid: int
    post: int
    began: float
    heart: HeartState
    last: LastStop
    page: int | None = None
    hands_over: bool = False
    kept: Kept | None = None
    links: tuple[LinkState, ...] = ()

    @property
    def descriptors(self) -> tuple[int, ...]:
        """What must stay open."""
        of_links = (number for link in self.links for number in (link.stream, link.datagrams))
        return tuple(number for number in (self.post, self.page, *of_links) if number is not None)


class RunnerState(msgspec.Struct, frozen=True):
    """One robot: the file as it runs, and its process. next_at: when the next one starts, if none runs.

    forms, shares: of the robot's addresses.
    """

    path: str
    content: bytes
    identity: tuple[str, str] | None
    restarts: int = 0
    failures: int = 0
    next_at: float | None = None
    process: ProcessState | None = None
    forms: tuple[str, ...] = ()
    shares: bool = False


class ServerState(msgspec.Struct, frozen=True):
    """The fork server. post: a descriptor. stamp: of the installation that it loaded."""

    pid: int
    post: int
    stamp: bytes


class SupervisorState(msgspec.Struct, frozen=True):
    """Everything. at: the time of the handing over. look_at: of the next look at the hearts."""

    version: int
    sources: tuple[str, ...]
    at: float
    look_at: float
    watch: bool = False
    verbose: bool = False
    stagger_s: float = 0.0
    file_bytes: int = FILE_BYTES
    is_ready: bool = False
    runners: tuple[RunnerState, ...] = ()
    server: ServerState | None = None
    leaving: tuple[int, ...] = ()
    """Fork servers of before, until they have ended."""
    faults: dict[str, str] = {}

    @property
    def descriptors(self) -> tuple[int, ...]:
        """What must stay open."""
        of_server = (self.server.post,) if self.server is not None else ()
        return (*of_server, *(n for each in self.runners if each.process is not None for n in each.process.descriptors))


class _Head(msgspec.Struct, frozen=True):
    version: int


_encode = msgspec.msgpack.Encoder().encode
_head = msgspec.msgpack.Decoder(_Head).decode
_decode = msgspec.msgpack.Decoder(SupervisorState).decode


def store(state: SupervisorState) -> int:
    """Write a state to memory; return the descriptor, which the caller has to close. Raises OSError."""
    data, descriptor = _encode(state), os.memfd_create("zbridge state")
    try:
        while data:
            data = data[os.write(descriptor, data) :]
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def restore(descriptor: int) -> SupervisorState:
    """Read a state, and leave the descriptor open; raise HandoverError where it cannot be understood."""
    try:
        data = os.pread(descriptor, STATE_BYTES, 0)
        if (version := _head(data).version) != VERSION:
            raise HandoverError(f"the supervisor left a state of version {version}, this code takes version {VERSION}")
        return _decode(data)
    except (OSError, msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise HandoverError(f"no state of a supervisor: {error}") from error
