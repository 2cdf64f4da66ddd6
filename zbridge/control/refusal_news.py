"""What is new among the refusals that ``control`` shows. Sans-IO."""

from __future__ import annotations

from collections.abc import Callable

from zbridge.fleet.messages import Control, Refusal


class RefusalNews:
    """Returns each refusal that concerns a program once for each time its count changes.

    concerns: whether a refusal is the program's own. What listeners report of their programs never is.
    """

    def __init__(self, concerns: Callable[[Refusal], bool]) -> None:
        self._concerns = concerns
        self._counts: dict[tuple[str | None, str, str, str], int] = {}

    def __repr__(self) -> str:
        return f"<RefusalNews, {len(self._counts)} known>"

    def take(self, control: Control) -> list[Refusal]:
        """Return what is new since the last call."""
        news, counts = [], {}
        for refusal in control.refusals:
            if refusal.by is None and self._concerns(refusal):
                key = (refusal.who, refusal.command, refusal.code, refusal.reason)
                counts[key] = refusal.count
                if refusal.count != self._counts.get(key, 0):
                    news.append(refusal)
        self._counts = counts
        return news
