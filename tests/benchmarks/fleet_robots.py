"""Many robots in one process: each registers wheels and one sensor, then says nothing, or a reading so often.

``python -m tests.benchmarks.fleet_robots COUNT``; words: ``pace HZ`` (0: silence), ``flood`` (all send as fast as the
gateway reads), ``hang`` (neither send nor read), ``die`` (close every connection at once, again and again). Bytes are
those of ``tests/vectors/wc2ec-deployed.hex``.
"""

from __future__ import annotations

import asyncio
import contextlib
import resource
import socket
import sys

from tests.benchmarks.peer import tell

SENSOR = "sensor/dist_f"
REGISTERED = bytes.fromhex("00350006776865656c31 00350106776865656c32 00350206776865656c33 00350306776865656c34")
REGISTERED += bytes.fromhex("00250606646973745f66")
READING = bytes.fromhex("0125060000000000408f40")
_AT_ONCE = 1000
"""Readings in one write of a flood."""


class Robots:
    """The robots of this process, and what they are told to do."""

    def __init__(self) -> None:
        self.writers: set[asyncio.StreamWriter] = set()
        self.pace_hz = 0.0
        self.mode = "pace"
        self.changed = asyncio.Event()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Be one robot, for one connection."""
        if self.mode == "die":
            writer.close()
            return
        writer.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        writer.write(REGISTERED)
        self.writers.add(writer)
        with contextlib.suppress(OSError):
            while self.mode == "hang" or await reader.read(65_536):
                if self.mode == "hang":
                    await self.changed.wait()
        self.writers.discard(writer)
        writer.close()

    async def send(self) -> None:
        """Send readings as told."""
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            if self.mode == "flood":
                for writer in tuple(self.writers):
                    writer.write(READING * _AT_ONCE)
                    with contextlib.suppress(OSError):
                        await writer.drain()
                due = loop.time()
            elif self.mode == "pace" and self.pace_hz:
                for writer in tuple(self.writers):
                    writer.write(READING)
                due = max(due + 1 / self.pace_hz, loop.time())
                await asyncio.sleep(due - loop.time())
            else:
                self.changed.clear()
                await self.changed.wait()
                due = loop.time()

    def obey(self) -> None:
        """Take one word."""
        words = sys.stdin.readline().split()
        if not words:
            raise SystemExit(0)
        self.mode = words[0]
        if self.mode == "pace":
            self.pace_hz = float(words[1])
        if self.mode == "die":
            for writer in tuple(self.writers):
                writer.transport.abort()
        self.changed.set()
        tell(mode=self.mode)


async def main() -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    robots = Robots()
    servers = [await asyncio.start_server(robots.serve, "127.0.0.1", 0) for _ in range(int(sys.argv[1]))]
    asyncio.get_running_loop().add_reader(sys.stdin.fileno(), robots.obey)
    tell(ports=[server.sockets[0].getsockname()[1] for server in servers])
    await robots.send()


if __name__ == "__main__":
    asyncio.run(main())
