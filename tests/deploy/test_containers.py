"""The container file, the composition and the chart, as far as they can be read without their tools (deploy/try.sh)."""

import contextlib
import importlib.util
import json
import os
import re
import socket
import subprocess
import threading
import time
import tomllib
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
COMPOSE = yaml.safe_load((DEPLOY / "container" / "compose.yaml").read_text())
CHART = DEPLOY / "helm" / "zbridge"
SCHEMA = json.loads((CHART / "values.schema.json").read_text())
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
START = DEPLOY / "container" / "start.sh"
CONTAINERFILE = (DEPLOY / "container" / "Containerfile").read_text()

every_service = pytest.mark.parametrize("name", ["router", "gateways", "recorder", "console"])


def test_the_image_runs_as_a_user_without_a_name_of_its_own_rights_and_has_a_check() -> None:
    last = CONTAINERFILE.rpartition("\nFROM ")[2]
    assert "\nUSER 10001:10001\n" in last
    assert "\nHEALTHCHECK " in last
    assert "pip install" not in last


def test_what_the_build_copies_passes_the_list_of_ignored_files() -> None:
    passed = {line.removeprefix("!") for line in (ROOT / ".containerignore").read_text().split() if line[0] == "!"}
    copied = {
        name for line in re.findall(r"^COPY (?!--)(.+) \S+$", CONTAINERFILE, re.MULTILINE) for name in line.split()
    }
    assert copied == passed
    assert all((ROOT / name).exists() for name in copied)


SPEC = importlib.util.spec_from_file_location("healthy", DEPLOY / "container" / "healthy.py")
assert SPEC is not None
healthy = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(healthy)  # type: ignore[union-attr]


def test_the_check_of_the_image_asks_gateways_with_metrics_and_names_the_silent_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ThreadingHTTPServer(("127.0.0.1", 0), Healthz) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        (tmp_path / "r1.toml").write_text(f'[metrics]\nlisten = "0.0.0.0:{server.server_port}"\n')
        (tmp_path / "r2.toml").write_text("[robot]\nname = 'r2'\n")
        (tmp_path / "r3.toml").write_text("[robot")
        (tmp_path / "host.toml").write_text("")
        assert healthy.main(tmp_path) == 0
        (tmp_path / "r4.toml").write_text(f'[metrics]\nlisten = "127.0.0.1:{silent_port()}"\n')
        assert healthy.main(tmp_path) == 1
        server.shutdown()
    assert capsys.readouterr().out.splitlines() == ["1 of 1 gateways answer", "1 of 2 gateways answer; r4 does not"]


def silent_port() -> int:
    """Give a port at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return int(taken.getsockname()[1])


class Healthz(BaseHTTPRequestHandler):
    """Answers as a gateway does, and at no other path."""

    def do_GET(self) -> None:
        self.send_response(200 if self.path == "/healthz" else 404)
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Write nothing."""


SUPERVISOR = """#!/bin/sh
trap 'touch "$1.reloaded"' HUP
trap 'exit 7' TERM
(while kill -0 $$ 2>/dev/null; do sleep 0.05; done; sleep 0.3; echo stopped >"$1") &
touch "$1.ready"
while :; do sleep 0.05; done
"""
"""Has a child that stops its robot a moment after its parent has ended."""


def started(folder: Path, zbridge: str) -> Path:
    """Return the start of a container in which this script is zbridge."""
    (program := folder / "zbridge").write_text(zbridge)
    (start := folder / "start.sh").write_text(START.read_text().replace("/opt/zbridge/bin/zbridge", str(program)))
    for script in (program, start):
        script.chmod(0o755)
    return start


@contextlib.contextmanager
def own_processes(command: str, *arguments: str, stdin: int = subprocess.DEVNULL) -> Iterator[subprocess.Popen[str]]:
    """Run a command as the first process of a namespace, as a container does: no signal is ignored."""
    namespace = ("env", "--default-signal", "unshare", "--pid", "--fork", "--mount-proc", "--kill-child")
    with subprocess.Popen([*namespace, command, *arguments], stdin=stdin, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.skipif(os.geteuid() != 0, reason="a namespace of processes needs root")
@pytest.mark.parametrize(("signal", "reloads", "code"), [("KILL", False, 137), ("TERM", True, 7)])
def test_gateways_have_time_for_their_stop_when_the_supervisor_of_a_container_ends(
    tmp_path: Path, signal: str, reloads: bool, code: int
) -> None:
    start = started(tmp_path, SUPERVISOR)
    stopped = tmp_path / "stopped"
    with own_processes(str(start), str(stopped)) as namespace:
        first = only_child(namespace.pid)
        until((tmp_path / "stopped.ready").exists)
        if reloads:
            until(lambda: bool(kill("HUP", first)) or (tmp_path / "stopped.reloaded").exists())
        kill(signal, only_child(first) if signal == "KILL" else first)
        assert namespace.wait(20) == code
    assert stopped.read_text() == "stopped\n"


RESTARTED = """#!/bin/sh
exec 3<&0
(trap 'echo stopped >"$1"; exit 0' TERM; read word; echo "$word" >"$1.word"; while :; do sleep 0.05; done) <&3 &
exit 0
"""
"""Hands its robot to a process that continues without it."""


@pytest.mark.skipif(os.geteuid() != 0, reason="a namespace of processes needs root")
def test_a_container_lives_as_long_as_the_gateway_that_a_restart_began_and_tells_it_to_end(tmp_path: Path) -> None:
    start = started(tmp_path, RESTARTED)
    start.write_text(start.read_text().replace("left=50", "left=5"))
    stopped, word = tmp_path / "stopped", tmp_path / "stopped.word"
    with own_processes(str(start), str(stopped), stdin=subprocess.PIPE) as namespace:
        first = only_child(namespace.pid)
        assert namespace.stdin is not None
        namespace.stdin.write("hello\n")
        namespace.stdin.flush()
        until(lambda: word.exists() and word.read_text() == "hello\n")
        time.sleep(1.5)  # longer than a dead supervisor's gateways are given
        assert namespace.poll() is None
        kill("TERM", first)
        assert namespace.wait(20) == 0
    assert stopped.read_text() == "stopped\n"


def kill(signal: str, pid: int) -> int:
    """Send a signal by its name; return the exit code."""
    return subprocess.run(("kill", f"-{signal}", str(pid)), check=False).returncode


def only_child(pid: int) -> int:
    """Wait for the child of a process."""
    children = Path(f"/proc/{pid}/task/{pid}/children")
    until(lambda: bool(children.read_text().split()))
    return int(children.read_text().split()[0])


def until(condition: Callable[[], bool]) -> None:
    """Wait for a condition, for 20 s at most."""
    deadline = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_the_composition_has_router_gateways_recorder_and_console() -> None:
    assert list(COMPOSE["services"]) == ["router", "gateways", "recorder", "console"]


@every_service
def test_a_service_is_confined_and_bounded(name: str) -> None:
    service = COMPOSE["services"][name]
    assert (service["read_only"], service["cap_drop"], service["user"]) == (True, ["ALL"], "10001:10001")
    assert service["security_opt"] == ["no-new-privileges:true"]
    assert {"mem_limit", "pids_limit", "stop_grace_period"} <= service.keys()


@every_service
def test_a_service_sees_its_own_certificates_only(name: str) -> None:
    folder = {"gateways": "bus"}.get(name, name)
    mounted = [volume for volume in COMPOSE["services"][name]["volumes"] if "ZBRIDGE_CONFIG" in volume]
    assert all(volume.endswith(":ro") for volume in mounted)
    assert {volume.split("/")[-1].removesuffix(":ro") for volume in mounted} <= {folder, "robots"}


def test_the_chart_has_the_version_of_the_package() -> None:
    chart = yaml.safe_load((CHART / "Chart.yaml").read_text())
    assert (chart["version"], chart["appVersion"]) == (VERSION, VERSION)
    assert COMPOSE["services"]["router"]["image"].endswith(f":{VERSION}}}")


def resolved(schema: dict[str, Any]) -> dict[str, Any]:
    """Follow a reference to a definition."""
    name = schema.get("$ref", "").removeprefix("#/definitions/")
    return SCHEMA["definitions"][name] if name else schema


def unknown(values: Any, schema: dict[str, Any], path: str = "") -> list[str]:
    """List the keys of values that the schema does not have, and those that it has and values lack."""
    schema = resolved(schema)
    if "properties" not in schema or not isinstance(values, dict):
        return []
    known = schema["properties"]
    more = [f"{path}.{key}" for key in values if key not in known and not schema.get("additionalProperties", True)]
    return more + [item for key in values if key in known for item in unknown(values[key], known[key], f"{path}.{key}")]


def absent(values: Any, schema: dict[str, Any], path: str = "") -> list[str]:
    """List the settings of the schema that values do not show."""
    known = resolved(schema).get("properties", {})
    if not isinstance(values, dict) or not known:
        return []
    less = [f"{path}.{key}" for key in known if key not in values]
    return less + [item for key in known if key in values for item in absent(values[key], known[key], f"{path}.{key}")]


def test_values_show_every_setting_of_the_schema_and_no_other() -> None:
    values = yaml.safe_load((CHART / "values.yaml").read_text())
    assert unknown(values, SCHEMA) == []
    assert absent(values, SCHEMA) == [".global"]  # Helm's own


def test_the_example_names_settings_that_exist() -> None:
    values = yaml.safe_load((DEPLOY / "helm" / "example.yaml").read_text())
    robots = values.pop("robots")
    assert unknown(values, SCHEMA) == []
    assert [unknown(robot, SCHEMA["definitions"]["robot"]) for robot in robots.values()] == [[]] * len(robots)


def test_values_that_are_used_in_templates_are_declared() -> None:
    used = {
        tuple(path.split("."))
        for template in CHART.glob("templates/*")
        for path in re.findall(r"\.Values\.([\w.]+)", template.read_text())
    }
    values = yaml.safe_load((CHART / "values.yaml").read_text())
    for path in used:
        at: Any = values
        for key in path:
            assert key in at, ".".join(path)
            at = at[key]
