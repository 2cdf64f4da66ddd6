"""The commands as a user types them: real processes, real Zenoh."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import Bench, device, end, listener, start, until
from tests.e2e.rigs.robots import Robot
from tests.ports import free_port
from zbridge.protocol.plugin import protocol_names

ROOT = Path(__file__).parents[2]
FILE = '[robot]\nname = "r1"\n' + device(1, options="gap = 1")
NOBODY = "tcp://127.0.0.1:1"


def zbridge(*arguments: str, module: str = "zbridge", timeout_s: float = 30.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.run(
        command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=timeout_s, cwd=ROOT, check=False
    )


@pytest.mark.parametrize("module", ["zbridge", "gateways.tcpudp"])
def test_a_bad_file_ends_run_and_the_error_names_file_key_and_value(module: str, tmp_path: Path) -> None:
    bad = tmp_path / "r1.toml"
    bad.write_text(FILE)
    ran = zbridge(*(["run"] if module == "zbridge" else []), str(bad), module=module)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert f"{bad}: device.options.gap = 1: unknown key; expected one of udp, gap_s," in ran.stderr
    assert "Traceback" not in ran.stderr


def test_an_hq_program_that_finds_no_robot_says_so() -> None:
    ran = zbridge("simulate", "alf", "--hq", NOBODY)
    assert (ran.returncode, ran.stdout) == (1, "connecting to 127.0.0.1:1\n")
    assert ran.stderr.startswith(f"zbridge: {NOBODY}: ")
    assert "Traceback" not in ran.stderr


def test_ls_echo_and_stop_say_what_there_is_and_a_stop_takes_the_robot_from_its_driver(bench: Bench) -> None:
    port, fleet, at = bench.simulator(), bench.fleet, ("--connect", bench.endpoint)
    bench.serve(port)
    (robot,) = [json.loads(line) for line in zbridge("ls", "--json", *at).stdout.splitlines()]
    assert (robot["robot"], robot["state"], robot["version"]) == ("r1", "established", "1.3")
    assert "established" in zbridge("ls", *at).stdout
    for line in zbridge("echo", "fleet/r1/pose", "--json", "--count", "2", *at).stdout.splitlines():
        assert json.loads(line).keys() == {"key", "x", "y", "heading", "stamp_ns"}
    until(lambda: fleet.last("r1/map"), what="a map")
    (last,) = zbridge("echo", "fleet/r1/map", "--count", "1", *at).stdout.splitlines()
    assert "cells=uint8[100, 100]" in last
    nothing = zbridge("drive", "r1", *at)
    assert (nothing.returncode, nothing.stderr) == (1, "zbridge: drive needs a terminal to read keys from\n")
    fleet.hold("r1", "driver")
    stopped = zbridge("stop", "r1", *at)
    assert (stopped.returncode, stopped.stdout) == (0, "r1: stopped\n")
    fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: fleet.refusal(who="driver", reason="the lease has ended (stop)"), what="refusal")
    missing = zbridge("stop", "r9", *at)
    assert (missing.returncode, missing.stderr) == (1, "r9: stop sent, but no gateway confirmed it within 3 s\n")
    bench.gateway(device(free_port()), robot="r2")
    until(lambda: "refused" in fleet.reason("r2"), what="why it is offline")
    both = zbridge("stop", "--all", *at)
    assert (both.returncode, both.stdout) == (1, "1 of 2 stopped; r2 offline\n")
    assert both.stderr.startswith("r2: stop accepted, but the robot is ")
    elsewhere = zbridge("stop", "--all", "--realm", "lab", *at)
    assert (elsewhere.returncode, elsewhere.stderr) == (1, "no gateways on lab/\n")


def test_a_latched_robot_is_driven_by_nobody_before_it_is_unlatched(bench: Bench) -> None:
    fleet, at = bench.fleet, ("--connect", bench.endpoint)
    bench.serve(bench.simulator())
    latched = zbridge("stop", "r1", "--latch", "--reason", "a cable is loose", *at)
    assert (latched.returncode, latched.stdout, latched.stderr) == (0, "r1: latched\n", "")
    with pytest.raises(AssertionError, match="'ok': False"):
        fleet.hold("r1", "driver")
    stopped = zbridge("stop", "r1", *at)
    assert (stopped.returncode, stopped.stdout) == (0, "r1: stopped\n"), "a plain stop of a latched robot"
    everybody = zbridge("stop", "--all", "--latch", *at)
    assert (everybody.returncode, everybody.stdout) == (0, "1 of 1 latched\n")
    released = zbridge("unlatch", "r1", *at)
    assert (released.returncode, released.stderr) == (0, "")
    assert released.stdout.startswith("r1: released the stop of ")
    assert released.stdout.endswith(" (a cable is loose)\n")
    fleets = zbridge("unlatch", "r1", *at)
    assert (fleets.returncode, fleets.stdout) == (1, "")
    assert "whole fleet" in fleets.stderr
    released = zbridge("unlatch", "--all", *at)
    assert (released.returncode, released.stdout) == (0, "1 of 1 unlatched\n")
    assert zbridge("unlatch", "r1", *at).stdout == "r1: was not latched\n"
    fleet.hold("r1", "driver")


def test_a_program_to_play_with_is_listed_with_all_there_is_to_know_of_it(bench: Bench) -> None:
    port = free_port()
    bench.serve(bench.simulator(), listener("desk", "tcpudp", port))
    program = bench.zbridge("simulate", "tcpudp", "--hq", f"tcp://127.0.0.1:{port}", "--drive", "0.3")

    def listed(state: str) -> list[dict[str, Any]]:
        entries = zbridge("ls", "--json", "--sessions", "--connect", bench.endpoint).stdout.splitlines()
        return [entry for entry in map(json.loads, entries) if (entry["name"], entry["state"]) == ("desk.2", state)]

    (entry,) = until(lambda: listed("established"), what="the program")
    assert (entry["who"], entry["role"], entry["transport"]) == ("gateway", "robot", "udp")
    assert entry["version"] == "1.3"
    until(lambda: bench.fleet.last("r1/control").get("holder") == "hq.desk.2", what="its lease")
    place = [bench.fleet.last("r1/pose")[axis] for axis in "xy"]
    until(lambda: [bench.fleet.last("r1/pose")[axis] for axis in "xy"] != place, what="motion")
    printed = end(program)
    assert program.returncode == 0
    for line in ("established: client id 2, robot of ", "sends neutral", "drives: forward 0.3", "stops driving"):
        assert line in printed
    assert "violation" not in printed
    (gone,) = until(lambda: listed("closed"), what="its end")
    assert gone["reason"] == "closed by peer"


def test_probe_talks_to_a_robot_only_with_yes_and_asks_a_gateway_first(bench: Bench, robot: Robot) -> None:
    probe = ("probe", "tcpudp", f"tcp://127.0.0.1:{robot.port}", "--connect", bench.endpoint)
    assert zbridge(*probe).returncode == 2
    assert robot.connections == 0
    asked = zbridge(*probe, "--yes")
    assert (asked.returncode, robot.connections) == (0, 1)
    assert "version: 1.3" in asked.stdout
    assert '"joystick"' in asked.stdout
    bench.serve(robot.port)
    served = zbridge(*probe)
    assert (served.returncode, robot.connections) == (0, 2)
    assert "served by the gateway of r1" in served.stdout
    assert "version: 1.3" in served.stdout


@pytest.mark.long
def test_the_secure_demo_drives_its_robots_by_roles_and_ends_with_0() -> None:
    shown = zbridge("demo", "--secure", "--seconds", "8", timeout_s=120.0)  # nine processes start, one by one
    assert (shown.returncode, shown.stderr) == (0, "")
    assert "router at tls/127.0.0.1:" in shown.stdout
    assert "in a browser, with STOP ALL: http://127.0.0.1:" in shown.stdout
    for protocol in protocol_names():
        assert f"{protocol}1" in shown.stdout
    assert "established" in shown.stdout  # the viewer sees
    assert "  demo  " in shown.stdout  # the operator drives


@pytest.mark.long
def test_the_demo_interrupted_leaves_no_process_behind() -> None:
    demo = start("demo")
    assert demo.stdout is not None
    line = ""
    while "the fleet in a browser" not in line:
        line = demo.stdout.readline()
        assert line, "it has ended"
    with urllib.request.urlopen(line.split()[-1], timeout=10) as page:
        assert b"zbridge console" in page.read()
    children = Path(f"/proc/{demo.pid}/task/{demo.pid}/children").read_text().split()
    assert len(children) == 2 * len(protocol_names()) + 1
    end(demo, signal.SIGINT, within_s=20.0)  # seven processes; what counts is that none is left
    assert demo.returncode == 0
    until(lambda: not any(Path(f"/proc/{child}").exists() for child in children), what="the end of all")
