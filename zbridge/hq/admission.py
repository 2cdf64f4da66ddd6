"""Decides which connections a listener accepts. Sans-IO; knows no protocol."""

from __future__ import annotations

from collections import deque

from zbridge.hq.settings import ListenerPlan
from zbridge.protocol.networks import is_among

ADDRESSES = 1024
"""Addresses whose connections are counted separately; beyond that the address seen longest ago is forgotten."""
FULL = "the maximum number of clients is connected"


class Admission:
    """Accepts connections by network, by rate per address and by number of clients, as the settings say."""

    def __init__(self, plan: ListenerPlan) -> None:
        self._allow = plan.allow
        self._clients = plan.settings.clients
        self._arrivals = Arrivals(plan.settings.accept_hz)

    def __repr__(self) -> str:
        return f"<Admission of {self._clients} clients, {self._arrivals!r}>"

    def refusal(self, host: str, clients: int, now: float) -> str | None:
        """Return why a connection from ``host`` is refused while there are ``clients``; None if it is accepted.

        Counts the connection. Called once for each.
        """
        if not self._arrivals.admit(host, now):
            return f"more than {self._arrivals.rate_hz:g} connections a second of its address"
        if clients >= self._clients:
            return FULL
        if self._allow and not is_among(host, self._allow):
            return "its network is not allowed"
        return None


class Arrivals:
    """Accepts ``rate_hz`` connections a second from each address, and never more within any second."""

    def __init__(self, rate_hz: float, addresses: int = ADDRESSES) -> None:
        self.rate_hz = rate_hz
        self._most = max(1, int(rate_hz))
        self._within_s = self._most / rate_hz
        self._addresses = addresses
        self._times: dict[str, deque[float]] = {}
        """When the last connections of each address were accepted; the address seen last is last."""

    def __repr__(self) -> str:
        return f"<Arrivals of {len(self._times)} addresses, {self._most} in {self._within_s:g} s each>"

    def admit(self, address: str, now: float) -> bool:
        """Return whether one more connection of an address is accepted, and count it if so."""
        times = self._times.pop(address, None) or deque(maxlen=self._most)
        self._times[address] = times
        if len(self._times) > self._addresses:
            del self._times[next(iter(self._times))]
        if len(times) == self._most and now - times[0] < self._within_s:
            return False
        times.append(now)
        return True
