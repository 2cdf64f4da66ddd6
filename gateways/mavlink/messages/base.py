"""MAVLink messages: each is declared once, in the order of the wire, with its id and CRC_EXTRA. Sans-IO.

Source: "Frames" of the protocol page. Fields are ordered by size, extensions after them. A payload on the wire may lack
trailing zeros, or have extensions that are not known here: :meth:`MavlinkSpec.decode` fills and cuts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, ClassVar, TypeVar

from zbridge.protocol import EncodeError
from zbridge.wire import BinaryCodec, Message, Scalar
from zbridge.wire.fields import declared_fields

I64 = Annotated[int, Scalar("q")]
U64 = Annotated[int, Scalar("Q")]
Name = Annotated[bytes, Scalar("16s")]
"""The name of a parameter; zeros fill what is left."""
Chunk = Annotated[bytes, Scalar("50s")]
"""A text of 50 bytes at most; zeros fill what is left."""
Bytes8 = Annotated[bytes, Scalar("8s")]
Bytes18 = Annotated[bytes, Scalar("18s")]
Bytes251 = Annotated[bytes, Scalar("251s")]
Floats4 = Annotated[bytes, Scalar("16s")]
"""float32[4], little-endian."""
Shorts4 = Annotated[bytes, Scalar("8s")]
Shorts10 = Annotated[bytes, Scalar("20s")]
Shorts72 = Annotated[bytes, Scalar("144s")]
"""uint16[n], little-endian."""


class MavlinkMessage(Message, frozen=True):
    """A message of this protocol."""

    spec: ClassVar[MavlinkSpec]


class MavlinkSpec:
    """A row of the message table. crc_extra: goes into the checksum, so that both sides mean the same fields."""

    def __init__(self, message_id: int, crc_extra: int, declared: type[MavlinkMessage]) -> None:
        self.id = message_id
        self.crc_extra = bytes((crc_extra,))
        self.message = declared
        self._codec = BinaryCodec(declared)
        self.size = self._codec.fixed_size
        """Bytes of the payload with all its zeros."""
        wires = {field.name: field.wire for field in declared_fields(declared)}
        self._arrays = {
            name: int(wire.code[:-1])
            for name, wire in wires.items()
            if isinstance(wire, Scalar) and wire.code[-1] == "s"
        }

    def __repr__(self) -> str:
        return f"<MavlinkSpec {self.id} {self.message.__name__}, {self.size} bytes>"

    def decode(self, payload: bytes) -> MavlinkMessage:
        """Read a payload: fill it with zeros, cut what is longer."""
        if len(payload) != self.size:
            payload = payload.ljust(self.size, b"\0")[: self.size]
        return self._codec.decode(payload, 0)

    def encode(self, message: MavlinkMessage) -> bytes:
        """Write a payload without its trailing zeros, of which the first byte stays; raise EncodeError."""
        for name, most in self._arrays.items():
            if (size := len(getattr(message, name))) > most:  # struct would cut it
                raise EncodeError(f"{self.message.__name__}.{name}: {size} bytes, expected {most} at most")
        payload = self._codec.encode(message)
        return payload.rstrip(b"\0") or payload[:1]


MESSAGES: dict[int, MavlinkSpec] = {}
"""The message table, by id."""
M = TypeVar("M", bound=MavlinkMessage)


def message(message_id: int, crc_extra: int) -> Callable[[type[M]], type[M]]:
    """Enter a declaration into the message table."""

    def enter(declared: type[M]) -> type[M]:
        declared.spec = MESSAGES[message_id] = MavlinkSpec(message_id, crc_extra, declared)
        return declared

    return enter
