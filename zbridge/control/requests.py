"""Requests for the lease, within their bounds, and the refusals that ``control`` shows. Sans-IO."""

from __future__ import annotations

from collections import OrderedDict

from zbridge.errors import Code, Malformed, Refused
from zbridge.fleet.lease_messages import Acquire
from zbridge.fleet.messages import Refusal
from zbridge.lease.lease_events import EXPLAINED, NAMED

LEAST_S = 0.01
"""The shortest lease or deadman that can be requested, seconds."""
REFUSALS = 16
"""Different refusals that ``control`` shows; a new one replaces the one that was counted least recently."""


def name_of(request: Acquire) -> str:
    """Return the name of who asks, shortened; raise Malformed if people cannot be shown it."""
    if not request.who or not request.who.isprintable():
        raise Malformed(f"who = {request.who[:NAMED]!r}: expected a name that others are shown")
    return request.who[:NAMED]


def capped(name: str, requested_s: float | None, most_s: float) -> float:
    """Return the time requested, at most ``most_s``, which is also the default; raise Malformed if it is no time."""
    if requested_s is None:
        return most_s
    if not requested_s >= LEAST_S:
        raise Malformed(f"{name} = {requested_s:g}: expected at least {LEAST_S:g}")
    return min(requested_s, most_s)


class RefusalCounts:
    """Counts refusals that agree in sender, command, code, reason and listener; keeps the last :data:`REFUSALS`."""

    def __init__(self) -> None:
        self._counts: OrderedDict[tuple[str | None, str, Code, str, str | None], int] = OrderedDict()

    def __repr__(self) -> str:
        return f"<RefusalCounts of {len(self._counts)} different refusals>"

    def add(self, command: str, refused: Refused, who: str | None, by: str | None, count: int) -> Refusal:
        """Count a refusal and return it as it is shown, with its total. Names and reasons are shortened."""
        who, command, reason = who and who[:NAMED], command[:NAMED], str(refused)[:EXPLAINED]
        key = (who, command, refused.code, reason, by)
        self._counts[key] = total = self._counts.pop(key, 0) + count
        if len(self._counts) > REFUSALS:
            self._counts.popitem(last=False)
        return Refusal(who=who, command=command, code=refused.code, reason=reason, count=total, by=by)

    def shown(self) -> tuple[Refusal, ...]:
        """Return all refusals that are shown, the newest last."""
        return tuple(
            Refusal(who=who, command=command, code=code, reason=reason, count=count, by=by)
            for (who, command, code, reason, by), count in self._counts.items()
        )
