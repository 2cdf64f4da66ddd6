"""Lines of text: a word that names the message, then its fields as numbers, separated. Sans-IO.

``D,100,-100`` and a line feed, where the word is ``D`` and the separator a comma. The fields are declared as for the
text codec. A reader also takes a carriage return before the line feed.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Generic, TypeVar

from zbridge.errors import ProtocolError
from zbridge.wire.fields import Message
from zbridge.wire.text import NUMBER, TextCodec

_QUOTED = 64


class Line(Message, frozen=True):
    """A message of such a protocol: ``word`` names it."""

    word: ClassVar[bytes]


L = TypeVar("L", bound=Line)


class Lines(Generic[L]):
    """Reads and writes the lines of a protocol, given its messages."""

    def __init__(self, messages: Iterable[type[L]], separator: bytes = b",") -> None:
        self.messages = tuple(messages)
        self._codecs = {message.word: TextCodec(message) for message in self.messages}
        self._separator = separator

    @staticmethod
    def end(data: bytes, start: int) -> int:
        """Find where the line that begins at ``start`` ends; beyond ``data`` while its end has not come."""
        found = data.find(b"\n", start)
        return found + 1 if found >= 0 else len(data) + 1

    def read(self, frame: bytes) -> L:
        """Read one line; raise ProtocolError if it is none of the messages or a number is out of range."""
        word, *numbers = frame.rstrip(b"\r\n").split(self._separator)
        codec = self._codecs.get(word)
        if codec is None:
            raise ProtocolError(f"{frame[:_QUOTED]!r} begins no message")
        if not all(map(NUMBER.fullmatch, numbers)):
            raise ProtocolError(f"{frame[:_QUOTED]!r}: expected numbers")
        return codec.decode(b"|".join(numbers))

    def write(self, message: L) -> bytes:
        """Write one line; raise EncodeError if a number is out of range."""
        numbers = self._codecs[message.word].encode(message)
        return message.word + (self._separator + numbers.replace(b"|", self._separator) if numbers else b"") + b"\n"
