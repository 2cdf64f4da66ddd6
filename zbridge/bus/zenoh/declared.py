"""Declares callbacks on a Zenoh session, and takes back what was declared on it.

Zenoh refuses to undeclare an entity whose callback runs at that moment ("Already borrowed"), so that is tried again: a
few times at once, then by a thread of its own.
"""

from __future__ import annotations

import ctypes
import itertools
import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

log = logging.getLogger("zbridge.bus")

UNDECLARE_S = 1.0
"""Longest time for which undeclaring an entity is tried while its callback runs on."""
_TRIES_AT_ONCE, _PAUSE_S = 4, 0.0005
"""Tries of the calling thread, which may be the event loop's, and the pause between two tries, seconds."""
KNOWN_THREADS = 64
"""Threads of Zenoh's whose state Python keeps: 16 kB each. Two or three bring all samples of a process."""

_keep_state = ctypes.pythonapi.PyGILState_Ensure
_here = threading.local()
_known = itertools.count()


def threadless(callback: Callable[[Any], object]) -> zenoh.handlers.Callback[Any]:
    """Let Zenoh's own thread call back, for what is rare and returns at once; else each callback gets a thread."""
    return zenoh.handlers.Callback(callback, indirect=False)


def prompt(callback: Callable[[Any], object]) -> zenoh.handlers.Callback[Any]:
    """Let Zenoh's own thread call back, for what is frequent, returns at once and must not wait for another thread."""

    def called(raw: Any) -> None:
        if not hasattr(_here, "known"):
            keep_thread()
        callback(raw)

    return threadless(called)


def keep_thread() -> None:
    """Let Python keep its state of this thread, which is not one of its own, for the next call.

    Python makes and frees that state, with a stack that is mapped anew, for each call: 20 us. A reference too many,
    which is never given back, keeps it.
    """
    _here.known = True
    if next(_known) < KNOWN_THREADS:
        _keep_state()


class Declared:
    """Zenoh entities that are undeclared together. :meth:`close` is idempotent."""

    def __init__(self, *entities: Any) -> None:
        self._entities = entities

    @property
    def closed(self) -> bool:
        """Whether the entities were taken back."""
        return not self._entities

    def close(self) -> None:
        """Undeclare the entities."""
        entities, self._entities = self._entities, ()
        for entity in entities:
            _undeclare_soon(entity)


class Undo:
    """A handle that undoes something once."""

    def __init__(self, undo: Callable[[], object]) -> None:
        self._undo: Callable[[], object] | None = undo

    @property
    def closed(self) -> bool:
        """Whether it was undone."""
        return self._undo is None

    def close(self) -> None:
        """Undo it; idempotent."""
        undo, self._undo = self._undo, None
        if undo is not None:
            undo()


def _undeclare_soon(entity: Any) -> None:
    """Undeclare an entity, here within 2 ms or else by a thread of its own within :data:`UNDECLARE_S`."""
    for attempt in range(_TRIES_AT_ONCE):
        if attempt:
            time.sleep(_PAUSE_S)
        if _undeclare(entity):
            return
    threading.Thread(target=_undeclare_later, args=(entity,), name="zbridge-undeclare", daemon=True).start()


def _undeclare_later(entity: Any) -> None:
    give_up_at = time.monotonic() + UNDECLARE_S
    while time.monotonic() < give_up_at:
        time.sleep(_PAUSE_S)
        if _undeclare(entity):
            return
    log.error("%s could not be undeclared: Already borrowed for %g s", type(entity).__name__, UNDECLARE_S)


def _undeclare(entity: Any) -> bool:
    """Undeclare an entity; False if its own callback runs and it must be tried again."""
    try:
        entity.undeclare()
    except RuntimeError as error:
        if "borrowed" not in str(error):
            raise
        return False
    return True
