"""Shows the raw frames of one link to those who listen (``@wire``). Knows no bus.

Theory of operation. Who listens from the start may still be heard of after the first frames of a connection: these are
kept, in order, to the end of the handshake, and the first listener of a direction is shown those of its direction
first, whenever it comes. The listeners of both directions mostly appear shortly one after the other. So what is kept
is shown :data:`SETTLE_S` after the first appeared, in the order in which it was said, and what comes meanwhile waits
behind it; a direction that appears later still misses nothing. While nobody listens and nothing more is kept the
session calls nobody.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from typing import Any

from zbridge.blackbox import BlackBox
from zbridge.fleet.topics import WIRE_DATAGRAM, KeySpace
from zbridge.log import Log
from zbridge.protocol.session import Datagram, Session, State

log = Log("zbridge.link")

FIRST = 16
"""First frames of a conversation that are kept, also where there is no handshake."""
KEPT = 64
"""Most frames that are kept during the handshake."""
KEPT_BYTES = 65_536
"""Bytes that are kept."""
SETTLE_S = 0.02
"""Seconds between the first listener and what was kept: both directions have theirs by then."""
_LOGGED = 64

Show = Callable[[bytes], object]
Entry = tuple[int, str, bytes]
"""The running number of a frame, its direction (``in`` or ``out``), and the frame."""


Tap = Callable[[str, bytes], None]
"""``tap(direction, frame)``."""


def recording(box: BlackBox | None, keys: KeySpace, link: str) -> Tap | None:
    """Return a tap that puts the frames of a link into the black box; None where there is none."""
    if box is None:
        return None
    put, by_direction = box.put, wire_keys(keys, link)

    def record(direction: str, frame: bytes) -> None:
        put(by_direction[direction], frame, WIRE_DATAGRAM if type(frame) is Datagram else None)

    return record


def wire_keys(keys: KeySpace, link: str) -> Mapping[str, str]:
    """Return the keys of a link's raw frames, by direction."""
    return {direction: keys.key(f"@wire/{link}/{direction}") for direction in ("in", "out")}


class WireTap:
    """Follows the conversations of one link. label: of the link in the log. record: called with every frame."""

    def __init__(self, label: str, record: Tap | None = None) -> None:
        self._record = record
        self._label = label
        self._session: Session[Any] | None = None
        self._shows: dict[str, Show] = {}
        self._shown: dict[str, int] = {}
        """The number of the last frame that was shown in a direction that is listened to."""
        self._number = 0
        self._kept: list[Entry] = []
        self._kept_bytes = 0
        self._waiting: list[Entry] | None = None
        """What came since a listener appeared, until it is shown what was kept."""

    def __repr__(self) -> str:
        return f"<WireTap {self._label} shown {sorted(self._shows)}, {len(self._kept)} kept>"

    def begin(self, session: Session[Any]) -> None:
        """Follow a new conversation from its first frame."""
        self._session, self._kept, self._kept_bytes = session, [], 0
        session.tap = self._take

    def watch(self, direction: str, show: Show | None) -> None:
        """Show the frames of one direction (``in`` or ``out``) from now on, the kept ones first; None: show none."""
        if show is None:
            self._shows.pop(direction, None)
            self._shown.pop(direction, None)
            return
        if self._waiting is None:
            self._waiting = []
            asyncio.get_running_loop().call_later(SETTLE_S, self._show_kept)
        self._shows[direction] = show
        if self._session is not None:
            self._session.tap = self._take

    def _take(self, direction: str, frame: bytes) -> None:
        if self._record is not None:
            self._record(direction, frame)
        debug = log.enabled(logging.DEBUG)
        if debug:
            mark, start = "<" if direction == "in" else ">", frame[:_LOGGED].hex(" ")
            log.debug("frame", "{mark} {link} {start}", mark=mark, link=self._label, start=start, size_bytes=len(frame))
        self._number += 1
        entry = (self._number, direction, frame)
        if self._waiting is not None:
            if len(self._waiting) < 2 * KEPT:
                self._waiting.append(entry)
        else:
            self._show(entry)
        if self._keeps:
            self._kept.append(entry)
            self._kept_bytes += len(frame)
        elif not (debug or self._shows or self._waiting is not None) and self._session is not None:
            self._session.tap = self._record

    @property
    def _keeps(self) -> bool:
        """Whether the conversation has just begun, within the bounds of what is kept."""
        session = self._session
        begins = session is not None and session.state in (State.CONNECTING, State.HANDSHAKING)
        return len(self._kept) < (KEPT if begins else FIRST) and self._kept_bytes < KEPT_BYTES

    def _show_kept(self) -> None:
        waiting, self._waiting = self._waiting or [], None
        for entry in sorted([*self._kept, *waiting]):
            self._show(entry)

    def _show(self, entry: Entry) -> None:
        number, direction, frame = entry
        show = self._shows.get(direction)
        if show is not None and number > self._shown.get(direction, 0):
            self._shown[direction] = number
            show(frame)
