"""Messages that begin with a byte that names them, with or without a framing around them. Sans-IO."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, ClassVar, Generic, TypeVar

from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire.binary import BinaryCodec
from zbridge.wire.fields import Message, Scalar, declared_fields


class Coded(Message, frozen=True):
    """A message of such a protocol: ``opcode`` is its first byte."""

    opcode: ClassVar[int]


C = TypeVar("C", bound=Coded)


class Opcodes(Generic[C]):
    """Reads and writes the messages of a protocol, given their classes.

    :meth:`end` frames messages that follow each other without any framing; all their fields must have a fixed width.
    """

    def __init__(self, messages: Iterable[type[C]]) -> None:
        self.messages = tuple(messages)
        self._codecs: dict[int, BinaryCodec[C]] = {kind.opcode: BinaryCodec(kind) for kind in self.messages}
        if len(self._codecs) != len(self.messages):
            raise TypeError(f"{', '.join(kind.__name__ for kind in self.messages)}: duplicate opcode")
        self._sizes: dict[int, int | None] = {kind.opcode: self._size(kind) for kind in self.messages}

    def __repr__(self) -> str:
        return f"<Opcodes {sorted(self._codecs)}>"

    def end(self, data: bytes, start: int) -> int:
        """Find where the message that begins at ``start`` ends; raise ProtocolError for an unknown opcode."""
        size = self._sizes.get(data[start])
        if size is None:
            raise ProtocolError(f"opcode {data[start]}, expected one of fixed width: {self._known()}")
        return start + size

    def read(self, data: bytes, start: int = 0) -> C:
        """Read the message that fills ``data`` from ``start`` on; raise ProtocolError."""
        if start >= len(data):
            raise ProtocolError("no opcode")
        codec = self._codecs.get(data[start])
        if codec is None:
            raise ProtocolError(f"opcode {data[start]}, expected one of {self._known()}")
        return codec.decode(data, start + 1)

    def write(self, message: C) -> bytes:
        """Write one message; raise EncodeError for a value that its field cannot hold."""
        codec = self._codecs.get(message.opcode)
        if codec is None or codec.message is not type(message):
            raise EncodeError(f"{message!r} is none of the messages")
        return bytes((message.opcode,)) + codec.encode(message)

    def _size(self, kind: type[Any]) -> int | None:
        fixed = all(isinstance(field.wire, Scalar) and not field.optional for field in declared_fields(kind))
        return 1 + self._codecs[kind.opcode].fixed_size if fixed else None

    def _known(self) -> str:
        return ", ".join(map(str, sorted(self._codecs)))
