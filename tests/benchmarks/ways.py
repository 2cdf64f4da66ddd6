"""Counts the files and the calls that a drive and a frame cross inside a gateway.

A robot is simulated by a process of its own and driven by another; the gateway between them runs here, traced. The way
in begins with Zenoh's callback for ``@cmd/drive`` and ends when the event loop has finished with it; the way out begins
with the read from the robot's socket and ends with the last put, here or by the writer thread. Of all drives and
frames of a run the most frequent way is printed. Comprehensions are no calls; each step of a generator is one.

    python -m tests.benchmarks.ways [PROTOCOL]
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import sys
import threading
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import zenoh

from tests.ports import free_port

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 4.0
"""How long the robot is driven."""
Call = tuple[str, str, str]
"""File below the repository, function, and the file that called it; "" where none of the project's did."""
Way = tuple[Call, ...]


class Tracer:
    """Records what one thread calls, as one way for each call from outside the project."""

    def __init__(self, done: Callable[[Way], None]) -> None:
        self._done = done
        self._callers: list[str] = []
        self._calls: list[Call] = []

    def __call__(self, frame: FrameType, event: str, arg: object) -> None:
        if event not in ("call", "return"):
            return
        function = _project_function(frame)
        if function is None:
            return
        if event == "call":
            self._calls.append((*function, self._callers[-1] if self._callers else ""))
            self._callers.append(function[0])
        elif self._callers:
            self._callers.pop()
            if not self._callers:
                way, self._calls = tuple(self._calls), []
                self._done(way)


class Ways:
    """Puts the ways of the threads together."""

    def __init__(self) -> None:
        self.ways_in: Counter[Way] = Counter()
        self.ways_out: Counter[Way] = Counter()
        self._came: list[Way] = []
        self._read: Way | None = None

    def from_bus(self, way: Way) -> None:
        """Take what a callback of Zenoh's has done."""
        self._came.append(way)

    def on_loop(self, way: Way) -> None:
        """Take what one callback of the event loop has done."""
        names = [name for _, name, _ in way]
        if "buffer_updated" in way[0][1] and any(name.endswith("put_all") for name in names):
            if any(name.endswith("_put_batch") for name in names):
                self.ways_out[way] += 1
            else:
                self._read = way
        elif self._came and any(path.endswith("transport/tcp.py") and name.endswith(".write") for path, name, _ in way):
            self.ways_in[self._came[-1] + way] += 1
            self._came.clear()

    def on_writer(self, way: Way) -> None:
        """Take what a writer thread has done in one turn."""
        if self._read is not None and len(way) > 1:
            self.ways_out[self._read + way] += 1
            self._read = None


def _project_function(frame: FrameType) -> tuple[str, str] | None:
    """Name the function of a frame; None where it is not the project's, or is a comprehension or a thread's loop."""
    code = frame.f_code
    path, name = code.co_filename, code.co_qualname
    if not path.startswith(str(ROOT)) or "/tests/" in path:
        return None
    if name.endswith(("<listcomp>", "<genexpr>", "<dictcomp>", "<setcomp>", "Writer._run")):
        return None
    return str(Path(path).relative_to(ROOT)), name


@contextlib.contextmanager
def traced(ways: Ways) -> Iterator[None]:
    """Trace this thread, every thread that is started from now on, and Zenoh's callbacks for ``@cmd``."""
    original = zenoh.open

    class Session:
        def __init__(self, session: zenoh.Session) -> None:
            self.session = session

        def __getattr__(self, name: str) -> Any:
            return getattr(self.session, name)

        def declare_subscriber(self, key: str, store: Callable[[Any], None]) -> object:
            return self.session.declare_subscriber(key, _traced_callback(store, ways) if "@cmd" in key else store)

    zenoh.open = lambda config: Session(original(config))  # type: ignore[assignment,return-value]
    threading.setprofile(_Lazy(ways))  # type: ignore[arg-type]
    sys.setprofile(Tracer(ways.on_loop))
    try:
        yield
    finally:
        sys.setprofile(None)
        threading.setprofile(None)  # type: ignore[arg-type]
        zenoh.open = original


class _Lazy:
    """Gives each thread a tracer of its own."""

    def __init__(self, ways: Ways) -> None:
        self._ways = ways

    def __call__(self, frame: FrameType, event: str, arg: object) -> None:
        tracer = Tracer(self._ways.on_writer)
        sys.setprofile(tracer)
        tracer(frame, event, arg)


def _traced_callback(store: Callable[[Any], None], ways: Ways) -> Callable[[Any], None]:
    def traced_store(sample: Any) -> None:
        if not str(sample.key_expr).endswith("@cmd/drive"):
            store(sample)
            return
        sys.setprofile(Tracer(ways.from_bus))
        try:
            store(sample)
        finally:
            sys.setprofile(None)

    return traced_store


_DRIVER = """
import sys, time, zbridge
with zbridge.blocking.connect(endpoints=[sys.argv[1]]) as fleet, fleet["r1"].control(deadman_s=2.0) as drive:
    for number in range(int(float(sys.argv[2]) * 10)):
        drive(forward=0.1 + 0.01 * (number % 5))
        time.sleep(0.1)
"""


async def measure(protocol: str) -> Ways:
    """Drive a simulated robot of a protocol, and give the ways that were taken."""
    from zbridge.app import config
    from zbridge.app.gateway import Gateway

    ways, ports = Ways(), (free_port(), free_port(), free_port())
    robot = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "zbridge", "simulate", protocol),
        *[
            part
            for port in ports[: 2 if protocol == "wc2ec" else 1]
            for part in ("--listen", f"tcp://127.0.0.1:{port}")
        ],
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.DEVNULL,
    )
    addresses = ", ".join(f'"tcp://127.0.0.1:{port}"' for port in ports[: 2 if protocol == "wc2ec" else 1])
    text = (
        f'[robot]\nname = "r1"\n[device]\nprotocol = "{protocol}"\nconnect = [{addresses}]\n'
        f'[bus]\nlisten = ["tcp/127.0.0.1:{ports[2]}"]\nmulticast = false\n'
    )
    try:
        await asyncio.sleep(1.5)
        with traced(ways):
            gateway = asyncio.ensure_future(Gateway(config.plan(tomllib.loads(text))).run())
            await asyncio.sleep(2.5)
            driver = await asyncio.create_subprocess_exec(
                *(sys.executable, "-c", _DRIVER, f"tcp/127.0.0.1:{ports[2]}", str(SECONDS)), cwd=ROOT
            )
            await driver.wait()
            gateway.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await gateway
    finally:
        robot.terminate()
        await robot.wait()
    return ways


def show(title: str, ways: Counter[Way], *, calls: bool) -> None:
    """Print the most frequent way: its numbers, its files in order, and its calls where they are wanted."""
    if not ways:
        print(f"{title}: nothing was seen")
        return
    way, times = ways.most_common(1)[0]
    files = list(dict.fromkeys(path for path, _, _ in way))
    arrows = {(caller, path) for path, _, caller in way if caller not in ("", path)}
    mutual = sorted(pair for pair in arrows if pair[::-1] in arrows and pair[0] < pair[1])
    changes = sum(one[0] != other[0] for one, other in itertools.pairwise(way))
    print(f"{title}: {len(files)} files, {len(way)} calls, {changes} changes of file ({times} of {ways.total()} alike)")
    for path in files:
        print(f"    {path}")
    for one, other in mutual:
        print(f"  both ways: {one} and {other}")
    if calls:
        print(*(f"        {path}: {name}" for path, name, _ in way), sep="\n")


def main() -> None:
    """Measure one protocol."""
    protocol = next((argument for argument in sys.argv[1:] if not argument.startswith("-")), "tcpudp")
    ways = asyncio.run(measure(protocol))
    show("in (a drive from the bus to the robot's socket)", ways.ways_in, calls="--calls" in sys.argv)
    show("out (a frame from the robot's socket to the bus)", ways.ways_out, calls="--calls" in sys.argv)


if __name__ == "__main__":
    main()
