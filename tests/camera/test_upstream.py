"""What ends a camera's stream: no picture for ``stall_s``, however much comes."""

from __future__ import annotations

import asyncio

import pytest

from tests.camera.camera_bytes import HEAD, jpeg, part
from zbridge.camera import upstream
from zbridge.camera.mjpeg import MjpegReader, Part
from zbridge.camera.settings import Source
from zbridge.errors import LinkError

pytestmark = pytest.mark.jumping

STALL_S = 3.0
BAD = part(b"no jpeg")
"""A part of a camera that is out of order."""
READ_BYTES = 64 * 1024


class _Transport:
    def abort(self) -> None:
        """Nothing is connected."""


class _Writer:
    transport = _Transport()

    def write(self, data: bytes) -> None:
        """Nobody reads."""


async def fetched(monkeypatch: pytest.MonkeyPatch, *stream: bytes) -> tuple[float, int, str]:
    """Fetch a stream that is there at once; return how long it took, the pictures, and why it ended."""
    reader, pictures = asyncio.StreamReader(), list[Part]()
    for data in stream:
        reader.feed_data(data)

    async def connect(source: Source) -> tuple[asyncio.StreamReader, _Writer]:
        return reader, _Writer()

    def took(stream: MjpegReader, parts: list[Part]) -> None:
        pictures.extend(parts)

    monkeypatch.setattr(upstream, "_connect", connect)
    loop = asyncio.get_running_loop()
    begun = loop.time()
    with pytest.raises(LinkError) as error:
        await upstream.fetch(Source("camera", 80, "/"), STALL_S, took)
    return loop.time() - begun, len(pictures), str(error.value)


async def test_a_camera_that_sends_bad_parts_quickly_is_ended_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each read costs seconds of the budget: 13 of them were 39 s, where ``stall_s`` was 3."""
    many = BAD * (20 * READ_BYTES // len(BAD))
    assert await fetched(monkeypatch, HEAD, many) == (pytest.approx(STALL_S), 0, "no picture for 3 s")


async def test_bad_parts_without_any_rest_do_not_hide_the_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    """What waits in the buffer is read without waiting: no timeout of a read can end that."""
    loop = asyncio.get_running_loop()
    monkeypatch.setattr(upstream.Budget, "rest_s", lambda *_: 0.01)
    begun = loop.time()
    took_s, pictures, why = await fetched(monkeypatch, HEAD, *[BAD * (READ_BYTES // len(BAD))] * 1000)
    assert (took_s, pictures, why) == (pytest.approx(STALL_S, abs=0.05), 0, "no picture for 3 s")
    assert loop.time() - begun == took_s


async def test_a_picture_now_and_then_keeps_a_stream_of_bad_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    mixed = (BAD * 500 + part(jpeg())) * 10
    took_s, pictures, why = await fetched(monkeypatch, HEAD, mixed, b"")
    assert (pictures, why) == (10, "no picture for 3 s")
    assert took_s > STALL_S
