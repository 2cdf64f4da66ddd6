"""The memory that a gateway process shares with its supervisor: what must be known at any time if the process dies.

Layout: one slot for each link, then two areas for deposits, in anonymous memory of which only the used pages exist.

A **slot** shows where the stream of a link was cut when the process died. The process sets the slot to ``READING``
before it takes bytes from the kernel, and to ``CUT`` when it has cut them into frames; then the slot has the incomplete
frame (:class:`Partial`). A process that dies while a slot is ``READING`` has taken bytes that nobody knows. A slot that
was never touched belongs to a link of which this process has read nothing.

A **deposit** is what a successor needs. The process writes it to the area that is not in use, and then reports which
area counts (:class:`zbridge.host.fd_channel.Deposited`). So a process that dies while it writes leaves the one
before.
"""

from __future__ import annotations

import mmap
import os
import struct

from zbridge.wire.frames import Partial

SLOTS = 16
"""Most links of one process at a time."""
PARTIAL_BYTES = 64 * 1024
"""Largest incomplete frame that is stored whole: a scan in text has 4 to 60 kB, and no length."""
DEPOSIT_BYTES = 1024 * 1024
"""Largest deposit."""
_HEAD = struct.Struct("<BxxxIQ")
"""State, length of the incomplete frame, bytes to skip."""
_SLOT_BYTES = 64 + PARTIAL_BYTES
_DEPOSITS_AT = SLOTS * _SLOT_BYTES
MEMORY_BYTES = _DEPOSITS_AT + 2 * DEPOSIT_BYTES
_UNTOUCHED, _READING, _CUT = range(3)


def slot_of(link: int) -> int:
    """Return the slot of a link by its number."""
    return link % SLOTS


class MemoryWriter:
    """The process's side. :attr:`descriptor`: to be sent to the supervisor, then closed by :meth:`close_descriptor`."""

    def __init__(self) -> None:
        self.descriptor = os.memfd_create("zbridge")
        os.ftruncate(self.descriptor, MEMORY_BYTES)
        self._map = mmap.mmap(self.descriptor, MEMORY_BYTES)
        self._area = 0

    def close_descriptor(self) -> None:
        """Close the descriptor: the supervisor has its own."""
        os.close(self.descriptor)

    def begin(self, link: int) -> None:
        """Set the slot of a new link: nothing was read."""
        self._map[slot_of(link) * _SLOT_BYTES] = _UNTOUCHED

    def reading(self, link: int) -> None:
        """Note that bytes are about to be taken from the kernel."""
        self._map[slot_of(link) * _SLOT_BYTES] = _READING

    def cut(self, link: int, partial: Partial | None) -> None:
        """Note the incomplete frame of the stream; None: nobody could resume it here."""
        at = slot_of(link) * _SLOT_BYTES
        self._map[at] = _READING
        if partial is not None and (size := len(partial.rest)) <= PARTIAL_BYTES:
            self._map[at + _HEAD.size : at + _HEAD.size + size] = partial.rest
            _HEAD.pack_into(self._map, at, _READING, size, partial.skip)
            self._map[at] = _CUT  # last: a process may die at any of these lines

    def deposit(self, data: bytes) -> int:
        """Write a deposit of :data:`DEPOSIT_BYTES` at most; return its area, which counts from :meth:`commit` on."""
        area = 1 - self._area
        start = _DEPOSITS_AT + area * DEPOSIT_BYTES
        self._map[start : start + len(data)] = data
        return area

    def commit(self, area: int) -> None:
        """Note that this area was reported to the supervisor: the next deposit goes to the other one."""
        self._area = area

    def close(self) -> None:
        self._map.close()


class MemoryReader:
    """The supervisor's side. descriptor: closed by :meth:`close`; raise ValueError for memory of another layout."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        if os.fstat(descriptor).st_size != MEMORY_BYTES:
            raise ValueError("shared memory of another version")
        self._map = mmap.mmap(descriptor, MEMORY_BYTES, prot=mmap.PROT_READ)

    def is_touched(self, link: int) -> bool:
        """Whether the process has read from this link."""
        return self._map[slot_of(link) * _SLOT_BYTES] != _UNTOUCHED

    def partial(self, link: int) -> Partial | None:
        """Return the incomplete frame of a link; None if nobody can resume its stream."""
        at = slot_of(link) * _SLOT_BYTES
        state, size, skip = _HEAD.unpack_from(self._map, at)
        if state == _UNTOUCHED:
            return Partial()
        if state != _CUT or size > PARTIAL_BYTES:
            return None
        return Partial(self._map[at + _HEAD.size : at + _HEAD.size + size], skip)

    def deposit(self, area: int, size: int) -> bytes:
        """Read a deposit; b"" for one that cannot be there."""
        if area not in (0, 1) or not 0 <= size <= DEPOSIT_BYTES:
            return b""
        start = _DEPOSITS_AT + area * DEPOSIT_BYTES
        return self._map[start : start + size]

    def close(self) -> None:
        """Unmap the memory and close the descriptor."""
        self._map.close()
        os.close(self.descriptor)
