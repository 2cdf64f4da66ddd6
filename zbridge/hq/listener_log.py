"""What one listener logs: connections, folded per address and second, and failures of a protocol, once each."""

from __future__ import annotations

import logging
import math
from collections import Counter

from zbridge.errors import EncodeError, ProtocolError
from zbridge.metrics import Count

log = logging.getLogger("zbridge.hq")

ADDRESSES = 64
"""Addresses that have lines of their own within a second; all others share theirs."""
FOLD_S = 1.0
"""Seconds that one line summarises."""
OTHERS = "other addresses"
FAILURES = 64
"""Different failures of a protocol that are logged; the rest are only counted."""


class ConnectionLog:
    """Logs what happens to the clients of one listener: at INFO the first event of each kind and address in a second.

    Further events of that second are logged at DEBUG and summarised by :meth:`flush`.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._folding = Folding()

    def __repr__(self) -> str:
        return f"<ConnectionLog {self._name} {self._folding!r}>"

    def first(self, host: str, kind: str, now: float) -> bool:
        """Return whether an event is the first of its kind and address in a second; otherwise count it."""
        return self._folding.first(host, kind, now)

    def note(self, host: str, kind: str, now: float, text: str, *values: object) -> None:
        """Log one event."""
        level = logging.INFO if self.first(host, kind, now) else logging.DEBUG
        log.log(level, f"%s: {text}", self._name, *values)

    def flush(self, now: float = math.inf) -> None:
        """Log the summaries whose second is over; without ``now`` all of them."""
        for line in self._folding.due(now):
            log.info("%s: %s", self._name, line)


class FailureLog:
    """Counts and logs what a protocol could not show or understand, so that a listener continues without it.

    A robot may be of a protocol that the listener's protocol has never met: ProtocolError and EncodeError are
    expected and logged at DEBUG. Anything else is a bug, logged once for each kind with its traceback.
    """

    def __init__(self, name: str, count: Count) -> None:
        self._name = name
        self._count = count
        self._logged: set[tuple[str, type[Exception]]] = set()

    def __repr__(self) -> str:
        return f"<FailureLog {self._name} {self._count.value}>"

    def note(self, what: str, error: Exception) -> None:
        """Count one failure and log it where it is new. what: what was left out."""
        self._count.value += 1
        kind = (what, type(error))
        if isinstance(error, EncodeError | ProtocolError):
            log.debug("%s: %s: %s", self._name, what, error)
        elif kind not in self._logged and len(self._logged) < FAILURES:
            self._logged.add(kind)
            log.error("%s: %s: %r; continuing without it", self._name, what, error, exc_info=error)


class Folding:
    """Reports the first event of each kind and address at once, and a second later how many followed. Sans-IO."""

    def __init__(self, addresses: int = ADDRESSES) -> None:
        self._addresses = addresses
        self._folds: dict[str, _Fold] = {}

    def __repr__(self) -> str:
        return f"<Folding of {len(self._folds)} addresses>"

    def first(self, address: str, kind: str, now: float) -> bool:
        """Return whether an event is reported now; otherwise count it. There are few kinds."""
        fold = self._folds.get(address)
        if fold is None:
            key = address if len(self._folds) < self._addresses else OTHERS
            fold = self._folds.setdefault(key, _Fold(now))
        if kind in fold.reported:
            fold.more[kind] += 1
            return False
        fold.reported.add(kind)
        return True

    def due(self, now: float) -> list[str]:
        """Return one line for each address whose second is over and that had further events; forget them."""
        over = [address for address, fold in self._folds.items() if now - fold.since >= FOLD_S]
        folds = [(address, self._folds.pop(address)) for address in over]
        return [
            f"{address}: " + ", ".join(f"{count} more {kind}" for kind, count in fold.more.items())
            for address, fold in folds
            if fold.more
        ]


class _Fold:
    """The events of one address since its first one was reported."""

    __slots__ = ("more", "reported", "since")

    def __init__(self, since: float) -> None:
        self.since = since
        self.reported: set[str] = set()
        self.more: Counter[str] = Counter()
