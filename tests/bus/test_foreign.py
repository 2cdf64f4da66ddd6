"""What other programs' formats need of the bus: attachments both ways, complete answers, frames for late listeners."""

from __future__ import annotations

import asyncio

import zenoh
import zenoh.ext

from tests.bus import SOON_S, Seen
from tests.ports import free_port
from zbridge.bus import BusSettings, IncomingQuery, open_bus
from zbridge.bus.zenoh import ZenohBus, zenoh_config
from zbridge.metrics import Metrics


async def opened(port: int) -> ZenohBus:
    settings = BusSettings(mode="peer", multicast=False, listen=(f"tcp/127.0.0.1:{port}",))
    return await open_bus(settings, Metrics(), timestamps=True)


def stranger(port: int) -> zenoh.Session:
    settings = BusSettings(mode="client", multicast=False, connect=(f"tcp/127.0.0.1:{port}",))
    return zenoh.open(zenoh_config(settings))


async def test_a_late_listener_of_kept_frames_gets_the_last_one_and_the_publisher_hears_of_it() -> None:
    port, heard, came = free_port(), Seen(), Seen()
    bus = await opened(port)
    try:
        frames = bus.frames("0/map", heard.take, kept=1)
        for payload in (b"1", b"2"):
            frames.put(payload, b"by me")
        other = await asyncio.to_thread(stranger, port)
        loop = asyncio.get_running_loop()

        def take(sample: zenoh.Sample) -> None:
            attachment = sample.attachment
            assert attachment is not None
            loop.call_soon_threadsafe(came.take, sample.payload.to_bytes(), attachment.to_bytes())

        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
        late = zenoh.ext.declare_advanced_subscriber(other, "0/map", take, history=history)
        await came.until(lambda: (b"2", b"by me") in came)
        await heard.until(lambda: True in heard)
        assert (b"1", b"by me") not in came
        await asyncio.to_thread(late.undeclare)
        await heard.until(lambda: heard[-1] is False)
        await asyncio.to_thread(other.close)
    finally:
        await bus.close()


async def test_a_complete_answer_is_found_by_those_who_ask_the_complete_and_carries_an_attachment() -> None:
    port = free_port()
    bus = await opened(port)

    def answer(query: IncomingQuery) -> None:
        query.answer(b"done", b"for " + (query.attachment or b""))

    try:
        bus.answer("0/stop", answer, complete=True)
        other = await asyncio.to_thread(stranger, port)

        def ask() -> list[zenoh.Reply]:
            target = zenoh.QueryTarget.ALL_COMPLETE
            return list(other.get("0/stop", target=target, payload=b"?", attachment=b"me", timeout=SOON_S))

        (reply,) = await asyncio.to_thread(ask)
        assert reply.ok is not None
        assert reply.ok.attachment is not None
        assert (reply.ok.payload.to_bytes(), reply.ok.attachment.to_bytes()) == (b"done", b"for me")
        await asyncio.to_thread(other.close)
    finally:
        await bus.close()
