"""The latched stops of one robot: each is in force until its own id is released. Sans-IO.

Theory of operation. A latched stop has an id of 16 random bytes. No clock and no order decides: an id is in force from
when it is known until it is released, and an id that was released never comes into force again. So it does not matter
in which order a partitioned network delivers latches and releases, or how often. A latch of the whole fleet is a latch
of each robot: a gateway that was away learns of it from the others (:meth:`Latches.adopt`), unless one of them knows
that it was released.

Beside them stands whether the robot was ever ordered to move by itself (:attr:`Latches.autonomous`): whichever gateway
comes next must stop such a robot in a way that ends that too. Nothing resets it: no robot confirms that it stopped.

Bounds: :data:`LATCHES` ids are in force; one more replaces the last, and the robot stays latched. The last
:data:`RELEASED` released ids of each kind are remembered.
Source: "Latched stops" in ``lease.md``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import msgspec

from zbridge.errors import Code, Malformed, PayloadError, ProtocolError, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet.lease_messages import FleetLatches
from zbridge.fleet.messages import Latch, Stop, StopId
from zbridge.protocol.kept import Exported

LATCHES = 16
"""Latched stops of one robot that are told apart."""
RELEASED = 64
"""Released ids that are remembered, of the robot and of the fleet each."""
STOPS = 4
"""Ids of stops that ``control`` shows."""
WHO, REASON = 64, 128
"""Characters of a name and of a reason that are kept."""


class LatchRecord(msgspec.Struct, frozen=True):
    """What survives a restart: the latched stops in force, and the released ids.

    autonomous: whether the robot was ever ordered to move by itself.
    """

    latches: tuple[Latch, ...] = ()
    released: tuple[StopId, ...] = ()
    released_fleet: tuple[StopId, ...] = ()
    autonomous: bool = False


def read_stop(payload: bytes) -> Stop:
    """Read a stop; what cannot be read is one without an id, and what has no id is not latched."""
    if not payload:
        return _PLAIN
    try:
        stop = payloads.decode(Stop, payload)
    except PayloadError:
        return _PLAIN
    return stop if stop.id is not msgspec.UNSET else _PLAIN


class Latches:
    """The latched stops of one robot. record: of the process before."""

    def __init__(self, record: LatchRecord | None = None) -> None:
        record = record or LatchRecord()
        self._in_force = {latch.id: latch for latch in record.latches[:LATCHES]}
        self._released = deque(record.released, maxlen=RELEASED)
        self._released_fleet = deque(record.released_fleet, maxlen=RELEASED)
        self.autonomous = record.autonomous
        """Whether the robot was ever ordered to move by itself, by this gateway or one before."""
        self._stops: deque[bytes] = deque(maxlen=STOPS)
        """The ids of the last stops that had one."""
        self._unsaved: set[bytes] = set()
        """The ids of latched stops that are not yet stored where they survive this process."""

    def __bool__(self) -> bool:
        return bool(self._in_force)

    def __contains__(self, stop_id: object) -> bool:
        return stop_id in self._in_force

    def __repr__(self) -> str:
        return f"<Latches {[latch.described for latch in self.in_force]}>"

    @property
    def in_force(self) -> tuple[Latch, ...]:
        """The latched stops, the oldest first."""
        return tuple(self._in_force.values())

    @property
    def fleet(self) -> FleetLatches:
        """What other gateways must know."""
        return FleetLatches(
            latches=tuple(latch for latch in self.in_force if latch.fleet), released=tuple(self._released_fleet)
        )

    @property
    def record(self) -> LatchRecord:
        """What must survive a restart."""
        return LatchRecord(self.in_force, tuple(self._released), tuple(self._released_fleet), self.autonomous)

    @property
    def described(self) -> str:
        """For people: the latest latch, and how many others are in force."""
        *others, last = self.in_force
        return last.described + (f" and {len(others)} more" if others else "")

    @property
    def stop_ids(self) -> frozenset[bytes]:
        """The ids of the last stops: what repeats one of them changes nothing. Read by other threads."""
        return frozenset(self._stops)

    @property
    def confirmed(self) -> tuple[StopId, ...]:
        """The ids of the last stops but for latched ones that :meth:`saved` does not cover: ``control`` shows them."""
        return tuple(stop_id for stop_id in self._stops if stop_id not in self._unsaved)

    def take(self, stop: Stop, *, fleet: bool) -> Latch | None:
        """Record a stop; return its latch if that is in force now. fleet: all robots of the realm were sent it."""
        if not isinstance(stop.id, bytes):
            return None
        self._stops.append(stop.id)
        if stop.latch is not True:
            return None
        who, reason = (text if isinstance(text, str) else None for text in (stop.who, stop.reason))
        latch = Latch(stop.id, who and who[:WHO], reason and reason[:REASON], fleet)
        self.add(latch)
        if latch.id not in self:
            return None
        self._unsaved.add(latch.id)
        return latch

    def saved(self) -> None:
        """Record that all latched stops survive this process, or cannot."""
        self._unsaved.clear()

    def add(self, latch: Latch) -> bool:
        """Let a latch come into force; return whether anything changed. A released one stays released."""
        if latch.id in self._released or latch.id in self._released_fleet:
            return False
        known = self._in_force.get(latch.id)
        if known is not None:
            if known.fleet or not latch.fleet:
                return False
        elif len(self._in_force) >= LATCHES:
            self._in_force.popitem()
        self._in_force[latch.id] = latch
        return True

    def release(self, stop_id: bytes, *, fleet: bool) -> bool:
        """Release a latch; return whether it was in force.

        fleet: whether who asks may release latches of the fleet, and of the fleet only. Raises Unsupported for a latch
        of the other kind, Malformed for one of the robot that was never known. A latch of the fleet that is not known
        here is remembered as released: this gateway may learn of it later.
        """
        latch = self._in_force.get(stop_id)
        if latch is not None and latch.fleet is not fleet:
            whose = "the whole fleet" if latch.fleet else "this robot alone"
            how = "zbridge unlatch --all" if latch.fleet else "zbridge unlatch ROBOT"
            raise Unsupported(f"this latched stop belongs to {whose}: release it with {how}")
        released = self._released_fleet if fleet else self._released
        if latch is None and not fleet and stop_id not in released:
            raise Malformed("no latched stop has this id", Code.MALFORMED)
        self._in_force.pop(stop_id, None)
        if stop_id not in released:
            released.append(stop_id)
        return latch is not None

    def adopt(self, answers: Iterable[FleetLatches]) -> tuple[Latch, ...]:
        """Take over the fleet's latches that others know, but for those that anybody knows to be released."""
        answers = tuple(answers)
        released = {stop_id for answer in answers for stop_id in answer.released}
        found = {latch.id: latch for answer in answers for latch in answer.latches if latch.id not in released}
        return tuple(latch for latch in found.values() if self.add(msgspec.structs.replace(latch, fleet=True)))

    def export(self) -> Exported:
        """Write everything down for another process of this robot."""
        exported: Exported = msgspec.to_builtins(self.record, builtin_types=(bytes,))
        return exported

    def restore(self, state: Exported) -> None:
        """Take over what another process of this robot wrote, besides what is known; raise ProtocolError."""
        try:
            record = msgspec.convert(state, LatchRecord)
        except msgspec.ValidationError as error:
            raise ProtocolError(f"latches: {error}") from error
        self.merge(record)

    def merge(self, record: LatchRecord) -> tuple[Latch, ...]:
        """Take over what another gateway of this robot knows; return the latches that are new."""
        self.autonomous = self.autonomous or record.autonomous
        for known, released in ((self._released, record.released), (self._released_fleet, record.released_fleet)):
            known.extend(stop_id for stop_id in released if stop_id not in known)
            for stop_id in released:
                self._in_force.pop(stop_id, None)
        return tuple(latch for latch in record.latches if self.add(latch))


_PLAIN = Stop()
