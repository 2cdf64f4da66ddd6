"""The commands as a user types them: real processes, real Zenoh."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import Bench, end, free_port, start, until
from zbridge.protocol.plugin import protocol_names

ROOT = Path(__file__).parents[2]
TOML = '[robot]\nname = "r1"\n[device]\nprotocol = "tcpudp"\nconnect = ["tcp://x:1"]\n'


def zbridge(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "zbridge", *arguments], capture_output=True, text=True, timeout=30, cwd=cwd or ROOT
    )


def test_init_prints_a_configuration_that_check_takes(tmp_path: Path) -> None:
    made = zbridge("init", "tcpudp", "--name", "arm-7")
    assert tomllib.loads(made.stdout)["robot"]["name"] == "arm-7"
    file = tmp_path / "arm.toml"
    file.write_text(made.stdout)
    checked = zbridge("check", str(file))
    assert (checked.returncode, checked.stderr) == (0, "")
    assert "fleet/arm-7, tcpudp at tcp://127.0.0.1:11001, bus as peer" in checked.stdout


@pytest.mark.parametrize("protocol", protocol_names())
def test_the_deployed_configurations_are_what_init_prints(protocol: str) -> None:
    assert (ROOT / f"deploy/config/{protocol}.toml").read_text() == zbridge("init", protocol).stdout
    assert (ROOT / f"deploy/config/hq-{protocol}.toml").read_text() == zbridge("init", protocol, "--hq").stdout


def test_a_bad_file_ends_run_with_2_and_names_file_key_and_value(tmp_path: Path) -> None:
    file = tmp_path / "r1.toml"
    file.write_text(
        '[robot]\nname = "r1"\n[device]\nprotocol = "tcpudp"\nconnect = ["tcp://x:1"]\noptions = {gap = 1}\n'
    )
    ran = zbridge("run", str(file))
    assert ran.returncode == 2
    assert f"{file}: device.options.gap = 1: unknown key; expected one of udp, gap_s," in ran.stderr
    assert "Traceback" not in ran.stderr


def test_an_audit_log_that_cannot_be_written_ends_run_with_2_and_names_key_and_value(tmp_path: Path) -> None:
    file = tmp_path / "r1.toml"
    file.write_text(f'{TOML}[control]\naudit = "{file}/audit.jsonl"\n')
    ran = zbridge("run", str(file))
    assert ran.returncode == 2
    assert f"control.audit = '{file}/audit.jsonl': " in ran.stderr
    assert "Traceback" not in ran.stderr


def test_the_module_of_a_protocol_runs_only_that_protocol(tmp_path: Path) -> None:
    file = tmp_path / "r1.toml"
    file.write_text('[robot]\nname = "r1"\n[device]\nprotocol = "nothing"\nconnect = ["tcp://x:1"]\n')
    ran = subprocess.run(
        [sys.executable, "-m", "gateways.tcpudp", str(file)], capture_output=True, text=True, timeout=30, cwd=ROOT
    )
    assert ran.returncode == 2
    assert "device.protocol = 'nothing': expected one of" in ran.stderr


def test_ls_lists_the_robot_and_stop_confirms(bench: Bench) -> None:
    port = free_port()
    bench.simulator(port)
    bench.serve("r1", port)
    at = ("--connect", bench.endpoint)
    (robot,) = [json.loads(line) for line in zbridge("ls", "--json", *at).stdout.splitlines()]
    assert (robot["robot"], robot["state"], robot["version"]) == ("r1", "established", "1.3")
    assert "established" in zbridge("ls", *at).stdout
    stopped = zbridge("stop", "r1", *at)
    assert (stopped.returncode, stopped.stdout) == (0, "r1: stopped\n")
    assert zbridge("stop", "--all", *at).stdout == "r1: stopped\n"
    missing = zbridge("stop", "r2", *at)
    assert missing.returncode == 1
    assert "no gateway confirmed" in missing.stderr


def test_a_program_to_play_with_is_listed_with_all_there_is_to_know_of_it_on_a_narrow_screen_too(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    port, listener = free_port(), free_port()
    bench.simulator(port)
    address = f"tcp://127.0.0.1:{listener}"
    bench.serve("r1", port, f'[[hq]]\nname = "desk"\nprotocol = "tcpudp"\nlisten = "{address}"\n')
    program = bench.zbridge("simulate", "tcpudp", "--hq", address)
    at = ("--sessions", "--connect", bench.endpoint)

    def listed() -> list[dict[str, Any]]:
        return [json.loads(line) for line in zbridge("ls", "--json", *at).stdout.splitlines()]

    entries = until(lambda: [entry for entry in listed() if entry["name"] == "desk.2" and entry["version"]])
    assert (entries[0]["who"], entries[0]["role"], entries[0]["transport"]) == ("gateway", "robot", "udp")
    monkeypatch.setenv("COLUMNS", "80")
    shown = zbridge("ls", *at).stdout
    assert "desk.2" in shown
    assert entries[0]["peer"] in shown
    assert end(program) == "", "it complained of nothing"
    assert program.returncode == 0
    gone = until(lambda: [entry for entry in listed() if entry["state"] == "closed"])
    assert gone[0]["reason"] == "closed by peer"


def test_simulate_is_either_a_robot_or_an_hq_program() -> None:
    assert "give either --listen" in zbridge("simulate", "tcpudp").stderr
    address = f"tcp://127.0.0.1:{free_port()}"
    nobody = zbridge("simulate", "alf", "--hq", address)
    assert (nobody.returncode, nobody.stderr.count("\n")) == (1, 1)
    assert address in nobody.stderr


def test_a_stop_typed_by_anybody_takes_the_robot_from_its_driver(bench: Bench) -> None:
    port = free_port()
    bench.simulator(port)
    bench.serve("r1", port)
    bench.fleet.hold("r1", "driver")
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    assert zbridge("stop", "r1", "--connect", bench.endpoint).stdout == "r1: stopped\n"
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    refused = until(lambda: bench.fleet.last("r1/control")["refusals"], what="refusal")[0]
    assert (refused["who"], refused["reason"]) == ("driver", "the lease has ended (stop)")


def test_echo_prints_decoded_messages_with_the_last_states_first(bench: Bench) -> None:
    port = free_port()
    bench.simulator(port)
    bench.gateway("r1", port)
    until(lambda: bench.fleet.last("r1/map"))
    at = ("--connect", bench.endpoint)
    printed = zbridge("echo", "fleet/r1/pose", "--json", "--count", "2", *at)
    for line in printed.stdout.splitlines():
        assert json.loads(line).keys() == {"key", "x", "y", "heading", "stamp_ns"}
    (line,) = zbridge("echo", "fleet/r1/map", "--count", "1", *at).stdout.splitlines()
    assert "cells=uint8[100, 100]" in line


def test_stop_needs_one_robot_or_all() -> None:
    assert zbridge("stop").returncode == 2
    assert zbridge("stop", "r1", "--all").returncode == 2


@pytest.mark.parametrize("command", ["stop", "drive"])
def test_a_robot_that_cannot_be_one_ends_with_2_and_one_line(command: str) -> None:
    ran = zbridge(command, "a b")
    line = "zbridge: ROBOT = 'a b': expected letters, digits, '_', '.' and '-' only\n"
    assert (ran.returncode, ran.stdout, ran.stderr) == (2, "", line)


def test_the_demo_shows_data_and_ends_by_itself() -> None:
    shown = zbridge("demo", "--seconds", "4")
    assert shown.returncode == 0, shown.stdout + shown.stderr
    assert "established" in shown.stdout
    for robot, protocol in (("alf1", "alf"), ("tcpudp1", "tcpudp"), ("wc2ec1", "wc2ec")):
        assert robot in shown.stdout
        assert f"zbridge simulate {protocol} --hq tcp://127.0.0.1:" in shown.stdout


def test_the_demo_interrupted_leaves_no_process_behind() -> None:
    demo = start("demo")
    assert demo.stdout is not None
    until(lambda: "router at" in (demo.stdout.readline() if demo.stdout else ""))
    children = Path(f"/proc/{demo.pid}/task/{demo.pid}/children").read_text().split()
    assert len(children) == 2 * len(protocol_names())
    end(demo, signal.SIGINT, within_s=20.0)  # seven processes; what counts is that none is left
    assert demo.returncode == 0
    for child in children:
        until(lambda child=child: not Path(f"/proc/{child}").exists(), what=f"end of {child}")  # type: ignore[misc]


@pytest.mark.parametrize("address", ["127.0.0.1:1", "udp://127.0.0.1:1", "tcp://127.0.0.1"])
def test_simulate_says_what_address_it_expects(address: str) -> None:
    ran = zbridge("simulate", "tcpudp", "--listen", address)
    assert ran.returncode == 1
    assert "expected tcp://host:port" in ran.stderr
