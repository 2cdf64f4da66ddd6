"""What ``zbridge ros2`` costs, against a bare Python relay in the same run: ``python -m tests.benchmarks.ros2``.

Two ways, by turns, message by message: through the view, and through a relay that subscribes, copies and puts.

- *scan*: from the socket of an ALF vehicle, through its gateway and the fleet's bus, to the callback of a subscriber on
  ROS's side; and, stricter, from the fleet's bus to that callback: only the view or the relay lies between.
- *Twist*: from a put on ROS's side to the socket of a TCP/UDP robot, through its gateway; and, stricter, to the fleet's
  bus. The view knows the publisher, scales its Twist, and proves the drive by a lease. The relay does nothing of that:
  the benchmark holds the lease, and gives it drives that are written and proven before the clock begins.

Both robots of a pair, and their gateways, are alike. Costs are processor time of the whole process, of its threads too.
"""

from __future__ import annotations

import argparse
import contextlib
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median

import msgpack
import zenoh

from tests.benchmarks.harness import cpu_s
from tests.benchmarks.paced import interval
from tests.benchmarks.ros2_scene import (
    RELAYED,
    ROBOTS,
    SCAN,
    TWIST,
    VIEWED,
    Scene,
    Vehicle,
    fleets_scan,
    number_in_cdr,
    number_in_msgpack,
    vehicles_scan,
)
from tests.e2e.conftest import Lease
from tests.e2e.rigs.robots import SCALE, Robot
from tests.proofs import packed

RATE_HZ, PAUSE_S, WARM, BLOCKS = 10.0, 0.005, 20, 20
TF = "tf2_msgs/msg/TFMessage"
NAMES = (f"{VIEWED}0", f"{RELAYED}0")
Put = Callable[[], object]


class Way:
    """One of the ways: the times from a put to its arrival, by number. prepare: returns what is to be put at once."""

    def __init__(self, prepare: Callable[[int], Put]) -> None:
        self.prepare = prepare
        self.times_us: list[float] = []
        self.lost = 0
        self._sent: tuple[int, int] = (-1, 0)
        self._came = threading.Event()

    def go(self, number: int) -> None:
        """Put, and wait for the arrival, for a second at most."""
        put = self.prepare(number)
        self._came.clear()
        self._sent = (number, time.perf_counter_ns())
        put()
        self.lost += not self._came.wait(1.0)

    def came(self, number: int, at_ns: int) -> None:
        """Note an arrival; the first one counts."""
        sent, sent_ns = self._sent
        if number == sent and not self._came.is_set():
            self.times_us.append((at_ns - sent_ns) / 1e3)
            self._came.set()


def compare(name: str, ways: tuple[Way, Way], count: int) -> None:
    """Go both ways by turns, and print how much longer the first one, the view's, takes."""
    for number in range(1, count + WARM + 1):
        for way in ways if number % 2 else ways[::-1]:
            way.go(number)
            time.sleep(PAUSE_S)
    (mine, other), lost = ([way.times_us[WARM:] for way in ways], [way.lost for way in ways])
    if min(len(mine), len(other)) < count / 2:
        print(f"{name}: lost {lost}: nothing is said")
        return
    size = max(1, min(len(mine), len(other)) // BLOCKS)
    blocks = [median(mine[at : at + size]) / median(other[at : at + size]) for at in range(0, size * BLOCKS, size)]
    low, high = interval(blocks)
    ratio = median(mine) / median(other)
    print(
        f"{name}: p50 {median(mine):.0f} us, relay {median(other):.0f} us, ratio {ratio:.2f} "
        f"(95 %: {low:.2f} to {high:.2f}), lost {lost}",
        flush=True,
    )


def scans(scene: Scene, count: int) -> None:
    """Measure scans from the robot's socket, and from the fleet's bus."""
    publishers = {name: scene.fleet.declare_publisher(f"fleet/{name}/scan", express=True) for name in NAMES}
    with scene.robots(Vehicle, "alf") as vehicles:
        robots = dict(zip(NAMES, vehicles, strict=True))
        for title, write, send in (
            ("scan, robot's socket to ROS", vehicles_scan, lambda name: robots[name].send),
            ("scan, fleet's bus to ROS", fleets_scan, lambda name: publishers[name].put),
        ):
            ways = tuple(
                Way(lambda number, name=name, write=write, send=send: _put(send(name), write(number))) for name in NAMES
            )
            with contextlib.ExitStack() as stack:
                for way, name, read in zip(ways, NAMES, (number_in_cdr, number_in_msgpack), strict=True):
                    _subscribe(stack, scene.ros.session, scene.key(name), way, read)
                time.sleep(1.0)
                compare(title, ways, count)


def twists(scene: Scene, count: int) -> None:
    """Measure Twists to the robot's socket, and to the fleet's bus."""
    no_gap = "gap_s = 0"  # a gateway keeps 5 ms between commands, which would hide what is measured
    with scene.robots(Told, "tcpudp", no_gap) as robots, contextlib.ExitStack() as stack:
        lease = Lease(scene.fleet, NAMES[1], "acquire", {"who": "bench", "deadman_s": 2.0})
        stack.callback(lease.close)
        publishers = [scene.ros.publisher(f"/{name}/cmd_vel", TWIST) for name in NAMES]
        for publisher in publishers:
            stack.callback(publisher.close)

        def twist(number: int) -> Put:
            payload = b"\x00\x01\x00\x00" + struct.pack("<6d", number / SCALE, 0, 0, 0, 0, 0)
            return lambda: publishers[0].put_payload(payload)

        def drive(number: int) -> Put:
            payload = packed({"forward": number / SCALE, "left": 0.0, "turn": 0.0})
            beside = lease.held.attachment("drive", payload)
            return lambda: publishers[1].put_payload(payload, beside)

        for title in ("Twist, ROS to robot's socket", "Twist, ROS to fleet's bus"):
            ways = Way(twist), Way(drive)
            with contextlib.ExitStack() as inner:
                for way, name, robot in zip(ways, NAMES, robots, strict=True):
                    if "bus" in title:
                        _subscribe(inner, scene.fleet, f"fleet/{name}/@cmd/drive", way, _number_of_drive)
                    else:
                        robot.came = way.came
                begin(ways)
                compare(title, ways, count)


def begin(ways: tuple[Way, Way]) -> None:
    """Let the view get to know the publisher, and get the lease; numbers that count are not used."""
    ends_at = time.monotonic() + 3.0
    while time.monotonic() < ends_at:
        for way in ways:
            way.prepare(100_000 if time.monotonic() > ends_at - 1.5 else 0)()
        time.sleep(0.02)


class Told(Robot):
    """A robot that tells the number of each command as soon as it has read it."""

    def __init__(self) -> None:
        self.came: Callable[[int, int], None] = lambda number, at_ns: None
        super().__init__()
        self.frames = _Told(self)  # type: ignore[assignment]


class _Told(list):  # type: ignore[type-arg]
    def __init__(self, robot: Told) -> None:
        super().__init__()
        self._robot = robot

    def append(self, frame: object) -> None:
        at_ns = time.perf_counter_ns()
        super().append(frame)
        if frame.moves:  # type: ignore[attr-defined]
            self._robot.came(frame.number, at_ns)  # type: ignore[attr-defined]


def _put(send: Callable[[bytes], object], data: bytes) -> Put:
    return lambda: send(data)


def _subscribe(
    stack: contextlib.ExitStack, session: zenoh.Session, key: str, way: Way, read: Callable[[bytes], int]
) -> None:
    def take(sample: zenoh.Sample) -> None:
        at_ns = time.perf_counter_ns()
        way.came(read(sample.payload.to_bytes()), at_ns)

    stack.callback(session.declare_subscriber(key, take).undeclare)


def _number_of_drive(payload: bytes) -> int:
    return round(msgpack.unpackb(payload)["forward"] * SCALE)


# Costs


@contextlib.contextmanager
def published(
    scene: Scene, robots: list[str], kinds: dict[str, Callable[[], bytes]], *, evenly: bool
) -> Iterator[list[int]]:
    """Let robots publish at RATE_HZ, all at once or evenly in turn; the list holds how often each has."""
    ended, rounds = threading.Event(), [0]
    ways = [(scene.fleet.declare_publisher(f"fleet/{robot}/{kind}"), kinds[kind]) for robot in robots for kind in kinds]

    def go_on() -> None:
        due, pause_s = time.monotonic(), 1 / RATE_HZ / (len(ways) if evenly else 1)
        while not ended.is_set():
            payloads = {make: make() for make in kinds.values()}
            for number, (publisher, make) in enumerate(ways):
                if evenly or not number:
                    due += pause_s
                    time.sleep(max(0.0, due - time.monotonic()))
                publisher.put(payloads[make])
            rounds[0] += 1

    thread = threading.Thread(target=go_on, daemon=True)
    thread.start()
    try:
        yield rounds
    finally:
        ended.set()
        thread.join()


def cost(
    scene: Scene,
    pid: int,
    robots: list[str],
    kinds: dict[str, Callable[[], bytes]],
    keys: list[str],
    seconds: float,
    *,
    evenly: bool = False,
) -> tuple[float, float]:
    """Return a process's share of a core, and its processor time for each round of a robot in microseconds."""
    kept = [scene.ros.session.declare_subscriber(key, lambda sample: None) for key in keys]
    with published(scene, robots, kinds, evenly=evenly) as rounds:
        time.sleep(1.0)
        before, at, made = cpu_s(pid), time.monotonic(), rounds[0]
        time.sleep(seconds)
        used, passed, made = cpu_s(pid) - before, time.monotonic() - at, rounds[0] - made
    for subscriber in kept:
        subscriber.undeclare()
    return used / passed, used / (made * len(robots)) * 1e6


def costs(scene: Scene, seconds: float, turns: int) -> None:
    """Print what 30 robots cost; scans by turns through the view and the relay."""
    pose = msgpack.packb({"x": 1.0, "y": 2.0, "heading": 0.5})
    motion = msgpack.packb({"speed": 0.5, "gyro": [0.0, 0.0, 0.1], "acceleration": [0.0, 0.0, 9.8]})
    alone = {"scan": lambda: fleets_scan(1)}
    everything = {**alone, "pose": lambda: pose, "motion": lambda: motion}
    mine, bare = ([f"{first}{number}" for number in range(1, ROBOTS + 1)] for first in (VIEWED, RELAYED))
    for evenly in (False, True):
        taken = [
            [
                cost(scene, pid, robots, alone, [scene.key(name) for name in robots], seconds / turns, evenly=evenly)
                for pid, robots in ((scene.view, mine), (scene.relay, bare))
            ]
            for _ in range(turns)
        ]
        how = "evenly in turn" if evenly else "at once"
        for name, of_one in zip(("view", "relay"), zip(*taken, strict=True), strict=True):
            each_us = [us for _, us in of_one]
            low, high = interval(each_us)
            share = median(share for share, _ in of_one)
            print(
                f"{name}: scans of {ROBOTS} robots at {RATE_HZ:g} Hz, {how}: {share:.1%} of a core, "
                f"{median(each_us):.0f} us a scan (95 %: {low:.0f} to {high:.0f})",
                flush=True,
            )
    watched = {SCAN: "scan", "nav_msgs/msg/Odometry": "odom", "sensor_msgs/msg/Imu": "imu", TF: "tf"}
    keys = [scene.key(robot, kind, name) for robot in mine for kind, name in watched.items()]
    for evenly in (False, True):
        how = "evenly in turn" if evenly else "at once"
        share, _ = cost(scene, scene.view, mine, everything, keys, seconds, evenly=evenly)
        print(f"{ROBOTS} robots at {RATE_HZ:g} Hz, {how}, scan, odom, imu and tf watched: {share:.1%} of a core")
    share, _ = cost(scene, scene.view, mine, everything, [], seconds)
    print(f"{ROBOTS} robots at {RATE_HZ:g} Hz, nobody listens: {share:.2%} of a core", flush=True)


MEASURES = ("scans", "twists", "costs")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=1000, help="scans and Twists each way")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each measurement of costs")
    parser.add_argument("--turns", type=int, default=8, help="of the view and the relay in these seconds")
    parser.add_argument("--only", nargs="+", choices=MEASURES, default=MEASURES)
    given = parser.parse_args()
    with contextlib.ExitStack() as stack:
        scene = Scene(stack, Path(stack.enter_context(tempfile.TemporaryDirectory())))
        if "scans" in given.only:
            scans(scene, given.count)
        if "twists" in given.only:
            twists(scene, given.count)
        if "costs" in given.only:
            costs(scene, given.seconds, given.turns)


if __name__ == "__main__":
    main()
