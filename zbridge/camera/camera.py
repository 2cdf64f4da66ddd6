"""One robot's camera on the bus: fetches its stream while somebody watches, publishes the images, feeds the relay.

Theory of operation. There are two tasks. One waits until somebody watches (:class:`Demand`), fetches the stream until
it ends or nobody has watched for two seconds, and retries with a back-off. The other is the relay, if there is one. A
fault is a condition that ``status`` shows while somebody watches. The camera never affects serving the robot.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from zbridge.bus import Bus
from zbridge.camera.demand import Demand
from zbridge.camera.mjpeg import MjpegPart, MjpegReader, jpeg_size
from zbridge.camera.pace import Pace
from zbridge.camera.relay import Latest, Relay
from zbridge.camera.settings import CameraPlan
from zbridge.camera.upstream import fetch
from zbridge.control.faults import FaultCode, OpenFaults
from zbridge.errors import LinkError, ProtocolError, describe
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Image
from zbridge.fleet.topics import KeySpace
from zbridge.log import Log
from zbridge.metrics import Metrics
from zbridge.protocol.session_table import Backoff
from zbridge.tasks import race

log = Log("zbridge.camera")

STEADY_S = 10.0
"""A stream that lasted this long was good: the next attempt follows soon; seconds."""
RETRY_S = 5.0
"""Longest time between two attempts, without jitter: less than the relay's clients wait for a picture."""


class Camera:
    """One camera; ``run`` serves it. open_faults: what ``status`` shows. clock_ns: Unix time, for stamps."""

    def __init__(
        self,
        plan: CameraPlan,
        keys: KeySpace,
        bus: Bus,
        metrics: Metrics,
        open_faults: OpenFaults,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._plan = plan
        self._key = keys.key(topics.IMAGE.path)
        self._bus = bus
        self._open_faults = open_faults
        self._clock_ns = clock_ns
        self._loop = asyncio.get_running_loop()
        self.demand = demand = Demand()
        """Who watches, on the bus and by the relay."""
        self.latest = latest = Latest()
        """The newest picture."""
        self._relay: Relay | None = None
        if plan.relay is not None:
            self._relay = Relay(
                plan, plan.relay, demand, latest, metrics, lambda text: open_faults.set(FaultCode.CAMERA_RELAY, text)
            )
        self._publisher = bus.publisher(self._key, topics.IMAGE)
        self._pace: Pace[tuple[MjpegPart, int]] = Pace(plan.settings.rate_hz)
        self._timer: asyncio.TimerHandle | None = None
        self._pictures = metrics.count("camera_pictures")
        self._rejected = metrics.count("camera_not_jpeg")
        self._dropped = metrics.count("camera_rate_dropped")
        self._published = metrics.count("camera_published")
        self._failures = metrics.count("camera_failures")

    def __repr__(self) -> str:
        return f"<Camera {self._plan.source} {self.demand!r}>"

    async def run(self) -> None:
        watch = self._bus.watch_listeners(self._key, self.demand.listen)
        try:
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._follow())
                if self._relay is not None:
                    tasks.create_task(self._relay.run())
        finally:
            self._reset()
            watch.close()
            self._publisher.close()
            for code in (FaultCode.CAMERA, FaultCode.CAMERA_RELAY):
                self._open_faults.set(code, None)

    async def _follow(self) -> None:
        """Fetch the stream whenever somebody watches."""
        backoff = Backoff(most_s=RETRY_S)
        while True:
            if not self.demand.wanted:
                self._open_faults.set(FaultCode.CAMERA, None)
            await self.demand.begin()
            begun = self._loop.time()
            reason = await self._fetch()
            self._reset()
            if self._loop.time() - begun >= STEADY_S:
                backoff.reset()
            if reason is None:
                log.info("camera_idle", "camera {source}: nobody watches", source=self._plan.source)
                continue
            self._failures.value += 1
            delay_s = backoff.delay_s()
            template = "camera {source}: {reason}; next attempt in {delay_s:.1f} s"
            log.info("camera_lost", template, source=self._plan.source, reason=reason, delay_s=delay_s)
            self._open_faults.set(FaultCode.CAMERA, f"camera {self._plan.source}: {reason}")
            await asyncio.sleep(delay_s)

    async def _fetch(self) -> str | None:
        """Fetch until the stream ends; return why it ended. None: nobody watches any more."""
        log.info("camera_connecting", "camera {source}: connecting", source=self._plan.source)
        try:
            await race(fetch(self._plan.source, self._plan.settings.stall_s, self._receive), self.demand.end())
        except (LinkError, ProtocolError) as error:
            return str(error)
        except Exception as error:
            reason = describe(error)
            log.error(
                "camera_fault", "camera {source}: {error}", source=self._plan.source, error=reason, exc_info=error
            )
            return describe(error)
        return None

    def _receive(self, stream: MjpegReader, parts: list[MjpegPart]) -> None:
        """Handle the parts of one read; the newest counts."""
        self._rejected.value += stream.rejected
        if not parts:
            return
        self._pictures.value += len(parts)
        self._open_faults.set(FaultCode.CAMERA, None)
        for part in parts:
            self.latest.show(stream, part)
        if self.demand.listened:
            self._dropped.value += len(parts) - 1
            self._pace.offer((parts[-1], self._clock_ns()))
            self._publish()

    def _publish(self) -> None:
        """Publish the newest picture as soon as it is due."""
        now = self._loop.time()
        due = self._pace.due(now)
        self._dropped.value += self._pace.dropped
        self._pace.dropped = 0
        if due is not None:
            part, stamp_ns = due
            width, height = jpeg_size(part.jpeg) or (None, None)
            image = Image(format="jpeg", data=part.jpeg, width=width, height=height, stamp_ns=stamp_ns)
            self._publisher.put(payloads.encode(image))
            self._published.value += 1
        deadline = self._pace.deadline()
        if deadline is not None and self._timer is None:
            self._timer = self._loop.call_at(deadline, self._on_due)

    def _on_due(self) -> None:
        self._timer = None
        self._publish()

    def _reset(self) -> None:
        """Forget the pictures of a stream that has ended."""
        self.latest.forget()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
