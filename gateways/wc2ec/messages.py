"""The messages of WC2EC, each declared once for all dialects that have it, and their framing.

Source: "Versions and dialects" of the protocol page. Every message begins with a byte of command, one of sensor type
and one of sensor number; the command determines the rest. Sans-IO.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from functools import partial
from typing import Annotated, ClassVar, TypeVar

import msgspec

from zbridge.protocol import Codec, ProtocolError, Role
from zbridge.wire import F64, U8, BinaryCodec, F64Fill, Message
from zbridge.wire.fields import CountedBytes
from zbridge.wire.frames import FrameEnd

FROM_CONTROLLER = range(128)
"""Commands that the Webots controller sends; all others are sent by the external controller."""
MAX_FRAME = 4096
_QUOTED = 16


class Wc2EcDialect(Enum):
    """The document's first draft, or the dialect of legacy programs."""

    DRAFT = "draft"
    DEPLOYED = "deployed"


class Wc2EcMessage(Message, frozen=True):
    """A message; its fields follow the command byte."""

    kind: U8
    number: U8

    commands: ClassVar[dict[Wc2EcDialect, int]]


W = TypeVar("W", bound=Wc2EcMessage)
Name = Annotated[bytes, CountedBytes("B")]


class Wc2EcSpec(msgspec.Struct, frozen=True, eq=False):
    """A row of a dialect's table."""

    command: int
    name: str
    message: type[Wc2EcMessage]
    codec: BinaryCodec[Wc2EcMessage]

    @property
    def sender(self) -> Role:
        """Who sends it, by its command: the Webots controller is the robot."""
        return Role.ROBOT if self.command in FROM_CONTROLLER else Role.HQ


MESSAGES: dict[Wc2EcDialect, dict[int, Wc2EcSpec]] = {dialect: {} for dialect in Wc2EcDialect}
"""The tables, by command."""


def message(name: str, **commands: int) -> Callable[[type[W]], type[W]]:
    """Enter a declaration into the tables of its dialects: ``draft`` and ``deployed`` give its command there."""

    def enter(declared: type[W]) -> type[W]:
        declared.commands = {Wc2EcDialect(dialect): command for dialect, command in commands.items()}
        for dialect, command in declared.commands.items():
            MESSAGES[dialect][command] = Wc2EcSpec(command, name, declared, BinaryCodec(declared))
        return declared

    return enter


@message("registerSensor", deployed=0)
class RegisterSensor(Wc2EcMessage, frozen=True):
    """The robot has this device, under this name; motors are registered too."""

    name: Name


@message("sensorData", draft=0, deployed=1)
class SensorData(Wc2EcMessage, frozen=True):
    """A sensor's newest value."""

    value: F64


@message("error", deployed=127)
class Error(Wc2EcMessage, frozen=True):
    """Documented, but sent by no legacy program."""


@message("enableSensor", draft=128)
class EnableSensor(Wc2EcMessage, frozen=True):
    """Start a sensor."""


@message("disableSensor", draft=129)
class DisableSensor(Wc2EcMessage, frozen=True):
    """Stop a sensor."""


@message("changeSensor", draft=130)
class ChangeSensor(Wc2EcMessage, frozen=True):
    """Change one configuration value of a sensor."""

    index: U8
    value: F64


@message("setSensor", draft=131)
class SetSensor(Wc2EcMessage, frozen=True, eq=False):
    """Set all configuration values of a sensor; their number is an option."""

    values: F64Fill


@message("setValue", deployed=130)
class SetValue(Wc2EcMessage, frozen=True):
    """Set a motor: rad/s of a rotational one, position in metres of a linear one."""

    value: F64


def frame_end(dialect: Wc2EcDialect, sender: Role, *, values: int = 0) -> FrameEnd:
    """Make the framing function for what one side sends. ``values``: configuration values of a sensor.

    A command that the side cannot send breaks the stream: its length is unknown.
    """
    specs = {command: spec for command, spec in MESSAGES[dialect].items() if spec.sender is sender}
    sizes = {command: 1 + spec.codec.fixed_size for command, spec in specs.items()}
    registration = RegisterSensor.commands.get(dialect) if sender is Role.ROBOT else None
    if (setting := SetSensor.commands.get(dialect)) in sizes:
        sizes[setting] += 8 * values

    def end(data: bytes, start: int) -> int:
        command = data[start]
        size = sizes.get(command)
        if size is None:
            half = (
                "" if (command in FROM_CONTROLLER) is (sender is Role.ROBOT) else ", which is of the other side's half"
            )
            quoted = data[start : start + _QUOTED].hex(" ")
            raise ProtocolError(f"command {command}{half}, expected one of {sorted(sizes)}: {quoted}")
        if command != registration:
            return start + size
        counted = start + size + 1
        return counted if len(data) < counted else counted + data[counted - 1]

    return end


def read(frame: bytes, dialect: Wc2EcDialect) -> Wc2EcMessage:
    """Read one message; raise ProtocolError if it is none of the dialect's."""
    spec = MESSAGES[dialect].get(frame[0])
    if spec is None:
        raise ProtocolError(f"command {frame[0]}, expected one of {sorted(MESSAGES[dialect])}")
    return spec.codec.decode(frame, 1)


def write(message: Wc2EcMessage, dialect: Wc2EcDialect) -> bytes:
    """Write one message; raise EncodeError for a value that its type cannot carry."""
    command = message.commands[dialect]
    return bytes((command,)) + MESSAGES[dialect][command].codec.encode(message)


def codecs() -> tuple[Codec, ...]:
    """List the messages of both dialects and both sides for the conformance kit; a sensor has two values."""
    return tuple(
        Codec(
            f"{dialect.value}, {name}",
            partial(write, dialect=dialect),
            partial(read, dialect=dialect),
            frame_end(dialect, sender, values=2),
            tuple(spec.message for spec in MESSAGES[dialect].values() if spec.sender is sender),
        )
        for dialect in Wc2EcDialect
        for name, sender in (("Webots controller", Role.ROBOT), ("external controller", Role.HQ))
    )
