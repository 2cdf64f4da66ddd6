import asyncio
from collections.abc import Callable

SOON_S = 5.0


class Seen(list[object]):
    """What a handler was told, and a way to wait for it."""

    def __init__(self) -> None:
        super().__init__()
        self._changed = asyncio.Event()

    def take(self, *told: object) -> None:
        self.append(told if len(told) > 1 else told[0])
        self._changed.set()

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(SOON_S):
            while not condition():
                self._changed.clear()
                await self._changed.wait()
