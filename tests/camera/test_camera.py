"""One robot's camera on a fake bus, its stream played by the test: when it is fetched, and what is published."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

import pytest

from tests.camera.camera_bytes import HEAD, jpeg, part
from tests.fake_bus import FakeBus
from zbridge.camera import camera as cameras
from zbridge.camera.camera import RETRY_S, Camera
from zbridge.camera.demand import LINGER_S
from zbridge.camera.mjpeg import MjpegPart, MjpegReader
from zbridge.camera.settings import CameraSettings, CameraSource, plan_camera
from zbridge.camera.upstream import OnParts
from zbridge.control.faults import FaultCode, OpenFaults
from zbridge.errors import LinkError
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Image
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics

pytestmark = pytest.mark.jumping

KEY = "fleet/r1/image"
STAMP_NS = 1_700_000_000_000_000_000


class Scene:
    """A camera, and the bus that its images are put on. ``end`` ends the stream that is fetched now."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, rate_hz: float = 10.0) -> None:
        self.bus, self.metrics, self.open_faults = FakeBus(), Metrics(), OpenFaults()
        self.begun: list[float] = []
        """When a stream was begun."""
        self.fetching = 0
        self.end: asyncio.Future[Exception]
        self.took: OnParts
        self.loop = asyncio.get_running_loop()
        plan = plan_camera(CameraSettings("http://robot/s", rate_hz=rate_hz, stall_s=3.0))
        monkeypatch.setattr(cameras, "fetch", self._fetch)
        self.camera = Camera(plan, KeySpace("fleet", "r1"), self.bus, self.metrics, self.open_faults, lambda: STAMP_NS)
        self._watched = False

    async def _fetch(self, source: CameraSource, stall_s: float, took: OnParts) -> None:
        assert (source, stall_s) == (CameraSource("robot", 80, "/s"), 3.0)
        self.took, self.end = took, self.loop.create_future()
        self.begun.append(self.loop.time())
        self.fetching += 1
        try:
            raise await self.end
        finally:
            self.fetching -= 1

    def watch(self, anybody: bool) -> None:
        """Let the first listener on the bus come, or the last one go."""
        self.camera.demand.listen(anybody)

    def read(self, *pictures: bytes, bad: int = 0) -> None:
        """Give the camera what one read of its stream brought."""
        stream = MjpegReader()
        parts: list[MjpegPart] = stream.receive(HEAD + b"".join(map(part, pictures)) + part(b"no jpeg") * bad)
        self.took(stream, parts)

    def images(self) -> list[Image]:
        return [payloads.decode(Image, each) for each in self.bus.values(KEY)]

    def counts(self) -> dict[str, float]:
        names = ("pictures", "not_jpeg", "rate_dropped", "published", "failures")
        return {name: self.metrics.total(f"camera_{name}") for name in names}


@contextlib.asynccontextmanager
async def serving(scene: Scene) -> AsyncIterator[Scene]:
    running = asyncio.ensure_future(scene.camera.run())
    await asyncio.sleep(0)
    try:
        yield scene
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_the_stream_is_fetched_only_while_somebody_watches(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serving(Scene(monkeypatch)) as scene:
        await asyncio.sleep(100.0)
        assert scene.begun == []
        scene.watch(True)
        await asyncio.sleep(100.0)
        assert (len(scene.begun), scene.fetching) == (1, 1)
        scene.watch(False)
        await asyncio.sleep(LINGER_S + 0.1)
        assert scene.fetching == 0
        assert scene.counts()["failures"] == 0
        scene.watch(True)
        await asyncio.sleep(0.01)
        assert scene.fetching == 1, "at once: nothing had failed"


async def test_a_subscriber_on_the_bus_is_one_who_watches(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch)
    scene.bus.join("2").subscribe(KEY, lambda sample: None)
    async with serving(scene):
        await asyncio.sleep(0.01)
        assert scene.fetching == 1


async def test_images_are_published_with_size_and_time_and_the_newest_at_the_rate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with serving(Scene(monkeypatch, rate_hz=10.0)) as scene:
        scene.watch(True)
        await asyncio.sleep(0.01)
        scene.read(jpeg(1), jpeg(2, width=320, height=240), bad=1)
        assert scene.images() == [
            Image(format="jpeg", data=jpeg(2, width=320, height=240), width=320, height=240, stamp_ns=STAMP_NS)
        ]
        scene.read(jpeg(3))  # may be early by an interval
        scene.read(jpeg(4))
        scene.read(jpeg(5))
        assert [each.data for each in scene.images()[1:]] == [jpeg(3)]
        await asyncio.sleep(1.0)
        assert [each.data for each in scene.images()[2:]] == [jpeg(5)], "the last one when it is due, and once"
        assert scene.counts() == {"pictures": 5, "not_jpeg": 1, "rate_dropped": 2, "published": 3, "failures": 0}


async def test_nothing_is_published_for_clients_of_the_relay_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serving(Scene(monkeypatch)) as scene:
        scene.camera.demand.join()
        await asyncio.sleep(0.01)
        scene.read(jpeg(1))
        assert scene.images() == []
        assert scene.counts()["pictures"] == 1
        assert (await scene.camera.latest.after(0)).part.jpeg == jpeg(1)


async def test_a_fault_is_shown_until_a_picture_comes_and_tried_again_later_and_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with serving(Scene(monkeypatch)) as scene:
        scene.watch(True)
        await asyncio.sleep(0.001)
        waits: list[float] = []
        for _ in range(6):
            ended_at = scene.loop.time()
            scene.end.set_result(LinkError("the stream ended"))
            await asyncio.sleep(0.001)
            assert scene.open_faults.texts == ("camera http://robot:80/s: the stream ended",)
            await asyncio.sleep(1.5 * RETRY_S)
            waits.append(scene.begun[-1] - ended_at)
        assert waits[0] < 1.5 < waits[-1]
        assert max(waits) < 1.3 * RETRY_S
        assert scene.counts()["failures"] == 6
        scene.read(bad=1)
        assert scene.open_faults.texts != (), "no picture yet"
        scene.read(jpeg(1))
        assert scene.open_faults.texts == ()


async def test_a_stream_that_lasted_is_fetched_again_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serving(Scene(monkeypatch)) as scene:
        scene.watch(True)
        for _ in range(5):
            await asyncio.sleep(2 * RETRY_S)
            scene.end.set_result(LinkError("the stream ended"))
        await asyncio.sleep(60.0)
        ended_at = scene.loop.time()
        scene.end.set_result(LinkError("the stream ended"))
        await asyncio.sleep(2 * RETRY_S)
        assert scene.begun[-1] - ended_at < 1.5


async def test_a_fault_of_nobody_who_watches_is_not_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serving(Scene(monkeypatch)) as scene:
        scene.watch(True)
        await asyncio.sleep(0.01)
        scene.watch(False)
        scene.end.set_result(LinkError("the stream ended"))
        await asyncio.sleep(60.0)
        assert scene.open_faults.texts == ()
        assert len(scene.begun) == 1


async def test_an_error_of_ours_does_not_end_the_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serving(Scene(monkeypatch)) as scene:
        scene.watch(True)
        await asyncio.sleep(0.01)
        scene.end.set_result(RuntimeError("what"))
        await asyncio.sleep(0.01)
        assert "what" in scene.open_faults.texts[0]
        await asyncio.sleep(2 * RETRY_S)
        assert len(scene.begun) == 2


async def test_pictures_of_a_stream_that_has_ended_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serving(Scene(monkeypatch, rate_hz=1.0)) as scene:
        scene.watch(True)
        await asyncio.sleep(0.01)
        for number in (1, 2, 3):
            scene.read(jpeg(number))
        scene.end.set_result(LinkError("the stream ended"))
        await asyncio.sleep(0.1)
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(1.0):
                await scene.camera.latest.after(0)
        assert [each.data for each in scene.images()] == [jpeg(1), jpeg(2)], "the third was not due yet"


async def test_the_end_of_a_camera_clears_what_it_showed(monkeypatch: pytest.MonkeyPatch) -> None:
    async with serving(Scene(monkeypatch)) as scene:
        scene.watch(True)
        await asyncio.sleep(0.01)
        scene.end.set_result(LinkError("the stream ended"))
        await asyncio.sleep(0.01)
        scene.open_faults.set(FaultCode.CAMERA_RELAY, "camera relay 127.0.0.1:1: Address already in use")
        assert len(scene.open_faults.texts) == 2
    assert scene.open_faults.texts == ()
    assert scene.fetching == 0
