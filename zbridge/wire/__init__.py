"""Legacy messages as bytes: declared once, coded by what the declaration says, cut from a bounded buffer.

Sans-IO. Knows no protocol: the messages are declared in ``gateways/<protocol>/messages.py``.
The binary and the text codec read the same declarations.
"""

from zbridge.wire.binary import BinaryCodec
from zbridge.wire.fields import (
    F32,
    F64,
    I16,
    I32,
    U8,
    U32,
    Blob,
    Bool,
    Decimal,
    F32Array,
    I64Fill,
    Message,
    Rest,
    Scalar,
    Text,
    Whole,
)
from zbridge.wire.frames import FrameBuffer
from zbridge.wire.lines import Line, Lines
from zbridge.wire.text import TextCodec

__all__ = [
    "F32",
    "F64",
    "I16",
    "I32",
    "U8",
    "U32",
    "BinaryCodec",
    "Blob",
    "Bool",
    "Decimal",
    "F32Array",
    "FrameBuffer",
    "I64Fill",
    "Line",
    "Lines",
    "Message",
    "Rest",
    "Scalar",
    "Text",
    "TextCodec",
    "Whole",
]
