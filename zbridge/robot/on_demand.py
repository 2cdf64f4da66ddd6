"""Keys that are declared while somebody listens: one declaration for all of a kind tells whether anybody does.

Routers pay for every declaration of every gateway, and most of the time nobody listens to raw frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

from zbridge.bus import Bus, Handle, Publisher

Listened = Callable[[Publisher, bool], object]
"""Called with a key's publisher when its first listener comes (True) and when the last one has gone (False)."""


class OnDemand:
    """The keys that ``key_expr`` matches, each with whom to tell of its listeners."""

    def __init__(self, bus: Bus, key_expr: str, keys: Mapping[str, Listened]) -> None:
        self._bus = bus
        self._key_expr = key_expr
        self._keys = keys
        self._publishers: dict[str, Publisher] = {}
        self._listened: set[str] = set()
        self._watch: Handle | None = None

    def __repr__(self) -> str:
        return f"<OnDemand {self._key_expr}, listened to: {sorted(self._listened)}>"

    def open(self) -> None:
        """Watch for listeners."""
        self._watch = self._bus.watch_listeners(self._key_expr, self._on_any)

    def close(self, *, tell: bool = False) -> None:
        """Declare nothing any more; idempotent. tell: as if the last listener had gone, instead of nobody."""
        watch, self._watch = self._watch, None
        if watch is not None:
            watch.close()
        if tell:
            self._tell_gone()
        self._withdraw()
        self._listened.clear()

    def _on_any(self, anybody: bool) -> None:
        """Declare the keys with the first listener of any of them; take them back with the last."""
        if self._watch is None or anybody is bool(self._publishers):
            return
        if anybody:
            self._publishers = {key: self._bus.frames(key, partial(self._on_key, key)) for key in self._keys}
            return
        self._tell_gone()
        self._withdraw()

    def _tell_gone(self) -> None:
        for key in sorted(self._listened):
            self._on_key(key, False)

    def _on_key(self, key: str, anybody: bool) -> None:
        publisher = self._publishers.get(key)
        if publisher is None or anybody is (key in self._listened):
            return
        (self._listened.add if anybody else self._listened.discard)(key)
        self._keys[key](publisher, anybody)

    def _withdraw(self) -> None:
        publishers, self._publishers = self._publishers, {}
        for publisher in publishers.values():
            publisher.close()
