"""Messages that begin with an opcode: with the bytes of the Create's manual, and what is none of them."""

from __future__ import annotations

import pytest

from zbridge.errors import EncodeError, ProtocolError
from zbridge.wire import I16, U8, Coded, FrameBuffer, Opcodes, Rest


class Start(Coded, frozen=True):
    opcode = 128


class Drive(Coded, frozen=True):
    opcode = 137
    byte_order = ">"
    velocity_mm_s: I16
    radius_mm: I16


class Stream(Coded, frozen=True):
    opcode = 148
    count: U8
    ids: Rest


COMMANDS = Opcodes((Start, Drive))


def test_commands_of_the_manual_are_written_and_read() -> None:
    assert COMMANDS.write(Drive(-200, 500)) == bytes([137, 255, 56, 1, 244])
    assert COMMANDS.read(bytes([137, 255, 56, 1, 244])) == Drive(-200, 500)
    assert COMMANDS.write(Start()) == b"\x80"
    assert Opcodes((Stream,)).read(b"..\x94\x02\x1d\x0d", 2) == Stream(2, b"\x1d\x0d")


def test_messages_without_framing_are_cut_by_their_opcodes() -> None:
    buffer = FrameBuffer(COMMANDS.end, 64)
    stream = bytes([128, 137, 255, 56, 1, 244, 128])
    frames = [frame for byte in stream for frame in buffer.feed(bytes([byte]))]
    assert [COMMANDS.read(frame) for frame in frames] == [Start(), Drive(-200, 500), Start()]


def test_what_is_no_message_is_told() -> None:
    with pytest.raises(ProtocolError, match="opcode 1, expected one of 128, 137"):
        COMMANDS.read(b"\x01")
    with pytest.raises(ProtocolError, match="no opcode"):
        COMMANDS.read(b"")
    with pytest.raises(ProtocolError, match="opcode 148, expected one of fixed width: 148"):
        Opcodes((Stream,)).end(b"\x94", 0)
    with pytest.raises(ProtocolError, match="Drive of 1 bytes, expected 4"):
        COMMANDS.read(b"\x89\x01")
    with pytest.raises(EncodeError, match="Drive"):
        COMMANDS.write(Drive(40_000, 0))
    with pytest.raises(EncodeError, match="is none of the messages"):
        COMMANDS.write(Stream(0, b""))
    with pytest.raises(TypeError, match="duplicate opcode"):
        Opcodes((Start, Start))
