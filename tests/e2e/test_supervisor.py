"""``zbridge run DIR`` with real processes: many robots, a crash, a hang, files that change, and the end."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import socket
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.e2e.conftest import Bench, device, end, repeated, start, until
from tests.e2e.measured.crossings import Case, Outcome, measure
from tests.e2e.rigs.robots import MOVE, STOP, Robot, position
from tests.e2e.rigs.steps import AFTER_GIVEN, AFTER_GO, FIRST_READ
from tests.e2e.rigs.supervised import Supervised
from zbridge.host.runner import RESUMED_CRASHES

ROBOTS = 8


class Host:
    """A supervisor and its robots: scripted ones, in this process."""

    def __init__(
        self,
        bench: Bench,
        systemd: socket.socket,
        robots: int = ROBOTS,
        more: str = "",
        before: Callable[[Path], object] = lambda folder: None,
    ) -> None:
        self.bench = bench
        self.folder = bench.folder / "robots"
        self.folder.mkdir()
        self.robots: list[Robot] = []
        for number in range(robots):
            self.robots.append(bench.stack.enter_context(contextlib.closing(Robot())))
            self.write(number, more)
        self.systemd = systemd
        before(self.folder)
        environment = {**os.environ, "NOTIFY_SOCKET": str(systemd.getsockname())}
        self.supervisor = Supervised(bench.stack, self.folder, environment=environment)

    def ready(self) -> None:
        """Wait until all robots are established, and systemd was told."""
        names = [f"r{number}" for number in range(len(self.robots))]
        until(lambda: {self.bench.fleet.state(name) for name in names} == {"established"}, 30, "all robots")
        told = b""
        while b"READY=1" not in told:
            told = self.systemd.recv(1000)

    @contextlib.contextmanager
    def driven(self) -> Iterator[None]:
        """Drive all robots, again and again, until the block ends."""
        names = [f"r{number}" for number in range(len(self.robots))]
        for name in names:
            self.bench.fleet.hold(name)

        def drive() -> None:
            for name in names:
                self.bench.fleet.put(f"{name}/@cmd/drive", forward=0.5)

        with repeated(drive):
            yield

    def write(self, number: int, more: str = "", name: str = "") -> Path:
        """Write the file of a robot."""
        path = self.folder / f"{name or f'r{number}'}.toml"
        bus = f'[bus]\nconnect = ["{self.bench.endpoint}"]\nmulticast = false\n'
        path.write_text(f'[robot]\nname = "r{number}"\n{device(self.robots[number].port)}{bus}{more}')
        return path

    def reload(self, words: str) -> None:
        """Let the supervisor look at its files, and wait for what it says."""
        count = self.supervisor.log.count(words)
        self.supervisor.reload()
        until(lambda: self.supervisor.log.count(words) > count, what=words)

    @property
    def connections(self) -> list[int]:
        """How often each robot was connected to."""
        return [robot.connections for robot in self.robots]


@pytest.fixture
def systemd(bench: Bench) -> Iterator[socket.socket]:
    with contextlib.closing(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)) as mine:
        mine.bind(str(bench.folder / "systemd"))
        mine.settimeout(20)
        yield mine


@pytest.fixture
def host(bench: Bench, systemd: socket.socket) -> Host:
    return Host(bench, systemd)


def test_eight_robots_of_which_one_crashes_and_one_gets_a_faulty_file(host: Host) -> None:
    fleet, supervisor = host.bench.fleet, host.supervisor
    host.ready()

    goes_on = r"r3: process \d+ continues with its connections"
    for count in range(1, RESUMED_CRASHES + 1):
        os.kill(supervisor.gateway("r3"), signal.SIGKILL)
        until(lambda count=count: len(re.findall(goes_on, supervisor.log)) == count, 20, goes_on)  # type: ignore[misc]
    assert host.connections[3] == 1
    os.kill(supervisor.gateway("r3"), signal.SIGKILL)  # what was deposited may be what kills them
    until(lambda: "r3: next process in" in supervisor.log, 20, "another connection")
    until(lambda: host.robots[3].connections == 2, what="its connections")
    until(lambda: fleet.state("r3") == "established", what="the robot")
    assert host.connections == [1, 1, 1, 2, 1, 1, 1, 1]

    host.write(5, more="colour = 1\n")
    host.reload("colour")
    host.write(6, name="twice")
    host.reload("expected another name than that of")
    (host.folder / "twice.toml").unlink()
    host.write(5, more="[control]\nlease_s = 2.0\n")
    host.reload("r5.toml: has changed")
    until(lambda: re.search(r"r5: process \d+ serves it now", supervisor.log), 20, "the restart of one gateway")
    assert host.connections == [1, 1, 1, 2, 1, 1, 1, 1], "its robot noticed nothing"
    assert fleet.state("r5") == "established"

    former, host.robots[4] = host.robots[4], host.bench.stack.enter_context(contextlib.closing(Robot()))
    host.write(4)
    host.reload("r4.toml: has changed")
    until(lambda: host.robots[4].connections == 1, 20, "a robot at another address, which cannot be handed over")
    assert former.ended

    (host.folder / "r7.toml").unlink()
    host.reload("was removed")
    until(lambda: host.robots[7].ended, what="the end of one gateway")

    os.kill(supervisor.gateway("r0"), signal.SIGUSR2)
    until(lambda: re.search(r"r0: process \d+ serves it now", supervisor.log), 20, "the restart of another one")
    assert host.connections[0] == 1
    stopped = [len(robot.packets(STOP)) for robot in host.robots]
    supervisor.process.send_signal(signal.SIGTERM)
    host.bench.ended_within(supervisor.process, 5.0)
    assert "Traceback" not in supervisor.log, supervisor.log
    until(lambda: all(robot.ended for robot in host.robots), what="the end of all connections")
    assert all(count > 0 for count in stopped)


@pytest.mark.long
def test_robots_rest_and_stay_usable_whatever_their_gateway_dies_of_and_at_whatever_step_of_a_restart() -> None:
    plan = [
        Case("tcpudp-1.3", "hung"),
        Case("wc2ec", "frozen"),
        Case("alf", "killed"),
        Case("mavlink", "killed"),
        Case("tcpudp-1.4", f"predecessor {AFTER_GIVEN}"),
        Case("alf", f"successor {AFTER_GO}"),
        Case("tcpudp-1.3-udp", f"again successor {FIRST_READ}"),
    ]
    outcomes, left = list[Outcome](), plan
    for _ in range(4):  # the busier the machine, the more often somebody dies within a read
        tried = measure(left, lanes=len(left)) if left else []
        outcomes += [outcome for outcome in tried if not outcome.within_a_read]
        left = [outcome.case for outcome in tried if outcome.within_a_read]
    assert len(outcomes) == len(plan)
    assert [outcome for outcome in outcomes if not outcome.good] == []


def test_a_map_of_which_half_was_read_when_the_gateway_died_is_skipped_and_what_follows_it_is_read(
    bench: Bench, systemd: socket.socket
) -> None:
    host = Host(bench, systemd, 1)
    (robot,), cells = host.robots, 2048 * 2048
    host.ready()
    grid = struct.pack("<iBBi", 2 + 4 + cells, 1, 53, cells) + bytes(cells)
    robot.send(grid[:3_000_000])
    time.sleep(1.0)  # it is deposited, and what was read since is only in the shared memory
    robot.send(grid[3_000_000:3_500_000])
    time.sleep(0.3)  # who dies within a read leaves nothing that could be resumed
    killed, pid = time.monotonic(), host.supervisor.gateway("r0")
    os.kill(pid, signal.SIGKILL)
    until(lambda: robot.packets(STOP, killed), what="the stop")
    robot.send(grid[3_500_000:] + position(100.0, 0.0, 0.0))
    host.supervisor.gateway("r0", not_pid=pid)
    until(lambda: bench.fleet.last("r0/pose").get("x") == pytest.approx(1.0), 20, "what followed the map")
    assert bench.fleet.state("r0") == "established"
    assert robot.connections == 1


def test_no_file_keeps_a_supervisor_from_starting_from_following_others_or_from_stopping_a_robot(
    bench: Bench, systemd: socket.socket
) -> None:
    def strange(folder: Path) -> None:
        os.mkfifo(folder / "fifo.toml")
        (folder / "device.toml").symlink_to("/dev/zero")
        (folder / "folder.toml").mkdir()
        (folder / "brackets.toml").write_text("a = " + 20_000 * "[")
        (folder / "digits.toml").write_text("a = " + 5_000 * "1")
        Path(os.fsdecode(os.fsencode(folder) + b"/\xff.toml")).write_bytes((folder / "r0.toml").read_bytes())

    host = Host(bench, systemd, 1, before=strange)
    host.ready()
    (robot,), supervisor = host.robots, host.supervisor
    with host.driven():
        until(lambda: robot.packets(MOVE), what="the robot drives")
        (host.folder / "large.toml").write_text(f"a = [{450_000 * '1,'}]")
        supervisor.reload()
        killed = time.monotonic()
        os.kill(supervisor.gateway("r0"), signal.SIGKILL)
        stop = until(lambda: robot.packets(STOP, killed), what="the stop")[0]
    assert stop.at - killed < 0.5
    until(lambda: re.search(r"r0: process \d+ continues with its connections", supervisor.log), 20, "the next process")
    until(lambda: "large.toml" in supervisor.log, 20, "the fault of the large file")
    assert robot.connections == 1
    until(lambda: b"faulty files" in systemd.recv(1000), what="the status line")


def test_two_files_with_one_robot_are_refused_at_the_start(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / f"{name}.toml").write_text('[robot]\nname = "r1"\n' + device(1))
    process = start("run", str(tmp_path))
    said = end(process, signal.SIGCONT, 20)
    assert process.returncode == 2
    assert said.count("\n") == 1, said
    assert "robot.name = 'r1': expected another name than that of" in said


def test_the_gateways_end_in_order_when_the_supervisor_is_killed(host: Host) -> None:
    until(lambda: all(robot.connections for robot in host.robots), 30, "all robots")
    until(lambda: "ready:" in host.supervisor.log, what="ready")
    host.supervisor.process.kill()
    until(lambda: host.supervisor.log.count("the supervisor is gone") == ROBOTS, what="the end of all gateways")
    until(lambda: all(robot.ended for robot in host.robots), what="the end of all connections")
    assert "Traceback" not in host.supervisor.log


def test_a_supervisor_goes_on_by_the_installed_code_and_driven_robots_notice_nothing(
    bench: Bench, systemd: socket.socket
) -> None:
    host = Host(bench, systemd, 3, more="[control]\ndeadman_s = 10.0\n")
    supervisor, robots = host.supervisor, host.robots
    host.ready()
    pids = [supervisor.gateway(f"r{number}") for number in range(3)]
    with host.driven():
        until(lambda: all(robot.packets(MOVE) for robot in robots), what="the robots drive")
        since = time.monotonic()
        for count in (1, 2):  # the code that has taken over is replaced in its turn
            supervisor.process.send_signal(signal.SIGUSR2)
            supervisor.reload()  # comes at a moment when nobody may have asked for it yet
            until(lambda count=count: supervisor.log.count("has taken over in") == count, 30, "the other code")  # type: ignore[misc]
        taken = time.monotonic()
        until(lambda: all(robot.packets(MOVE, taken) for robot in robots), what="the robots are driven on")
        assert not any(robot.packets(STOP, since) for robot in robots)
        assert host.connections == [1, 1, 1]
        assert [supervisor.gateway(f"r{number}") for number in range(3)] == pids

        killed = time.monotonic()
        os.kill(pids[1], signal.SIGKILL)
        until(lambda: robots[1].packets(STOP, killed), what="the stop over the duplicate")
        until(
            lambda: re.search(r"r1: process \d+ continues with its connections", supervisor.log), 20, "the next process"
        )
        os.kill(pids[2], signal.SIGSTOP)
        until(lambda: "sent no heartbeat" in supervisor.log, 20, "the one that hangs")
        until(lambda: re.search(r"r2: (process \d+ continues|next process in)", supervisor.log), 20, "the next process")
    supervisor.gateway("r2", not_pid=pids[2])
    until(lambda: [bench.fleet.state(f"r{number}") for number in range(3)] == ["established"] * 3, 20, "all robots")
    assert host.connections[:2] == [1, 1]
    supervisor.process.send_signal(signal.SIGTERM)
    bench.ended_within(supervisor.process, 5.0)
    assert "Traceback" not in supervisor.log, supervisor.log
    until(lambda: all(robot.ended for robot in robots), what="the end of all connections")
