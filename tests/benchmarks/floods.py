"""Measure what floods do to the holder, to everybody's queries and to the gateway's memory.

    python -m tests.benchmarks.floods                          # all kinds, both ways, about eight minutes
    python -m tests.benchmarks.floods --kinds drives forged --rates 10000 40000 75000 0
    python -m tests.benchmarks.floods --ways router --seconds 2

Run it from the root of a checkout, on a machine that does nothing else. Every run has processes of its own: the real
``python -m zbridge run`` with ``gap_s = 0``, a robot on plain sockets, the holder that drives at 40/s, the one that
floods, and, for the way "router", a router that all of them are linked to (else they are linked to the gateway). First
the holder drives in peace, then under the flood. Meanwhile the harness asks for the gateway's sessions twenty times a
second, and reads its memory. A flood of stops or takeovers ends the lease: then what counts is when the last motion
came to the robot.
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import zenoh

from tests.benchmarks.flooder import KINDS
from tests.benchmarks.harness import WAIT_S, BenchmarkError, memory_mb
from tests.benchmarks.peer import ROBOT, open_session
from tests.benchmarks.scene import WARM, Drive, Through, scene

DRIVE_HZ = 40.0
RATES_HZ: dict[str, tuple[float, ...]] = {
    "drives": (20_000, 75_000, 0),
    "express": (40_000, 0),
    "forged": (20_000, 75_000, 0),
    "acquires": (10_000, 20_000, 0),
    "renewals": (10_000, 0),
    "scans": (200, 0),
    "raws": (200,),
    "small": (1000,),
    "stops": (75_000, 0),
    "takeovers": (10_000, 0),
}
ENDING = ("stops", "takeovers")
"""Floods that end the lease."""
_ASK_S = 0.05
_AFTER_S = 1.0
_SESSIONS = f"fleet/{ROBOT}/@rpc/sessions/gateway"


@dataclass
class Watch:
    """Asks the gateway and reads its memory, on a thread of its own, until it is closed."""

    session: zenoh.Session
    pid: int
    answers_s: list[float] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    _closed: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def __enter__(self) -> Watch:
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed.set()
        assert self._thread is not None
        self._thread.join(WAIT_S)

    def _run(self) -> None:
        while not self._closed.wait(_ASK_S):
            self.memory_mb.append(memory_mb(self.pid))
            begun = time.perf_counter()
            replies = [reply for reply in self.session.get(_SESSIONS, timeout=WAIT_S / 2) if reply.ok is not None]
            self.answers_s.append(time.perf_counter() - begun if replies else WAIT_S)


@dataclass(frozen=True)
class Row:
    """What one flood did."""

    way: str
    kind: str
    wished_hz: float
    rate_hz: float
    quiet: Drive
    flooded: Drive
    last_motion_s: float | None
    """Seconds from the flood's begin to the last motion the robot was sent, None where there was none after it."""
    stopped_s: float | None
    """Seconds from the flood's begin to the first stop the robot was sent."""
    answer_s: float
    before_mb: float
    most_mb: float
    after_mb: float
    counted: dict[str, int]

    def __str__(self) -> str:
        wished = f"{self.wished_hz:,.0f}" if self.wished_hz else "unpaced"
        text = f"{self.way:<7} {self.kind:<10} {wished:>8} {self.rate_hz:>9,.0f}  "
        quiet = f"{self.quiet.median_us / 1e3:6.2f} {self.quiet.p99_us / 1e3:6.1f}  "
        if self.kind in ENDING:
            text += f"{quiet}stop {_ms(self.stopped_s):>6} last motion {_ms(self.last_motion_s):>6}  "
        elif self.flooded.latencies_us:
            ratio = self.flooded.median_us / self.quiet.median_us
            text += f"{quiet}{self.flooded.median_us / 1e3:6.2f} {self.flooded.p99_us / 1e3:7.1f} {ratio:5.1f} "
            text += f"{self.flooded.arrived:4.0%}  "
        else:
            text += f"{quiet}nothing arrived           "
        return text + f"{self.answer_s:6.3f}  {self.before_mb:5.0f} {self.most_mb:5.0f} {self.after_mb:5.0f}"


HEAD = (
    f"{'way':<7} {'flood':<10} {'wished/s':>8} {'reached/s':>9}  {'quiet median, p99':>14} {'flooded, p99':>13}"
    f" {'ratio':>5} {'got':>4}  {'answer':>6}  {'MB':>5} {'most':>5} {'after':>5}   (ms; s; before, most, after)"
)


def _since(begun_ns: int, at_ns: int | None) -> float | None:
    return None if at_ns is None else (at_ns - begun_ns) / 1e9


def _ms(seconds: float | None) -> str:
    return "none" if seconds is None else f"{seconds * 1e3:.0f} ms"


def measure(way: str, kind: str, rate_hz: float, seconds: float, quiet_s: float | None = None) -> Row:
    """Set a scene up, drive in peace, and drive on under a flood."""
    with scene(Through.GATEWAY, router=way == "router") as running:
        flooder = running.start("flooder", running.endpoint)
        flooder.hear()
        lease = running.lease()
        with open_session(connect=running.endpoint, shared_memory=False) as session:
            wait_ready(session)
            quiet = running.drive(DRIVE_HZ, int(DRIVE_HZ * (quiet_s or seconds)))
            before_mb, before = memory_mb(running.tested.pid), running.counters()
            with Watch(session, running.tested.pid) as watch:
                first = running.begin(DRIVE_HZ, int(DRIVE_HZ * (seconds + WAIT_S)))
                time.sleep((WARM + 1) / DRIVE_HZ)
                flooder.say(f"flood {kind} {rate_hz} {seconds} {lease}")
                sent = flooder.hear(seconds + 2 * WAIT_S)
                flooded, moved_ns, stopped_ns = running.halt(first, sent["begun_ns"], sent["ended_ns"])
                time.sleep(_AFTER_S)
            after = running.counters()
        moved_ns = [at_ns for at_ns in moved_ns if at_ns > sent["begun_ns"]]
        stopped_ns = [at_ns for at_ns in stopped_ns if at_ns > sent["begun_ns"]]
        return Row(
            way,
            kind,
            rate_hz,
            sent["sent"] / ((sent["ended_ns"] - sent["begun_ns"]) / 1e9),
            quiet,
            flooded,
            _since(sent["begun_ns"], max(moved_ns, default=None)),
            _since(sent["begun_ns"], min(stopped_ns, default=None)),
            max(watch.answers_s),
            before_mb,
            max(watch.memory_mb),
            memory_mb(running.tested.pid),
            {name: after[name] - before.get(name, 0) for name in after if after[name] != before.get(name, 0)},
        )


def wait_ready(session: zenoh.Session) -> None:
    """Wait until the gateway answers."""
    end = time.monotonic() + WAIT_S
    while not any(reply.ok for reply in session.get(_SESSIONS, timeout=1.0)):
        if time.monotonic() > end:
            raise BenchmarkError("nobody answered")


def runs(ways: Sequence[str], kinds: Sequence[str], rates: Sequence[float] | None) -> Iterator[tuple[str, str, float]]:
    """Give what is to be measured."""
    for kind in kinds:
        for way in ways:
            for rate_hz in rates if rates is not None else RATES_HZ[kind]:
                yield way, kind, rate_hz


def main() -> None:
    """Run what the arguments say; this is a report, not a test."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=tuple(KINDS), default=tuple(KINDS))
    parser.add_argument("--ways", nargs="+", choices=("router", "peer"), default=("router", "peer"))
    parser.add_argument("--rates", nargs="+", type=float, help="a second; 0: as fast as the bus takes it")
    parser.add_argument("--seconds", type=float, default=3.0, help="of peace, and of flood")
    parser.add_argument("--counted", action="store_true", help="show what the gateway counted")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the processes started are ended
    print(HEAD)
    for way, kind, rate_hz in runs(arguments.ways, arguments.kinds, arguments.rates):
        try:
            row = measure(way, kind, rate_hz, arguments.seconds)
        except BenchmarkError as error:
            print(f"{way:<7} {kind:<10} {rate_hz:>8,.0f} failed: {error}", flush=True)
            continue
        print(row, flush=True)
        if arguments.counted:
            print(f"        {row.counted}", flush=True)


if __name__ == "__main__":
    main()
