"""Restarts under traffic, with motion before each: one connection, no packet lost or doubled, how long nothing came.

    python -m tests.e2e.measured.restarts                  # 100 restarts for each protocol
    python -m tests.e2e.measured.restarts --times 5 --protocol alf

The robots number what they send, and cut it where frames do not end; a restart finds most of them within a frame. The
numbers that came on the bus are held against those that were sent.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import random
import re
import signal
import socket
import tempfile
import threading
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from gateways.alf.conformance import parser as alf
from gateways.mavlink.conformance import machine as mavlink
from gateways.mavlink.conformance import parser as mavlink_wire
from gateways.wc2ec.conformance import parser as wc2ec
from tests.e2e.conftest import HOST, Bench, Gateway, device, until
from tests.e2e.rigs.fragile import ARMS, WHEELS
from tests.e2e.rigs.processes import Finding, report
from tests.e2e.rigs.robots import MOVE, ROTATE, SETTINGS, STOP, position

CUT_S = 0.002
"""Seconds between the two parts of a message."""
DRIVE_S = 0.05
LOSSLESS = 'stream = "block"'
"""A stream may be dropped on a busy machine, restart or not; what is counted here is what a restart loses."""
MOST_GAP_S = 1.0


# Robots that number what they send


class Numbered:
    """Takes connections, counts them, and sends numbered messages in two parts each. Threads of its own."""

    protocol: ClassVar[str]
    options: ClassVar[str] = ""
    path: ClassVar[str]
    """The key on which the numbers come."""
    period_s: ClassVar[float] = 0.01
    hello: ClassVar[bytes] = b""

    def __init__(self, seed: int = 1, host: str = HOST) -> None:
        self.connections = 0
        self.sent = 0
        self.faults: list[str] = []
        self.moving = False
        self.commands = 0
        self._cuts = random.Random(seed)
        self._server = socket.create_server((host, 0))
        self._peers: list[socket.socket] = []
        self.port = int(self._server.getsockname()[1])
        self.pause = threading.Event()
        self.pause.set()
        threading.Thread(target=self._serve, daemon=True).start()

    def message(self, number: int) -> bytes:
        """Write the message of this number."""
        raise NotImplementedError

    def number(self, sample: dict[str, Any]) -> int:
        """Read the number of what came on the bus."""
        raise NotImplementedError

    def hear(self, data: bytes) -> None:
        """Take bytes; note whether the robot moves, and what is no command."""
        raise NotImplementedError

    def _serve(self) -> None:
        while True:
            try:
                peer, _ = self._server.accept()
            except OSError:
                return
            self.connections += 1
            self._peers.append(peer)
            peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            peer.sendall(self.hello)
            threading.Thread(target=self._talk, args=(peer,), daemon=True).start()
            threading.Thread(target=self._listen, args=(peer,), daemon=True).start()

    def _talk(self, peer: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while self.pause.wait():
                data = self.message(self.sent)
                cut = self._cuts.randrange(1, len(data))
                peer.sendall(data[:cut])
                time.sleep(CUT_S)
                peer.sendall(data[cut:])
                self.sent += 1
                time.sleep(self.period_s - CUT_S)

    def _listen(self, peer: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := peer.recv(65_536):
                self.hear(data)
        if not self.closed:
            self.faults.append("the connection ended")

    closed = False

    def close(self) -> None:
        """End the robot."""
        self.closed = True
        for each in (self._server, *self._peers):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()


class Package(Numbered):
    """TCP/UDP 1.3, telemetry by TCP: packet 55, whose x is the number."""

    protocol, path, hello = "tcpudp", "pose", SETTINGS

    def __init__(self, host: str = HOST) -> None:
        super().__init__(host=host)
        self._rest = b""

    def message(self, number: int) -> bytes:
        return position(float(number), 0.0, 0.0)

    def number(self, sample: dict[str, Any]) -> int:
        return round(sample["x"] * 100)

    def hear(self, data: bytes) -> None:
        self._rest += data
        while len(self._rest) >= 6 and len(self._rest) >= (end := 4 + int.from_bytes(self._rest[:4], "little")):
            sender, kind = self._rest[4], self._rest[5]
            self.commands += 1
            if kind not in (3, 10, MOVE, ROTATE, STOP) or (sender != 2 and kind != 3):
                self.faults.append(f"packet {kind} of {sender}")
            if kind in (MOVE, ROTATE, STOP):
                self.moving = kind != STOP
            self._rest = self._rest[end:]


class Vehicle(Numbered):
    """ALF text: measurements with their sequence numbers."""

    protocol, path, period_s = "alf", "scan", 0.02
    hello = alf.write("text", alf.INIT, [-95.0, 95.0, 0.25, 100, 20, 5600])

    def __init__(self) -> None:
        super().__init__()
        self._reader = alf.CommandReader("text", {alf.DRIVE, alf.END})

    def message(self, number: int) -> bytes:
        return alf.write("text", alf.SCAN, [number, 20 * number, *[1000] * alf.POINTS, 0, alf.POINTS - 1])

    def number(self, sample: dict[str, Any]) -> int:
        return int(sample["seq"])

    def hear(self, data: bytes) -> None:
        for heard in self._reader.take(data):
            self.commands += 1
            if heard.problem:
                self.faults.append(heard.problem)
            elif heard.kind == alf.DRIVE:
                self.moving = heard.fields[0] > 0


class Controller(Numbered):
    """WC2EC as deployed: a sensor whose value is the number."""

    protocol, path, options = "wc2ec", "sensor/ds0", WHEELS.replace("1000.0", "1e9")
    devices = wc2ec.DEFAULT["deployed"]
    hello = b"".join(map(wc2ec.registration, devices))

    def __init__(self) -> None:
        super().__init__()
        self._reader = wc2ec.ExternalReader("deployed", self.devices, 0)
        self._wheels: dict[int, Any] = {}

    def message(self, number: int) -> bytes:
        return wc2ec.measurement("deployed", self.devices[0], float(number))

    def number(self, sample: dict[str, Any]) -> int:
        return round(sample["value"])

    def hear(self, data: bytes) -> None:
        for heard in self._reader.take(data):
            self.commands += 1
            if heard.problem:
                self.faults.append(heard.problem)
            self._wheels[heard.number] = heard.value
        self.moving = any(self._wheels.values())


class Rover(Numbered):
    """An ArduRover: DISTANCE_SENSOR, whose centimetres are the number, behind a HEARTBEAT."""

    protocol, options, path = "mavlink", ARMS, "sensor/distance_forward"

    def __init__(self) -> None:
        super().__init__()
        self._reader = mavlink_wire.MavlinkReader()
        self._answers: deque[int] = deque()
        self._mode, self._armed, self._seq = mavlink.HOLD, False, 0

    def message(self, number: int) -> bytes:
        mode = {"custom_mode": self._mode, "base_mode": 1 | mavlink.ARMED * self._armed}
        data = self._write("HEARTBEAT", type=10, autopilot=3, **mode)
        while self._answers:
            data += self._write("COMMAND_ACK", command=self._answers.popleft())
        return data + self._write("DISTANCE_SENSOR", current_distance=number, max_distance=65_535)

    def _write(self, name: str, **fields: int) -> bytes:
        self._seq = (self._seq + 1) % 256
        return mavlink_wire.write_frame(name, fields, (1, 1), self._seq)

    def number(self, sample: dict[str, Any]) -> int:
        return round(sample["value"] * 100)

    def hear(self, data: bytes) -> None:
        for heard in self._reader.take(data):
            self.commands += 1
            self.faults += [heard.problem] if heard.problem else []  # also a number that is not the next one
            if heard.name == "COMMAND_LONG":
                self._obey(heard.fields)
            elif heard.name == "SET_POSITION_TARGET_LOCAL_NED":
                self.moving = heard.fields["vx"] > 0

    def _obey(self, fields: dict[str, Any]) -> None:
        self._answers.append(fields["command"])
        if fields["command"] == mavlink.SET_MODE:
            self._mode = int(fields["param2"])
            self.moving = self.moving and self._mode != mavlink.HOLD
        elif fields["command"] == mavlink.ARM:
            self._armed = fields["param1"] == 1


ROBOTS: dict[str, type[Numbered]] = {kind.protocol: kind for kind in (Package, Vehicle, Controller, Rover)}

# Restarts


class Restarted:
    """A gateway that is restarted: knows the process that serves now, and ends it with the stack."""

    def __init__(self, bench: Bench, gateway: Gateway) -> None:
        self.gateway = gateway
        self._bench = bench
        self._pids = [gateway.process.pid]
        bench.stack.callback(self.kill)

    @property
    def successors(self) -> list[int]:
        """The processes that took over, in their order."""
        return list(map(int, re.findall(r"handed over to process (\d+)", self.gateway.log)))

    @property
    def pid(self) -> int:
        """The process that serves now."""
        return self.successors[-1] if self.successors else self.gateway.process.pid

    def ask(self, robot: str = "r1", timeout_s: float = 60.0) -> list[Any]:
        """Ask for a restart; give the answers."""
        return self._bench.fleet.get_within(f"fleet/{robot}/@rpc/restart/test", timeout_s)

    def kill(self) -> None:
        """End every process that took over."""
        for pid in self.successors:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def end(self) -> str:
        """End the process that serves now in order; give the whole log."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGTERM)
            until(lambda: ended(self.pid), what="the end of the last gateway")
        assert self.gateway.process.wait(10) == 0, self.gateway.log
        assert "Traceback" not in self.gateway.log, self.gateway.log
        return self.gateway.log


def ended(pid: int) -> bool:
    """Tell whether a process that is not our child has ended; nobody may have waited for it yet."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return True


@dataclass
class Judgement(Finding):
    """What came of the restarts of one gateway."""

    protocol: str
    times: int
    connections: int = 0
    sent: int = 0
    lost: int = 0
    doubled: int = 0
    disordered: int = 0
    gaps_s: list[float] = field(default_factory=list)

    def __str__(self) -> str:
        gaps = sorted(self.gaps_s) or [0.0]
        p50, p99 = (gaps[min(len(gaps) - 1, int(share * len(gaps)))] for share in (0.5, 0.99))
        return (
            f"{self.protocol}: {len(self.gaps_s)} restarts, {self.connections} connection(s), {self.sent} packets, "
            f"{self.lost} lost, {self.doubled} doubled, {self.disordered} out of order; "
            f"gap p50 {p50 * 1000:.0f} ms, p99 {p99 * 1000:.0f} ms, most {gaps[-1] * 1000:.0f} ms"
        )


def restart(protocol: str, times: int) -> Judgement:
    """Restart a gateway under traffic, with motion before."""
    judgement = Judgement(protocol=protocol, times=times)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        bench = Bench(Path(folder), stack)
        robot = stack.enter_context(contextlib.closing(ROBOTS[protocol]()))
        gateway = Restarted(bench, bench.gateway(device(robot.port, protocol, robot.options), bus=LOSSLESS))
        until(lambda: bench.fleet.state() == "established", what="established")
        key = f"fleet/r1/{robot.path}"
        until(lambda: len(bench.fleet.seen.get(key, ())) > 10, what="telemetry")
        with ThreadPoolExecutor(1) as pool:
            for number in range(times):
                try:
                    judgement.gaps_s.append(_once(bench, robot, gateway, key, pool))
                except AssertionError as error:
                    judgement.faults.append(f"restart {number + 1}: {error}")
                    break
        robot.pause.clear()
        _account(judgement, bench, robot, key)
        judgement.faults += robot.faults
        gateway.end()
    if judgement.connections != 1:
        judgement.faults.append(f"{judgement.connections} connections")
    return judgement


def _once(bench: Bench, robot: Numbered, gateway: Restarted, key: str, pool: ThreadPoolExecutor) -> float:
    """Drive, restart while driving; give the longest time without telemetry."""
    fleet = bench.fleet
    fleet.hold("r1", deadman_s=1.0)
    drive = {"forward": 0.5, "left": 0.0, "turn": 0.0}
    until(lambda: fleet.put("r1/@cmd/drive", **drive) or robot.moving, what="motion")
    began, asked = time.monotonic(), pool.submit(gateway.ask)
    while not asked.done():
        fleet.put("r1/@cmd/drive", **drive)
        time.sleep(DRIVE_S)
    assert asked.result() == [{}], (asked.result(), gateway.gateway.log)
    until(lambda: not robot.moving, what="the robot at rest")
    answered = time.monotonic()
    until(lambda: fleet.seen[key][-1]["at"] > answered + 0.1, what="telemetry after the restart")
    for _ in range(5):  # the lease ended: no drive of it is obeyed
        fleet.put("r1/@cmd/drive", **drive)
        time.sleep(DRIVE_S)
    assert not robot.moving, "moved by a lease that had ended"
    times = [sample["at"] for sample in fleet.seen[key] if sample["at"] > began - 0.1]
    return max(later - earlier for earlier, later in itertools.pairwise(times))


def _account(judgement: Judgement, bench: Bench, robot: Numbered, key: str) -> None:
    """Hold the numbers on the bus against those that were sent."""
    time.sleep(0.1)
    with contextlib.suppress(AssertionError):
        until(lambda: robot.number(bench.fleet.seen[key][-1]) == robot.sent - 1, 2.0)
    numbers = [robot.number(sample) for sample in bench.fleet.seen[key]]
    judgement.connections, judgement.sent = robot.connections, robot.sent - numbers[0]
    judgement.lost = judgement.sent - len(set(numbers))
    judgement.doubled = len(numbers) - len(set(numbers))
    judgement.disordered = sum(later < earlier for earlier, later in itertools.pairwise(numbers))
    if judgement.lost or judgement.doubled or judgement.disordered:
        judgement.faults.append("packets were lost, doubled or out of order")


def main() -> Iterator[Judgement]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=100)
    parser.add_argument("--protocol", choices=[*ROBOTS], action="append")
    arguments = parser.parse_args()
    for protocol in arguments.protocol or ROBOTS:
        judgement = restart(protocol, arguments.times)
        slow = [gap_s for gap_s in judgement.gaps_s if gap_s > MOST_GAP_S]
        judgement.faults += [f"nothing came for {gap_s:.2f} s" for gap_s in slow]
        yield judgement


if __name__ == "__main__":
    report(main())
