"""Converts keys to drive commands: motion only while a key repeats. Knows no terminal; time is an argument."""

from __future__ import annotations

import re

import msgspec

from zbridge.fleet.messages import Drive

FIRST_REPEAT_S = 0.8
"""Longest time a keyboard waits before it repeats a key that is held down."""
NEXT_REPEAT_S = 0.15
"""Longest time between two repetitions, including a slow network."""
STEP = 0.1
"""Change of speed of one ``+`` or ``-``, a fraction of full scale."""

DRIVES = {
    "w": Drive(forward=1.0),
    "s": Drive(forward=-1.0),
    "a": Drive(turn=1.0),
    "d": Drive(turn=-1.0),
    "q": Drive(left=1.0),
    "e": Drive(left=-1.0),
}
ARROWS = {"\x1b[A": "w", "\x1b[B": "s", "\x1b[D": "a", "\x1b[C": "d"}
_KEYS = re.compile(r"\x1b\[[0-?]*[!-/]*[@-~]|\x1bO[A-Za-z]|\x1b[^\x1b \[]?|.", re.DOTALL)
"""One key: one character, or a whole escape sequence, whose letters are no keys.

A space is never part of a sequence: it stops the robot whatever precedes it.
"""


def split_keys(text: str) -> list[str]:
    """Split a terminal's input into keys; arrows, three characters each, become their letters."""
    keys = [ARROWS.get(key, key) for key in _KEYS.findall(text)]
    return [key for key in keys if not key.startswith("\x1b")]


class Keyboard:
    """The command that the keys pressed so far stand for.

    A single press moves nothing: a terminal that hangs does not repeat it.
    """

    def __init__(self, speed: float) -> None:
        self.speed = speed
        self._key = ""
        self._pressed_at = 0.0
        self._moves_until = 0.0

    def press(self, key: str, now: float) -> None:
        """Record one key press."""
        if key in ("+", "-"):
            self.speed = min(1.0, max(STEP, round(self.speed + (STEP if key == "+" else -STEP), 2)))
            return
        if key == self._key and now - self._pressed_at <= FIRST_REPEAT_S:
            self._moves_until = now + NEXT_REPEAT_S
        else:
            self._moves_until = 0.0
        self._key, self._pressed_at = key, now

    def drive(self, now: float) -> Drive:
        """Return the command to send at ``now``."""
        wanted = DRIVES.get(self._key)
        if wanted is None or now >= self._moves_until:
            return Drive()
        speed = self.speed
        return msgspec.structs.replace(
            wanted, forward=wanted.forward * speed, left=wanted.left * speed, turn=wanted.turn * speed
        )
