"""The packets of the protocol: ``FA FB``, a count, a body that begins with what it is, and a checksum."""

from enum import IntEnum
from functools import partial
from typing import Annotated

from zbridge.protocol import ProtocolError
from zbridge.wire import I16, U8, U16, BinaryCodec, Counted, Message, Packets, Rest


class Do(IntEnum):
    """The numbers of commands. Before OPEN, 0 to 2 are the steps of the handshake: SYNC0, SYNC1 and SYNC2."""

    PULSE, OPEN, CLOSE = 0, 1, 2
    ENABLE = 4  # the motors: 1 on, 0 off
    VEL = 11  # mm/s
    RVEL = 21  # degrees/s, counter-clockwise
    SONAR = 28  # 1 on, 0 off


class Command(Message, frozen=True):
    number: U8


class Setting(Message, frozen=True):
    """A command with an integer of 16 bits. sign: 0x3B of a positive one, 0x1B of a negative one. size: without it."""

    number: U8
    sign: U8
    size: U16

    @classmethod
    def of(cls, number: Do, value: int) -> "Setting":
        return cls(number, 0x1B if value < 0 else 0x3B, min(abs(value), 2**15 - 1))


class Synced(Message, frozen=True):
    """The answer to a SYNC. texts: of SYNC2, the name, class and subclass of the robot, each with a NUL behind it."""

    number: U8
    texts: Rest = b""


class Sonar(Message, frozen=True):
    number: U8
    range_mm: U16


class Report(Message, frozen=True):
    """The server information packet, ten times a second. sonars: only those that have a new reading."""

    kind: U8  # 0x32 while the robot stands, 0x33 while it moves
    x_mm: I16
    y_mm: I16
    heading: I16  # 4096 are a full turn
    left_mm_s: I16
    right_mm_s: I16
    battery: U8  # 0.1 V
    bumpers: U16  # bits 1 to 5 rear, 9 to 13 front; bits 0 and 8: the left and the right wheel are stalled
    control: I16
    flags: U16  # bit 0: the motors are on
    compass: U8
    sonars: Annotated[tuple[Sonar, ...], Counted("B")]
    rest: Rest = b""  # gripper, analog and digital ports, and what newer firmware adds


COMMANDS: dict[int, type[Message]] = {number: Command if number <= Do.CLOSE else Setting for number in Do}
ANSWERS: dict[int, type[Message]] = {0: Synced, 1: Synced, 2: Synced, 0x32: Report, 0x33: Report}
CODECS = {kind: BinaryCodec(kind) for kind in {*COMMANDS.values(), *ANSWERS.values()}}


def checksum(packet: bytes) -> bytes:
    """Sum the words of the body, the first byte of each the higher one; an odd last byte is XORed in."""
    body = packet[3:]
    words = sum(body[at] << 8 | body[at + 1] for at in range(0, len(body) - 1, 2))
    return (words % 2**16 ^ (body[-1] if len(body) % 2 else 0)).to_bytes(2, "big")


PACKETS = Packets(b"\xfa\xfb", "B", uncounted=3, checksum=checksum, most=208)


def write(message: Message) -> bytes:
    return PACKETS.packet(CODECS[type(message)].encode(message))


def read(frame: bytes, kinds: dict[int, type[Message]] = ANSWERS) -> Message:
    """Read what the robot sent."""
    body = PACKETS.body(frame)
    if not body or body[0] not in kinds:
        raise ProtocolError(f"a packet of an unknown kind: {body.hex(' ')}")
    return CODECS[kinds[body[0]]].decode(body, 0)


read_command = partial(read, kinds=COMMANDS)
