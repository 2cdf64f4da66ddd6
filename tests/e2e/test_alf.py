"""ALF vehicles end to end: simulator or scripted vehicle, real sockets, real Zenoh, one link and two."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import zbridge
from tests.e2e.conftest import Bench, Fleet, end, free_port, until
from tests.e2e.fragile import charges

DEADMAN_S = 0.3
INIT = b"2|-135.000000|119.882812|0.351562|100|20|5600;"
END = {"text": b"255|1;", "binary": bytes.fromhex("ff 01")}
STANDS = {"text": b"3|0|0|0|0;", "binary": bytes.fromhex("03 00 00 5a 00")}
HALF = {"text": b"3|50|0|0|0;", "binary": bytes.fromhex("03 32 00 5a 00")}
SPEED_0 = {"text": b"3|0|", "binary": bytes.fromhex("03 00")}


def scan(sequence: int, counter_ms: int) -> bytes:
    return b"1|%d|%d|" % (sequence, counter_ms) + b"1500|" * 769 + b"44|725;"


class Server:
    """One server of a scripted vehicle: accepts one HQ after the other, keeps every message with its time."""

    def __init__(self, dialect: str = "text", greeting: bytes = b"", port: int = 0) -> None:
        self.connections: list[list[tuple[float, bytes]]] = []
        """The messages of each connection, b"" where it ended."""
        self._dialect = dialect
        self._greeting = greeting
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
            self._peer = peer
            messages: list[tuple[float, bytes]] = []
            self.connections.append(messages)
            with peer:
                with contextlib.suppress(OSError):
                    peer.sendall(self._greeting)
                    rest = b""
                    while data := peer.recv(4096):
                        at = time.monotonic()
                        *whole, rest = self._cut(rest + data)
                        messages += [(at, message) for message in whole]
                messages.append((time.monotonic(), b""))

    def _cut(self, data: bytes) -> list[bytes]:
        """The messages of ``data`` and what is left of it."""
        if self._dialect == "text":
            *whole, rest = data.split(b";")
            return [message + b";" for message in whole] + [rest]
        cut = []
        while data and len(data) >= (size := {3: 5, 255: 2}[data[0]]):
            cut.append(data[:size])
            data = data[size:]
        return [*cut, data]

    def send(self, data: bytes) -> None:
        assert self._peer is not None
        self._peer.sendall(data)

    def heard(self, since: float = 0.0) -> list[bytes]:
        """What came after a moment, over all connections."""
        return [message for messages in self.connections for at, message in messages if at > since]

    def first(self, start: bytes, since: float = 0.0) -> float:
        """When the first message that begins like this came after a moment; 0 before it has come."""
        return next((at for at, _ in self.timed(start) if at > since), 0.0)

    def timed(self, start: bytes) -> list[tuple[float, bytes]]:
        return [both for messages in self.connections for both in messages if both[1].startswith(start)]

    def close(self) -> None:
        """End the server and its connection, without a word."""
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self._peer.shutdown(socket.SHUT_RDWR)
        self._thread.join(5)


@pytest.fixture
def servers() -> Iterator[list[Server]]:
    """The servers that a test starts."""
    started: list[Server] = []
    yield started
    for server in started:
        server.close()


def gateway(
    bench: Bench, ports: list[int], *, dialect: str = "text", robot: str = "r1", more: str = ""
) -> subprocess.Popen[str]:
    """A gateway of one vehicle; ``ports``: its drive server, then its laser server."""
    connect = ", ".join(f'"tcp://127.0.0.1:{port}"' for port in ports)
    file = bench.folder / f"{robot}.toml"
    file.write_text(
        f'[robot]\nname = "{robot}"\n'
        f'[device]\nprotocol = "alf"\nconnect = [{connect}]\n[device.options]\ndialect = "{dialect}"\n'
        f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n{more}'
    )
    return bench.zbridge("run", str(file))


def simulator(bench: Bench, ports: list[int], dialect: str) -> subprocess.Popen[str]:
    more = [word for port in ports[1:] for word in ("--listen", f"tcp://127.0.0.1:{port}")]
    return bench.simulator(ports[0], "alf", *more, "--dialect", dialect)


def established(bench: Bench, robot: str = "r1", links: int = 1) -> bool:
    status = bench.fleet.last(f"{robot}/status")
    up = [link["state"] for link in status.get("links", [])]
    return status.get("state") == "established" and up == ["established"] * links


def link(bench: Bench, name: str) -> dict[str, Any]:
    """One link as ``status`` shows it."""
    links: list[dict[str, Any]] = bench.fleet.last("r1/status")["links"]
    return next(link for link in links if link["name"] == name)


def refused(bench: Bench) -> dict[str, str]:
    """The reasons of what ``control`` shows as refused, by command."""
    return {entry["command"]: entry["reason"] for entry in bench.fleet.last("r1/control").get("refusals", [])}


def age_s(fields: dict[str, Any]) -> float:
    """How long before its arrival a message says it was measured, seconds."""
    arrived_ns = time.time_ns() - (time.monotonic() - fields["at"]) * 1e9
    return float(arrived_ns - fields["stamp_ns"]) / 1e9


# The simulator


@pytest.mark.parametrize("dialect", ["text", "binary"])
def test_a_vehicle_with_one_port_and_one_with_two_are_seen_and_driven(bench: Bench, dialect: str) -> None:
    fleet, ports = bench.fleet, {"one": [free_port()], "two": [free_port(), free_port()]}
    simulators = {robot: simulator(bench, ports[robot], dialect) for robot in ports}
    for robot in ports:
        gateway(bench, ports[robot], dialect=dialect, robot=robot)
    for robot in ports:
        until(lambda robot=robot: established(bench, robot, len(ports[robot])), what=f"{robot} established")  # type: ignore[misc]
    for robot, names in (("one", ["vehicle"]), ("two", ["drive", "laser"])):
        status = fleet.get(f"fleet/{robot}/status")[0]
        assert (status["protocol"], status["dialect"], status["version"]) == ("alf", dialect, None)
        assert [link["name"] for link in status["links"]] == names
        check_telemetry(fleet, robot)
        fleet.hold(robot)
    drive(fleet, forward=0.5, turn=1.0)
    for robot in ports:
        motion = fleet.last(f"{robot}/motion")
        assert motion["gyro"][2] > 0.1, "a positive turn is to the left"
        assert motion["acceleration"][2] == pytest.approx(9.80665, abs=0.1)
        assert motion["acceleration"][1] > 0.0, "on a circle to the left it is accelerated to the left"
    drive(fleet, forward=-0.5, turn=1.0)
    for robot in ports:
        assert fleet.last(f"{robot}/motion")["gyro"][2] > 0.1, "backwards too"
        fleet.put(f"{robot}/@cmd/stop")
    until(lambda: {fleet.last(f"{robot}/motion")["speed"] for robot in ports} == {0.0}, what="both stand")
    for robot, process in simulators.items():
        end(process)
        until(lambda robot=robot: "ended" in reasons(fleet, robot), what=f"{robot} ended")  # type: ignore[misc]


def reasons(fleet: Fleet, robot: str) -> set[str | None]:
    """Every reason that ``status`` has ever shown."""
    return {status["reason"] for status in fleet.seen[f"fleet/{robot}/status"]}


def check_telemetry(fleet: Fleet, robot: str) -> None:
    """Scans keep coming, of now, in order, with the geometry and the valid points of the scanner."""
    scanner = until(lambda: fleet.get(f"fleet/{robot}/scanner"), what="scanner")[0]
    assert scanner["points"] == 769
    assert (scanner["angle_min"], scanner["angle_max"]) == pytest.approx((-2.3561945, 2.0923498))
    scans = fleet.seen.setdefault(f"fleet/{robot}/scan", [])
    until(lambda: len(scans) >= 5, what="five scans")
    for number, one in enumerate(scans[:5]):
        ranges = np.frombuffer(one["ranges"], "<f4")
        assert len(ranges) == 769
        assert np.isnan(ranges[:44]).all()
        assert np.isnan(ranges[726:]).all()
        valid = ranges[~np.isnan(ranges)]
        assert len(valid) > 300
        assert valid.min() > 0.02 - 1e-6
        assert valid.max() < 5.6 + 1e-6
        assert one["seq"] - scans[0]["seq"] == number
        assert one["device_ms"] - scans[0]["device_ms"] == 100 * number
        assert -0.05 < age_s(one) < 0.3
    stamps = [one["stamp_ns"] for one in scans[:5]]
    assert stamps == sorted(stamps)


def drive(fleet: Fleet, forward: float, turn: float) -> None:
    """Drive both vehicles until both say that they move in this direction."""
    wanted = 0.2 if forward > 0 else -0.2

    def moved() -> bool:
        for robot in ("one", "two"):
            fleet.put(f"{robot}/@cmd/drive", forward=forward, turn=turn)
        time.sleep(0.02)
        speeds = [fleet.last(f"{robot}/motion").get("speed", 0.0) / wanted for robot in ("one", "two")]
        return bool(min(speeds) >= 1.0)

    until(moved, what="both move")


# Links


def test_a_vehicle_whose_laser_link_dies_drives_on_and_status_says_so(bench: Bench, servers: list[Server]) -> None:
    metrics = free_port()
    wheels, laser = Server(), Server(greeting=INIT + scan(1, 1000) + scan(4, 1300) + scan(4, 1300))
    servers += [wheels, laser]
    gateway(bench, [wheels.port, laser.port], more=f'[metrics]\nlisten = "127.0.0.1:{metrics}"\n')
    until(lambda: established(bench, links=2), what="both links")
    assert until(lambda: bench.fleet.last("r1/scan").get("seq") == 4, what="scan")
    bench.fleet.hold("r1", lease_s=3.0, deadman_s=2.0)
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    moving = until(lambda: wheels.first(HALF["text"]), what="drive")
    laser.close()

    def laser_is_offline() -> bool:
        bench.fleet.put("r1/@cmd/drive", forward=0.5)  # again and again, or a late machine meets the deadman
        return bool(link(bench, "laser")["state"] == "offline")

    until(laser_is_offline, what="laser link offline")
    assert link(bench, "laser")["reason"]
    status = bench.fleet.last("r1/status")
    assert (status["state"], link(bench, "drive")["state"]) == ("established", "established")
    died = time.monotonic()
    bench.fleet.put("r1/@cmd/drive", forward=0.6)
    until(lambda: wheels.first(b"3|60|0|0|0;", died), what="a new command")
    until(lambda: len(wheels.timed(b"3|60|")) > 5, what="its repetitions")
    assert set(wheels.heard(moving - 1e-6)) == {HALF["text"], b"3|60|0|0|0;"}
    assert bench.fleet.last("r1/control")["state"] == "held"
    assert laser.heard() == [b""], "a laser link is told nothing"
    with urllib.request.urlopen(f"http://127.0.0.1:{metrics}/metrics", timeout=3) as page:
        text = page.read().decode()
    assert "zbridge_sequence_gaps_total 2\n" in text
    assert "zbridge_sequence_duplicates_total 1\n" in text
    revived = Server(greeting=INIT + scan(5, 1400), port=laser.port)
    servers.append(revived)
    until(lambda: bench.fleet.last("r1/scan")["seq"] == 5, what="scans again")
    until(lambda: established(bench, links=2), what="both links again")
    assert len(wheels.connections) == 1
    wheels.close()
    until(lambda: bench.fleet.state("r1") == "offline", what="offline, for the drive link is down")
    assert link(bench, "laser")["state"] == "established"
    revived.send(scan(6, 1500))
    until(lambda: bench.fleet.last("r1/scan")["seq"] == 6, what="scans without the drive link")


def test_end_from_the_vehicle_is_answered_shown_and_the_next_connection_begins_with_standing_still(
    bench: Bench, servers: list[Server]
) -> None:
    vehicle = Server(greeting=INIT)
    servers.append(vehicle)
    gateway(bench, [vehicle.port])
    until(lambda: established(bench), what="established")
    bench.fleet.hold("r1")
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: vehicle.first(HALF["text"]), what="drive")
    vehicle.send(END["text"])
    until(lambda: vehicle.connections[0][-1][1] == b"", what="the end of the connection")
    *before, answer, _ = [message for _, message in vehicle.connections[0]]
    assert answer == END["text"]
    assert set(before) == {STANDS["text"], HALF["text"]}
    until(lambda: "ended" in reasons(bench.fleet, "r1"), what="reason ended")
    assert {status["state"] for status in bench.fleet.seen["fleet/r1/status"] if status["reason"] == "ended"} <= {
        "offline",
        "closing",
    }
    until(lambda: len(vehicle.connections) == 2 and established(bench), what="connected again")
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: "send a neutral drive first" in refused(bench).get("drive", ""), what="refusal")
    assert set(vehicle.heard(vehicle.connections[1][0][0] - 1e-6)) == {STANDS["text"]}
    bench.fleet.put("r1/@cmd/drive")
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: HALF["text"] in [message for _, message in vehicle.connections[1]], what="drive again")


def test_sigterm_stops_the_vehicle_says_end_on_both_links_and_nothing_behind_it(bench, servers) -> None:
    wheels, laser = Server("binary"), Server("binary")
    servers += [wheels, laser]
    process = gateway(bench, [wheels.port, laser.port], dialect="binary")
    until(lambda: established(bench, links=2), what="both links")
    bench.fleet.hold("r1")
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: wheels.first(HALF["binary"]), what="drive")
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=3) == 0
    until(lambda: wheels.heard()[-1] == laser.heard()[-1] == b"", what="the end of both connections")
    assert laser.heard() == [END["binary"], b""]
    *_, stop, said, _ = wheels.heard()
    assert (stop, said) == (STANDS["binary"], END["binary"])
    assert wheels.heard().count(END["binary"]) == 1
    last = max(at for at, _ in wheels.timed(HALF["binary"]))
    assert STANDS["binary"] in wheels.heard(last)


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
    drive = session.declare_publisher("fleet/r1/@cmd/drive")
    while True:
        command = msgpack.packb({"forward": 0.5})
        drive.put(command, attachment=held.attachment("drive", command))
        time.sleep(0.02)
"""


@pytest.mark.parametrize("dialect", ["text", "binary"])
def test_driver_killed_the_vehicle_gets_speed_0_within_the_deadman(bench, servers, dialect) -> None:
    vehicle = Server(dialect)
    servers.append(vehicle)
    gateway(bench, [vehicle.port], dialect=dialect, more=f"[control]\ndeadman_s = {DEADMAN_S}\n")
    until(lambda: established(bench), what="established")
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, bench.endpoint])
    try:
        until(lambda: len(vehicle.timed(HALF[dialect])) > 20, what="driving")
    finally:
        withheld_s = bench.withheld_s
        driver.kill()
        killed = time.monotonic()
        driver.communicate()
    stop_at = until(lambda: vehicle.first(SPEED_0[dialect], killed), what="stop")
    # The last accepted command came before the kill, so this is the stricter bound seen from outside.
    assert stop_at - killed < DEADMAN_S + 0.05 + bench.withheld_s - withheld_s
    until(lambda: len(vehicle.heard(stop_at)) >= 25, what="repetitions for as long as the link stands")
    took_s = vehicle.timed(b"")[-1][0] - stop_at
    assert took_s < 25 * 0.02 + 0.1 + bench.withheld_s - withheld_s, "every 20 ms"
    assert set(vehicle.heard(stop_at)) == {STANDS[dialect]}


def test_without_the_lease_nothing_moves_and_with_it_one_program_drives(bench: Bench, servers: list[Server]) -> None:
    vehicle = Server()
    servers.append(vehicle)
    gateway(bench, [vehicle.port])
    until(lambda: established(bench), what="established")
    fleet, other = bench.fleet, Fleet(bench.fleet.session)
    fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: refused(bench).get("drive") == "no lease: acquire first", what="refusal")
    assert set(vehicle.heard()) == {STANDS["text"]}
    fleet.put("r1/@cmd/light", on=True)
    until(lambda: vehicle.first(b"3|0|0|0|1;"), what="light, which nobody needs a lease for")
    fleet.hold("r1", "first")
    fleet.put("r1/@cmd/drive", forward=0.5, turn=0.5)
    began = until(lambda: vehicle.first(b"3|50|0|-45|1;"), what="the holder's drive")
    other.put("r1/@cmd/drive", forward=1.0)
    fleet.put("r1/@cmd/drive", left=1.0)
    fleet.put("r1/@cmd/mode", mode="autonomous")
    until(lambda: {"drive", "mode"} <= refused(bench).keys(), what="refusals")
    other.hold("r1", "second", how="takeover")
    stop_at = until(lambda: vehicle.first(b"3|0|0|0|1;", began), what="the stop of a takeover")
    fleet.put("r1/@cmd/drive", forward=0.7)
    until(lambda: "taken over by second" in refused(bench)["drive"], what="refusal of the first")
    assert set(vehicle.heard(began)) == {b"3|50|0|-45|1;", b"3|0|0|0|1;"}
    other.put("r1/@cmd/drive", forward=-0.3, light=False)
    back = until(lambda: vehicle.first(b"3|30|1|0|0;", stop_at), what="the second's drive")
    fleet.put("r1/@cmd/stop")
    until(lambda: vehicle.first(b"3|0|", back), what="a stop that anybody may send")
    until(lambda: fleet.last("r1/control")["state"] == "stopped", what="stopped")
    other.close()


@pytest.mark.parametrize("dialect", ["text", "binary"])
def test_a_fragile_vehicle_finds_nothing_to_complain_of(bench: Bench, dialect: str) -> None:
    vehicle = bench.zbridge(
        *("simulate", "alf", "--fragile", "--dialect", dialect),
        *(argument for _ in range(2) for argument in ("--listen", f"tcp://127.0.0.1:{free_port()}")),
    )
    assert vehicle.stdout is not None
    addresses = [word for word in vehicle.stdout.readline().split() if word.startswith("tcp://")]
    file = bench.folder / "r1.toml"
    file.write_text(
        f'[robot]\nname = "r1"\n[device]\nprotocol = "alf"\nconnect = {json.dumps(addresses)}\n'
        f'options = {{ dialect = "{dialect}" }}\n[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n'
    )
    gateway = bench.zbridge("run", str(file))
    until(lambda: bench.fleet.state("r1") == "established", what="established")
    withheld_s = bench.withheld_s
    with zbridge.blocking.connect(bench.endpoint) as fleet, fleet["r1"].control() as drive:
        for number in range(60):
            drive(forward=(number % 21 - 10) / 10, turn=(number % 13 - 6) / 6, light=bool(number % 2))
            time.sleep(0.02)
    late_s = bench.withheld_s - withheld_s
    end(gateway)
    said = end(vehicle)
    assert len(bench.fleet.seen["fleet/r1/scan"]) > 5
    assert charges([line for line in said.splitlines() if "violation" in line], late_s) == [], said
    assert "died" not in said, said
