"""``zbridge doctor`` against what is really broken: real gateways, robots, routers and certificates."""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.e2e.conftest import Bench, Gateway, ask, device, listener, until
from tests.e2e.rigs.robots import SETTINGS, Robot
from tests.e2e.rigs.secure import ROLES, SecureBus
from tests.ports import HOST, free_port
from zbridge.bus import BusSettings
from zbridge.doctor.examination import Examination, Options, examine_bus
from zbridge.doctor.findings import Verdict

ROOT = Path(__file__).parents[2]
PASSING = ("ends_soon", "restarted", "late", "busy", "robot_quiet")
"""Codes of what the test itself does: certificates of five days, gateways that have just started, a busy machine."""


def doctor(*arguments: str) -> tuple[int, list[dict[str, Any]]]:
    """Give doctor's exit code and findings."""
    command = [sys.executable, "-m", "zbridge", "doctor", "--json", *arguments]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=ROOT, check=False)
    assert ran.stderr == "", ran.stderr
    return ran.returncode, [json.loads(line) for line in ran.stdout.splitlines()]


def here(settings: BusSettings) -> list[dict[str, Any]]:
    """Examine all robots in this process, which need not start first."""
    examination = Examination()
    asyncio.run(examine_bus(examination, settings, "fleet", None, Options()))
    found: list[dict[str, Any]] = msgspec.to_builtins(examination.findings)
    return [each | {"verdict": Verdict(each["verdict"]).name.lower()} for each in found]


def codes(findings: list[dict[str, Any]], robot: str | None = None, layer: str = "") -> set[str]:
    """Give the codes of what is not well, of one robot and layer, or of all."""
    return {
        each["code"]
        for each in findings
        if each["verdict"] not in ("ok", "skipped") and each["code"] not in PASSING
        if robot in (None, each["robot"]) and layer in ("", each["layer"])
    }


@contextlib.contextmanager
def mute() -> Iterator[int]:
    """Accept connections, and say nothing."""
    held: list[socket.socket] = []
    with socket.create_server((HOST, 0)) as server:

        def accept() -> None:
            with contextlib.suppress(OSError):
                while True:
                    held.append(server.accept()[0])

        thread = threading.Thread(target=accept, daemon=True)
        thread.start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)
        thread.join(5.0)
    for each in held:
        each.close()


@pytest.fixture
def odd_robot() -> Iterator[Robot]:
    """Make a robot of a version that nobody knows: "9.9,9.8,9.7" in place of "1.1,1.2,1.3"."""
    robot = Robot(SETTINGS.replace(b"1.1,1.2,1.3", b"9.9,9.8,9.7"))
    yield robot
    robot.close()


@pytest.mark.long
def test_each_robot_of_a_fleet_is_diagnosed_by_what_is_broken_there(bench: Bench, odd_robot: Robot) -> None:
    fleet, at = bench.fleet, ("--connect", bench.endpoint)
    full = '[control]\naudit = "/dev/full"\n'
    with mute() as silent_port:
        bench.serve(bench.simulator(), listener("desk", "tcpudp", free_port()), full)
        bench.gateway(device(silent_port), robot="mute")
        bench.gateway(device(odd_robot.port), robot="odd")
        bench.gateway(device(free_port()), robot="gone")
        frozen = bench.gateway(device(bench.simulator()), robot="frozen")
        until(lambda: fleet.state("frozen") == "established", what="the robot whose gateway is frozen")
        fleet.hold("r1", "driver")
        fleet.put("r1/@cmd/drive", forward=0.1)
        fleet.release("r1")
        fleet.put("r1/@cmd/drive", forward=0.1)
        fleet.hold("r1", "somebody")
        until(lambda: "may be used up" in str(fleet.get("fleet/mute/@rpc/sessions/gateway")), what="the mute robot")
        until(lambda: "not written" in fleet.reason("r1"), what="the full disk")
        frozen.signal(signal.SIGSTOP)  # its token stays for the ten seconds after which its router gives it up
        try:
            findings = here(BusSettings(connect=(bench.endpoint,), multicast=False))
        finally:
            frozen.signal(signal.SIGCONT)
    assert codes(findings, "mute") >= {"used_up"}
    assert codes(findings, "odd") >= {"wrong_version"}
    assert codes(findings, "gone", "robot") <= {"robot_offline", "robot_connecting"} != set()
    assert codes(findings, "frozen") == {"gateway_silent"}
    assert codes(findings, "r1") - {"restarted", "late", "busy", "robot_quiet"} >= {
        "condition",
        "held",
        "listener_loopback",
    }
    refused = next(each for each in findings if each["code"] == "held" and each["robot"] == "r1")
    assert refused["text"].startswith("somebody drives")
    _, alone = doctor("gone", *at)
    assert "Connection refused" in next(each["text"] for each in alone if each["code"].startswith("robot_"))
    assert codes(doctor("nobody", *at)[1]) == {"no_gateway"}


def test_a_file_is_examined_on_its_own_host(bench: Bench, tmp_path: Path) -> None:
    port, hq = bench.simulator(), free_port()
    bench.serve(port, listener("desk", "tcpudp", hq))
    bus = f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n'
    parts = device(port) + listener("desk", "tcpudp", hq) + bus
    own, other = tmp_path / "own.toml", tmp_path / "other.toml"
    own.write_text(f'[robot]\nname = "r1"\n{parts}')
    other.write_text(f'[robot]\nname = "r2"\n{parts}')
    code, findings = doctor(str(own))
    assert code == 0, findings
    assert {(each["layer"], each["verdict"]) for each in findings} >= {
        ("configuration", "ok"),
        ("names", "ok"),
        ("address", "ok"),
        ("listeners", "ok"),
        ("bus", "ok"),
        ("robot", "ok"),
    }
    code, findings = doctor(str(other))
    assert code == 1
    assert codes(findings, "r2") >= {"address_taken", "port_taken", "no_gateway"}
    assert doctor("r1", "--connect", bench.endpoint, "--from-here", f"tcp://{HOST}:{hq}")[0] == 0
    code, findings = doctor("r1", "--connect", bench.endpoint, "--from-here", f"tcp://{HOST}:{free_port()}")
    assert (code, codes(findings, layer="listeners") >= {"not_reached"}) == (1, True)


def test_a_robot_is_contacted_by_a_probe_only(bench: Bench, odd_robot: Robot, tmp_path: Path) -> None:
    file = tmp_path / "odd.toml"
    bus = f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n'
    file.write_text(f'[robot]\nname = "odd"\n{device(odd_robot.port)}{bus}')
    code, findings = doctor(str(file))
    assert (code, codes(findings)) == (1, {"not_here", "no_gateway"} | codes(findings, layer="supervisor"))
    assert odd_robot.connections == 0
    code, findings = doctor(str(file), "--probe")
    assert (code, odd_robot.connections) == (1, 1)
    assert codes(findings, layer="robot") == {"wrong_version"}


def test_who_may_not_drive_and_what_a_router_refuses_are_told(tmp_path: Path) -> None:
    bus = SecureBus(tmp_path, ROLES)
    try:
        code, findings = doctor("r1", "--tls", str(bus.folders["v1"]), "--connect", bus.endpoint)
        assert code == 1, "no gateway serves it"
        assert codes(findings, layer="role") == {"may_not_drive"}
        assert codes(doctor("r2", "--tls", str(bus.folders["h1"]), "--connect", bus.endpoint)[1]) >= {"other_robot"}
        stranger = bus.authority.issue("viewer.zed")
        _, findings = doctor("r1", "--tls", str(stranger), "--connect", bus.endpoint)
        assert codes(findings) == {"bus_refused"}
        assert "does not know viewer.zed" in next(each["text"] for each in findings if each["code"] == "bus_refused")
        _, findings = doctor("r1", "--connect", bus.endpoint.replace("tls/", "tcp/"))
        assert codes(findings) == {"bus_refused"}
    finally:
        bus.stop()


def test_a_gateways_file_joins_a_secure_bus_as_the_gateway_and_reads_it_as_a_viewer(
    bench: Bench, tmp_path: Path
) -> None:
    bus = SecureBus(tmp_path / "secure", ROLES)
    try:
        file = tmp_path / "r1.toml"
        folder = bus.folders["g1"]
        names = {"ca": "ca.pem", "certificate": "certificate.pem", "key": "key.pem"}
        tls = ", ".join(f'{name} = "{folder / path}"' for name, path in names.items())
        (folder / "key.pem").chmod(0o600)
        file.write_text(
            f'[robot]\nname = "r1"\n{device(bench.simulator())}[bus]\nconnect = ["{bus.endpoint}"]\ntls = {{ {tls} }}\n'
        )
        code, findings = doctor(str(file))
        assert (code, codes(findings, layer="gateway")) == (1, {"no_gateway"})
        bench.zbridge("run", str(file))
        until(lambda: codes(doctor(str(file))[1], layer="gateway") == {"gateway_token"}, what="its token")
        viewer = ("--tls", str(bus.folders["v1"]))
        _, findings = doctor(str(file), *viewer)
        assert codes(findings, layer="robot") <= {"condition"}, "its certificate ends soon"
        assert {each["layer"] for each in findings} >= {"robot", "driving", "process", "clocks"}
        with bus.session("v1") as viewer_session:
            (stats,) = ask(viewer_session, "fleet/*/@gateway/stats")
        assert stats["process"]["robots"] == 1, "a plain get returns the last value"
    finally:
        bus.stop()


def test_a_router_whose_sessions_are_used_says_so_and_so_does_doctor(tmp_path: Path) -> None:
    endpoint, log = f"tcp/{HOST}:{free_port()}", tmp_path / "log"
    file = tmp_path / "router.toml"
    file.write_text(f'listen = ["{endpoint}"]\n[limits]\nsessions = 1\n')
    with contextlib.ExitStack() as stack:
        with log.open("wb") as output:
            router = subprocess.Popen([sys.executable, "-m", "zbridge", "router", str(file)], stderr=output)
        stack.callback(router.wait, 10)
        stack.callback(router.terminate)
        until(lambda: "router at" in log.read_text(), what="the router")
        with mute() as port:
            Gateway(stack, tmp_path / "r1.toml", endpoint, device(port))
            until(lambda: "connected from" in log.read_text(), what="the only session")
            code, findings = doctor("r1", "--connect", endpoint)
    assert (code, codes(findings)) == (1, {"router_full"})
    assert "limits.sessions = 1 are used" in log.read_text()
