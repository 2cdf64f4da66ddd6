"""All states of the intent of an HQ program: :mod:`zbridge.hq.intent`, with time in steps.

What is known of an intent from outside: what the program said, and what became of the lease. The account here knows no
table: motion may be sent only after neutral, in a mode, with the lease.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

from tests.search.search import Finding, _Row
from zbridge.errors import Refused
from zbridge.hq.intent import Intent
from zbridge.lease.stick import StickAction

DEADMAN_S, STEP_S = 0.5, 0.25
MODES = ("none", "manual", "autonomous")
_TIMES = ("_moved_at", "heard_at", "_rests_at", "_modeless_at")
_FAR = 3
"""Steps after which a time in the past is as any other."""


@dataclass
class FoundIntent:
    """What the search came to."""

    states: int = 0
    moves: int = 0
    cells: Counter[tuple[str, str, str]] = field(default_factory=Counter)


@dataclass(frozen=True)
class Known:
    """What is known from outside. owes: neutral must be said; silent: so many steps nothing was heard."""

    lease: str = "none"
    owes: bool = True
    moving: bool = False


def search_intent() -> FoundIntent:
    """Visit every state; raise Finding at the first that breaks a rule."""
    found = FoundIntent()
    table = {state: _Row("Intent", state.value, row, found.cells) for state, row in Intent.TABLE.items()}
    with patch.object(Intent, "TABLE", table):
        first = Intent(DEADMAN_S)
        seen = {_key(first, 1000.0, Known())}
        level = [(first, 1000.0, Known())]
        while level:
            following = []
            for intent, now, known in level:
                for after, later, next_known in _after(intent, now, known):
                    found.moves += 1
                    key = _key(after, later, next_known)
                    if key not in seen:
                        seen.add(key)
                        following.append((after, later, next_known))
            level = following
    found.states = len(seen)
    return found


def _key(intent: Intent, now: float, known: Known) -> Any:
    times = tuple(_steps(getattr(intent, name) - now) for name in _TIMES)
    return (intent._state, intent.mode, intent.needs_neutral or "", intent._moving, intent._waited, times, known)


def _steps(seconds: float) -> int:
    return max(-_FAR, min(_FAR, round(seconds / STEP_S))) if abs(seconds) < 1e9 else (_FAR if seconds > 0 else -_FAR)


def _copy(intent: Intent) -> Intent:
    new = object.__new__(Intent)
    new.__dict__.update(intent.__dict__)
    return new


def _after(intent: Intent, now: float, known: Known) -> Iterator[tuple[Intent, float, Known]]:
    for name, act in _MOVES.items():
        after = _copy(intent)
        later = now + STEP_S if name == "time" else now
        action: StickAction | None = None
        with contextlib.suppress(Refused):
            action = act(after, later)
        yield after, later, _judge(name, intent, after, action, known)
    for name, news in _NEWS.items():
        if name == "granted" and known.lease != "asked":
            continue
        if known.lease == "none" and name == "released":
            continue
        after = _copy(intent)
        news(after, now)
        lease = {"granted": "held", "refused": known.lease}.get(name, "none")
        owes = known.owes or name in ("lost", "refused")
        yield after, now, Known(lease, owes, known.moving and name == "granted")


def _judge(name: str, before: Intent, after: Intent, action: StickAction | None, known: Known) -> Known:
    """Follow what the program said; raise Finding."""
    owes = after.needs_neutral is not None
    if (
        name in ("motion", "autonomous")
        and action in (StickAction.SEND, StickAction.ACQUIRE, StickAction.WAIT)
        and (known.owes and owes)
    ):
        raise Finding(f"{name} was {action} while neutral was owed: {before!r}")
    if name == "motion" and action is StickAction.SEND and known.lease != "held":
        raise Finding(f"motion was sent without a lease: {before!r}")
    if name == "motion" and action in (StickAction.SEND, StickAction.ACQUIRE) and before.mode == "none":
        raise Finding(f"motion was {action} in mode none: {before!r}")
    if action is StickAction.SEND and known.lease != "held":
        raise Finding(f"{name} was sent without a lease: {before!r}")
    if known.owes and not owes and name not in ("neutral", "time", *MODES, "motion"):
        raise Finding(f"{name} paid a neutral: {before!r}")
    lease = "asked" if action is StickAction.ACQUIRE else known.lease
    if (lease == "held") != after.held or (lease == "asked") != (after.active and not after.held):
        raise Finding(f"after {name} the lease is {lease}, and the intent is {after!r}")
    return Known(lease, owes, after._moving)


def _said(act: Callable[[Intent, float], StickAction]) -> Callable[[Intent, float], StickAction]:
    def say(intent: Intent, now: float) -> StickAction:
        intent.heard(now)
        return act(intent, now)

    return say


_MOVES: dict[str, Callable[[Intent, float], StickAction | None]] = {
    "motion": _said(lambda intent, now: intent.motion(now)),
    "motion once": _said(lambda intent, now: intent.motion(now, lasts=False)),
    "neutral": _said(lambda intent, now: intent.neutral(now)),
    "neutral of a part": _said(lambda intent, now: intent.neutral(now, whole=False)),
    **{mode: _said(lambda intent, now, mode=mode: intent.choose(mode, now)) for mode in MODES},  # type: ignore[misc]
    "want": lambda intent, now: intent.want(now),
    "time": lambda intent, now: intent.expire(now),  # type: ignore[func-returns-value]
}
_NEWS: dict[str, Callable[[Intent, float], None]] = {
    "granted": lambda intent, now: intent.granted(1.0),
    "lost": lambda intent, now: intent.lost("lost"),
    "released": lambda intent, now: intent.released(),
    "refused": lambda intent, now: intent.refused("refused"),
}
