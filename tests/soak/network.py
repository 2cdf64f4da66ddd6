"""Two network namespaces, joined by a link that delays and loses packets.

``python -m tests.soak.network NET PID``: joins this namespace, address NET.1, with that of process PID, NET.2. Each
line on stdin sets the link: seconds of delay, of jitter, and the part of packets that is lost, to there and back.

The packets pass through this process, by two TUN devices: many kernels lack ``sch_netem``, and few lack these.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import random
import select
import struct
import sys
import time
from collections import deque
from pathlib import Path

from tests.e2e.rigs.processes import Namespace, Part, ip

_TUNSETIFF, _TUN_WITHOUT_HEADER = 0x400454CA, 0x1001
_PACKET_BYTES = 65_536
_QUEUE = 5_000
"""Packets that are on their way at most; more are lost."""
CLEAN = (0.0, 0.0, 0.0)
CUT = (0.0, 0.0, 1.0)
Quality = tuple[float, float, float]
"""Delay and jitter in seconds, and the part that is lost."""


class Link:
    """The link, as its scene sees it: ``near`` and ``far`` are the addresses of its ends."""

    def __init__(self, stack: contextlib.ExitStack, enter: tuple[str, ...], net: str, there: Namespace) -> None:
        self.near, self.far = f"{net}.1", f"{net}.2"
        self._there, self._back = CLEAN, CLEAN
        command = (sys.executable, "-m", "tests.soak.network", net, str(there.keeper.pid))
        self._part = Part(stack, *enter, *command)
        assert self._part.line() == "open"

    def set(self, there: Quality, back: Quality) -> None:
        """Set what happens to packets from near to far, and back."""
        self._there, self._back = there, back
        self._say(there, back)

    def cut(self, *, there: bool = True, back: bool = True) -> None:
        """Lose every packet of one direction or both."""
        self._say(CUT if there else self._there, CUT if back else self._back)

    def mend(self) -> None:
        """Be again what it was before it was cut."""
        self._say(self._there, self._back)

    def _say(self, there: Quality, back: Quality) -> None:
        self._part.say(" ".join(map(str, (*there, *back))))


class _Direction:
    """One direction of the link; keeps the order of packets."""

    def __init__(self, source: int, sink: int) -> None:
        self.source, self._sink = source, sink
        self.quality: Quality = CLEAN
        self._waiting: deque[tuple[float, bytes]] = deque()

    def take(self) -> None:
        """Read what has come, until there is no more."""
        with contextlib.suppress(BlockingIOError):
            while True:
                packet = os.read(self.source, _PACKET_BYTES)
                delay_s, jitter_s, lost = self.quality
                if random.random() < lost or len(self._waiting) >= _QUEUE:
                    continue
                due = time.monotonic() + delay_s + random.uniform(0, jitter_s)
                self._waiting.append((max(due, self._waiting[-1][0]) if self._waiting else due, packet))

    def pass_on(self) -> float | None:
        """Write what is due; give the seconds until the next packet is."""
        while self._waiting:
            wait_s = self._waiting[0][0] - time.monotonic()
            if wait_s > 0:
                return wait_s
            with contextlib.suppress(OSError):  # the other end is down, or full
                os.write(self._sink, self._waiting.popleft()[1])
        return None


def _tun(name: str) -> int:
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _TUN_WITHOUT_HEADER))
    return device


def main() -> None:
    net, pid = sys.argv[1:]
    name = f"soak{net.replace('.', '')}"
    here, there = _tun(name), _tun(f"{name}b")
    ip(f"link set {name}b netns {pid}", f"address add {net}.1/30 dev {name}", f"link set {name} up")
    enter = ("nsenter", "--target", pid, "--net")
    ip("link set lo up", f"address add {net}.2/30 dev {name}b", f"link set {name}b up", enter=enter)
    directions = _Direction(here, there), _Direction(there, here)
    print("open", flush=True)
    wait_s: float | None = None
    while True:
        ready = select.select([0, here, there], [], [], wait_s)[0]
        if 0 in ready:
            if not (words := os.read(0, 1000).decode().splitlines()):
                return
            values = [*map(float, words[-1].split())]
            directions[0].quality, directions[1].quality = (*values[:3],), (*values[3:],)  # type: ignore[assignment]
        waits = []
        for direction in directions:
            direction.take()
            waits += [] if (wait := direction.pass_on()) is None else [wait]
        wait_s = min(waits, default=None)


def missing() -> str:
    """Say why there can be no link on this machine; empty where there can."""
    try:
        os.close(os.open("/dev/net/tun", os.O_RDWR))
    except OSError as error:
        return f"no TUN devices: {error}"
    return "" if Path("/proc/self/ns/net").exists() else "no network namespaces"


if __name__ == "__main__":
    main()
