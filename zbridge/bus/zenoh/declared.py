"""Declares callbacks on a Zenoh session, and undeclares them.

Zenoh refuses to undeclare an entity whose callback runs at that moment ("Already borrowed"), so that is retried: a
few times at once, then on a thread of its own.
"""

from __future__ import annotations

import ctypes
import itertools
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import zenoh

from zbridge.log import Log

log = Log("zbridge.bus")

UNDECLARE_S = 1.0
"""Longest time for which undeclaring an entity is retried while its callback keeps running."""
_TRIES_AT_ONCE, _PAUSE_S = 4, 0.0005
"""Attempts on the calling thread, which may be the event loop's, and the pause between two attempts, seconds."""
KNOWN_THREADS = 64
"""Zenoh's threads whose state Python keeps: 16 kB each. Two or three deliver all samples of a process."""

_keep_state = ctypes.pythonapi.PyGILState_Ensure
_here = threading.local()
_known = itertools.count()


def threadless(callback: Callable[[Any], object]) -> zenoh.handlers.Callback[Any]:
    """Let Zenoh's own thread call back: for rare calls that return at once; otherwise each callback gets a thread."""
    return zenoh.handlers.Callback(callback, indirect=False)


def prompt(callback: Callable[[Any], object]) -> zenoh.handlers.Callback[Any]:
    """Let Zenoh's own thread call back: for frequent calls that return at once and must not wait for another thread."""

    def called(raw: Any) -> None:
        if not hasattr(_here, "known"):
            keep_thread()
        callback(raw)

    return threadless(called)


def keep_thread() -> None:
    """Make Python keep its state of this foreign thread for the next call.

    Otherwise Python creates and frees that state, with a newly mapped stack, for each call: 20 us. An extra reference
    that is never released keeps it.
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
        """Whether the entities were undeclared."""
        return not self._entities

    def close(self) -> None:
        """Undeclare the entities."""
        entities, self._entities = self._entities, ()
        for entity in entities:
            _undeclare_soon(entity)


def undoing(undo: Callable[[], object]) -> Declared:
    """Make a handle that undoes something once, as what was declared otherwise than on the session."""
    return Declared(SimpleNamespace(undeclare=undo))


def _undeclare_soon(entity: Any) -> None:
    """Undeclare an entity, here within 2 ms, or else on a thread of its own within :data:`UNDECLARE_S`."""
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
    template = "{entity} could not be undeclared: Already borrowed for {waited_s:g} s"
    log.error("undeclare_failed", template, entity=type(entity).__name__, waited_s=UNDECLARE_S)


def _undeclare(entity: Any) -> bool:
    """Undeclare an entity; False if its own callback runs and it must be tried again."""
    try:
        entity.undeclare()
    except RuntimeError as error:
        if "borrowed" not in str(error):
            raise
        return False
    return True
