"""Admission filters choose for every sample and query whether it reaches the event loop, and with which priority.

Theory of operation. Filters run on Zenoh's threads; one thread calls each. Anybody on the bus may send as much as the
network carries, so input that nobody has to obey must cost little: a filter drops it before the event loop wakes.

- A command that needs the lease is proven first. Only a proven command gets the priority COMMAND and uses up its
  number: a sender that merely knows the lease's public id fills no queue of the holder's and spoils no number.
- All other input is limited in rate. What passes is refused by the event loop with reason and sender. The rest is
  counted by code and shown once a second.
- A stop is never refused. A stop that follows another within :data:`SAME_STOP_S`, for a stopped robot without a
  holder, changes nothing and is only counted; one with an id of its own does, for ``control`` has to show the id.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator

import msgspec
from msgspec import UNSET

from zbridge.bus import PriorityClass, ReadPayload
from zbridge.control.authority import Authority
from zbridge.control.latch import read_stop
from zbridge.errors import Code, LeaseLost, Malformed, RateLimited, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Mode, Motor, Raw
from zbridge.fleet.topics import KeySpace
from zbridge.lease.proof import read
from zbridge.protocol.rate_limit import RateLimit

OF_THE_HOLDER = (Drive, Motor, Mode, Raw)
"""Commands that move a robot, or may move it: they need the lease."""
SHOWN_HZ = 20.0
"""Refused samples or queries a second of each filter that reach the event loop, with reason and sender."""
OPEN_HZ = 500.0
"""Commands a second that need no lease, all senders together."""
NAME_HZ, ALL_NAMES_HZ = 20.0, 100.0
"""Queries for the lease a second, of one name and of all."""
NAMES = 256
"""Names that are limited apart; one more replaces the name that asked longest ago."""
SAME_STOP_S = 0.05
"""Seconds within which a second stop changes nothing, for a stopped robot without a holder."""
_KEPT = 1024
"""Keys whose kind is remembered."""

Clock = Callable[[], float]
_STOP_PATH = f"/{topics.CMD_STOP.path}"


def is_stop(key: str) -> bool:
    """Return whether a command's key is a stop's. Only a stop may have wildcards before its last chunk."""
    return key.endswith(_STOP_PATH)


class RefusalLimit:
    """Lets ``rate_hz`` refused samples or queries through to the event loop, and counts the others by code.

    Zenoh's thread counts, the event loop's thread reads: no number is written by both.
    """

    def __init__(self, rate_hz: float, clock: Clock) -> None:
        self._allowance = RateLimit(rate_hz)
        self._clock = clock
        self._counted = dict.fromkeys(_REFUSALS, 0)
        self._reported = dict.fromkeys(_REFUSALS, 0)

    def __repr__(self) -> str:
        return f"<RefusalLimit {sum(self._counted.values())} dropped>"

    def priority(self, code: Code) -> PriorityClass | None:
        """Return the priority of a refused sample or query; None if it is only counted."""
        if self._allowance.take(self._clock()):
            return PriorityClass.OTHER
        self._counted[code] += 1
        return None

    def count(self, code: Code) -> None:
        """Count one that is dropped."""
        self._counted[code] += 1

    def dropped(self) -> Iterator[tuple[Refused, int]]:
        """Yield what was counted since the last call; on the event loop's thread."""
        for code, total in self._counted.items():
            count, self._reported[code] = total - self._reported[code], total
            if count:
                yield _REFUSALS[code], count


class _CommandRule(msgspec.Struct, frozen=True):
    """What a key's commands are: whether they need the lease, and the most bytes they may have."""

    leased: bool
    most_bytes: int
    stop: bool = False


_STOP = _CommandRule(leased=False, most_bytes=0, stop=True)
_UNKNOWN = _CommandRule(leased=False, most_bytes=topics.LARGE_BYTES)


class QueryFilter:
    """Distinguishes new input of the holder's from all other input: its queries about the lease, each key on its own.

    notes: keep each proof for the event loop, which admits the command without proving it again.
    """

    def __init__(self, authority: Authority, clock: Clock, *, notes: bool = False) -> None:
        self._notes = notes
        self.refusals = RefusalLimit(SHOWN_HZ, clock)
        self._authority = authority
        self._newest = (b"", -1)

    def __repr__(self) -> str:
        return f"<QueryFilter {self.refusals!r}>"

    def __call__(self, key: str, shown: bytes | None, size: int, read_payload: ReadPayload) -> PriorityClass | None:
        """Return COMMAND if the proof shows the holder as the sender and the number is new."""
        holder = self._authority.holders.current
        if shown is None or holder is None or not (verifier := holder.verifier).plausible(shown):
            return self.refusals.priority(Code.NO_LEASE)
        try:
            authorization = read(shown)
        except Malformed:
            return self.refusals.priority(Code.MALFORMED)
        if authorization.lease != verifier.lease:
            return self.refusals.priority(Code.NO_LEASE)
        lease, seq = self._newest
        if authorization.lease == lease and authorization.seq <= seq:
            return self.refusals.priority(Code.OUT_OF_ORDER)
        payload = read_payload()
        if not verifier.proves(authorization, key, payload):
            return self.refusals.priority(Code.MALFORMED)
        self._newest = (authorization.lease, authorization.seq)
        if self._notes:
            verifier.note(shown, authorization, key, payload)
        return PriorityClass.COMMAND


class CommandFilter:
    """Sorts the commands for one robot. ``clock``: seconds on the event loop's time line, from any thread."""

    def __init__(self, authority: Authority, keys: KeySpace, clock: Clock) -> None:
        self._authority = authority
        self._keys = keys
        self._clock = clock
        self._prover = QueryFilter(authority, clock, notes=True)
        self.refusals = self._prover.refusals
        self._open = RateLimit(OPEN_HZ)
        self._rules: dict[str, _CommandRule] = {}
        self._stopped_at = float("-inf")
        self.same_stops = 0
        """Stops that were counted only."""

    def __repr__(self) -> str:
        return f"<CommandFilter {self._keys.robot} {self.refusals!r}>"

    def __call__(self, key: str, shown: bytes | None, size: int, read_payload: ReadPayload) -> PriorityClass | None:
        kind = self._rules.get(key) or self._find(key)
        if kind.stop:
            return self._stop(read_payload() if size else b"")
        if size > kind.most_bytes:
            return self.refusals.priority(Code.MALFORMED)
        if kind.leased:
            return self._prover(key, shown, size, read_payload)
        if self._open.take(self._clock()):
            return PriorityClass.OTHER
        self.refusals.count(Code.RATE)
        return None

    def stopped(self) -> None:
        """Note that a stop was carried out now; on the event loop's thread."""
        self._stopped_at = self._clock()

    def _stop(self, payload: bytes) -> PriorityClass | None:
        """Let a stop through unless it changes nothing. The holder is checked last: a new one may come meanwhile."""
        stop_id = read_stop(payload).id
        known = stop_id is UNSET or stop_id in self._authority.latches.stop_ids
        fresh = self._clock() - self._stopped_at < SAME_STOP_S
        if known and fresh and not self._authority.motion.moving and self._authority.verifier is None:
            self.same_stops += 1
            return None
        return PriorityClass.STOP if stop_id is UNSET else PriorityClass.LATCH

    def _find(self, key: str) -> _CommandRule:
        kind = self._read(key)
        if len(self._rules) < _KEPT:
            self._rules[key] = kind
        return kind

    def _read(self, key: str) -> _CommandRule:
        if is_stop(key):
            return _STOP
        topic = topics.find(self._keys.path(key)) if topics.is_concrete(key) else None
        if topic is None or topic.most_bytes is None:
            return _UNKNOWN
        return _CommandRule(leased=topic.message in OF_THE_HOLDER, most_bytes=topic.most_bytes)


class NameFilter:
    """Sorts queries for the lease: limits their rate by name (the last chunk of the key) and altogether."""

    def __init__(self, clock: Clock) -> None:
        self.refusals = RefusalLimit(0.0, clock)
        self._clock = clock
        self._all = RateLimit(ALL_NAMES_HZ)
        self._names: OrderedDict[str, RateLimit] = OrderedDict()

    def __repr__(self) -> str:
        return f"<NameFilter {len(self._names)} names, {self.refusals!r}>"

    def __call__(self, key: str, shown: bytes | None, size: int, read_payload: ReadPayload) -> PriorityClass | None:
        now, name = self._clock(), key.rpartition("/")[2]
        own = self._names.get(name)
        if own is None:
            own = self._names[name] = RateLimit(NAME_HZ)
            if len(self._names) > NAMES:
                self._names.popitem(last=False)
        else:
            self._names.move_to_end(name)
        if own.take(now) and self._all.take(now):
            return PriorityClass.OTHER
        self.refusals.count(Code.RATE)
        return None


_REFUSALS: dict[Code, Refused] = {
    Code.NO_LEASE: LeaseLost("no lease: acquire first", Code.NO_LEASE),
    Code.MALFORMED: Malformed("wrong proof, or too large"),
    Code.OUT_OF_ORDER: Malformed("repeated or out of order", Code.OUT_OF_ORDER),
    Code.RATE: RateLimited("too many per second"),
}
"""The refusals that ``control`` shows for what was only counted."""
