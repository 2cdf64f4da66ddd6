"""Who drove each robot, and who stopped it, since the console started: read from what ``control`` shows.

A stop names nobody on the bus, unless it latches. A stop that this console sent is known by its id.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection

import msgspec

from zbridge.bus import Bus, Handle, Sample
from zbridge.errors import PayloadError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Control
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import is_name, split_key

ENTRIES = 50
"""Most entries of a robot."""
ROBOTS = 1000
"""Most robots that have a history; of further ones nothing is kept."""
OWN_STOPS = 4096
"""Most stops of this console that are known by their ids."""
_TEXT = 200
_encode = msgspec.msgpack.Encoder().encode


class HistoryEntry(msgspec.Struct, frozen=True):
    """What happened to the control of a robot. at: Unix seconds."""

    at: float
    text: str


class ControlHistory:
    """The histories of all robots, from :meth:`open` to :meth:`close`. changed: called with a robot's name."""

    def __init__(
        self, bus: Bus, realm: str, changed: Callable[[str], None], clock: Callable[[], float] = time.time
    ) -> None:
        self._bus = bus
        self._realm = realm
        self._changed = changed
        self._clock = clock
        self._last: dict[str, Control] = {}
        self._entries: dict[str, deque[HistoryEntry]] = {}
        self._own: dict[bytes, str] = {}
        self._handle: Handle | None = None

    def __repr__(self) -> str:
        return f"<ControlHistory of {len(self._entries)} robots>"

    def open(self) -> None:
        """Follow all robots from now on."""
        self._handle = self._bus.subscribe(f"{self._realm}/*/{topics.CONTROL.path}", self._take, history=True)

    def close(self) -> None:
        """Follow them no longer; idempotent."""
        if self._handle is not None:
            self._handle.close()

    def note_own(self, stop_id: bytes, who: str) -> None:
        """Remember a stop that this console sends. who: for whom, as pages say it."""
        self._own[stop_id] = who
        if len(self._own) > OWN_STOPS:
            del self._own[next(iter(self._own))]

    def payload(self, robot: str) -> bytes:
        """Return the entries of a robot, the oldest first, as a payload."""
        return _encode(tuple(self._entries.get(robot, ())))

    def _take(self, sample: Sample) -> None:
        split = split_key(sample.key)
        if split is None or not is_name(robot := split[1]):
            return
        try:
            control = payloads.decode(Control, sample.payload)
        except PayloadError:
            return
        if robot not in self._last and len(self._last) >= ROBOTS:
            return
        before, self._last[robot] = self._last.get(robot), control
        texts = changes(before, control, self._own) if before is not None else []
        if texts:
            entries = self._entries.setdefault(robot, deque(maxlen=ENTRIES))
            entries.extend(HistoryEntry(self._clock(), shown(text, _TEXT)) for text in texts)
            self._changed(robot)


def changes(before: Control, now: Control, own: dict[bytes, str]) -> list[str]:
    """Say what happened between two messages of ``control``. own: who sent the stops of this console, by id."""
    texts = []
    known, latches = {latch.id for latch in before.latches}, {latch.id: latch for latch in now.latches}
    new_stops = [stop for stop in now.stops if stop not in before.stops]
    for stop in new_stops:
        whom = f": {before.holder} no longer drives" if before.holder and before.lease != now.lease else ""
        if stop in latches:
            texts.append(latches[stop].described + whom)
        else:
            texts.append((f"stopped by {own[stop]}" if stop in own else "a stop") + whom)
    texts += [latch.described for latch in now.latches if latch.id not in known and latch.id not in new_stops]
    texts += [f"no longer {latch.described}" for latch in before.latches if latch.id not in latches]
    return texts + _holder_changes(before, now, new_stops)


def _holder_changes(before: Control, now: Control, new_stops: Collection[bytes]) -> list[str]:
    if before.holder == now.holder and before.lease == now.lease:
        return []
    texts = []
    if before.holder and not new_stops:
        how = "was stopped" if now.state == "stopped" else "no longer drives"
        texts.append(f"{before.holder} {how}")
    if now.holder:
        texts.append(f"{now.holder} drives")
    return texts
