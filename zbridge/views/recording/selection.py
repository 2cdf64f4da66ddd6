"""Chooses messages of a recording by key and time. Sans-IO."""

from __future__ import annotations

from functools import lru_cache

import msgspec

from zbridge.views.recording.reader import Message

_LAST_NS = 2**64


@lru_cache(maxsize=4096)
def matches(key_expr: str, key: str) -> bool:
    """Tell whether a key expression matches a key, as on the bus: ``@...`` matches only itself."""
    return _match(tuple(key_expr.split("/")), tuple(key.split("/")))


def _match(expression: tuple[str, ...], chunks: tuple[str, ...]) -> bool:
    """Follow all positions of the expression that the chunks so far may have reached."""
    places = _skipped(expression, {0})
    for chunk in chunks:
        plain = not chunk.startswith("@")
        reached = set()
        for place in places:
            if place < len(expression):
                wanted = expression[place]
                if wanted == "**" and plain:
                    reached.add(place)
                elif wanted == chunk or (wanted == "*" and plain):
                    reached.add(place + 1)
        places = _skipped(expression, reached)
    return len(expression) in places


def _skipped(expression: tuple[str, ...], places: set[int]) -> set[int]:
    """Add the places behind each ``**``, which may stand for nothing."""
    found = set(places)
    for place in sorted(places):
        while place < len(expression) and expression[place] == "**":
            place += 1
            found.add(place)
    return found


class Selection(msgspec.Struct, frozen=True):
    """Which messages: of keys that ``key_expr`` matches (None: all), from ``since_ns`` to before ``until_ns``."""

    key_expr: str | None = None
    since_ns: int = 0
    until_ns: int = _LAST_NS

    def takes(self, message: Message) -> bool:
        """Tell whether a message is chosen."""
        if not self.since_ns <= message.log_ns < self.until_ns:
            return False
        return self.key_expr is None or matches(self.key_expr, message.channel.topic)
