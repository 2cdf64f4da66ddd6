"""Makes text of others safe to print: on a terminal, in a table, in a log. Sans-IO."""

from __future__ import annotations

import json
from typing import Any

LINE = 2000
"""Characters of a line, by default."""
_CUT = "..."


def shown(text: object, most: int = LINE) -> str:
    """Return ``text`` as one line of at most ``most`` characters (3 or more), with non-printing characters escaped.

    Escaped are control characters (C0, DEL, C1), line breaks, and characters that turn or hide the text around them: no
    part reaches a terminal as a command. Markup is left as it is: the caller must not interpret it.
    """
    raw = str(text)
    safe = raw[: most + 1]
    if not safe.isprintable():
        safe = "".join(character if character.isprintable() else _escaped(character) for character in safe)
    return safe if len(safe) <= most else safe[: most - len(_CUT)] + _CUT


def as_json(value: Any) -> str:
    """Return ``value`` as one line of JSON, printable ASCII only, of any length; bytes as hex."""
    return json.dumps(value, default=bytes.hex).replace("\x7f", "\\u007f")


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode()
