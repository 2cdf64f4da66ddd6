"""Webots robots end to end: simulator, scripted controller or fragile one, real sockets, real Zenoh."""

from __future__ import annotations

import contextlib
import math
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

import zbridge
from tests.e2e.conftest import Bench, Fleet, end, free_port, until
from tests.e2e.wc2ec_judge import DIALECTS, judge

DEADMAN_S = 0.3
STEP_S = 0.02
DISTANCE, LINEAR, ROTATIONAL = 37, 46, 53
WHEELS = """
[device.options.differential]
left = ["left"]
right = ["right"]
wheel_radius_m = 0.05
track_m = 0.3
speed_full_m_s = 0.5
"""
CAR = [(ROTATIONAL, 0, b"left"), (ROTATIONAL, 1, b"right"), (LINEAR, 2, b"lift"), (DISTANCE, 3, b"eye")]
LEFT, RIGHT, LIFT, EYE = range(4)


class Webots:
    """A scripted controller: one external controller after the other is shown its devices, then fed; keeps every
    command with its time."""

    def __init__(
        self,
        devices: list[tuple[int, int, bytes]],
        feed: Callable[[int], bytes] = lambda step: b"",
        *,
        port: int = 0,
        size: int = 11,
    ) -> None:
        self.connections = 0
        self.commands: list[tuple[float, bytes]] = []
        self.steps = 0
        self._greeting = b"".join(bytes((0, kind, number, len(name))) + name for kind, number, name in devices)
        self._feed = feed
        self._size = size
        self._peer: socket.socket | None = None
        self._server = socket.create_server(("127.0.0.1", port))
        self.port = int(self._server.getsockname()[1])
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                peer, _ = self._server.accept()
            except OSError:
                return
            peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.connections += 1
            with peer, contextlib.suppress(OSError):
                peer.sendall(self._greeting)
                self._peer = peer
                gone = threading.Event()
                feeding = threading.Thread(target=self._live, args=(peer, gone), daemon=True)
                feeding.start()
                try:
                    self._hear(peer)
                finally:
                    gone.set()
                    feeding.join(5)

    def _live(self, peer: socket.socket, gone: threading.Event) -> None:
        """Send a round of data every 20 ms, joined in one segment or not."""
        due = time.monotonic()
        with contextlib.suppress(OSError):
            while not gone.wait(max(0.0, due - time.monotonic())):
                due += STEP_S
                if data := self._feed(self.steps):
                    peer.sendall(data)
                self.steps += 1

    def _hear(self, peer: socket.socket) -> None:
        rest = b""
        while data := peer.recv(4096):
            at, rest = time.monotonic(), rest + data
            while rest:
                size = self._size if self._size == 11 else {128: 3, 129: 3, 130: 12, 131: 27}[rest[0]]
                if len(rest) < size:
                    break
                self.commands.append((at, rest[:size]))
                rest = rest[size:]

    def send(self, data: bytes) -> None:
        assert self._peer is not None
        self._peer.sendall(data)

    def motor(self, number: int, since: float = 0.0) -> list[tuple[float, float]]:
        """When a motor was set after a moment, and to what."""
        return [
            (at, struct.unpack("<BBBd", command)[3])
            for at, command in tuple(self.commands)
            if at > since and command[2] == number
        ]

    def last(self, number: int) -> float | None:
        return next((value for _, value in reversed(self.motor(number))), None)

    def close(self) -> None:
        """End the simulation, without a word."""
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._peer.shutdown(socket.SHUT_RDWR)
        self._thread.join(5)


@pytest.fixture
def robots() -> Iterator[list[Webots]]:
    """The scripted controllers that a test starts."""
    started: list[Webots] = []
    yield started
    for robot in started:
        robot.close()


def data(number: int, value: float) -> bytes:
    return struct.pack("<BBBd", 1, DISTANCE, number, value)


def car(robots: list[Webots], **more: Any) -> Webots:
    robot = Webots(CAR, lambda step: data(EYE, step), **more)
    robots.append(robot)
    return robot


def gateway(
    bench: Bench, port: int, options: str = WHEELS, *, dialect: str = "deployed", robot: str = "r1", more: str = ""
) -> subprocess.Popen[str]:
    file = bench.folder / f"{robot}.toml"
    file.write_text(
        f'[robot]\nname = "{robot}"\n'
        f'[device]\nprotocol = "wc2ec"\nconnect = ["tcp://127.0.0.1:{port}"]\n'
        f'[device.options]\ndialect = "{dialect}"\n{options}\n'
        f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n{more}'
    )
    return bench.zbridge("run", str(file))


def established(bench: Bench, robot: str = "r1") -> None:
    until(lambda: bench.fleet.state(robot) == "established", what=f"{robot} established")


def refused(fleet: Fleet, robot: str = "r1") -> dict[str, str]:
    """The reasons of what ``control`` shows as refused, by command."""
    return {entry["command"]: entry["reason"] for entry in fleet.last(f"{robot}/control").get("refusals", [])}


def devices(bench: Bench, robot: str = "r1") -> dict[str, tuple[int, str]]:
    return {
        entry["name"]: (entry["number"], entry["kind"])
        for entry in bench.fleet.last(f"{robot}/devices").get("devices", [])
    }


# The simulator


def test_the_simulated_robot_of_the_field_is_seen_and_driven(bench: Bench) -> None:
    port = free_port()
    bench.simulator(port, "wc2ec", "--dialect", "deployed")
    bearings = ", ".join(f"ds{number} = {45.0 * number}" for number in range(8))
    tables = ", ".join(f"ds{number} = [[0.0, 0.0], [1000.0, 1.0]]" for number in range(8))
    options = (
        f"bounds_default = [0.0, 1000.0]\nscan_range_m = [0.0, 1.0]\n"
        f"bearings_deg = {{ {bearings} }}\ntables = {{ {tables} }}\n"
        f"[device.options.differential]\nleft = ['left wheel']\nright = ['right wheel']\n"
        f"wheel_radius_m = 0.05\ntrack_m = 0.3\nspeed_full_m_s = 1.0\n"
    )
    gateway(bench, port, options)
    established(bench)
    with zbridge.blocking.connect([bench.endpoint]) as fleet:
        robot = fleet["r1"]
        status, table = robot.status.last(), robot.devices.last()
        assert status is not None
        assert (status.protocol, status.dialect) == ("wc2ec", "deployed")
        assert table is not None
        assert {entry.name: entry.kind for entry in table.devices} == {
            **{f"ds{number}": "distance" for number in range(8)},
            "left wheel": "rotational",
            "right wheel": "rotational",
            "lift": "linear",
        }
        scan = next(iter(robot.scan))
        assert (scan.angle_min, scan.angle_increment) == pytest.approx((0.0, math.pi / 4))
        assert len(scan.ranges) == 8
        with robot.control("test") as drive:
            drive.motor("lift", 0.1)
            began = time.monotonic()
            for scan in robot.scan:
                drive(forward=1.0)
                if np.nanmin(scan.ranges) < 0.7:
                    break
                assert time.monotonic() - began < 15, "it drives until it sees a box or a wall"
            drive()
    for number in range(8):
        reading = bench.fleet.last(f"r1/sensor/ds{number}")
        assert (reading["kind"], reading["device"], reading["fault"]) == ("distance", number, False)
        assert 0.0 <= reading["value"] <= 1.0
    assert not {"drive", "motor/lift"} & refused(bench.fleet).keys()


def test_the_simulated_robot_of_the_document_measures_and_is_configured(bench: Bench) -> None:
    port, fleet = free_port(), bench.fleet
    bench.simulator(port, "wc2ec", "--dialect", "draft")
    listed = ", ".join(f'{{ name = "light {number}", number = {number} }}' for number in range(4))
    gateway(bench, port, f"devices = [{listed}]\nvalues = 3\n", dialect="draft")
    established(bench)
    assert fleet.last("r1/status")["dialect"] == "draft"
    names = [f"r1/sensor/light%20{number}" for number in range(4)]
    until(lambda: all(fleet.last(name) for name in names), what="four lights, for somebody listens")
    assert devices(bench) == {f"light {number}": (number, "light") for number in range(4)}
    plain = [fleet.last(name)["value"] for name in names]
    assert min(plain) > 0
    fleet.put("r1/@cmd/sensor/light%200", index=0, value=2.0)
    fleet.put("r1/@cmd/sensor/light%201", values=[0.5, 1.0, 0.0])
    until(lambda: fleet.last(names[0])["value"] == pytest.approx(2 * plain[0]), what="twice the gain")
    until(lambda: fleet.last(names[1])["value"] == pytest.approx(plain[1] / 2 + 1), what="all values")
    assert fleet.last(names[2])["value"] == pytest.approx(plain[2])


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_fragile_simulator_has_nothing_to_complain_of_and_ends_with_its_gateway(bench: Bench, dialect: str) -> None:
    port = free_port()
    simulator = bench.simulator(port, "wc2ec", "--dialect", dialect, "--fragile")
    wheels = WHEELS.replace('"left"', '"left wheel motor"').replace('"right"', '"right wheel motor"')
    listed = 'devices = [{ name = "light0", number = 0 }, { name = "light1", number = 1 }]'
    process = gateway(bench, port, wheels if dialect == "deployed" else listed, dialect=dialect)
    established(bench)
    sensor = "ds0" if dialect == "deployed" else "light0"
    until(lambda: bench.fleet.last(f"r1/sensor/{sensor}"), what="readings")
    bench.fleet.hold("r1")
    for number in range(10):
        bench.fleet.put("r1/@cmd/drive", forward=number / 10)
        bench.fleet.put("r1/@cmd/motor/lift", value=number / 10)
        bench.fleet.put("r1/@cmd/motor/nobody", value=number / 10)
        bench.fleet.put("r1/@cmd/sensor/light0", index=0, value=number / 10)
        time.sleep(0.02)
    end(process)
    assert process.returncode == 0
    output, _ = simulator.communicate(timeout=5)
    assert "violation" not in output
    assert simulator.returncode == 0, output
    assert "at rest" in output, "a gateway that leaves stops what it moved"


def test_a_sensor_of_the_document_measures_only_while_somebody_listens(bench: Bench, robots: list[Webots]) -> None:
    webots = Webots([], lambda step: b"", size=0)
    robots.append(webots)
    listed = ", ".join(f'{{ name = "light{number}", number = {number} }}' for number in range(3))
    session: Any = bench.fleet.session
    watching: Any = bench.fleet._subscriber
    watching.undeclare()
    gateway(bench, webots.port, f'devices = [{listed}]\npinned = ["light2"]\n', dialect="draft")

    def heard() -> list[bytes]:
        return [command for _, command in webots.commands]

    until(lambda: heard() == [b"\x80\x00\x02"], what="the pinned one alone")
    first = session.declare_subscriber("fleet/r1/sensor/light1", lambda sample: None)
    until(lambda: heard()[1:] == [b"\x80\x00\x01"], what="enabled for the first listener")
    second = session.declare_subscriber("fleet/r1/sensor/light1", lambda sample: None)
    first.undeclare()
    time.sleep(0.2)
    assert len(heard()) == 2
    second.undeclare()
    until(lambda: heard()[2:] == [b"\x81\x00\x01"], what="disabled after the last")


# Many devices, two robots


def test_a_robot_of_54_devices_and_a_second_on_another_port(bench: Bench, robots: list[Webots]) -> None:
    def feed(step: int) -> bytes:
        return b"".join(data(number, step + number / 64) for number in range(54))

    many = Webots([(DISTANCE, number, b"d/%d" % number) for number in range(54)], feed)
    robots.append(many)
    second = car(robots)
    gateway(bench, many.port, "")
    gateway(bench, second.port, robot="r2")
    for name in ("r1", "r2"):
        established(bench, name)
    began = time.monotonic()
    steps = many.steps
    until(lambda: many.steps - steps >= 75, what="75 rounds of 54 readings")
    took_s = time.monotonic() - began
    assert devices(bench) == {f"d/{number}": (number, "distance") for number in range(54)}
    assert devices(bench, "r2") == {
        "left": (LEFT, "rotational"),
        "right": (RIGHT, "rotational"),
        "lift": (LIFT, "linear"),
        "eye": (EYE, "distance"),
    }
    total = 0
    for number in range(54):
        readings = bench.fleet.seen[f"fleet/r1/sensor/d%2F{number}"]
        values = [reading["value"] for reading in readings]
        assert values == sorted(set(values)), "in order, each once"
        assert {value % 1 for value in values} == {number / 64}
        assert {reading["device"] for reading in readings} == {number}
        total += sum(began <= reading["at"] <= began + took_s for reading in readings)
    assert total > 0.5 * 54 * 75, f"{total} of {54 * 75} readings in {took_s:.1f} s"
    keys = {key.split("/", 2)[2] for key in bench.fleet.seen if key.startswith("fleet/r2/sensor/")}
    assert keys == {"sensor/eye"}
    bench.fleet.hold("r2")
    bench.fleet.put("r2/@cmd/drive", forward=0.5, turn=0.5)
    until(lambda: second.last(LEFT) == pytest.approx(3.5), what="left wheel")
    until(lambda: second.last(RIGHT) == pytest.approx(6.5), what="right wheel")
    assert many.commands == [], "a robot without motors is told nothing"


# Who may drive

DRIVER = """
import sys, time, msgpack, zenoh
from tests.proofs import Holder
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", '["%s"]' % sys.argv[1])
with zenoh.open(config) as session:
    request = msgpack.packb({"who": "driver"})
    (reply,) = session.get("fleet/r1/@rpc/control/acquire/driver", payload=request, timeout=3)
    held = Holder.of(msgpack.unpackb(reply.ok.payload.to_bytes()))
    command = session.declare_publisher("fleet/r1/@cmd/" + sys.argv[2])
    payload = msgpack.packb({"forward": 0.5} if sys.argv[2] == "drive" else {"value": 5.0})
    while True:
        command.put(payload, attachment=held.attachment(sys.argv[2], payload))
        time.sleep(0.02)
"""


@pytest.mark.parametrize("what", ["drive", "motor/left"])
def test_driver_killed_the_motors_are_set_to_0_within_the_deadman(bench: Bench, robots: list[Webots], what) -> None:
    webots = car(robots)
    gateway(bench, webots.port, more=f"[control]\ndeadman_s = {DEADMAN_S}\n")
    established(bench)
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, bench.endpoint, what])
    try:
        until(lambda: sum(value == 5.0 for _, value in webots.motor(LEFT)) > 20, what="driving")
    finally:
        driver.kill()
        killed = time.monotonic()
        driver.communicate()
    until(lambda: all(webots.last(wheel) == 0.0 for wheel in (LEFT, RIGHT)), what="stop")
    moved = max(at for at, value in webots.motor(LEFT) if value)
    for wheel in (LEFT, RIGHT):
        stopped = min(at for at, value in webots.motor(wheel, moved) if value == 0.0)
        # The last accepted command came before the kill, so this is the stricter bound seen from outside.
        assert stopped - killed < DEADMAN_S + 0.05
        assert {value for _, value in webots.motor(wheel, stopped)} <= {0.0}
    assert webots.motor(LIFT) == [], "a linear motor holds its position"


def test_without_the_lease_nothing_moves_and_a_stop_is_everybodys(bench: Bench, robots: list[Webots]) -> None:
    webots = car(robots)
    gateway(bench, webots.port)
    established(bench)
    fleet = bench.fleet
    for path, fields in (
        ("motor/left", {"value": 3.0}),
        ("motor/lift", {"value": 0.3}),
        ("drive", {"forward": 0.3}),
        ("motor/nobody", {"value": 3.0}),
    ):
        fleet.put(f"r1/@cmd/{path}", **fields)
        until(lambda path=path: path in refused(fleet), what=f"refusal of {path}")  # type: ignore[misc]
    assert refused(fleet)["motor/left"] == "no lease: acquire first"
    assert {value for number in (LEFT, RIGHT, LIFT) for _, value in webots.motor(number)} <= {0.0}
    assert webots.motor(LIFT) == []
    fleet.hold("r1")
    other = Fleet(fleet.session)
    fleet.put("r1/@cmd/motor/lift", value=0.25)
    fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: (webots.last(LEFT), webots.last(RIGHT), webots.last(LIFT)) == (5.0, 5.0, 0.25), what="motion")
    other.put("r1/@cmd/motor/left", value=7.0)
    for name, value in (("eye", 7.0), ("nobody", 7.0), ("left", math.nan), ("left", math.inf), ("lift", -math.inf)):
        fleet.put(f"r1/@cmd/motor/{name}", value=value)
    until(lambda: {"motor/eye", "motor/nobody", "motor/lift"} <= refused(fleet).keys(), what="refusals")
    other.put("r1/@cmd/stop")
    until(lambda: (webots.last(LEFT), webots.last(RIGHT)) == (0.0, 0.0), what="stop")
    fleet.put("r1/@cmd/motor/left", value=8.0)
    until(lambda: fleet.last("r1/control")["state"] == "stopped", what="stopped")
    time.sleep(0.2)
    values = [struct.unpack("<BBBd", command)[2:] for _, command in webots.commands]
    assert {value for number, value in values if number != LIFT} == {0.0, 5.0}
    assert {number for number, _ in values} == {LEFT, RIGHT, LIFT}, "130 is sent to motors only"
    assert {value for number, value in values if number == LIFT} == {0.25}


def test_a_motor_that_is_set_in_the_first_second_keeps_its_velocity(bench: Bench, robots: list[Webots]) -> None:
    """The stop that the gateway repeats after connecting must not undo what the holder commands meanwhile."""
    webots = Webots(CAR, lambda step: data(EYE, step) if step > 10 else b"")
    robots.append(webots)
    gateway(bench, webots.port)
    established(bench)
    bench.fleet.hold("r1")
    bench.fleet.put("r1/@cmd/motor/left", value=4.0)
    moved = until(lambda: next((at for at, value in webots.motor(LEFT) if value == 4.0), 0.0), what="velocity")
    until(lambda: time.monotonic() > moved + 0.5)
    assert webots.last(LEFT) == 4.0


# Links


def test_a_simulation_that_ends_and_is_started_again_has_a_fresh_table(bench: Bench, robots: list[Webots]) -> None:
    webots = car(robots)
    gateway(bench, webots.port)
    established(bench)
    until(lambda: bench.fleet.last("r1/sensor/eye"), what="readings")
    assert set(devices(bench)) == {"left", "right", "lift", "eye"}
    webots.close()
    until(lambda: bench.fleet.state("r1") in ("offline", "connecting"), what="offline")
    assert bench.fleet.last("r1/status")["links"][0]["reason"]
    again = Webots(
        [(DISTANCE, LEFT, b"left"), (ROTATIONAL, RIGHT, b"arm")], lambda step: data(LEFT, step), port=webots.port
    )
    robots.append(again)
    until(lambda: bench.fleet.last("r1/sensor/left"), what="readings of the new one")
    established(bench)
    until(lambda: devices(bench) == {"left": (LEFT, "distance"), "arm": (RIGHT, "rotational")}, what="table")
    bench.fleet.hold("r1")
    bench.fleet.put("r1/@cmd/drive")  # whoever drove before begins with neutral
    for name in ("left", "right", "lift", "arm"):
        bench.fleet.put(f"r1/@cmd/motor/{name}", value=3.0)
    until(lambda: any(value == 3.0 for _, value in again.motor(RIGHT)), what="the arm")
    until(lambda: {"motor/left", "motor/right", "motor/lift"} <= refused(bench.fleet).keys(), what="refusals")
    assert {command[2] for _, command in again.commands} == {RIGHT}, "nothing goes to what is no motor any more"


def test_a_simulator_that_ends_and_is_started_again_is_found(bench: Bench) -> None:
    port = free_port()
    simulator = bench.simulator(port, "wc2ec", "--dialect", "deployed")
    gateway(bench, port, "")
    until(lambda: bench.fleet.last("r1/sensor/ds0"), what="readings")
    end(simulator)
    until(lambda: bench.fleet.state("r1") in ("offline", "connecting"), what="offline")
    ended = time.monotonic()
    bench.simulator(port, "wc2ec", "--dialect", "deployed")
    until(lambda: bench.fleet.last("r1/sensor/ds0")["at"] > ended + 0.1, what="readings again")
    established(bench)


def test_an_unknown_command_ends_the_link_with_its_bytes_in_the_reason_and_it_reconnects(bench, robots) -> None:
    webots = car(robots)
    gateway(bench, webots.port)
    established(bench)
    webots.send(bytes.fromhex("64 ab cd ef"))
    until(
        lambda: any("64 ab cd ef" in (status["reason"] or "") for status in bench.fleet.seen["fleet/r1/status"]),
        what="the bytes in the reason",
    )
    until(lambda: webots.connections == 2, what="a second connection")
    established(bench)
    ended = time.monotonic()
    until(lambda: bench.fleet.last("r1/sensor/eye")["at"] > ended, what="readings again")


def test_bad_registrations_are_shown_and_end_nothing(bench: Bench, robots: list[Webots]) -> None:
    names = [b"", b"n" * 255, b"\xff\xfe", b"a/*#@%", b"twin", b"twin"]
    webots = Webots(
        [*((DISTANCE, number, name) for number, name in enumerate(names)), (DISTANCE, 0, b"again")],
        lambda step: data(77, 1.0) + b"".join(data(number, math.nan) for number in range(len(names))),
    )
    robots.append(webots)
    gateway(bench, webots.port, "")
    chunks = ["%", "n" * 255, "%FF%FE", "a%2F%2A%23%40%25", "twin", "twin%235", "distance-77"]
    for chunk in chunks:
        until(lambda chunk=chunk: bench.fleet.last(f"r1/sensor/{chunk}"), what=chunk)  # type: ignore[misc]
    assert [bench.fleet.last(f"r1/sensor/{chunk}")["device"] for chunk in chunks] == [0, 1, 2, 3, 4, 5, 77]
    assert [bench.fleet.last(f"r1/sensor/{chunk}")["fault"] for chunk in chunks] == [True] * 6 + [False]
    assert np.isnan(bench.fleet.last("r1/sensor/twin")["value"])
    assert len(devices(bench)) == 6
    assert any("twin" in text["text"] for text in bench.fleet.seen["fleet/r1/text"])
    assert (webots.connections, bench.fleet.state("r1")) == (1, "established")


# The judge


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_fragile_robot_survives_a_hundred_mixed_commands(dialect: str) -> None:
    judgement = judge(dialect, commands=100)
    assert judgement.alive
    assert judgement.violations == []
    assert judgement.missing == []
    assert len(judgement.overtaken) <= 3
