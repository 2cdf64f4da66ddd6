"""``zbridge drive``: drives one robot by keyboard, and holds its lease while it runs."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from functools import partial

from zbridge.bus import BusSettings
from zbridge.cli.keyboard import Keyboard, split_keys
from zbridge.client import Robot, connect
from zbridge.client.pilot import Pilot
from zbridge.errors import BusError, LeaseLost, Refused, ZbridgeError
from zbridge.fleet.messages import Drive
from zbridge.fleet.printable import shown
from zbridge.lease.stick import Stick, StickRules

EVERY_S = 0.05
DEADMAN_S = 0.3
_READ_BYTES = 1024
_HELP = """hold a key down to move, release it to stop
  w s, arrows  forward, backward     a d  turn left, right     q e  sideways
  space  STOP (whoever drives)       + -  speed                Enter  take the lease again     x  end"""


class DriveRun:
    """One run of ``zbridge drive``: keys in, drives out, one line of state on the terminal."""

    def __init__(self, robot: Robot, speed: float, *, who: str | None, takeover: bool) -> None:
        self._robot = robot
        self._keyboard = Keyboard(speed)
        lease = partial(robot.control, who, deadman_s=DEADMAN_S, takeover=takeover)
        self._pilot = Pilot(Stick(StickRules()), lease, on_end=self._on_end)
        self._failure: ZbridgeError | None = None
        self._keys: asyncio.Queue[tuple[str, float]] = asyncio.Queue(_READ_BYTES)
        self._loop = asyncio.get_running_loop()
        self._line = ""

    async def run(self) -> None:
        """Drive until ``x``; Enter acquires a lost lease again."""
        print(_HELP, f"waiting for the gateway of {self._robot.name}", sep="\n")  # noqa: T201
        with _raw_keys(self._loop, self._take):
            self._pilot.take()
            try:
                while await self._obey_keys():
                    self._drive()
                    await asyncio.sleep(EVERY_S)
            finally:
                await self._pilot.close()

    async def _obey_keys(self) -> bool:
        """Act on the keys pressed so far; return False if one of them was ``x``.

        Raises the error for which the lease was not granted, or a drive was not sent.
        """
        while not self._keys.empty():
            key, at = self._keys.get_nowait()
            if key == "x":
                return False
            if key == " ":
                await self._stop()
                continue
            self._keyboard.press(key, at)  # Enter too: any other key ends the motion of the one before
            if key in ("\r", "\n"):
                self._pilot.take()
        if self._failure is not None:
            raise self._failure
        return True

    def _drive(self) -> None:
        """Send the drive that the keys command; without the lease only note that no key is held."""
        command, held = self._keyboard.drive(self._loop.time()), self._pilot.stick.held
        if command.moving and not held:
            return
        try:
            self._pilot.drive(command)
            if held:
                self._show(command)
        except Refused as refusal:
            self._say(str(refusal))

    def _on_end(self, error: ZbridgeError | None) -> None:
        if isinstance(error, LeaseLost):
            self._say(f"{error}. Enter: take the lease again, x: end")
        else:
            self._failure = error

    async def _stop(self) -> None:
        try:
            await self._robot.stop()
            self._say(f"{self._robot.name}: stopped")
        except (Refused, BusError) as error:
            self._say(str(error))

    def _take(self, text: str) -> None:
        for key, _ in itertools.groupby(split_keys(text)):  # repeated within one read: queued, not held
            with contextlib.suppress(asyncio.QueueFull):
                self._keys.put_nowait((key, self._loop.time()))

    def _show(self, command: Drive) -> None:
        line = (
            f"{self._robot.name}  forward {command.forward:+.2f}  left {command.left:+.2f}  "
            f"turn {command.turn:+.2f}  speed {self._keyboard.speed:.1f}"
        )
        if line != self._line:
            self._line = line
            sys.stdout.write(f"\r\x1b[K{line}")
            sys.stdout.flush()

    def _say(self, text: str) -> None:
        if text == self._line:
            return
        self._line = text
        sys.stdout.write(f"\r\x1b[K{shown(text)}\n")
        sys.stdout.flush()


async def drive_robot(
    settings: BusSettings, realm: str, name: str, speed: float, *, who: str | None, takeover: bool
) -> None:
    """Drive one robot by keyboard; raise ZbridgeError without a terminal, Held if another program holds the lease."""
    if not sys.stdin.isatty():
        raise ZbridgeError("drive needs a terminal to read keys from")
    async with connect(settings=settings, realm=realm) as fleet:
        await DriveRun(fleet[name], speed, who=who, takeover=takeover).run()
    print()  # noqa: T201


@contextlib.contextmanager
def _raw_keys(loop: asyncio.AbstractEventLoop, take: Callable[[str], None]) -> Iterator[None]:
    """Read keys one by one, without echo, while the context lasts."""
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)

    def readable() -> None:
        data = os.read(descriptor, _READ_BYTES)
        take(data.decode("utf-8", "replace") if data else "x")

    tty.setcbreak(descriptor)
    loop.add_reader(descriptor, readable)
    try:
        yield
    finally:
        loop.remove_reader(descriptor)
        with contextlib.suppress(termios.error):  # the terminal is gone
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
