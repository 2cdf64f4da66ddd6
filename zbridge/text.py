"""Text that others wrote, made safe to show to people: on a terminal, in a table, in a log. Sans-IO."""

from __future__ import annotations

import json
from typing import Any

LINE = 2000
"""Characters of a line, unless told otherwise."""
_CUT = "..."


def shown(text: object, most: int = LINE) -> str:
    """Write ``text`` on one line of at most ``most`` characters (3 or more), with all escaped that does not print.

    That is control characters (C0, DEL, C1), so that no terminal takes a part of it for a command, line breaks, and
    what turns or hides the text around it. Markup is the business of who shows it: it must not be interpreted.
    """
    raw = str(text)
    safe = raw[: most + 1]
    if not safe.isprintable():
        safe = "".join(character if character.isprintable() else _escaped(character) for character in safe)
    return safe if len(safe) <= most else safe[: most - len(_CUT)] + _CUT


def as_json(value: Any) -> str:
    """Write ``value`` as one line of JSON that holds printable ASCII only; it is not cut."""
    return json.dumps(value).replace("\x7f", "\\u007f")


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode()
