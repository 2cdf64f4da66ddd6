"""What a program may ask for with a lease: a name, a length, a deadman. Sans-IO."""

from __future__ import annotations

from zbridge.errors import Malformed
from zbridge.fleet.messages import Acquire
from zbridge.lease.lease_events import NAMED

LEAST_S = 0.01
"""The shortest lease or deadman that can be asked for, seconds."""


def name_of(request: Acquire) -> str:
    """Return the name of who asks, shortened; raise Malformed if people cannot be shown it."""
    if not request.who or not request.who.isprintable():
        raise Malformed(f"who = {request.who[:NAMED]!r}: expected a name that others are shown")
    return request.who[:NAMED]


def capped(name: str, wish_s: float | None, most_s: float) -> float:
    """Return the wish, at most ``most_s``, which is also the default; raise Malformed if it is no time."""
    if wish_s is None:
        return most_s
    if not wish_s >= LEAST_S:
        raise Malformed(f"{name} = {wish_s:g}: expected at least {LEAST_S:g}")
    return min(wish_s, most_s)
