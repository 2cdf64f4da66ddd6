"""What one side of a protocol sends in one dialect: its golden table, and the code that reads and writes it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from zbridge.errors import ProtocolError
from zbridge.wire.frames import FrameBuffer, FrameEnd

Receive = Callable[[bytes], list[Any]]


@dataclass(frozen=True)
class Side:
    """``golden`` pairs each message with its bytes, written by hand from the protocol page or read off a capture."""

    name: str
    golden: list[tuple[Any, bytes]]
    read: Callable[[bytes], Any]
    """One frame to one message; raises ProtocolError."""
    write: Callable[[Any], bytes]
    receiver: Callable[[], Receive]
    """Make a receiver of a stream: bytes to the messages they complete; a broken stream raises ProtocolError."""
    declared: set[Any]
    """The classes of all messages of this side."""
    bends: Callable[[Any, bytes], bool] = lambda message, frame: False
    """Tell that this frame, shortened or prolonged, is still a message by the page."""
    ends: tuple[Any, ...] = ()
    """Messages that end the conversation: a session keeps them to itself and takes no other."""

    def __repr__(self) -> str:
        return self.name

    @property
    def stream(self) -> list[tuple[Any, bytes]]:
        """The golden messages that may follow each other on one connection."""
        return [(message, frame) for message, frame in self.golden if message not in self.ends]

    def delivered(self, message: Any) -> list[list[Any]]:
        """What a receiver delivers of one message."""
        return [] if message in self.ends else [plain(message)]


def plain(message: Any) -> list[Any]:
    """A message for comparing: its class and its values, an array as a list."""
    values = [getattr(message, name) for name in message.__struct_fields__]
    return [type(message), *(value.tolist() if isinstance(value, np.ndarray) else value for value in values)]


def framed(frame_end: FrameEnd, limit: int, read: Callable[[bytes], Any]) -> Callable[[], Receive]:
    """Make receivers of a framing and a reader; a frame that is no message is left out, as sessions do."""

    def receiver() -> Receive:
        buffer = FrameBuffer(frame_end, limit)

        def receive(data: bytes) -> list[Any]:
            messages = []
            for frame in buffer.feed(data):
                try:
                    messages.append(read(frame))
                except ProtocolError:
                    continue
            return messages

        return receive

    return receiver
