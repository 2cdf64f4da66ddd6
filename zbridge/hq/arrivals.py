"""Connections by the address that they come from: how many are let in, and what a log tells of them. Sans-IO."""

from __future__ import annotations

from collections import Counter, deque

ADDRESSES = 1024
"""Addresses whose connections are counted apart; of more, those are forgotten that came longest ago."""
TOLD = 64
"""Addresses that have lines of their own in a second; the others share theirs."""
FOLD_S = 1.0
"""Seconds that one line tells of."""
OTHERS = "other addresses"


class Arrivals:
    """Lets in ``rate_hz`` connections a second from each address: never more within any second."""

    def __init__(self, rate_hz: float, addresses: int = ADDRESSES) -> None:
        self._most = max(1, int(rate_hz))
        self._within_s = self._most / rate_hz
        self._addresses = addresses
        self._times: dict[str, deque[float]] = {}
        """When the last ones were let in, by address; the address that came last is last."""

    def __repr__(self) -> str:
        return f"<Arrivals of {len(self._times)} addresses, {self._most} in {self._within_s:g} s each>"

    def admit(self, address: str, now: float) -> bool:
        """Let one more in from an address, if it may come."""
        times = self._times.pop(address, None) or deque(maxlen=self._most)
        self._times[address] = times
        if len(self._times) > self._addresses:
            del self._times[next(iter(self._times))]
        if len(times) == self._most and now - times[0] < self._within_s:
            return False
        times.append(now)
        return True


class _Fold:
    """The events of one address since its first one was told."""

    __slots__ = ("more", "since", "told")

    def __init__(self, since: float) -> None:
        self.since = since
        self.told: set[str] = set()
        self.more: Counter[str] = Counter()


class Folding:
    """Tells of the first event of each kind and address at once, and a second later how many more there were."""

    def __init__(self, addresses: int = TOLD) -> None:
        self._addresses = addresses
        self._folds: dict[str, _Fold] = {}

    def __repr__(self) -> str:
        return f"<Folding of {len(self._folds)} addresses>"

    def first(self, address: str, kind: str, now: float) -> bool:
        """Tell whether an event is to be told now; if not, it is counted. There are few kinds."""
        fold = self._folds.get(address)
        if fold is None:
            key = address if len(self._folds) < self._addresses else OTHERS
            fold = self._folds.setdefault(key, _Fold(now))
        if kind in fold.told:
            fold.more[kind] += 1
            return False
        fold.told.add(kind)
        return True

    def due(self, now: float) -> list[str]:
        """Say what more there was of each address whose second is over."""
        over = [address for address, fold in self._folds.items() if now - fold.since >= FOLD_S]
        folds = [(address, self._folds.pop(address)) for address in over]
        return [
            f"{address}: " + ", ".join(f"{count} more {kind}" for kind, count in fold.more.items())
            for address, fold in folds
            if fold.more
        ]
