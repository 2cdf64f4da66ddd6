"""The simulated camera: its pictures are JPEGs that a decoder reads, and it streams as legacy robots do."""

from __future__ import annotations

import asyncio
import hashlib

import pytest

from tests.camera.camera_bytes import HEAD
from zbridge.camera.mjpeg import MjpegReader, jpeg_size
from zbridge.errors import LinkError
from zbridge.protocol.address import Address
from zbridge.simulation.camera import COLUMNS, ROWS, draw, scene, serve_camera


def test_a_picture_is_what_a_decoder_was_seen_to_read() -> None:
    """libjpeg (by Pillow) gave back every grey of these bytes."""
    assert draw(bytes((0, 255, 128, 129)), 2).hex()[-60:] == LAST
    assert hashlib.sha256(draw(scene(150), COLUMNS)).hexdigest() == SCENE
    assert jpeg_size(draw(scene(0), COLUMNS)) == (8 * COLUMNS, 8 * ROWS)
    assert draw(scene(1), COLUMNS) != draw(scene(2), COLUMNS)


async def test_the_camera_streams_as_a_deployed_robot_does() -> None:
    url: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    serving = asyncio.create_task(serve_camera(Address("127.0.0.1", 0), url.set_result))
    async with asyncio.timeout(20.0):
        port = int((await url).removeprefix("http://127.0.0.1:").removesuffix("/stream.mjpg"))
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET /stream.mjpg HTTP/1.0\r\n\r\n")
        stream, pictures = MjpegReader(), list[bytes]()
        while len(pictures) < 3:
            pictures += [part.jpeg for part in stream.receive(await reader.read(4096))]
        assert pictures[:3] == [draw(scene(number), COLUMNS) for number in range(3)]
        names = [[line.split(b":")[0] for line in head.split(b"\r\n")] for head in (stream.head, HEAD)]
        assert names[0] == names[1]
        writer.close()
        with pytest.raises(LinkError, match="in use"):
            await serve_camera(Address("127.0.0.1", port), print)
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


LAST = "c0000b080010001001011100ffda0008010100003f00f9fdf7fbc00affd9"
SCENE = "de70afff0f4bf25ab631c7a139eeb09fd815515668f3981815dc84e456006012"
