"""What one listener logs: connections, folded per address and second, and failures of a protocol, once each."""

from __future__ import annotations

import math

import msgspec

from zbridge.errors import EncodeError, ProtocolError
from zbridge.log import Log
from zbridge.metrics import Count

log = Log("zbridge.hq")

ADDRESSES = 64
"""Addresses that have lines of their own within a second; all others share theirs."""
FOLD_S = 1.0
"""Seconds that one line summarises."""
OTHERS = "other addresses"
FAILURES = 64
"""Different failures of a protocol that are logged; the rest are only counted."""


class _Fold(msgspec.Struct):
    """The events of one address since its first one was logged. more: by kind."""

    since: float
    logged: set[str] = msgspec.field(default_factory=set)
    more: dict[str, int] = msgspec.field(default_factory=dict)


class ConnectionLog:
    """Logs what happens to the clients of one listener: at INFO the first event of each kind and address in a second.

    Further events of that second are logged at DEBUG and summarised by :meth:`flush`.
    """

    def __init__(self, name: str, addresses: int = ADDRESSES) -> None:
        self._name = name
        self._addresses = addresses
        self._folds: dict[str, _Fold] = {}

    def __repr__(self) -> str:
        return f"<ConnectionLog {self._name} of {len(self._folds)} addresses>"

    def first(self, host: str, kind: str, now: float) -> bool:
        """Return whether an event is the first of its kind and address in a second; otherwise count it."""
        fold = self._folds.get(host)
        if fold is None:
            key = host if len(self._folds) < self._addresses else OTHERS
            fold = self._folds.setdefault(key, _Fold(now))
        if kind in fold.logged:
            fold.more[kind] = fold.more.get(kind, 0) + 1
            return False
        fold.logged.add(kind)
        return True

    def flush(self, now: float = math.inf) -> None:
        """Log a line for each address whose second is over and that had further events; without ``now`` for all."""
        for address in [address for address, fold in self._folds.items() if now - fold.since >= FOLD_S]:
            if more := self._folds.pop(address).more:
                counts = ", ".join(f"{count} more {kind}" for kind, count in more.items())
                template = "{listener}: {address}: {counts}"
                log.info("hq_connections", template, listener=self._name, address=address, counts=counts)


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
            log.debug("message_left_out", "{listener}: {what}: {error}", listener=self._name, what=what, error=error)
        elif kind not in self._logged and len(self._logged) < FAILURES:
            self._logged.add(kind)
            template = "{listener}: {what}: {error!r}; continuing without it"
            log.error("protocol_failed", template, listener=self._name, what=what, error=error, exc_info=error)
