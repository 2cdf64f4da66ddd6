"""Legacy messages as bytes: one declaration a message, compiled to a binary or a text codec; frames cut from a stream.

Sans-IO. Knows no protocol: a protocol declares its messages in its own package. ``fields`` has the wire types of
declarations, ``binary`` and ``text`` the codecs, ``lines`` and ``packets`` whole framings of lines of text and of
packets with a head, a count and a checksum, ``opcodes`` messages that begin with a byte that names them, ``frames`` the
bounded buffer of an incomplete frame.
"""

from zbridge.wire.binary import BinaryCodec
from zbridge.wire.fields import (
    F32,
    F64,
    I8,
    I16,
    I32,
    U8,
    U16,
    U32,
    Blob,
    Bool,
    Counted,
    Decimal,
    F32Array,
    F64Fill,
    I64Fill,
    Message,
    Rest,
    Scalar,
    Text,
    Whole,
)
from zbridge.wire.frames import FrameBuffer
from zbridge.wire.lines import Line, Lines
from zbridge.wire.opcodes import Coded, Opcodes
from zbridge.wire.packets import Packets
from zbridge.wire.text import TextCodec

__all__ = [
    "F32",
    "F64",
    "I8",
    "I16",
    "I32",
    "U8",
    "U16",
    "U32",
    "BinaryCodec",
    "Blob",
    "Bool",
    "Coded",
    "Counted",
    "Decimal",
    "F32Array",
    "F64Fill",
    "FrameBuffer",
    "I64Fill",
    "Line",
    "Lines",
    "Message",
    "Opcodes",
    "Packets",
    "Rest",
    "Scalar",
    "Text",
    "TextCodec",
    "Whole",
]
