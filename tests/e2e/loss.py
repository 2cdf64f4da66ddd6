"""Losing what drives a robot, or what stands between them: the scenery, and the measuring of how long it moves on.

A real gateway process and a router in processes of their own, and a robot on a real socket, played here. The time runs
from the first arrival of the last motion at the robot to the first stop that arrives there.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import random
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import msgpack
import zenoh

from tests.e2e.conftest import free_port, until
from tests.e2e.robots import SETTINGS
from tests.machine import contended_s

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
MOVE, ROTATE, STOP = 11, 12, 13
SCALE = 1_000_000
"""A driver's command number n is the speed n / SCALE."""


# The robot


class Frame(NamedTuple):
    """One packet that the robot got, and when."""

    at: float
    packet_id: int
    body: bytes

    @property
    def moves(self) -> bool:
        """Whether the packet sets the robot moving."""
        return self.packet_id in (MOVE, ROTATE)

    @property
    def number(self) -> int:
        """The driver's number of the command that this packet carries; negative when driving backwards."""
        _, forward, speed = struct.unpack("<fff", self.body)
        return round(forward * speed * SCALE)


class Robot:
    """A robot of the TCP/UDP package protocol: takes one HQ after the other, and keeps every packet with its time."""

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self.ended: list[float] = []
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._server.getsockname()[1])
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()

    def _serve(self) -> None:
        while True:
            try:
                peer, _ = self._server.accept()
            except OSError:
                return
            with peer, contextlib.suppress(OSError):
                peer.sendall(SETTINGS)
                self._read(peer)
            self.ended.append(time.monotonic())

    def _read(self, peer: socket.socket) -> None:
        waiting = b""
        while data := peer.recv(65536):
            at = time.monotonic()
            waiting += data
            while len(waiting) >= 4 and len(waiting) >= (end := 4 + int.from_bytes(waiting[:4], "little")):
                self.frames.append(Frame(at, waiting[5], waiting[6:end]))
                waiting = waiting[end:]


# The bus


def configuration(mode: str, endpoints: Iterable[str]) -> zenoh.Config:
    """Configure a session without multicast: a router that listens, or a client that connects."""
    config = zenoh.Config()
    config.insert_json5("mode", json.dumps(mode))
    config.insert_json5(f"{'listen' if mode == 'router' else 'connect'}/endpoints", json.dumps(list(endpoints)))
    config.insert_json5("scouting/multicast/enabled", "false")
    return config


def query(session: zenoh.Session, path: str, payload: bytes = b"", **fields: Any) -> dict[str, Any]:
    """Ask ``fleet/r1/<path>``; {} where nobody answers or the question was refused."""
    replies = session.get(f"fleet/r1/{path}", payload=payload or msgpack.packb(fields), timeout=1.0)
    answers = [msgpack.unpackb(reply.ok.payload.to_bytes()) for reply in replies if reply.ok]
    return answers[0] if answers else {}


def commander(session: zenoh.Session, path: str) -> zenoh.Publisher:
    """Declare a publisher for ``fleet/r1/@cmd/<path>``, of the class that the design gives a command."""
    return session.declare_publisher(
        f"fleet/r1/@cmd/{path}",
        priority=zenoh.Priority.REAL_TIME,
        congestion_control=zenoh.CongestionControl.DROP if path == "drive" else zenoh.CongestionControl.BLOCK,
        express=True,
    )


def be_router(endpoint: str) -> None:
    """Be a router until stdin ends."""
    with zenoh.open(configuration("router", [endpoint])):
        print("open", flush=True)
        sys.stdin.read()


# Processes


def start(*command: str) -> subprocess.Popen[str]:
    """Start a part of the scene that ends when its stdin does."""
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def kill(process: subprocess.Popen[str]) -> None:
    """End a process by its id, whatever state it is in; idempotent."""
    process.kill()
    process.wait()
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            stream.close()


def frozen(pid: int) -> bool:
    """Tell whether every thread of a process stands still: on a busy machine some are told late."""
    states = [(task / "stat").read_text().rpartition(")")[2].split()[0] for task in Path(f"/proc/{pid}/task").iterdir()]
    return set(states) == {"T"}


def part(name: str, *arguments: object) -> list[str]:
    """Give the command that runs a part of this module."""
    return [sys.executable, "-m", "tests.e2e.loss", name, *map(str, arguments)]


class Watch:
    """A process on each processor that sleeps and wakes: late, that processor was late with everything."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self._late: list[list[tuple[float, float]]] = []
        for processor in sorted(os.sched_getaffinity(0))[:8]:
            process = start(*part("watch", processor))
            stack.callback(kill, process)
            late: list[tuple[float, float]] = []
            self._late.append(late)
            reader = threading.Thread(target=self._read, args=(process, late), daemon=True)
            reader.start()
            stack.callback(reader.join)  # the end of the process ends it, however late; only then the pipe is closed
            stack.callback(process.kill)

    @property
    def late_s(self) -> float:
        """The longest time that one was late."""
        return max((woke - due for late in self._late for due, woke in late), default=0.0)

    def late_between(self, begin: float, end: float) -> float:
        """Give how much of a stretch of time one was late for, seconds."""
        return max(sum(max(0.0, min(woke, end) - max(due, begin)) for due, woke in late) for late in self._late)

    @staticmethod
    def _read(process: subprocess.Popen[str], late: list[tuple[float, float]]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            if line.endswith("\n"):  # a process that is killed may leave a part of one
                due, woke = map(float, line.split())
                late.append((due, woke))


def be_watch(processor: int) -> None:
    """Tell when we should have woken and when we did, where that differs by more than 5 ms, until stdin ends."""
    os.sched_setaffinity(0, {processor})
    due = time.monotonic() + 0.005
    while not select.select([sys.stdin], [], [], max(0.0, due - time.monotonic()))[0]:
        woke = time.monotonic()
        if woke - due > 0.005:
            print(due, woke, flush=True)
        due = time.monotonic() + 0.005


class Cable:
    """A network namespace for the driver, and a cable to it. To be used in a namespace of the test's own."""

    HERE, THERE = "10.77.0.1", "10.77.0.2"

    def __init__(self, stack: contextlib.ExitStack) -> None:
        keeper = start("unshare", "--net", "cat")
        stack.callback(kill, keeper)
        assert keeper.stdin is not None
        assert keeper.stdout is not None
        keeper.stdin.write("there\n")
        keeper.stdin.flush()
        assert keeper.stdout.readline() == "there\n"
        self.enter = ("nsenter", "--target", str(keeper.pid), "--net")
        _run("ip", "link", "set", "lo", "up")
        _run("ip", "link", "add", "here", "type", "veth", "peer", "name", "there", "netns", str(keeper.pid))
        _run("ip", "address", "add", f"{self.HERE}/30", "dev", "here")
        _run("ip", "link", "set", "here", "up")
        _run(*self.enter, "ip", "address", "add", f"{self.THERE}/30", "dev", "there")
        self.mend()

    def cut(self) -> None:
        """Take the cable away: nothing passes, and nobody is told."""
        _run(*self.enter, "ip", "link", "set", "there", "down")

    def mend(self) -> None:
        """Plug the cable in again."""
        _run(*self.enter, "ip", "link", "set", "there", "up")


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, timeout=10)
    if done.returncode:
        raise OSError(f"{' '.join(command)}: {done.stderr.strip() or f'exit {done.returncode}'}")


class NotHereError(Exception):
    """This machine does not let us make network namespaces; says why."""


_TRIAL = "ip link set lo up && ip link add here type veth peer name there && unshare --net true"
_APART = (("unshare", "--net"), ("unshare", "--map-root-user", "--net"))


def apart() -> tuple[str, ...]:
    """Give the command that runs another one in a network namespace of its own; raise NotHereError."""
    for tool in ("unshare", "nsenter", "ip"):
        if shutil.which(tool) is None:
            raise NotHereError(f"no {tool} on this machine")
    reasons = []
    for prefix in _APART:
        try:
            _run(*prefix, "sh", "-c", _TRIAL)
        except OSError as error:
            reasons.append(str(error))
        else:
            return prefix
    raise NotHereError("; ".join(reasons))


# The scene


class Scene:
    """A robot, its gateway, a router, an onlooker on the bus, and the driver of the moment."""

    driven_s = (0.2, 0.5)
    """The shortest and the longest time for which it is driven before something is lost."""

    def __init__(self, stack: contextlib.ExitStack, *, cable: bool = False, parts: str = "") -> None:
        self.faults: list[str] = []
        self.robot = Robot()
        stack.callback(self.robot.close)
        self.watch = Watch(stack)
        self.cable = Cable(stack) if cable else None
        port = free_port()
        self.endpoint = f"tcp/127.0.0.1:{port}"
        self._listen = f"tcp/0.0.0.0:{port}" if cable else self.endpoint
        self.reach = f"tcp/{Cable.HERE}:{port}" if cable else self.endpoint
        """Where a driver finds the router."""
        self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        device = f'[device]\nprotocol = "tcpudp"\nconnect = ["tcp://127.0.0.1:{self.robot.port}"]\n'
        self._file = self.configured("gateway", device + parts)
        self.log = stack.enter_context((self.folder / "log").open("w+"))
        self.router = self._start_router()
        stack.callback(lambda: kill(self.router))
        self.gateway = self.run(self._file)
        stack.callback(lambda: kill(self.gateway))
        self.session = stack.enter_context(zenoh.open(configuration("client", [self.endpoint])))
        self._stop = commander(self.session, "stop")
        self.driver: subprocess.Popen[str] | None = None
        self.deadman_s = 0.0
        stack.callback(self.end_driver)
        self.wait()

    def drive(self, rng: random.Random) -> int:
        """Start a driver, wait until the robot moves, and tell which of its packets was the first motion."""
        raise NotImplementedError

    @property
    def driving(self) -> subprocess.Popen[str]:
        """The driver's process."""
        assert self.driver is not None
        return self.driver

    def start_driver(self, *command: str) -> None:
        """Start a driver's process, behind the cable if there is one."""
        self.driver = start(*(self.cable.enter if self.cable is not None else ()), *command)

    @property
    def end_of_log(self) -> str:
        """Give the last words of what :meth:`run` started."""
        return (self.folder / "log").read_text()[-2000:]

    def end_driver(self) -> None:
        """End the driver of the moment, whatever state it is in."""
        if self.driver is not None:
            kill(self.driver)
            self.driver = None

    def moved(self, begun: int) -> int | None:
        """Find the first motion among the robot's packets from ``begun`` on."""
        frames = self.robot.frames
        return next((index for index in range(begun, len(frames)) if frames[index].moves), None)

    def stop(self) -> None:
        """Stop the robot, as anybody may."""
        self._stop.put(msgpack.packb({}))

    def wait(self) -> None:
        """Wait until the gateway is on the bus and the robot can be used."""
        until(lambda: query(self.session, "status").get("state") == "established", what="established")

    def restart_router(self) -> None:
        """Start the router again."""
        kill(self.router)
        self.router = self._start_router()
        self.wait()

    def restart_gateway(self) -> None:
        """Start the gateway again."""
        kill(self.gateway)
        self.gateway = self.run(self._file)
        self.wait()

    def configured(self, name: str, parts: str) -> Path:
        """Write a configuration of this robot and bus with further ``parts``."""
        file = self.folder / f"{name}.toml"
        bus = f'[bus]\nconnect = ["{self.endpoint}"]\nmulticast = false\n'
        file.write_text(f'[robot]\nname = "r1"\n{bus}{parts}')
        return file

    def run(self, file: Path) -> subprocess.Popen[str]:
        """Start a process of ``zbridge``."""
        command = [sys.executable, "-m", "zbridge", "run", str(file)]
        return subprocess.Popen(command, stdout=self.log, stderr=self.log, text=True)

    def _start_router(self) -> subprocess.Popen[str]:
        router = start(*part("router", self._listen))
        assert router.stdout is not None
        assert router.stdout.readline() == "open\n"
        return router


S = TypeVar("S", bound=Scene)


# The ways to be lost: each does it and tells when. What is done afterwards must not move the robot


def kill_driver(scene: Scene) -> float:
    """Kill the driver."""
    at = time.monotonic()
    scene.driving.kill()
    return at


def freeze_driver(scene: Scene) -> float:
    """Freeze the driver."""
    at = time.monotonic()
    scene.driving.send_signal(signal.SIGSTOP)
    return at


def thaw_driver(scene: Scene) -> None:
    """Let it go on."""
    scene.driving.send_signal(signal.SIGCONT)


def cut_driver_off(scene: Scene) -> float:
    """Take the cable to the driver away."""
    assert scene.cable is not None
    at = time.monotonic()
    scene.cable.cut()
    return at


def mend_cable(scene: Scene) -> None:
    """Plug it in again."""
    assert scene.cable is not None
    scene.cable.mend()
    time.sleep(0.5)  # what waits in TCP's queues is sent again only now


def let_driver_end(scene: Scene) -> float:
    """Let the driver end as it does in good order."""
    assert scene.driving.stdin is not None
    at = time.monotonic()
    scene.driving.stdin.close()
    return at


def freeze_gateway(scene: Scene) -> float:
    """Freeze the gateway while the driver drives on; the time runs from when it goes on."""
    scene.gateway.send_signal(signal.SIGSTOP)
    until(lambda: frozen(scene.gateway.pid), what="a frozen gateway")
    time.sleep(READ_S)
    quiet = len(scene.robot.frames)
    time.sleep(scene.deadman_s + FROZEN_S)
    if len(scene.robot.frames) > quiet:
        scene.faults.append("a frozen gateway wrote to the robot")
    at = time.monotonic()
    scene.gateway.send_signal(signal.SIGCONT)
    return at


def nothing(scene: Scene) -> None:
    """Mend nothing."""


@dataclass(frozen=True)
class Way(Generic[S]):
    """One way to lose the driver, or what stands between it and the robot."""

    lose: Callable[[S], float]
    mend: Callable[[S], None] = nothing
    often: bool = False
    at_once: bool = False
    """Others see it: nobody has to wait for the deadman."""
    connection_ends: bool = False
    """The robot gets no stop: its connection ends."""
    resumes: bool = False
    """The time runs from when it goes on, and then the stop must come before everything else."""


# Measuring


def stop_since(frames: list[Frame], begun: int, lost_at: float) -> int | None:
    """Find the first stop that came after the loss."""
    found = (i for i in range(begun, len(frames)) if frames[i].packet_id == STOP and frames[i].at >= lost_at)
    return next(found, None)


@dataclass
class Result:
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
    """How late a processor of this machine was at most, whatever it had to do."""
    faults: list[str] = field(default_factory=list)

    @property
    def late_s(self) -> list[float]:
        """The times that are too long."""
        times_s = self.since_loss_s if self.from_loss else self.since_motion_s
        return [time_s for time_s in times_s if time_s > self.limit_s]

    @property
    def clean(self) -> bool:
        """Whether every stop came in time and nothing moved after it."""
        return bool(self.since_loss_s) and not self.late_s and not self.faults

    def __str__(self) -> str:
        row = f"{self.way:29} {len(self.since_loss_s):4}  {_distribution(self.since_motion_s)}  "
        row += f"{_distribution(self.since_loss_s)}  {self.limit_s * 1000:7.0f} "
        row += f"{'loss' if self.from_loss else 'motion':6}  "
        row += f"{len(self.late_s):4}  {self.disturbed:9}  {len(self.faults):6}  {self.machine_late_s * 1000:7.1f}"
        return "\n".join([row, *(f"    {fault}" for fault in self.faults[:10])])


def heading() -> str:
    """Give the heading of the rows of results."""
    four = f"{'least':>7} {'median':>7} {'p99':>7} {'most':>7}"
    return (
        "Milliseconds to the first stop at the robot's socket. gateway-killed: to the end of the connection, there is\n"
        "no stop; gateway-frozen, process-frozen: since it goes on. machine: how late the machine was, at most.\n"
        f"{'':35} {'since the last motion':^31}  {'since the loss':^31}\n"
        f"{'way':29} {'n':>4}  {four}  {four}  {'limit':>7} {'since':6}  "
        f"{'late':>4}  {'disturbed':>9}  {'faults':>6}  {'machine':>7}"
    )


def _distribution(times_s: list[float]) -> str:
    if not times_s:
        return " ".join(f"{'-':>7}" for _ in range(4))
    ordered = sorted(times_s)
    ranks = (0, (len(ordered) - 1) // 2, math.ceil(0.99 * len(ordered)) - 1, -1)
    return " ".join(f"{ordered[rank] * 1000:7.1f}" for rank in ranks)


def measured(scene: S, way: Way[S], result: Result, *, repetitions: int, rng: random.Random) -> Result:
    """Lose the driver in one way again and again."""
    scene.faults = result.faults
    while len(result.since_loss_s) < repetitions:
        _lose(scene, way, rng, result)
        if result.disturbed > max(DISTURBED, repetitions // 10):
            scene.faults.append("disturbed again and again: this machine is too busy")
            break
    result.machine_late_s = scene.watch.late_s
    return result


def measured_apart(module: str, *arguments: object, timeout_s: float) -> list[Result]:
    """Let a module measure in a network namespace of its own: nothing is changed in that of the caller.

    Raises NotHereError where this machine does not allow it.
    """
    command = [*apart(), sys.executable, "-m", module, "--be", "measurement", *map(str, arguments)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            output, _ = process.communicate(timeout=timeout_s)
        except BaseException:
            process.terminate()
            raise
    if process.returncode:
        raise AssertionError(f"{' '.join(command)}: exit {process.returncode}")
    return [Result(**fields) for fields in json.loads(output)]


def be_measurement(measure: Callable[[], list[Result]]) -> None:
    """Measure here, and print the results for the process that asked."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    print(json.dumps([asdict(result) for result in measure()]))


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
    contended, lost_at = contended_s(), way.lose(scene)
    patience_s = result.limit_s + 10
    if way.connection_ends:
        until(lambda: len(robot.ended) > ends, patience_s, "end of the connection")
        stop_at, stop = robot.ended[ends], len(robot.frames)
    else:
        stop = until(lambda: stop_since(robot.frames, begun, lost_at), patience_s, "stop")
        stop_at = robot.frames[stop].at
    contended = contended_s() - contended
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
    machine_late_s = max(contended, scene.watch.late_between(since, stop_at))
    if _stopped(driven) or 0 < too_long_s <= machine_late_s:
        result.disturbed += 1
        return
    if too_long_s > 0:
        times = f"{(stop_at - since) * 1000:.0f} ms, {(stop_at - lost_at) * 1000:.0f} ms of it since the loss"
        scene.faults.append(f"late: {times}; this machine was late for {machine_late_s * 1000:.0f} ms")
    result.since_loss_s.append(stop_at - lost_at)
    if not way.resumes:
        result.since_motion_s.append(stop_at - _last_motion(driven).at)


def _motion_faults(way: Way[S], driven: list[Frame], after: list[Frame], lost_at: float, stop_at: float) -> list[str]:
    """Tell of motions that should not have come, whoever was late."""
    found = []
    stale = [frame for frame in driven if frame.moves and frame.at >= lost_at]
    if way.resumes and stale and not _in_hand(driven, lost_at):
        numbers = f"{[frame.number for frame in stale]} after {_last_motion(driven[: -len(stale)]).number}"
        found.append(f"what went on sent {len(stale)} motions before its stop: {numbers}")
    if moved := [frame for frame in after if frame.moves]:
        found.append(f"{len(moved)} motions after the stop, the first {(moved[0].at - stop_at) * 1000:.0f} ms after it")
    return found


def _in_hand(driven: list[Frame], lost_at: float) -> bool:
    """Tell whether what went on first did what it was about to do when it was frozen, between its look and its write.

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


_PARTS: dict[str, Callable[[str], None]] = {"router": be_router, "watch": lambda processor: be_watch(int(processor))}


if __name__ == "__main__":
    _PARTS[sys.argv[1]](sys.argv[2])
