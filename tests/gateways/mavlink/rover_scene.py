"""A gateway and a simulated rover without a link, and what went over the wire."""

from __future__ import annotations

from typing import Any

from gateways.mavlink import PROTOCOL
from gateways.mavlink.frames import numbered, read_frame
from gateways.mavlink.messages import MavlinkMessage
from gateways.mavlink.messages.control import CommandLong
from gateways.mavlink.numbers import Command, Result, RoverMode
from gateways.mavlink.simulator import ArduRover
from zbridge.simulation.scene import Scene

HOLD = bytes.fromhex("fd20000000ffbe4c00000000803f000080400000000000000000000000000000000000000000b00001010e93")
"""The page's vector: DO_SET_MODE HOLD."""


class DeafRover(ArduRover):
    """A rover to which commands are lost. deaf: how many of each kind."""

    def __init__(self, **more: Any) -> None:
        super().__init__(**more)
        self.deaf: dict[int, int] = {}

    def _obey(self, message: MavlinkMessage, sender: int) -> None:
        if isinstance(message, CommandLong) and self.deaf.get(message.command, 0) > 0:
            self.deaf[message.command] -= 1
            return
        super()._obey(message, sender)


class RefusingRover(ArduRover):
    """A rover that takes no mode but HOLD from ground stations."""

    def _command(self, message: CommandLong) -> Result:
        if message.command == Command.DO_SET_MODE and message.param2 != RoverMode.HOLD:
            return Result.FAILED
        return super()._command(message)


class MuteRover(ArduRover):
    """A rover whose HEARTBEAT is lost while it is mute; all else comes."""

    mute = False

    def _beat(self) -> None:
        if not self.mute:
            super()._beat()


def begin(rover: ArduRover | None = None, **options: Any) -> Scene:
    """Return a scene whose session is established; the first motion arms the rover, unless told otherwise."""
    scene = Scene(PROTOCOL, rover or ArduRover(), {"arm": "drive"} | options)
    scene.establish()
    return scene


def drive(scene: Scene, seconds: float, forward: float = 0.5, turn: float = 0.0) -> None:
    """Repeat a drive, as programs do."""
    for _ in range(round(seconds / 0.1)):
        scene.drive(forward, turn=turn)
        scene.run(0.1)


def sent(scene: Scene, kind: type[MavlinkMessage], since: int = 0) -> list[Any]:
    """Return the messages of one class that the gateway has written."""
    messages = (read_frame(frame).message for frame in scene.written[since:])
    return [message for message in messages if type(message) is kind]


def modes(scene: Scene, since: int = 0) -> list[RoverMode]:
    """Return the modes that the rover was asked for."""
    asked = sent(scene, CommandLong, since)
    return [RoverMode(int(each.param2)) for each in asked if each.command == Command.DO_SET_MODE]


def plain(scene: Scene, since: int = 0) -> list[bytes]:
    """Return what was written, without its numbers."""
    return [numbered(frame, 0) for frame in scene.written[since:]]
