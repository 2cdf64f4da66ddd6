"""How much an object keeps, whatever it calls it: for tests of bounds."""

from __future__ import annotations

from collections.abc import Sized


def most_kept(thing: object, *, depth: int = 1) -> int:
    """Give the length of the longest container or buffer that an object keeps; depth: objects of its own count, too."""
    longest = 0
    for value in vars(thing).values():
        if isinstance(value, Sized) and not isinstance(value, str):
            longest = max(longest, len(value))
        if depth > 1 and hasattr(value, "__dict__") and type(value).__module__.startswith(("zbridge.", "gateways.")):
            longest = max(longest, most_kept(value, depth=depth - 1))
    return longest
