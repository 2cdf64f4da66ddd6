"""The queryables of one session: one for each key that is answered, or one for all keys below an expression.

Theory of operation. Routers pay for every declaration of every process. Keys below an expression that
:meth:`Answers.gather` was given share one queryable ``<expression>/**``: it is declared with the first of them and
undeclared with the last, and its callback finds the key that is queried. A query with wildcards may match several: each
answers its share, and the query ends with the last of them. A query that no key matches ends without a reply.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

import zenoh

from zbridge.bus.interface import Handle
from zbridge.bus.zenoh.declared import Declared, undoing
from zbridge.fleet.topics import is_concrete

Take = Callable[[Any], None]
"""Handles a query on Zenoh's threads; must not block."""
_BELOW = "/**"
_FAMILY = "/*"


class Answers:
    """Declares queryables on one session."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._gathered: list[_Gathered] = []

    def __repr__(self) -> str:
        return f"<Answers {self._gathered}>"

    def gather(self, key_expr: str) -> Handle:
        """Answer for all keys below ``key_expr``, which ends with ``/**``, with one queryable from now on."""
        gathered = _Gathered(self._session, key_expr)
        self._gathered.append(gathered)
        return undoing(lambda: self._gathered.remove(gathered))

    def add(self, key: str, take: Take) -> Handle:
        """Pass queries for ``key``, whose last chunk may be ``*``, to ``take``."""
        for gathered in self._gathered:
            if key.startswith(gathered.prefix):
                return gathered.add(key, take)
        return Declared(self._session.declare_queryable(key, take))


class _Gathered:
    """The keys below one expression. Keys are added and removed by the event loop's thread."""

    def __init__(self, session: zenoh.Session, key_expr: str) -> None:
        self.prefix = key_expr.removesuffix(_BELOW) + "/"
        self._key_expr = key_expr
        self._session = session
        self._takes: dict[str, Take] = {}
        self._queryable: Declared | None = None

    def __repr__(self) -> str:
        return f"<{self._key_expr}: {len(self._takes)} keys>"

    def add(self, key: str, take: Take) -> Handle:
        if key in self._takes:  # a second answerer of one key: it has a queryable of its own
            return Declared(self._session.declare_queryable(key, take))
        self._takes = {**self._takes, key: take}  # replaced as a whole: Zenoh's thread reads it meanwhile
        if self._queryable is None:
            self._queryable = Declared(self._session.declare_queryable(self._key_expr, self._take))
        return undoing(partial(self._remove, key))

    def _remove(self, key: str) -> None:
        self._takes = {other: take for other, take in self._takes.items() if other != key}
        if not self._takes and self._queryable is not None:
            self._queryable.close()
            self._queryable = None

    def _take(self, query: zenoh.Query) -> None:
        takes, asked = self._takes, str(query.key_expr)
        if is_concrete(asked):
            take = takes.get(asked) or takes.get(asked.rpartition("/")[0] + _FAMILY)
            found = [take] if take is not None else []
        else:
            found = [take for key, take in takes.items() if query.key_expr.intersects(zenoh.KeyExpr(key))]
        if len(found) == 1:
            found[0](query)
        elif found:
            parts = _Parts(query, len(found))
            for take in found:
                take(parts)
        else:
            query.drop()  # type: ignore[no-untyped-call]


class _Parts:
    """A query that several keys answer: it ends when each of them has dropped it."""

    def __init__(self, query: zenoh.Query, parts: int) -> None:
        self.key_expr = query.key_expr
        self.payload = query.payload
        self.attachment = query.attachment
        self.reply = query.reply
        self.reply_err = query.reply_err
        self._query = query
        self._parts = parts
        self._lock = threading.Lock()

    def drop(self) -> None:
        """End one part."""
        with self._lock:
            self._parts -= 1
            last = not self._parts
        if last:
            self._query.drop()  # type: ignore[no-untyped-call]
