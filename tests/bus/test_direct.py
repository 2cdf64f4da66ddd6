"""Samples that come on Zenoh's own threads: to handlers that are called there, and to the event loop."""

from __future__ import annotations

import asyncio
import itertools
import os
import threading
from collections.abc import AsyncIterator

import pytest
import zenoh

from tests.bus import SOON_S, Seen
from tests.e2e.conftest import free_port
from zbridge.bus import BusSettings, Sample, open_bus
from zbridge.bus.zenoh import ZenohBus, declared, zenoh_config
from zbridge.metrics import Metrics

COUNT = 200
MANY = 20


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
async def bus(port: int) -> AsyncIterator[ZenohBus]:
    opened = await open_bus(BusSettings(multicast=False, listen=(f"tcp/127.0.0.1:{port}",)), Metrics(), threads=False)
    yield opened
    await opened.close()


@pytest.fixture
async def sender(bus: ZenohBus, port: int) -> AsyncIterator[zenoh.Session]:
    """Give another session, whose samples come by the network."""
    settings = BusSettings(mode="client", multicast=False, connect=(f"tcp/127.0.0.1:{port}",))
    session = await asyncio.to_thread(zenoh.open, zenoh_config(settings))
    yield session
    await asyncio.to_thread(session.close)


async def put(sender: zenoh.Session, key: str) -> None:
    """Put numbered samples; the first ones may come before the way is known."""

    def put_all() -> None:
        publisher = sender.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        for number in range(COUNT):
            publisher.put(b"%d" % number, attachment=b"of %d" % number)

    await asyncio.to_thread(put_all)


async def test_a_direct_handler_is_called_in_order_on_threads_that_python_knows_again(bus, sender, caplog) -> None:
    taken, done, here = list[Sample](), threading.Event(), threading.local()
    threads = set[int]()
    new_threads = itertools.count(1)

    def take(sample: Sample) -> None:
        if not hasattr(here, "number"):
            here.number = next(new_threads)
        threads.add(threading.get_ident())
        taken.append(sample)
        if len(taken) == COUNT:
            done.set()
        if sample.payload == b"7":
            raise ValueError("a handler's fault")

    bus.subscribe("fleet/r1/scan", take, direct=True)
    await put(sender, "fleet/r1/scan")
    assert done.wait(SOON_S), "the event loop stands still: only Zenoh's threads can have called"
    expected = [Sample("fleet/r1/scan", b"%d" % number, b"of %d" % number) for number in range(COUNT)]
    assert taken == expected
    assert threading.get_ident() not in threads
    assert next(new_threads) <= 8, "what belongs to a thread was forgotten between two calls"
    assert "a handler failed" in caplog.text


async def test_a_direct_handler_of_many_keys_is_told_which(bus, sender) -> None:
    seen, loop = Seen(), asyncio.get_running_loop()
    bus.subscribe("fleet/r1/sensor/*", lambda sample: loop.call_soon_threadsafe(seen.take, sample.key), direct=True)
    await put(sender, "fleet/r1/sensor/left")
    await seen.until(lambda: len(seen) == COUNT)
    assert set(seen) == {"fleet/r1/sensor/left"}


async def test_without_threads_samples_come_to_the_event_loop_in_order(bus, sender) -> None:
    seen, threads = Seen(), set[int]()

    def take(sample: Sample) -> None:
        threads.add(threading.get_ident())
        seen.take(sample.payload)

    bus.subscribe("fleet/r1/pose", take)
    await put(sender, "fleet/r1/pose")
    await seen.until(lambda: len(seen) == COUNT)
    assert seen == [b"%d" % number for number in range(COUNT)]
    assert threads == {threading.get_ident()}


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="counts threads as Linux does")
async def test_without_threads_subscriptions_take_none(bus: ZenohBus) -> None:
    before = len(os.listdir("/proc/self/task"))
    for number in range(MANY):
        bus.subscribe(f"fleet/r{number}/pose", lambda sample: None)
    assert len(os.listdir("/proc/self/task")) < before + MANY / 2


def test_the_threads_whose_state_is_kept_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    kept = list[int]()
    monkeypatch.setattr(declared, "_known", itertools.count())
    monkeypatch.setattr(declared, "_keep_state", lambda: kept.append(threading.get_ident()))
    for _ in range(declared.KNOWN_THREADS + 5):
        thread = threading.Thread(target=declared.keep_thread)
        thread.start()
        thread.join()
    assert len(kept) == declared.KNOWN_THREADS
