"""Losing what drives a robot, or what stands between them: the scenery, and the measuring of how long it moves on.

A real gateway process and a router in processes of their own, and a robot on a real socket, played here. The time runs
from the first arrival of the last motion at the robot to the first stop that arrives there.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import os
import random
import select
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgpack
import zenoh

from tests.e2e.conftest import HOST, Gateway, Lease, configuration, device, end, until
from tests.e2e.rigs.processes import LINE_S, Finding, Part, Road, frozen, go_apart, module
from tests.e2e.rigs.robots import SCALE, STOP, Frame, Robot
from tests.machine import Withheld, contended_s
from tests.ports import free_port
from tests.proofs import packed
from zbridge.bus.interface import FULL_QUEUES

LATE_S = 0.05
"""Seconds after the deadman in which the stop must be at the robot."""
FROZEN_S = 0.8
"""Seconds for which something is frozen after the deadman."""
READ_S = 0.2
"""Seconds that the robot is given to read what was written before that."""
DISTURBED = 8
"""Repetitions that may be done again at least."""
IN_HAND = 3
"""Commands that may have come since the last one that was written, and not be written yet."""


# The bus


def query(session: zenoh.Session, path: str, payload: bytes = b"", **fields: Any) -> dict[str, Any]:
    """Ask ``fleet/r1/<path>``; {} where nobody answers or the question was refused."""
    replies = session.get(f"fleet/r1/{path}", payload=payload or packed(fields), timeout=1.0)
    answers = [msgpack.unpackb(reply.ok.payload.to_bytes()) for reply in replies if reply.ok]
    return answers[0] if answers else {}


def commander(session: zenoh.Session, path: str, robot: str = "r1") -> zenoh.Publisher:
    """Declare a publisher for ``fleet/<robot>/@cmd/<path>``, of the class that the design gives a command."""
    return session.declare_publisher(
        f"fleet/{robot}/@cmd/{path}",
        priority=zenoh.Priority.REAL_TIME,
        congestion_control=zenoh.CongestionControl.DROP if path == "drive" else zenoh.CongestionControl.BLOCK,
        express=True,
    )


def be_router(endpoint: str) -> None:
    """Be a router until stdin ends."""
    config = configuration("router", endpoint)
    for path, waits_us in FULL_QUEUES.items():
        config.insert_json5(path, str(waits_us))
    with zenoh.open(config):
        print("open", flush=True)
        sys.stdin.read()


def router(stack: contextlib.ExitStack, endpoint: str) -> Part:
    """Start a router in a process of its own."""
    part = Part(stack, *module("tests.e2e.rigs.loss", "router", endpoint))
    assert part.line() == "open"
    return part


def driver(endpoint: str, robot: str, deadman_s: float, rate_hz: float, first: int, step: int = 1) -> list[str]:
    """Give the command of a driver; its motions are first, first + step, ... of SCALE."""
    return module("tests.e2e.rigs.loss", "driver", endpoint, robot, deadman_s, rate_hz, first, step)


def be_driver(endpoint: str, robot: str, deadman_s: str, rate_hz: str, first: str, step: str) -> None:
    """Acquire the lease and drive until stdin ends; then leave without a release.

    Words on stdin, each a neutral but the second: ``neutral``, ``silent``, ``again NUMBER``.
    """
    with zenoh.open(configuration("client", endpoint)) as session:
        alive = f"operator.driver.{session.zid()}"
        announced = session.liveliness().declare_token(f"fleet/{robot}/@alive/{alive}")
        wishes = {"who": "driver", "deadman_s": float(deadman_s), "lease_s": 1.0, "alive": alive}
        lease = until(lambda: _acquired(session, robot, wishes), LINE_S, "the lease")
        commands = commander(session, "drive", robot)

        def drive(number: int) -> None:
            command = packed({"forward": number / SCALE})
            commands.put(command, attachment=lease.held.attachment("drive", command))

        number: int | None = int(first)
        while not lease.lost:
            if number is not None:
                drive(number)
                number += int(step)
            if not select.select([sys.stdin], [], [], 1 / float(rate_hz))[0]:
                continue
            if not (words := sys.stdin.readline().split()):
                break
            number = int(words[1]) if words[1:] else None
            if words[0] != "silent":
                drive(0)
        announced.undeclare()


def _acquired(session: zenoh.Session, robot: str, wishes: dict[str, Any]) -> Lease | None:
    with contextlib.suppress(AssertionError):
        return Lease(session, robot, "acquire", wishes)
    return None


# The scene


class Scene:
    """A robot, its gateway, a router, an onlooker on the bus, and the driver of the moment."""

    driven_s = (0.2, 0.5)
    """The shortest and the longest time for which it is driven before something is lost."""

    def __init__(
        self, stack: contextlib.ExitStack, *, cut: bool = False, parts: str = "", deadman_s: float = 0.0
    ) -> None:
        self.faults: list[str] = []
        self.stack, self.deadman_s = stack, deadman_s
        self.robot = Robot()
        stack.callback(self.robot.close)
        self._withheld = Withheld()
        self.road = Road(stack) if cut else None
        self.here = self.road.near if self.road else HOST
        """Where a driver finds what listens here."""
        port = free_port()
        self.endpoint = f"tcp/{HOST}:{port}"
        self._listen = f"tcp/0.0.0.0:{port}" if cut else self.endpoint
        self.reach = f"tcp/{self.here}:{port}"
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        self.router = router(stack, self._listen)
        self._parts = device(self.robot.port) + parts
        self.gateway = self.run("gateway", self._parts)
        self.session = stack.enter_context(zenoh.open(configuration("client", self.endpoint)))
        self._stop = commander(self.session, "stop")
        self._driver: Part | None = None
        self.wait()

    def drive(self, rng: random.Random) -> int:
        """Start a driver, wait until the robot moves, and tell which of its packets was the first motion."""
        raise NotImplementedError

    @property
    def late_s(self) -> float:
        """The time that this machine withheld so far from what happens here: what excuses a delay."""
        pids = [self.router.pid, self.gateway.process.pid, self.driver.pid]
        return max(contended_s(), self._withheld.seconds(pids))

    @property
    def driver(self) -> Part:
        """The driver's process."""
        assert self._driver is not None
        return self._driver

    def start_driver(self, *command: str) -> None:
        """Start a driver's process, at the end of the road if there is one."""
        self._driver = Part(self.stack, *(self.road.enter if self.road is not None else ()), *command)

    def end_driver(self) -> None:
        """End the driver of the moment, whatever state it is in."""
        self.driver.kill()

    def moved(self, begun: int) -> int | None:
        """Find the first motion among the robot's packets from ``begun`` on."""
        frames = self.robot.frames
        return next((index for index in range(begun, len(frames)) if frames[index].moves), None)

    def stop(self) -> None:
        """Stop the robot, as anybody may."""
        self._stop.put(packed({}))

    def wait(self) -> None:
        """Wait until the gateway is on the bus and the robot can be used."""
        until(lambda: query(self.session, "status").get("state") == "established", what="established")

    def restart_router(self) -> None:
        """Start the router again."""
        self.router.kill()
        self.router = router(self.stack, self._listen)
        self.wait()

    def restart_gateway(self) -> None:
        """Start the gateway again."""
        self.gateway = self.run("gateway", self._parts, self.gateway)
        self.wait()

    def run(self, name: str, parts: str, former: Gateway | None = None) -> Gateway:
        """Start a process of ``zbridge`` for this robot and bus."""
        if former is not None:
            end(former.process, signal.SIGKILL)
        return Gateway(self.stack, self.folder / f"{name}.toml", self.endpoint, parts)


S = TypeVar("S", bound=Scene)


# The ways to be lost. What is done to mend it must not move the robot


@dataclass(frozen=True)
class Way(Generic[S]):
    """One way to lose the driver, or what stands between it and the robot."""

    lose: Callable[[S], object]
    mend: Callable[[S], object] = lambda scene: None
    often: bool = False
    at_once: bool = False
    """Others see it: nobody has to wait for the deadman."""
    connection_ends: bool = False
    """The robot gets no stop: its connection ends."""
    resumes: bool = False
    """The time runs from when it continues, and then the stop must come before everything else."""


def cut_off(scene: Scene) -> None:
    assert scene.road is not None
    scene.road.cut()


def mend_road(scene: Scene) -> None:
    assert scene.road is not None
    scene.road.mend()
    time.sleep(0.5)  # what waits in TCP's queues is sent again only now


def freeze_gateway(scene: Scene) -> float:
    """Freeze the gateway while the driver drives on; the time runs from when it continues."""
    scene.gateway.signal(signal.SIGSTOP)
    until(lambda: frozen(scene.gateway.process.pid), what="a frozen gateway")
    time.sleep(READ_S)
    quiet = len(scene.robot.frames)
    time.sleep(scene.deadman_s + FROZEN_S)
    if len(scene.robot.frames) > quiet:
        scene.faults.append("a frozen gateway wrote to the robot")
    at = time.monotonic()
    scene.gateway.signal(signal.SIGCONT)
    return at


def see_off(scene: Scene, process: Gateway) -> None:
    """Wait for the end of a process that was told to end."""
    code = process.process.wait(timeout=5)
    if code != 0:
        scene.faults.append(f"a process of zbridge ended with {code}")


EVERYWHERE: dict[str, Way[Any]] = {
    "killed": Way(lambda scene: scene.driver.signal(signal.SIGKILL), often=True, at_once=True),
    "frozen": Way(
        lambda scene: scene.driver.signal(signal.SIGSTOP),
        lambda scene: scene.driver.signal(signal.SIGCONT),
        often=True,
    ),
    "cut": Way(cut_off, mend_road, often=True),
    "gateway-frozen": Way(freeze_gateway, resumes=True),
}
"""Ways in which any driver may be lost."""


# Measuring


def stop_since(frames: list[Frame], begun: int, lost_at: float) -> int | None:
    """Find the first stop that came after the loss."""
    found = (i for i in range(begun, len(frames)) if frames[i].packet_id == STOP and frames[i].at >= lost_at)
    return next(found, None)


@dataclass
class Result(Finding):
    """What was measured of one way, in seconds."""

    way: str
    limit_s: float
    """The longest time from the last motion, or from the loss, to the stop."""
    from_loss: bool = False
    since_motion_s: list[float] = field(default_factory=list)
    since_loss_s: list[float] = field(default_factory=list)
    disturbed: int = 0
    """Repetitions that were done again: the driver was late and stopped before it was lost, or the machine was late."""
    machine_late_s: float = 0.0
    """How late this machine was at most while a stop was awaited, whatever it had to do."""

    @property
    def late_s(self) -> list[float]:
        """The times that are too long."""
        times_s = self.since_loss_s if self.from_loss else self.since_motion_s
        return [time_s for time_s in times_s if time_s > self.limit_s]

    @property
    def clean(self) -> bool:
        """Whether every stop came in time and nothing moved after it."""
        return super().clean and bool(self.since_loss_s) and not self.late_s

    def __str__(self) -> str:
        times = [*_distribution(self.since_motion_s), *_distribution(self.since_loss_s), f"{self.limit_s * 1000:.0f}"]
        counts = [len(self.late_s), self.disturbed, len(self.faults), f"{self.machine_late_s * 1000:.1f}"]
        return _row(self.way, len(self.since_loss_s), *times, "loss" if self.from_loss else "motion", *counts)


def _row(way: str, *cells: object) -> str:
    return f"{way:29}" + "".join(f" {cell!s:>8}" for cell in cells)


def heading() -> str:
    """Give the heading of the rows of results."""
    four = ("least", "median", "p99", "most")
    return (
        "Milliseconds to the first stop at the robot's socket. gateway-killed: to the end of the connection, there is\n"
        "no stop; gateway-frozen, process-frozen: since it continues. machine: how late the machine was, at most.\n"
        f"{'':38}{'since the last motion':^36}{'since the loss':^36}\n"
        + _row("way", "n", *four, *four, "limit", "since", "late", "again", "faults", "machine")
    )


def _distribution(times_s: list[float]) -> list[str]:
    ordered = sorted(times_s)
    ranks = (0, (len(ordered) - 1) // 2, math.ceil(0.99 * len(ordered)) - 1, -1)
    return [f"{ordered[rank] * 1000:.1f}" if ordered else "-" for rank in ranks]


def measured(scene: S, way: Way[S], result: Result, *, repetitions: int, rng: random.Random) -> Result:
    """Lose the driver in one way again and again."""
    scene.faults = result.faults
    while len(result.since_loss_s) < repetitions:
        _lose(scene, way, rng, result)
        if result.disturbed > max(DISTURBED, repetitions // 10):
            scene.faults.append("disturbed again and again: this machine is too busy")
            break
    return result


def _lose(scene: S, way: Way[S], rng: random.Random, result: Result) -> None:
    """Let a driver drive, lose it, and note how long it took."""
    robot = scene.robot
    ends = len(robot.ended)
    begun = scene.drive(rng)
    time.sleep(rng.uniform(*scene.driven_s))
    if _stopped(robot.frames[begun:]):
        scene.end_driver()
        result.disturbed += 1
        return
    late_s, lost_at = scene.late_s, time.monotonic()
    resumed_at = way.lose(scene)
    lost_at = resumed_at if isinstance(resumed_at, float) else lost_at
    patience_s = result.limit_s + 10
    if way.connection_ends:
        until(lambda: len(robot.ended) > ends, patience_s, "end of the connection")
        stop_at, stop = robot.ended[ends], len(robot.frames)
    else:
        stop = until(lambda: stop_since(robot.frames, begun, lost_at), patience_s, "stop")
        stop_at = robot.frames[stop].at
    late_s = scene.late_s - late_s
    result.machine_late_s = max(result.machine_late_s, late_s)
    way.mend(scene)
    time.sleep(0.3)
    scene.end_driver()
    driven = robot.frames[begun:stop]
    scene.faults += _motion_faults(way, driven, robot.frames[stop:], lost_at, stop_at)
    if way.resumes and _in_hand(driven, lost_at):
        result.disturbed += 1
        return
    since = lost_at if result.from_loss else _last_motion(driven).at
    too_long_s = stop_at - since - result.limit_s
    if _stopped(driven) or 0 < too_long_s <= late_s:
        result.disturbed += 1
        return
    if too_long_s > 0:
        times = f"{(stop_at - since) * 1000:.0f} ms, {(stop_at - lost_at) * 1000:.0f} ms of it since the loss"
        scene.faults.append(f"late: {times}; this machine was late for {late_s * 1000:.0f} ms")
    result.since_loss_s.append(stop_at - lost_at)
    if not way.resumes:
        result.since_motion_s.append(stop_at - _last_motion(driven).at)


def _motion_faults(way: Way[S], driven: list[Frame], after: list[Frame], lost_at: float, stop_at: float) -> list[str]:
    """Tell of motions that should not have come, whoever was late."""
    found = []
    stale = [frame for frame in driven if frame.moves and frame.at >= lost_at]
    if way.resumes and stale and not _in_hand(driven, lost_at):
        numbers = f"{[frame.number for frame in stale]} after {_last_motion(driven[: -len(stale)]).number}"
        found.append(f"what continued sent {len(stale)} motions before its stop: {numbers}")
    if moved := [frame for frame in after if frame.moves]:
        found.append(f"{len(moved)} motions after the stop, the first {(moved[0].at - stop_at) * 1000:.0f} ms after it")
    return found


def _in_hand(driven: list[Frame], lost_at: float) -> bool:
    """Tell whether what continued first did what it was about to do when it was frozen, between its look and its write.

    That is one motion, that came just after the last one before. The last one again is not; and what waited meanwhile
    would be found every time.
    """
    before = [frame.number for frame in driven if frame.moves and frame.at < lost_at]
    after = [frame.number for frame in driven if frame.moves and frame.at >= lost_at]
    return bool(before) and len(after) == 1 and 0 < after[0] - before[-1] <= IN_HAND


def _stopped(frames: Iterable[Frame]) -> bool:
    return any(frame.packet_id == STOP for frame in frames)


def _last_motion(frames: list[Frame]) -> Frame:
    """Find the first arrival of the last value: a motion is repeated while the robot moves."""
    motions = [frame for frame in frames if frame.moves]
    first = len(motions) - 1
    while first and motions[first - 1].body == motions[-1].body:
        first -= 1
    return motions[first]


# The programs that measure


def options(doc: str | None, ways: Iterable[str], repetitions: int) -> argparse.ArgumentParser:
    """Give what all of them can be told."""
    parser = argparse.ArgumentParser(description=(doc or "").splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=repetitions)
    parser.add_argument("--way", choices=(*ways, "all"), default="all")
    parser.add_argument("--seed", type=int, default=os.getpid(), help="of the moments")
    return parser


def possible(program: str, way: str, ways: Iterable[str]) -> list[str]:
    """Give the ways that are wanted; become a program that can be cut off if that is among them. Print the heading."""
    wanted = [name for name in ways if way in ("all", name)]
    if "cut" in wanted and not go_apart(program):
        wanted.remove("cut")
    print(heading(), flush=True)
    return wanted


_PARTS: dict[str, Callable[..., None]] = {"router": be_router, "driver": be_driver}


if __name__ == "__main__":
    _PARTS[sys.argv[1]](*sys.argv[2:])
