"""Runs the server: robots of the bus live, or a recording, until cancelled."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable
from pathlib import Path

from zbridge.app.prometheus import serve_metrics
from zbridge.bus import Bus, BusSettings, open_bus
from zbridge.client import Fleet
from zbridge.metrics import Metrics
from zbridge.views.foxglove.commands import Commands
from zbridge.views.foxglove.front import Front, tls_context
from zbridge.views.foxglove.hub import Hub
from zbridge.views.foxglove.live import Live
from zbridge.views.foxglove.playback import Playback
from zbridge.views.foxglove.recording import Recording
from zbridge.views.foxglove.settings import Plan
from zbridge.views.foxglove.source import Source

log = logging.getLogger("zbridge.foxglove")


async def serve_live(
    plan: Plan, bus: BusSettings, realm: str, metrics: Metrics, on_ready: Callable[[Front], None]
) -> None:
    """Serve the robots of a realm; raise BusError or ConfigError. on_ready: called when viewers are accepted."""
    joined = await open_bus(bus, metrics, wait_for_peers=True)
    try:
        await _serve_bus(plan, joined, realm, metrics, on_ready)
    finally:
        await joined.close()


async def _serve_bus(plan: Plan, bus: Bus, realm: str, metrics: Metrics, on_ready: Callable[[Front], None]) -> None:
    hub = Hub()
    commands = Commands(hub, Fleet(bus, realm), plan.scales, plan.policy.who)
    live = Live(hub, bus, realm, plan.robots, commands, metrics)
    live.start()
    try:
        await _serve(plan, live, metrics, on_ready)
    finally:
        await live.close()


async def serve_file(plan: Plan, file: Path, metrics: Metrics, on_ready: Callable[[Front], None]) -> None:
    """Serve a recording; raise ZbridgeError if it cannot be read. on_ready: called when viewers are accepted."""
    recording = await asyncio.to_thread(Recording, file)
    if not recording.whole:
        log.warning("%s: has no index, as if it was cut off; it is played up to the cut", file)
    await _serve(plan, Playback(Hub(), recording), metrics, on_ready)


async def _serve(plan: Plan, source: Source, metrics: Metrics, on_ready: Callable[[Front], None]) -> None:
    tls = tls_context(*plan.tls) if plan.tls is not None else None
    front = Front(source, plan.address, plan.policy, metrics, tls)
    async with front.serve(), _counters(plan, metrics):
        on_ready(front)
        await source.run()


def _counters(plan: Plan, metrics: Metrics) -> contextlib.AbstractAsyncContextManager[object]:
    """Serve the counters to Prometheus, where that was asked for."""
    return serve_metrics(plan.metrics, metrics) if plan.metrics is not None else contextlib.nullcontext()
