"""What this process uses of its machine: processor, memory, descriptors, the disks that it writes to.

Theory of operation. The cheap numbers are read when somebody asks, at most every :data:`APART_S`: the gateways of one
process share them. What may take milliseconds, or hang as a disk of another machine may, is read by a thread of its own
every :data:`SLOW_S`; the next one begins only when the one before has ended.
"""

from __future__ import annotations

import os
import platform
import socket
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from zbridge.fleet.processes import DiskSpace, ProcessStats
from zbridge.metrics import Metrics, Reading
from zbridge.version import __version__

APART_S = 0.5
"""Least time between two readings."""
SLOW_S = 5.0
"""Seconds between two readings of what takes time."""
_TICKS_AT = 19
"""Where ``/proc/self/stat`` has the time of the start, counted after the name of the program."""

VERSIONS = {"version": __version__, "python": platform.python_version(), "zenoh": version("eclipse-zenoh")}

Disks = tuple[tuple[str, Path], ...]
"""What is written, and where: ``(("audit", Path("/var/log/zbridge/r1.log")),)``."""


class ProcessUsage:
    """Reads what this process uses; where the platform does not say, a number is 0 or None.

    clock: seconds. threads: whether to read what takes time, on a thread; else only the number of descriptors is read.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, *, threads: bool = True) -> None:
        self.robots = 0
        """How many robots this process serves."""
        self.disks: dict[str, Disks] = {}
        """The disks of each gateway, by its robot."""
        self._clock = clock
        self._threads = threads
        self._host = socket.gethostname()
        self._at = self._slowly_at = -SLOW_S
        self._started_s: float = 0.0
        """When the process started, seconds since the machine did."""
        self._processor_s = 0.0
        self._last: ProcessStats | None = None
        self._slow = _Slow()
        self._thread: threading.Thread | None = None

    def __repr__(self) -> str:
        return f"<ProcessUsage of {self.robots} robots>"

    def read(self) -> ProcessStats:
        """Return what the process uses now."""
        now = self._clock()
        if self._last is None:
            self._started_s = _started_s()
        if self._last is None or now - self._at >= APART_S:
            self._last = self._read(now)
        return self._last

    def readings(self) -> Iterator[Reading]:
        """Return what the metrics show of the process."""
        stats = self.read()
        yield "process_cpu_seconds", {}, time.process_time()
        yield "process_resident_memory_bytes", {}, stats.resident_bytes
        yield "process_open_fds", {}, stats.files
        yield "process_max_fds", {}, stats.most_files
        yield "process_start_time_seconds", {}, round(time.time() - stats.uptime_s, 1)
        yield "build_info", VERSIONS, 1

    def free(self, robot: str) -> tuple[DiskSpace, ...]:
        """Return the space on the disks of a robot's gateway, as it was read last."""
        known = self._slow.free
        return tuple(DiskSpace(use, str(path), known[path]) for use, path in self.disks.get(robot, ()) if path in known)

    def _read(self, now: float) -> ProcessStats:
        used_s, since_s = time.process_time(), now - self._at
        cpu = max(0.0, (used_s - self._processor_s) / since_s) if self._last is not None else 0.0
        self._at, self._processor_s = now, used_s
        if not self._threads:
            self._slow.read_files()
        elif now - self._slowly_at >= SLOW_S and (self._thread is None or not self._thread.is_alive()):
            self._slowly_at = now
            paths = frozenset(path for disks in self.disks.values() for _, path in disks)
            self._thread = threading.Thread(target=self._slow.read, args=(paths,), name="zbridge-usage", daemon=True)
            self._thread.start()
        return ProcessStats(
            host=self._host,
            pid=os.getpid(),
            version=__version__,
            robots=self.robots,
            uptime_s=round(_boot_s() - self._started_s, 1),
            cpu=round(cpu, 4),
            resident_bytes=_resident_bytes(),
            proportional_bytes=self._slow.proportional_bytes,
            files=self._slow.files,
            most_files=self._slow.most_files,
        )


class _Slow:
    """What the thread reads; each attribute is replaced as a whole."""

    def __init__(self) -> None:
        self.proportional_bytes: int | None = None
        self.files = 0
        self.most_files = 0
        self.free: dict[Path, int] = {}

    def read(self, paths: Iterable[Path]) -> None:
        with suppress(OSError, ValueError, StopIteration):
            lines = Path("/proc/self/smaps_rollup").read_text().splitlines()
            self.proportional_bytes = 1024 * int(next(line for line in lines if line.startswith("Pss:")).split()[1])
        self.read_files()
        self.free = {path: free for path in paths if (free := free_bytes(path)) is not None}

    def read_files(self) -> None:
        with suppress(OSError):
            self.files = len(os.listdir("/proc/self/fd"))
        self.most_files = most_files()


def free_bytes(path: Path) -> int | None:
    """Return the space that is left where a file is, or will be written; None if that cannot be read. May block."""
    for folder in (path, *path.absolute().parents):
        with suppress(OSError):
            disk = os.statvfs(folder)
            return disk.f_bavail * disk.f_frsize
    return None


def most_files() -> int:
    """Return how many descriptors this process may have; 0 where the platform does not say."""
    try:
        import resource
    except ImportError:
        return 0
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def _resident_bytes() -> int:
    with suppress(OSError, ValueError, IndexError):
        return int(Path("/proc/self/statm").read_bytes().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def _boot_s() -> float:
    """Return the seconds since the machine started, as ``/proc`` counts them."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


def _started_s() -> float:
    with suppress(OSError, ValueError, IndexError):
        fields = Path("/proc/self/stat").read_bytes().rpartition(b")")[2].split()
        return int(fields[_TICKS_AT]) / os.sysconf("SC_CLK_TCK")
    return _boot_s()


USAGE = ProcessUsage()
"""This process."""


def process_metrics() -> Metrics:
    """Make the metrics of a process that is no gateway: they show what it uses."""
    metrics = Metrics()
    metrics.add_source(USAGE.readings)
    return metrics
