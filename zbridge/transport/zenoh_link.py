"""A link over a Zenoh session of its own: the frames of :mod:`zbridge.protocol.samples` are carried out on it.

The session is never the fleet's: it is a client of the robots' router, or is that router itself (:func:`serve`, for
simulated robots). Knows no robot and no format of keys, payloads and attachments.

What comes is bounded before it is copied: :data:`RATE_HZ` samples a second of each subscription, then the bounds of the
bus's inbox. What is dropped is counted, and reported to the receiver. A router does not report what it has forwarded:
the link detects no stall, and its receiver has to watch for silence.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator

from zbridge.bus import Bus, BusSettings, Handle, PriorityClass, Publisher, ReadPayload, Sample, Sort, open_bus
from zbridge.errors import BusError, LinkError
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address, ZenohAddress
from zbridge.protocol.rate_limit import RateLimit
from zbridge.protocol.samples import KeyedSample, SampleKind, dropped, read_sample, write_sample
from zbridge.transport.link import Link, Receiver

RATE_HZ = 2000.0
"""Samples a second of one subscription; more are dropped on Zenoh's own thread."""
DECLARED = 256
"""Most keys that a link may have declared at a time."""
REPORT_S = 0.5
"""Seconds between two reports: the time, and what was dropped."""


class ZenohLink(Link):
    """One Zenoh session. Made by :func:`connect` and :func:`serve`; its receiver is told when the session ends."""

    ready = True

    def __init__(self, peer: str, bus: Bus, metrics: Metrics, receiver: Receiver) -> None:
        super().__init__(receiver)
        self.peer = peer
        self._bus = bus
        self._metrics = metrics
        self._loop = asyncio.get_running_loop()
        self._paused = False
        self._declared: dict[tuple[SampleKind, str], Handle] = {}
        self._publishers: dict[str, Publisher] = {}
        self._above = 0
        """Samples that came too fast."""
        self._reported = 0
        self._looking: dict[str, asyncio.Task[None]] = {}
        self._closing: asyncio.Task[bool] | None = None
        self._timer: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<ZenohLink {self.peer}, {len(self._declared)} keys>"

    def begin(self, *, ends: bool) -> None:
        """Attach the receiver and report that the session is open. ends: the link ends with its last connection."""
        self.receiver.attached(self)
        if ends:
            self._bus.watch_connected(self._on_connected)
        self._report()

    def write(self, data: bytes) -> None:
        """Carry out one frame. Raises ProtocolError for one that cannot be, LinkError above :data:`DECLARED` keys."""
        if not self.ready:
            return
        sample = read_sample(data)
        if sample.kind in (SampleKind.PUT, SampleKind.KEEP):
            self._publisher(sample.key, sample.kind).put(sample.payload, sample.attachment)
        elif sample.kind is SampleKind.WITHDRAW:
            for kind in (SampleKind.SUBSCRIBE, SampleKind.WATCH, SampleKind.ANNOUNCE):
                handle = self._declared.pop((kind, sample.key), None)
                if handle is not None:
                    handle.close()
        elif sample.kind is SampleKind.WATCH and (sample.kind, sample.key) in self._declared:
            self._look_again(sample.key)
        elif (sample.kind, sample.key) not in self._declared:
            self._bounded(len(self._declared))
            self._declared[sample.kind, sample.key] = self._declare(sample)

    def pause_reading(self) -> None:
        """Drop and count what comes, until :meth:`resume_reading`: Zenoh cannot be asked to wait."""
        self._paused = True

    def resume_reading(self) -> None:
        self._paused = False

    @property
    def blocker(self) -> str | None:
        return "a Zenoh session stays in its process"

    def close(self) -> None:
        self._end("closed")

    abort = close

    async def ended(self) -> None:
        """Wait until the session is closed: a process that ends before would be cut off in the middle of Zenoh."""
        if self._closing is not None:
            await asyncio.shield(self._closing)

    def _declare(self, sample: KeyedSample) -> Handle:
        if sample.kind is SampleKind.ANNOUNCE:
            return self._bus.announce(sample.key)
        if sample.kind is SampleKind.WATCH:
            return self._bus.watch_alive(sample.key, self._on_token)
        return self._bus.subscribe(sample.key, self._on_sample, priority=self._sort(), kept=bool(sample.payload))

    def _publisher(self, key: str, kind: SampleKind) -> Publisher:
        publisher = self._publishers.get(key)
        if publisher is None:
            self._bounded(len(self._publishers))
            publisher = self._publishers[key] = self._bus.frames(key, _unheard, kept=int(kind is SampleKind.KEEP))
        return publisher

    def _bounded(self, count: int) -> None:
        if count >= DECLARED:
            raise LinkError(f"{self.peer}: more than {DECLARED} keys")

    def _sort(self) -> Sort:
        """Make what drops, on Zenoh's threads, the samples of one subscription that come too fast."""
        limit, clock = RateLimit(RATE_HZ), time.monotonic

        def sort(key: str, shown: bytes | None, size: int, read_payload: ReadPayload) -> PriorityClass | None:
            if limit.take(clock()):
                return PriorityClass.OTHER
            self._above += 1
            return None

        return sort

    def _on_sample(self, sample: Sample) -> None:
        if self._paused:
            self._above += 1
            return
        self._feed(KeyedSample(SampleKind.SAMPLE, sample.key, sample.payload, sample.attachment, time.time_ns()))

    def _on_token(self, token: str, here: bool) -> None:
        kind = SampleKind.APPEARED if here else SampleKind.GONE
        self._feed(KeyedSample(kind, token, stamp_ns=time.time_ns()))

    def _look_again(self, key: str) -> None:
        """Ask for the tokens that are there: news of some may be lost while many come and go at once."""
        if key not in self._looking:
            self._looking[key] = self._loop.create_task(self._ask(key))
            self._looking[key].add_done_callback(lambda _: self._looking.pop(key, None))

    async def _ask(self, key: str) -> None:
        with contextlib.suppress(BusError):
            for token in await self._bus.alive(key):
                self._on_token(token, here=True)

    def _feed(self, sample: KeyedSample) -> None:
        if not self.ready:
            return
        try:
            frame = write_sample(sample)
        except Exception:  # a key, an attachment or a payload beyond all bounds
            self._above += 1
            return
        self.receiver.received(frame)

    def _report(self) -> None:
        """Tell the time, and what was dropped since."""
        if not self.ready:
            return
        self._timer = self._loop.call_later(REPORT_S, self._report)
        lost = self._above + self._metrics.total("bus_dropped", queue="bus_in")
        if lost > self._reported:
            count, self._reported = lost - self._reported, lost
            self._feed(dropped(count))
        self._feed(KeyedSample(SampleKind.OPENED, payload=self._bus.zid.encode(), stamp_ns=time.time_ns()))

    def _on_connected(self, connected: bool) -> None:
        if not connected:
            self._end("connection lost: the router is gone")

    def _end(self, reason: str) -> None:
        if not self.ready:
            return
        self.ready = False
        if self._timer is not None:
            self._timer.cancel()
        for looking in self._looking.values():
            looking.cancel()
        self._closing = self._loop.create_task(self._bus.close())
        _closing.add(self._closing)
        self._closing.add_done_callback(_closing.discard)
        self._loop.call_soon(self.receiver.lost, reason)


def _unheard(listened: bool) -> None:
    """Take no notice of listeners: the session decides what is put."""


_closing: set[asyncio.Task[bool]] = set()
"""Sessions that are being closed; the event loop itself keeps no task."""


async def connect(address: ZenohAddress, receiver: Receiver) -> ZenohLink:
    """Open a session that is a client of the router at ``address``; raise LinkError if there is none."""
    settings = BusSettings(mode="client", connect=(address.endpoint,), multicast=False)
    link = await _opened(str(address), settings, receiver)
    link.begin(ends=True)
    return link


@contextlib.asynccontextmanager
async def serve(address: Address, receiver: Receiver) -> AsyncIterator[ZenohLink]:
    """Open a router at ``address``, which is itself the session of ``receiver``; raise LinkError if it cannot be."""
    settings = BusSettings(mode="router", listen=(f"tcp/{address.host}:{address.port}",), multicast=False)
    link = await _opened(str(address), settings, receiver)
    link.begin(ends=False)
    try:
        yield link
    finally:
        link.close()
        await link.ended()


async def _opened(peer: str, settings: BusSettings, receiver: Receiver) -> ZenohLink:
    metrics = Metrics()
    try:
        bus = await open_bus(settings, metrics, timestamps=True)
    except BusError as error:
        raise LinkError(f"{peer}: {error}") from error
    return ZenohLink(peer, bus, metrics, receiver)
