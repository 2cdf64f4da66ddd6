"""An event loop whose clock jumps: what waits for a time is next, and nobody really waits."""

import asyncio
import functools
import selectors
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import AbstractAsyncContextManager
from functools import partial
from typing import Any, TypeVar

import pytest

T = TypeVar("T")


class _Jumping(selectors.DefaultSelector):
    """Moves the clock of its loop forward instead of sleeping."""

    def __init__(self, pass_s: float) -> None:
        super().__init__()
        self.now, self._pass_s = 1000.0, pass_s

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        ready = super().select(0)
        self.now += self._pass_s
        if ready or timeout == 0:
            return ready
        if timeout is None:
            raise RuntimeError("every task waits, and no timer is set")
        self.now += timeout
        return ready


class JumpingLoop(asyncio.SelectorEventLoop):
    """An event loop for code that uses nothing but timers and futures, and for both ends of TCP on loopback.

    What is written to loopback is there for the next pass; no other process and no thread may be waited for. pass_s:
    seconds that each pass takes; with some, code that sleeps until a time has come gets there in spite of rounding.
    """

    def __init__(self, pass_s: float = 0.0) -> None:
        self._jumping = _Jumping(pass_s)
        super().__init__(self._jumping)

    def time(self) -> float:
        return self._jumping.now

    def pause(self, seconds: float) -> None:
        """Let time pass in which nothing of this process runs, as if it was stopped: all timers are late then."""
        self._jumping.now += seconds


def at_once(main: Coroutine[Any, Any, T]) -> T:
    """Run what drives a simulated robot of its own event loop as :func:`asyncio.run` does, and wait for nothing."""
    with asyncio.Runner(loop_factory=partial(JumpingLoop, pass_s=1e-9)) as runner:
        return runner.run(main)


def jumping(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run one async test of a module on a :class:`JumpingLoop`; ``pytest.mark.jumping`` does so for all of them."""

    @functools.wraps(test)
    def run(*args: Any, **kwargs: Any) -> None:
        with asyncio.Runner(loop_factory=JumpingLoop) as runner:
            runner.run(test(*args, **kwargs))

    return run


def scene_of(context: Callable[..., AbstractAsyncContextManager[Any]]) -> Any:
    """Make a fixture of a context; ``@pytest.mark.scene(...)`` at a test gives the context's arguments."""

    @pytest.fixture
    async def scene(request: pytest.FixtureRequest) -> AsyncIterator[Any]:
        mark = request.node.get_closest_marker("scene") or pytest.mark.scene.mark
        async with context(*mark.args, **mark.kwargs) as made:
            yield made

    return scene
