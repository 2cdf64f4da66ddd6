"""Cuts a byte stream into frames with a protocol's pure framing function, in bounded memory. Sans-IO."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import msgspec

from zbridge.errors import ProtocolError

FrameEnd = Callable[[bytes, int], int]
"""``frame_end(data, start)``: the offset behind the frame that begins at ``start``; always greater than ``start``.

An offset beyond ``len(data)`` means that at least so many bytes are needed. Raises ProtocolError for bytes that cannot
begin a frame.
"""


_JOINED = 1024
"""Least bytes that are joined to an incomplete frame while its end is unknown."""
_HEADER = 64
"""Bytes of a frame from which its end is known, where a protocol has a length field."""


class Partial(NamedTuple):
    """The incomplete frame of a stream, as somebody else can resume it.

    rest: the bytes that came. skip: bytes that are still to come and are dropped, because those before them are lost.
    """

    rest: bytes = b""
    skip: int = 0

    @classmethod
    def read(cls, raw: Any) -> Partial:
        """Read what another process exported; raise ProtocolError for anything else."""
        try:
            return cls(*msgspec.convert(raw, tuple[bytes, int]))
        except msgspec.ValidationError as error:
            raise ProtocolError(f"incomplete frame: {error}") from error


class FramingFault(ProtocolError):
    """A protocol's framing function returned an offset that is not behind the frame's start."""


class FrameBuffer:
    """Keeps the incomplete frame between reads: at most ``limit`` bytes."""

    __slots__ = ("_frame_end", "_limit", "_needed", "_rest", "_skip")

    def __init__(self, frame_end: FrameEnd, limit: int) -> None:
        self._frame_end = frame_end
        self._limit = limit
        self._rest = bytearray()
        self._needed = 0
        self._skip = 0
        """Bytes that are dropped before the next frame."""

    def __len__(self) -> int:
        return len(self._rest)

    def __repr__(self) -> str:
        return f"<FrameBuffer {len(self._rest)} of {self._needed} bytes, limit {self._limit}>"

    def partial(self, most_bytes: int | None = None) -> Partial | None:
        """Describe the incomplete frame for :meth:`resume`.

        A frame of which more than ``most_bytes`` came is described by the bytes that are still to come; None if its
        first bytes do not tell how many.
        """
        rest = self._rest
        if self._skip or most_bytes is None or len(rest) <= most_bytes:
            return Partial(bytes(rest), self._skip)
        end = self._frame_end(bytes(rest[:_HEADER]), 0)
        return Partial(skip=end - len(rest)) if end == self._needed > _HEADER + 1 else None

    def resume(self, partial: Partial) -> None:
        """Resume an incomplete frame in a buffer that was just made; raise ProtocolError for one that is none."""
        self._skip = partial.skip
        if not 0 <= partial.skip <= self._limit or (partial.skip and partial.rest):
            raise ProtocolError(f"{partial.skip} bytes to skip after {len(partial.rest)}, limit {self._limit}")
        for frame in self.feed(partial.rest):
            raise ProtocolError(f"a whole frame of {len(frame)} bytes was left over")

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Yield every frame that ``data`` completes; raise ProtocolError at a broken or too large frame.

        The frames before it are yielded first. After an error the buffer must not be used any more.
        Raises FramingFault, a ProtocolError, where the framing function does not advance.
        """
        start = 0
        if self._skip:
            start = min(self._skip, len(data))
            self._skip -= start
        while self._rest:
            # Only what the incomplete frame needs is joined to it: the rest of a large read is not copied.
            more = data[start : start + max(self._needed - len(self._rest), _JOINED)]
            self._rest += more
            start += len(more)
            if len(self._rest) < self._needed:
                return
            joined = bytes(self._rest)
            self._rest.clear()
            end = self._end(joined, 0)
            if end > len(joined):
                self._rest += joined
                self._needed = end
                if start == len(data):
                    return
            else:
                yield joined[:end]
                behind, start = start, start - (len(joined) - end)
                if start < 0:  # noise that ended within an earlier read
                    data, start = joined[end:] + data[behind:], 0
        size = len(data)
        while start < size:
            end = self._end(data, start)
            if end > size:
                self._rest += data[start:]
                self._needed = end - start
                return
            yield data[start:end]
            start = end

    def _end(self, data: bytes, start: int) -> int:
        end = self._frame_end(data, start)
        if end - start > self._limit:
            raise ProtocolError(f"frame of {end - start} bytes exceeds {self._limit}")
        if end <= start:
            raise FramingFault(f"{_name(self._frame_end)} returned a frame of {end - start} bytes, expected 1 or more")
        return end


class DatagramFrames(FrameBuffer):
    """Cuts datagrams into frames: what a datagram has beside whole frames is dropped. dropped: takes the reason."""

    def __init__(self, frame_end: FrameEnd, limit: int, dropped: Callable[[str], object]) -> None:
        super().__init__(frame_end, limit)
        self._dropped = dropped

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Yield every frame of a datagram; raise nothing."""
        start, size = 0, len(data)
        try:
            while start < size:
                end = self._end(data, start)
                if end > size:  # nothing follows: what waits for more is judged as if zeros did
                    end = self._end(data + bytes(self._limit), start)
                if end > size:
                    self._dropped(f"the last {size - start} bytes of a datagram are no whole frame")
                    return
                yield data[start:end]
                start = end
        except ProtocolError as error:
            self._dropped(str(error))


def _name(function: FrameEnd) -> str:
    """Return a function's name with that of its module, which is the protocol's."""
    module, name = getattr(function, "__module__", None), getattr(function, "__qualname__", None)
    return f"{module}.{name}" if module and name else repr(function)
