"""Version negotiation: the highest version both sides list. Sans-IO."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable

_VERSION = re.compile(r"\d{1,9}(\.\d{1,9})*")


def parse_versions(listed: str) -> tuple[str, ...]:
    """Read a comma-separated version list; ignore entries that are not dotted numbers."""
    entries = (entry.strip() for entry in listed.split(","))
    return tuple(entry for entry in entries if _VERSION.fullmatch(entry))


def agree(ours: Iterable[str], theirs: Iterable[str]) -> str | None:
    """Choose the highest common version, compared number by number; None: there is none."""
    common = set(ours) & set(theirs)
    return max(common, key=_numbers, default=None)


def newest(listed: Iterable[str], known: Collection[str]) -> str | None:
    """Choose the newest known version that is not newer than the newest listed; None: there is none."""
    limit = max(map(_numbers, listed), default=None)
    fitting = [version for version in known if limit is not None and _numbers(version) <= limit]
    return max(fitting, key=_numbers, default=None)


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split("."))
