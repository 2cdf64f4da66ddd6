"""Legacy messages as bytes: declared once, coded by what the declaration says, cut from a bounded buffer.

Sans-IO. Knows no protocol: the messages are declared in ``gateways/<protocol>/messages.py``.
The text codec will stand beside :mod:`zbridge.wire.binary` and read the same declarations.
"""

from zbridge.wire.binary import BinaryCodec
from zbridge.wire.fields import F32, F64, I32, U8, Blob, Bool, F32Array, Message, Rest, Text
from zbridge.wire.frames import FrameBuffer

__all__ = [
    "F32",
    "F64",
    "I32",
    "U8",
    "BinaryCodec",
    "Blob",
    "Bool",
    "F32Array",
    "FrameBuffer",
    "Message",
    "Rest",
    "Text",
]
