"""Watches of liveliness tokens: all watchers of one key expression share one declaration on a session.

A later watcher is notified at once of the tokens that the others know.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial

from zbridge.bus.interface import Handle
from zbridge.bus.zenoh.declared import undoing
from zbridge.log import Log

log = Log("zbridge.bus")

Changed = Callable[[str, bool], None]
"""Called with the key of a token that exists (True) or has disappeared (False)."""


class AliveWatches:
    """The watches of one session. All calls belong on the event loop's thread.

    declare: subscribes to an expression's tokens, those that exist included.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, declare: Callable[[str, Changed], Handle]) -> None:
        self._loop = loop
        self._declare = declare
        self._watches: dict[str, _Watch] = {}

    def __repr__(self) -> str:
        return f"<AliveWatches {sorted(self._watches)}>"

    def add(self, key_expr: str, handler: Changed) -> Handle:
        """Call ``handler`` with every token that exists, appears or disappears."""
        watch = self._watches.get(key_expr)
        if watch is None:
            watch = self._watches[key_expr] = _Watch()
            watch.handle = self._declare(key_expr, watch.changed)
        watcher = _Watcher(handler)
        watch.watchers.append(watcher)
        if watch.tokens:
            self._loop.call_soon(watcher.greet, watch.tokens)
        return undoing(partial(self._remove, key_expr, watch, watcher))

    def _remove(self, key_expr: str, watch: _Watch, watcher: _Watcher) -> None:
        watcher.gone = True
        watch.watchers.remove(watcher)
        if not watch.watchers and watch.handle is not None:
            watch.handle.close()
            del self._watches[key_expr]


class _Watcher:
    def __init__(self, handler: Changed) -> None:
        self._handler = handler
        self._known: set[str] = set()
        self.gone = False

    def greet(self, tokens: set[str]) -> None:
        """Notify a watcher of the existing tokens that it does not know yet."""
        for key in tuple(tokens):
            if key not in self._known:
                self.notify(key, True)

    def notify(self, key: str, alive: bool) -> None:
        if self.gone:
            return
        (self._known.add if alive else self._known.discard)(key)
        try:
            self._handler(key, alive)
        except Exception:
            log.exception("handler_failed", "a handler failed")


class _Watch:
    """The tokens of one expression, and their watchers."""

    def __init__(self) -> None:
        self.handle: Handle | None = None
        self.tokens: set[str] = set()
        self.watchers: list[_Watcher] = []

    def changed(self, key: str, alive: bool) -> None:
        (self.tokens.add if alive else self.tokens.discard)(key)
        for watcher in tuple(self.watchers):
            watcher.notify(key, alive)
