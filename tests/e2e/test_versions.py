"""Every version of the TCP/UDP protocol, by TCP and by UDP, with the simulator; and the commands for it."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import pytest

from tests.e2e.conftest import Bench, end, free_port, until
from tests.e2e.robots import ScriptedRobot
from tests.e2e.test_cli import zbridge

FLAGS = {
    "1.1": ["cam", "joystick", "chat", "lidar"],
    "1.2": ["cam", "joystick", "chat", "lidar", "lidar_sim"],
    "1.3": ["cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map"],
    "1.4": ["cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map"],
}


@pytest.mark.parametrize("udp", [False, True], ids=["tcp", "udp"])
@pytest.mark.parametrize("version", FLAGS)
def test_a_robot_of_every_version_is_seen_and_driven(bench: Bench, version: str, udp: bool) -> None:
    port = free_port()
    bench.simulator(port, "tcpudp", "--version", version, *(["--udp"] if udp else []))
    bench.gateway("r1", port)
    fleet = bench.fleet
    until(lambda: fleet.state("r1") == "established")
    status = fleet.last("r1/status")
    assert status["version"] == version
    assert status["features"] == (["udp"] if udp else []) + FLAGS[version]
    before = until(lambda: fleet.last("r1/pose"))
    fleet.hold("r1")
    for _ in range(10):
        fleet.put("r1/@cmd/drive", forward=1.0)
        time.sleep(0.05)
    until(lambda: abs(fleet.last("r1/pose")["y"] - before["y"]) > 0.1, what="motion")
    (answered,) = fleet.get("fleet/r1/@rpc/map")
    assert (answered["rows"], len(answered["cells"])) == (100, 10_000)


@pytest.mark.parametrize("udp", [False, True], ids=["tcp", "udp"])
def test_a_1_4_robot_is_driven_while_it_sends_its_map(bench: Bench, udp: bool) -> None:
    port = free_port()
    bench.simulator(port, "tcpudp", "--version", "1.4", *(["--udp"] if udp else []))
    bench.gateway("r1", port)
    fleet = bench.fleet
    until(lambda: fleet.state("r1") == "established")
    fleet.hold("r1")
    before = until(lambda: fleet.last("r1/pose"))
    maps = len(fleet.seen.get("fleet/r1/map", []))
    while len(fleet.seen.get("fleet/r1/map", [])) < maps + 2:  # each of four parts, one a second
        fleet.put("r1/@cmd/drive", turn=0.5)
        time.sleep(0.1)
    assert abs(fleet.last("r1/pose")["heading"] - before["heading"]) > 0.5
    (answered,) = fleet.get("fleet/r1/@rpc/map")
    assert answered["cells"].count(1) > 1000
    assert fleet.last("r1/status")["reason"] is None
    assert fleet.last("r1/control")["refusals"] == []


def test_datagrams_from_elsewhere_are_dropped_and_counted(bench: Bench) -> None:
    port, metrics = free_port(), free_port()
    bench.simulator(port, "tcpudp", "--udp")
    gateway = bench.serve("r1", port, f'[metrics]\nlisten = "127.0.0.1:{metrics}"\n')
    forged = bytes.fromhex("0e000000013700007a4400007a4400000000")  # a position at (1000, 1000)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for ours in _udp_ports(gateway.pid):
            stranger.sendto(forged, ("127.0.0.1", ours))
    until(lambda: "zbridge_foreign_datagrams_total 1" in _page(metrics), what="the count")
    assert all(pose["x"] < 9 for pose in bench.fleet.seen["fleet/r1/pose"])


def _udp_ports(pid: int) -> list[int]:
    """List the loopback UDP ports a process has bound."""
    inodes = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        target = str(descriptor.readlink())
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    rows = [line.split() for line in Path(f"/proc/{pid}/net/udp").read_text().splitlines()[1:]]
    return [int(row[1].split(":")[1], 16) for row in rows if row[9] in inodes and row[1].startswith("0100007F")]


def _page(port: int) -> str:
    with socket.create_connection(("127.0.0.1", port), timeout=3) as client:
        client.sendall(b"GET /metrics HTTP/1.0\r\n\r\n")
        return b"".join(iter(lambda: client.recv(65536), b"")).decode()


def test_probe_warns_talks_only_with_yes_and_asks_a_gateway_first(bench: Bench) -> None:
    robot = ScriptedRobot()
    at = f"tcp://127.0.0.1:{robot.port}"
    try:
        warned = zbridge("probe", "tcpudp", at, "--connect", bench.endpoint)
        assert warned.returncode == 2
        assert "uses it up" in warned.stderr
        assert robot.connections == 0
        asked = zbridge("probe", "tcpudp", at, "--yes", "--connect", bench.endpoint)
        assert asked.returncode == 0, asked.stderr
        assert "version: 1.3" in asked.stdout
        assert '"joystick"' in asked.stdout
        assert robot.connections == 1
        bench.serve("r1", robot.port)
        served = zbridge("probe", "tcpudp", at, "--connect", bench.endpoint)
        assert served.returncode == 0
        assert "served by the gateway of r1" in served.stdout
        assert "version: 1.3" in served.stdout
        assert robot.connections == 2
    finally:
        robot.close()


def test_probe_of_nothing_says_why(bench: Bench) -> None:
    asked = zbridge("probe", "tcpudp", f"tcp://127.0.0.1:{free_port()}", "--yes", "--connect", bench.endpoint)
    assert asked.returncode == 1
    assert "refused" in asked.stderr


def test_a_fragile_simulator_names_what_killed_it(bench: Bench) -> None:
    port = free_port()
    robot = bench.simulator(port, "tcpudp", "--fragile", "--version", "1.1")
    with socket.create_connection(("127.0.0.1", port)) as client:
        client.recv(4096)
        client.sendall(bytes.fromhex("0e000000000303000000312e310000000000"))
        time.sleep(0.05)
        client.sendall(bytes.fromhex("02000000004d"))  # 77 is registered by nobody
        output = robot.communicate(timeout=10)[0]
    assert "died: " in output
    assert "77" in output


@pytest.mark.parametrize("version", ["1.0", "2.0", "x"])
def test_a_version_nobody_knows_is_named_with_the_ones_there_are(version: str) -> None:
    ran = zbridge("simulate", "tcpudp", "--listen", "tcp://127.0.0.1:0", "--version", version)
    assert ran.returncode == 2
    assert "expected one of 1.1, 1.2, 1.3, 1.4" in ran.stderr
    assert "Traceback" not in ran.stderr


def test_a_robot_whose_datagrams_never_come_is_used_by_tcp(bench: Bench) -> None:
    """The robot offers UDP and starts it, and answers nothing: the gateway gives up after its two seconds."""
    settings = "210000000102020b000000312e312c312e322c312e3301010101010101e803000064000000"
    robot = ScriptedRobot(bytes.fromhex(settings) + bytes.fromhex("020000000104"))
    try:
        gateway = bench.gateway("r1", robot.port)
        until(lambda: bench.fleet.state("r1") == "established", what="established by TCP")
        assert [data[5] for _, data in robot.reads][:2] == [3, 7]
        assert robot.reads[1][1] == bytes.fromhex("03000000020700")
        bench.fleet.hold("r1")
        bench.fleet.put("r1/@cmd/drive", forward=0.5)
        until(lambda: robot.packets(11), what="drive by TCP")
        end(gateway)
    finally:
        robot.close()
