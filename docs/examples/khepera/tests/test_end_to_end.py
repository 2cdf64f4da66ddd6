"""A real gateway and real Zenoh: the robot on a TCP port, and on a serial line (a pair of pseudo terminals)."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import subprocess
import sys
import threading
import time
import tty
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import zbridge
from zbridge.errors import BusError, Refused
from zbridge.simulation import STEP_S

from khepera.messages import SetSpeeds
from khepera.simulator import Khepera

WAIT_S = 20.0


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port: int = found.getsockname()[1]
        return port


@contextlib.contextmanager
def running(*arguments: str) -> Iterator[None]:
    """Run ``zbridge`` with these arguments."""
    process = subprocess.Popen([sys.executable, "-m", "zbridge", *arguments])
    try:
        yield
    finally:
        process.terminate()
        assert process.wait(10) == 0


class SerialKhepera:
    """A simulated robot on a serial line; ``address``: the near end. A mute one never answers."""

    def __init__(self) -> None:
        self.robot, self.mute = Khepera(), False
        self._far, self._near = os.openpty()
        tty.setraw(self._near)
        os.set_blocking(self._far, False)
        self.address = f"serial://{os.ttyname(self._near)}?baud=57600"
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._live)

    def __enter__(self) -> SerialKhepera:
        self._thread.start()
        return self

    def __exit__(self, *raised: object) -> None:
        self._over.set()
        self._thread.join()
        os.close(self._far)
        os.close(self._near)

    def _live(self) -> None:
        lived = time.monotonic()
        while not self._over.wait(STEP_S):
            before, lived = lived, time.monotonic()
            self.robot.step(lived - before)
            with contextlib.suppress(BlockingIOError):
                answers = self.robot.receive(os.read(self._far, 4096))
                if not self.mute:
                    os.write(self._far, answers)


async def connected(endpoint: str, stack: contextlib.AsyncExitStack) -> zbridge.Fleet:
    """Connect to the gateway's router as soon as it listens."""
    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            return await stack.enter_async_context(zbridge.connect(endpoints=[endpoint]))
        except BusError:
            if time.monotonic() > deadline:
                raise
            await asyncio.sleep(0.2)


@contextlib.asynccontextmanager
async def gateway(address: str, folder: Path) -> AsyncIterator[zbridge.Robot]:
    """Run a gateway for the robot at an address; yield the robot on the bus, once it is established."""
    endpoint, file = f"tcp/127.0.0.1:{free_port()}", folder / "k1.toml"
    file.write_text(
        f'[robot]\nname = "k1"\n[device]\nprotocol = "khepera"\nconnect = ["{address}"]\n'
        f'[bus]\nmode = "router"\nlisten = ["{endpoint}"]\nmulticast = false\n'
    )
    with running("run", str(file)):
        async with contextlib.AsyncExitStack() as stack, asyncio.timeout(WAIT_S):
            robot = (await connected(endpoint, stack))["k1"]
            async for status in robot.status:
                if status.state == "established":
                    break
            assert (status.protocol, status.version) == ("khepera", "5.1")
            yield robot


async def drive(address: str, folder: Path) -> None:
    """Drive the robot at an address through the bus, and check that it stops."""
    async with gateway(address, folder) as robot:
        async with robot.control() as control:
            await control.during(1.5, forward=0.4)
        async for scan in robot.scan:
            assert len(scan.ranges) == 301
            break
        await asyncio.sleep(0.5)
        async for motion in robot.motion:
            if motion.speed == 0.0:
                break
        async for pose in robot.pose:
            assert 0.1 < pose.x < 0.6
            break


async def test_a_robot_on_tcp_is_driven_from_the_bus(tmp_path: Path) -> None:
    port = free_port()
    with running("simulate", "khepera", "--listen", f"tcp://127.0.0.1:{port}"):
        await drive(f"tcp://127.0.0.1:{port}", tmp_path)


async def test_a_robot_on_a_serial_line_is_driven_from_the_bus(tmp_path: Path) -> None:
    with SerialKhepera() as far:
        await drive(far.address, tmp_path)


async def test_a_robot_that_falls_silent_is_stopped(tmp_path: Path) -> None:
    with SerialKhepera() as far:
        async with gateway(far.address, tmp_path) as robot, robot.control() as control:
            for _ in range(10):
                await control(forward=0.4)
                await asyncio.sleep(0.05)
            assert far.robot.speeds == SetSpeeds(25, 25)
            far.mute = True
            for _ in range(20):
                with contextlib.suppress(Refused):
                    await control(forward=0.4)
                await asyncio.sleep(0.05)
            assert far.robot.speeds == SetSpeeds(0, 0)
