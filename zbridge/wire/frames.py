"""Cuts a byte stream into frames with a protocol's pure framing function, in bounded memory. Sans-IO."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from zbridge.errors import ProtocolError

FrameEnd = Callable[[bytes, int], int]
"""``frame_end(data, start)``: the offset behind the frame that begins at ``start``; always greater than ``start``.

An offset beyond ``len(data)`` means that at least so many bytes are needed. Raises ProtocolError for bytes that cannot
begin a frame.
"""


_JOINED = 1024
"""Least bytes that are joined to an incomplete frame while its end is unknown."""


class FramingFault(ProtocolError):
    """A protocol's framing function returned an offset that is not behind the frame's start."""


class FrameBuffer:
    """Keeps the incomplete frame between reads: at most ``limit`` bytes."""

    __slots__ = ("_frame_end", "_limit", "_needed", "_rest")

    def __init__(self, frame_end: FrameEnd, limit: int) -> None:
        self._frame_end = frame_end
        self._limit = limit
        self._rest = bytearray()
        self._needed = 0

    def __len__(self) -> int:
        return len(self._rest)

    def __repr__(self) -> str:
        return f"<FrameBuffer {len(self._rest)} of {self._needed} bytes, limit {self._limit}>"

    @property
    def rest(self) -> bytes:
        """The incomplete frame."""
        return bytes(self._rest)

    def feed(self, data: bytes) -> Iterator[bytes]:
        """Yield every frame that ``data`` completes; raise ProtocolError at a broken or too large frame.

        The frames before it are yielded first. After an error the buffer must not be used any more.
        Raises FramingFault, a ProtocolError, where the framing function does not advance.
        """
        start = 0
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
                start -= len(joined) - end
                yield joined[:end]
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


def _name(function: FrameEnd) -> str:
    """Return a function's name with that of its module, which is the protocol's."""
    module, name = getattr(function, "__module__", None), getattr(function, "__qualname__", None)
    return f"{module}.{name}" if module and name else repr(function)
