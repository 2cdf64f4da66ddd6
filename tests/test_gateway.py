"""How a gateway process ends: a signal cancels the work once, and its tidying up is waited for."""

import asyncio
import os
import signal

import pytest

from zbridge.gateway import until_signal

SOON_S = 5.0


class Work:
    """Something that runs until it is cancelled and then has something to tidy up."""

    def __init__(self) -> None:
        self.started = asyncio.Event()
        self.tidying = asyncio.Event()
        self.go_on = asyncio.Event()
        self.tidy = False

    async def run(self) -> None:
        self.started.set()
        try:
            await asyncio.Event().wait()
        finally:
            self.tidying.set()
            await self.go_on.wait()
            self.tidy = True


async def received(number: signal.Signals) -> None:
    """Send this process a signal, and wait until the event loop has handled it."""
    handled = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGUSR1, handled.set)
    os.kill(os.getpid(), number)
    os.kill(os.getpid(), signal.SIGUSR1)  # handled after it
    await handled.wait()


@pytest.mark.parametrize("first", [signal.SIGTERM, signal.SIGINT])
async def test_a_signal_ends_the_work_and_its_tidying_up_is_waited_for(first: signal.Signals) -> None:
    async with asyncio.timeout(SOON_S):
        work = Work()
        ending = asyncio.ensure_future(until_signal(work.run()))
        await work.started.wait()
        await received(first)
        await work.tidying.wait()
        assert not ending.done()
        work.go_on.set()
        await ending
    assert work.tidy


@pytest.mark.parametrize("first", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("second", [signal.SIGTERM, signal.SIGINT])
async def test_a_second_signal_does_not_cut_the_tidying_up_short(first: signal.Signals, second: signal.Signals) -> None:
    async with asyncio.timeout(SOON_S):
        work = Work()
        ending = asyncio.ensure_future(until_signal(work.run()))
        await work.started.wait()
        await received(first)
        await work.tidying.wait()
        await received(second)
        await received(second)
        work.go_on.set()
        await ending
    assert work.tidy


async def test_work_that_ends_by_itself_is_not_waited_for_any_longer() -> None:
    async def work() -> None:
        return

    async with asyncio.timeout(SOON_S):
        await until_signal(work())


async def test_work_that_fails_shows_why() -> None:
    async def work() -> None:
        raise OSError("no bus")

    with pytest.raises(OSError, match="no bus"):
        await until_signal(work())
