"""How late the commands of one lease are, by the clock of their sender. Sans-IO.

Theory of operation. A network that was cut delivers what it kept, in order and at once: a command may be seconds old
when it comes. So senders date their commands: ``t`` is their own raw monotonic clock when a command was given. Clocks
of two machines are never compared. The gateway compares what it receives with the fastest delivery that it saw: the
*baseline* is the least of receive time minus ``t``, and a command is as late as its own difference exceeds that. Two
clocks drift apart, and a network may become slower for good: so the baseline may rise, by :data:`RISES_MS_PER_S`.

A baseline that was first taken from a late question is too high; the next command in time lowers it.
Source: the design's "Command age".
"""

from __future__ import annotations

import math

from msgspec import UNSET, UnsetType

from zbridge.errors import Malformed

MAX_AGE_S = 0.4
"""The greatest age at which a command is obeyed, unless the configuration says otherwise."""
RISES_MS_PER_S = 1.0
"""Milliseconds by which the baseline rises in a second: raw clocks drift by less than 0.2."""


class CommandAge:
    """The age of the commands and renewals of one lease.

    limit_s: what is later is stale; ``inf``: nothing is.
    """

    def __init__(self, limit_s: float) -> None:
        self.limit_s = limit_s
        self._baseline_ms: float | None = None
        self._sampled_ms = 0.0

    def __repr__(self) -> str:
        return f"<CommandAge {'dated' if self._baseline_ms is not None else 'undated'}, limit {self.limit_s:g} s>"

    def late_s(self, given_ms: int | UnsetType, received_ms: float) -> float:
        """Return by how many seconds something is late that was given and received at these times.

        0 for senders that never date anything; raises Malformed for something undated after something dated.
        """
        if self.limit_s == math.inf:
            return 0.0
        if given_ms is UNSET:
            if self._baseline_ms is not None:
                raise Malformed("t is missing: earlier commands of this lease had it")
            return 0.0
        apart_ms = received_ms - given_ms
        if self._baseline_ms is None:
            self._baseline_ms = apart_ms
        else:
            risen_ms = self._baseline_ms + (received_ms - self._sampled_ms) / 1000 * RISES_MS_PER_S
            self._baseline_ms = min(apart_ms, risen_ms)
        self._sampled_ms = received_ms
        return (apart_ms - self._baseline_ms) / 1000

    def is_stale(self, late_s: float) -> bool:
        """Tell whether something that is late by so much must not be obeyed."""
        return late_s > self.limit_s
