"""How a camera is asked, and what ends its stream: no picture for ``stall_s``, however much comes."""

from __future__ import annotations

import asyncio
import socket

import pytest

from tests.camera.camera_bytes import HEAD, jpeg, part
from zbridge.camera import upstream
from zbridge.camera.mjpeg import MjpegPart, MjpegReader
from zbridge.camera.settings import CameraSource
from zbridge.errors import LinkError, ProtocolError

pytestmark = pytest.mark.jumping

STALL_S = 3.0
BAD = part(b"no jpeg")
"""A part of a camera that is out of order."""
READ_BYTES = 64 * 1024


class _Writer:
    """Notes what is written; ``transport`` is itself."""

    def __init__(self) -> None:
        self.transport, self.written, self.aborted = self, b"", False

    def write(self, data: bytes) -> None:
        self.written += data

    def abort(self) -> None:
        self.aborted = True


async def fetched(monkeypatch: pytest.MonkeyPatch, *stream: bytes) -> tuple[float, int, str]:
    """Fetch a stream that is there at once; return how long it took, the pictures, and why it ended."""
    reader, pictures = asyncio.StreamReader(), list[MjpegPart]()
    for data in stream:
        reader.feed_data(data)

    async def connect(source: CameraSource) -> tuple[asyncio.StreamReader, _Writer]:
        return reader, _Writer()

    def took(stream: MjpegReader, parts: list[MjpegPart]) -> None:
        pictures.extend(parts)

    monkeypatch.setattr(upstream, "_connect", connect)
    loop = asyncio.get_running_loop()
    begun = loop.time()
    with pytest.raises(LinkError) as error:
        await upstream.fetch(CameraSource("camera", 80, "/"), STALL_S, took)
    return loop.time() - begun, len(pictures), str(error.value)


async def test_a_camera_that_sends_bad_parts_quickly_is_ended_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each read costs seconds of the budget: 13 of them were 39 s, where ``stall_s`` was 3."""
    many = BAD * (20 * READ_BYTES // len(BAD))
    assert await fetched(monkeypatch, HEAD, many) == (pytest.approx(STALL_S), 0, "no picture for 3 s")


async def test_bad_parts_without_any_rest_do_not_hide_the_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    """What waits in the buffer is read without waiting: no timeout of a read can end that."""
    loop = asyncio.get_running_loop()
    monkeypatch.setattr(upstream.ReadBudget, "pause_s", lambda *_: 0.01)
    begun = loop.time()
    took_s, pictures, why = await fetched(monkeypatch, HEAD, *[BAD * (READ_BYTES // len(BAD))] * 1000)
    assert (took_s, pictures, why) == (pytest.approx(STALL_S, abs=0.05), 0, "no picture for 3 s")
    assert loop.time() - begun == took_s


async def test_a_picture_now_and_then_keeps_a_stream_of_bad_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    mixed = (BAD * 500 + part(jpeg())) * 10
    took_s, pictures, why = await fetched(monkeypatch, HEAD, mixed, b"")
    assert (pictures, why) == (10, "no picture for 3 s")
    assert took_s > STALL_S


def no_picture(stream: MjpegReader, parts: list[MjpegPart]) -> None:
    assert parts == []


ENDS = {"": "the stream ended", "404": "the answer is HTTP 404"}


@pytest.mark.parametrize("status", ENDS)
async def test_a_stream_is_asked_for_in_http_1_0_and_its_connection_closed_at_its_end(
    monkeypatch: pytest.MonkeyPatch, status: str
) -> None:
    reader, writer = asyncio.StreamReader(), _Writer()
    reader.feed_data(HEAD.replace(b"200 OK", status.encode()) if status else HEAD)
    reader.feed_eof()

    async def connect(host: str, port: int) -> tuple[asyncio.StreamReader, _Writer]:
        assert (host, port) == ("::1", 8000)
        return reader, writer

    monkeypatch.setattr(asyncio, "open_connection", connect)
    with pytest.raises((LinkError, ProtocolError), match=f"^{ENDS[status]}$"):
        await upstream.fetch(CameraSource("::1", 8000, "/stream.mjpg?q=1"), STALL_S, no_picture)
    line, host, *_, blank, rest = writer.written.split(b"\r\n")
    assert (line, host, blank, rest) == (b"GET /stream.mjpg?q=1 HTTP/1.0", b"Host: [::1]:8000", b"", b"")
    assert writer.aborted


UNREACHED = [
    (ConnectionRefusedError(111, "Connect call failed ('10.0.0.7', 80)"), "^Connection refused$"),
    (socket.gaierror(-2, "Name or service not known"), "^Name or service not known$"),
    (OSError("Multiple exceptions"), "^Multiple exceptions$"),
    (None, "^no connection within 5 s$"),
]


@pytest.mark.parametrize(("error", "told"), UNREACHED)
async def test_a_camera_that_is_not_reached_is_told_in_the_words_of_the_operating_system(
    monkeypatch: pytest.MonkeyPatch, error: OSError | None, told: str
) -> None:
    async def connect(host: str, port: int) -> None:
        if error is not None:
            raise error
        await asyncio.sleep(3600.0)

    monkeypatch.setattr(asyncio, "open_connection", connect)
    with pytest.raises(LinkError, match=told):
        await upstream.fetch(CameraSource("robot", 80, "/"), STALL_S, no_picture)


async def test_a_connection_that_breaks_is_told_and_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    reader, writer = asyncio.StreamReader(), _Writer()
    reader.set_exception(ConnectionResetError(104, "reset"))

    async def connect(source: CameraSource) -> tuple[asyncio.StreamReader, _Writer]:
        return reader, writer

    monkeypatch.setattr(upstream, "_connect", connect)
    with pytest.raises(LinkError, match=r"^Connection reset by peer$"):
        await upstream.fetch(CameraSource("robot", 80, "/"), STALL_S, no_picture)
    assert writer.aborted
