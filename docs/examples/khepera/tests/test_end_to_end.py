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
from collections.abc import Iterator
from pathlib import Path

from khepera.simulator import STEP_S, Khepera

import zbridge
from zbridge.errors import BusError

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


@contextlib.contextmanager
def on_a_serial_line() -> Iterator[str]:
    """Run a simulated robot at the far end of a serial line; give the address of the near end."""
    far, near = os.openpty()
    tty.setraw(near)
    os.set_blocking(far, False)
    robot, waiting, over = Khepera(), b"", threading.Event()

    def live() -> None:
        nonlocal waiting
        while not over.wait(STEP_S):
            robot.step(STEP_S)
            with contextlib.suppress(BlockingIOError):
                waiting += os.read(far, 4096)
            *lines, waiting = waiting.split(b"\n")
            os.write(far, b"".join(robot.answer(line + b"\n") for line in lines))

    thread = threading.Thread(target=live)
    thread.start()
    try:
        yield f"serial://{os.ttyname(near)}?baud=57600"
    finally:
        over.set()
        thread.join()
        os.close(far)
        os.close(near)


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


async def drive(address: str, folder: Path) -> None:
    """Run a gateway for the robot at an address, drive it through the bus, and see it stand."""
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
                assert 0.2 < pose.x < 0.45
                break


async def test_a_robot_on_tcp_is_driven_from_the_bus(tmp_path: Path) -> None:
    port = free_port()
    with running("simulate", "khepera", "--listen", f"tcp://127.0.0.1:{port}"):
        await drive(f"tcp://127.0.0.1:{port}", tmp_path)


async def test_a_robot_on_a_serial_line_is_driven_from_the_bus(tmp_path: Path) -> None:
    with on_a_serial_line() as address:
        await drive(address, tmp_path)
