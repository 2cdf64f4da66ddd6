"""The newest picture of a camera, for any number of clients that are each as slow as they are."""

from __future__ import annotations

import asyncio

import msgspec

from zbridge.camera.mjpeg import MjpegReader, Part


class Shot(msgspec.Struct, frozen=True):
    """One picture, and the stream it belongs to: ``answer`` is that stream's HTTP head. number: rises by one."""

    number: int
    answer: bytes
    boundary: bytes
    part: Part


class Latest:
    """Keeps the newest picture only; a client waits for one that is newer than the last it got."""

    def __init__(self) -> None:
        self._number = 0
        self._shot: Shot | None = None
        self._came = asyncio.Event()

    def __repr__(self) -> str:
        return f"<Latest {self._number}>"

    def show(self, stream: MjpegReader, part: Part) -> None:
        """Replace the picture by a newer one."""
        self._number += 1
        self._shot = Shot(self._number, stream.head, stream.boundary, part)
        self._came.set()
        self._came = asyncio.Event()

    def forget(self) -> None:
        """Keep no picture: the stream has ended, and what it showed is old."""
        self._shot = None

    async def after(self, number: int) -> Shot:
        """Return the newest picture as soon as its number is greater than ``number``."""
        while self._shot is None or self._shot.number <= number:
            await self._came.wait()
        return self._shot
