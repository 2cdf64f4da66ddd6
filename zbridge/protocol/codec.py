"""How the conformance kit finds the messages of a protocol. Sans-IO."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from zbridge.wire.frames import FrameEnd


class Codec(msgspec.Struct, frozen=True):
    """The messages that one side sends in one dialect, and how they are written, read and framed.

    write: returns one frame, raises EncodeError. read: decodes one frame, raises ProtocolError and nothing else.
    messages: examples. A class stands for one example whose fields the kit fills in.
    """

    name: str
    write: Callable[[Any], bytes]
    read: Callable[[bytes], Any]
    frame_end: FrameEnd
    messages: tuple[Any, ...]
