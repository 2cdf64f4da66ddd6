"""Counts what the authority of one robot decided: changes of the lease, stops by cause, refusals by code."""

from __future__ import annotations

from zbridge.control.events import AuthorityEvent, EventKind, StopCause
from zbridge.errors import Code
from zbridge.metrics import Count, Metrics

_LEASE = {
    EventKind.ACQUIRED: "acquired",
    EventKind.TAKEN_OVER: "taken_over",
    EventKind.RELEASED: "released",
    EventKind.ENDED: "ended",
}
_LATCHES = {EventKind.LATCHED: "latched", EventKind.UNLATCHED: "unlatched"}


class EventCounts:
    """The counters of one robot's events.

    Those of changes and stops exist from the start: Prometheus sees no increase in a series that begins with 1.
    """

    def __init__(self, metrics: Metrics) -> None:
        self._metrics = metrics
        self._refused: dict[Code | None, Count] = {}
        self._stops = {cause: metrics.count("stops", cause=cause) for cause in StopCause}
        self._changes = {
            **{kind: metrics.count("lease_changes", change=change) for kind, change in _LEASE.items()},
            **{kind: metrics.count("latch_changes", change=change) for kind, change in _LATCHES.items()},
        }

    def __repr__(self) -> str:
        return f"<EventCounts {sum(count.value for count in self._refused.values())} refused>"

    def refused(self, code: Code | None, times: int = 1) -> None:
        """Count refusals of one code."""
        count = self._refused.get(code)
        if count is None:
            count = self._refused[code] = self._metrics.count("refused", code=code or "none")
        count.value += times

    def note(self, event: AuthorityEvent) -> None:
        """Count one event."""
        if event.what is EventKind.REFUSED:
            self.refused(event.code)
        elif event.what in self._changes:
            self._changes[event.what].value += 1
        if event.cause is not None:
            self._stops[event.cause].value += 1
