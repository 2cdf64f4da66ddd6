"""The supervisor's duplicates of the sockets to one robot, and the stop that is written over them.

A duplicate keeps a connection open although the process that made it is dead. It must be closed when that process
closes its own on purpose: until then the robot sees no end of the connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import stat
from collections.abc import Iterator, Sequence

import msgspec

from zbridge.host.fd_channel import close_all
from zbridge.host.memory import SLOTS
from zbridge.log import Log
from zbridge.robot.observer import Boundary, LastStop

log = Log("zbridge.host")

TIMES = 4
"""So often a stop is written: legacy robots lose what they read together with something else."""
PERIOD_S = 0.12
"""Seconds between two stops."""
LEAVE_S = 0.5
"""Longest time for which a connection is read empty before it is closed."""
_READS, _READ_BYTES = 32, 65_536
"""How much is read away at a time."""


class Duplicate(msgspec.Struct):
    """The sockets of one link. descriptors: of its stream, then of its datagrams where there are any."""

    link: int
    name: str
    drives: bool
    boundary: Boundary = Boundary()
    descriptors: tuple[int, ...] = ()

    def set_descriptors(self, descriptors: Sequence[int]) -> None:
        """Set the descriptors: the stream's first, then the one of datagrams; those before are closed."""
        self.close()
        self.descriptors = tuple(descriptors[:2])
        close_all(descriptors[2:])

    def close(self) -> None:
        """Close the duplicates; idempotent."""
        close_all(self.descriptors)
        self.descriptors = ()

    def discard_input(self) -> None:
        """Read what waits, and discard it."""
        if self.descriptors and stat.S_ISSOCK(os.fstat(self.descriptors[0]).st_mode):
            with _borrowed(self.descriptors[0]) as stream, contextlib.suppress(OSError):
                for _ in range(_READS):
                    stream.recv(_READ_BYTES, socket.MSG_DONTWAIT)

    async def stop(self, last: LastStop, times: int) -> bool:
        """Write the stop so often; False if the link is stalled.

        The first frame waits for one gap: the dead process may have written a moment ago.
        """
        for time in range(times):
            if time:
                await asyncio.sleep(PERIOD_S)
            for frame in last.frames:
                await asyncio.sleep(last.gap_s)
                if not self._write(frame.data, datagram=frame.datagram):
                    return False
        return True

    def _write(self, data: bytes, *, datagram: bool) -> bool:
        if len(self.descriptors) < (2 if datagram else 1) or not self.boundary.outgoing:
            return False
        try:
            if not datagram:
                with contextlib.suppress(ConnectionRefusedError):  # of an earlier datagram: this one was not sent
                    return os.write(self.descriptors[0], data) == len(data)
                return os.write(self.descriptors[0], data) == len(data)
            with _borrowed(self.descriptors[0]) as robot, _borrowed(self.descriptors[1]) as own:
                # To where the stream leads: a robot takes datagrams at the same address and port.
                return own.sendto(data, socket.MSG_DONTWAIT, robot.getpeername()) == len(data)
        except OSError as error:
            log.debug("stop_not_written", "{link}: no stop written: {error}", link=self.name, error=error)
            return False


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """Make a socket object for a descriptor that stays open."""
    borrowed = socket.socket(fileno=descriptor)
    try:
        yield borrowed
    finally:
        borrowed.detach()


class Duplicates:
    """The duplicates of one process, by the numbers that it gives its links."""

    def __init__(self) -> None:
        self._links: dict[int, Duplicate] = {}

    def __repr__(self) -> str:
        return f"<Duplicates {sorted(self._links)}>"

    def __len__(self) -> int:
        return len(self._links)

    def __iter__(self) -> Iterator[Duplicate]:
        return iter(self._links.values())

    def opened(self, link: int, name: str, descriptors: Sequence[int], *, drives: bool) -> None:
        """Keep the descriptors of a link; too many links, and what is no socket or line, are closed at once."""
        if len(self._links) >= SLOTS or not descriptors or not all(map(_is_link, descriptors)):
            close_all(descriptors)
            return
        self._links.setdefault(link, Duplicate(link, name, drives)).set_descriptors(descriptors)

    def name_of(self, link: int) -> str | None:
        """Return the name of a link; None if there is none of this number."""
        return self._links[link].name if link in self._links else None

    def link_of(self, name: str) -> int | None:
        """Return the number of the newest link of this name."""
        return next((link for link, each in reversed(self._links.items()) if each.name == name), None)

    def descriptor(self, link: int, at: int) -> int | None:
        """Return a descriptor of a link: 0 its stream's, 1 that of datagrams.

        None if there is none, or half a frame was written.
        """
        duplicate = self._links.get(link)
        usable = duplicate.descriptors if duplicate is not None and duplicate.boundary.outgoing else ()
        return usable[at] if 0 <= at < len(usable) else None

    def set_boundaries(self, streams: dict[int, Boundary]) -> None:
        """Note where the streams are between frames."""
        for link, boundary in streams.items():
            if link in self._links:
                self._links[link].boundary = boundary

    def closed(self, link: int) -> None:
        """Close the duplicates of a link at once."""
        if link in self._links:
            self._links.pop(link).close()

    def close(self) -> None:
        """Close all duplicates; idempotent."""
        while self._links:
            self._links.popitem()[1].close()

    async def drain(self) -> None:
        """Close all, but first let the robot read its stop: the kernel would reset what is closed with bytes unread.

        A robot whose own sending is stalled continues when that is read.
        """
        loop = asyncio.get_running_loop()
        ends_at = loop.time() + LEAVE_S
        while self._links and loop.time() < ends_at:
            for duplicate in self._links.values():
                duplicate.discard_input()
            await asyncio.sleep(LEAVE_S / 25)
        self.close()

    async def stop(self, last: LastStop, times: int = TIMES) -> bool | None:
        """Write the robot's stop so often; whether its link accepted it, None if there is no link or no stop."""
        driving = [link for link in self._links.values() if link.drives]
        if not driving or not last.frames:
            return None
        return await driving[-1].stop(last, times)


def _is_link(descriptor: int) -> bool:
    mode = os.fstat(descriptor).st_mode
    return stat.S_ISSOCK(mode) or stat.S_ISCHR(mode)
