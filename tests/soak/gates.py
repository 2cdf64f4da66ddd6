"""What is measured in quiet minutes, and the limits of it, as a table."""

from __future__ import annotations

import contextlib
import socket
import statistics
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from tests.e2e.conftest import until
from tests.e2e.measured.hq_churn import use
from tests.e2e.rigs.robots import SCALE
from tests.soak.scene import COUNTED, LOSS_COUNTERS, Scene

WARM_UP_S = 600.0
MOST_MEMORY, MOST_P50, MOST_P99 = 0.05, 0.10, 0.20
QUIET_S, REST_S = 8.0, 3.0
RATE_HZ = 25.0
LABELS = {"pose_s": "pose, robot to bus", "drive_s": "drive, bus to robot"}


@dataclass
class Window:
    """One quiet time: latencies in seconds, and what each process used afterwards, at rest."""

    at: float
    pose_s: list[float]
    drive_s: list[float]
    undriven: int
    """Commands that did not arrive."""
    echo_s: list[float]
    """Of datagrams to the robot's process and back, over the same links: what a busy machine does to all."""
    use: dict[str, dict[str, int]]


@dataclass
class Gate:
    """One row of the table."""

    what: str
    early: str
    late: str
    limit: str
    good: bool

    def __str__(self) -> str:
        return f"| {self.what} | {self.early} | {self.late} | {self.limit} | {'yes' if self.good else 'NO'} |"


@dataclass
class Measured:
    """All windows of a run."""

    windows: list[Window] = field(default_factory=list)
    _numbers: int = SCALE // 10

    def measure(self, scene: Scene) -> Window:
        """Measure while nothing fails and nobody else drives."""
        until(lambda: _held(scene), 10, "the counted robot's lease")
        began, scene.losses.late_s = time.monotonic(), []
        sent, echo_s = self._drive(scene)
        pose_s = [*scene.losses.late_s]
        got = {number: at for at, number in scene.driven}
        scene.driven.clear()
        drive_s = [got[number] - at for number, at in sent.items() if number in got]
        scene.fleet.release(COUNTED)
        time.sleep(REST_S)
        used = {name: use(pid) for name, pid in scene.pids().items()}
        window = Window(began, pose_s, drive_s, len(sent) - len(drive_s), echo_s, used)
        self.windows.append(window)
        return window

    def _drive(self, scene: Scene) -> tuple[dict[int, float], list[float]]:
        """Drive the counted robot, each command a number of its own; tell when each was given, and each echo's time."""
        sent: dict[int, float] = {}
        echo_s: list[float] = []
        ends_at = time.monotonic() + QUIET_S
        while time.monotonic() < ends_at:
            self._numbers = SCALE // 10 + (self._numbers - SCALE // 10 + 7) % (SCALE * 8 // 10)
            sent[self._numbers] = time.monotonic()
            scene.fleet.put(f"{COUNTED}/@cmd/drive", forward=self._numbers / SCALE, left=0.0, turn=0.0)
            time.sleep(0.5 / RATE_HZ)
            echo_s += _echo(scene.field_link.far, scene.counted_port)
            time.sleep(0.5 / RATE_HZ)
        scene.fleet.put(f"{COUNTED}/@cmd/drive", forward=0.0, left=0.0, turn=0.0)
        time.sleep(0.3)
        return sent, echo_s

    def gates(self, began: float, seconds: float) -> Iterator[Gate]:
        """Compare the first third of the windows after the warm-up with the last third."""
        warm_s = min(WARM_UP_S, seconds / 6)
        windows = [window for window in self.windows if window.at - began >= warm_s]
        third = max(1, len(windows) // 3)
        early, late = windows[:third], windows[-third:]
        if len(windows) < 2:
            yield Gate("quiet windows", str(len(windows)), "", "2 or more", False)
            return
        for name in early[0].use:
            yield self._growth(name, "kB", early, late, MOST_MEMORY)
            yield self._growth(name, "files", early, late, 0.0)
        for label, share, most in (("p50", 0.5, MOST_P50), ("p99", 0.99, MOST_P99)):
            echo = [quantile([s for window in part for s in window.echo_s], share) for part in (early, late)]
            yield Gate(f"datagram to the robot and back, {label}", _ms(echo[0]), _ms(echo[1]), "for comparison", True)
            for what in ("pose_s", "drive_s"):
                times = [quantile([s for one in part for s in getattr(one, what)], share) for part in (early, late)]
                drift = times[1] / times[0] / max(1.0, echo[1] / echo[0]) - 1
                limit = f"{drift:+.1%} < {most:.0%}"
                yield Gate(f"{LABELS[what]}, {label}", _ms(times[0]), _ms(times[1]), limit, drift < most)

    def _growth(self, name: str, what: str, early: list[Window], late: list[Window], most: float) -> Gate:
        before, after = (statistics.median(window.use[name][what] for window in part) for part in (early, late))
        growth = after / before - 1
        good, limit = (growth < most, f"{growth:+.1%} < {most:.0%}") if most else (after <= before, "no more")
        label = {"kB": "resident memory, kB", "files": "descriptors"}[what]
        return Gate(f"{name}: {label}", f"{before:.0f}", f"{after:.0f}", limit, good)


def _held(scene: Scene) -> bool:
    """Acquire the counted robot; a lease of the window before may not have ended yet."""
    try:
        scene.fleet.hold(COUNTED, "soak", deadman_s=0.5)
    except AssertionError:
        return False
    return True


def _echo(host: str, port: int) -> list[float]:
    """Send a datagram, and give the seconds until it is back; none if it is lost."""
    with socket.socket(type=socket.SOCK_DGRAM) as udp:
        udp.settimeout(0.5)
        at = time.monotonic()
        udp.sendto(b"echo", (host, port))
        with contextlib.suppress(TimeoutError):
            udp.recv(100)
            return [time.monotonic() - at]
    return []


def _ms(seconds: float) -> str:
    return f"{seconds * 1000:.2f} ms"


def quantile(values: Sequence[float], share: float) -> float:
    """Give the value below which this share of the values is; not a number where there are none."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")


def loss_gates(scene: Scene, bus_faults: list[tuple[float, float]]) -> Iterator[Gate]:
    """Hold the positions that were lost against the faults of the bus, and what the gateway counted."""
    losses = scene.losses
    others = sum(n for begun, ended, n in losses.lost if not _touches(begun, ended, bus_faults))
    by_faults = sum(n for *_, n in losses.lost) - others
    counters = scene.counters()
    counted = sum(counters[name] for name in LOSS_COUNTERS)
    yield Gate("positions that came", str(losses.came), "", "some", losses.came > 0)
    yield Gate("positions lost while the bus was cut or its router away", str(by_faults), "", "any", True)
    yield Gate("other positions lost; counted", str(others), str(counted), "no fewer", others <= counted)
    yield Gate("positions out of order, or twice", str(losses.disordered), "", "0", not losses.disordered)


def _touches(begun: float, ended: float, spans: list[tuple[float, float]]) -> bool:
    return any(begun < end and ended > begin for begin, end in spans)
