"""The systemd units: what is started exists, what may go wrong is bounded, rights are few."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
import typer.main

from zbridge.cli.app import app

SYSTEMD = Path(__file__).parents[2] / "deploy" / "systemd"
UNITS = sorted(SYSTEMD.glob("*.service"))
EXPOSURE = 30
"""The highest exposure that `systemd-analyze security` may find, in tenths."""

every_unit = pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
needs_systemd = pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="this machine has no systemd-analyze")


def settings(unit: Path) -> dict[str, list[str]]:
    """Give the values of each key; all keys of the three sections differ."""
    found: dict[str, list[str]] = {}
    for key, value in re.findall(r"^(\w+)=(.*)$", unit.read_text(), re.MULTILINE):
        found.setdefault(key, []).append(value)
    return found


def test_there_is_a_unit_for_the_host_for_one_robot_and_for_router_recorder_and_console() -> None:
    assert [unit.name for unit in UNITS] == [
        "zbridge-console.service",
        "zbridge-recorder.service",
        "zbridge-router.service",
        "zbridge.service",
        "zbridge@.service",
    ]


@every_unit
def test_a_unit_has_no_rights_and_bounds_for_memory_tasks_and_its_stop(unit: Path) -> None:
    found = settings(unit)
    assert found["CapabilityBoundingSet"] == [""]
    assert found["NoNewPrivileges"] == ["yes"]
    assert found["ProtectSystem"] == ["strict"]
    assert found["RestrictAddressFamilies"] == ["AF_UNIX AF_INET AF_INET6 AF_NETLINK"]
    assert {"MemoryMax", "TasksMax", "TimeoutStopSec"} <= found.keys()
    assert found.get("DynamicUser") == ["yes"] or found["User"] == ["zbridge"]


@every_unit
def test_a_unit_starts_again_for_ever_whatever_ended_it(unit: Path) -> None:
    assert (settings(unit)["Restart"], settings(unit)["StartLimitIntervalSec"]) == (["always"], ["0"])


@pytest.mark.parametrize(
    ("unit", "secrets"),
    [
        ("zbridge.service", ("router", "recorder", "console")),
        ("zbridge@.service", ("router", "recorder", "console")),
        ("zbridge-router.service", ("bus", "recorder", "console")),
        ("zbridge-recorder.service", ("bus", "router", "console")),
        ("zbridge-console.service", ("bus", "router", "recorder")),
    ],
)
def test_a_unit_cannot_see_the_keys_of_the_others(unit: str, secrets: tuple[str, ...]) -> None:
    hidden = " ".join(settings(SYSTEMD / unit)["InaccessiblePaths"])
    assert all(f"-/etc/zbridge/{folder}" in hidden for folder in secrets)


def test_the_supervisor_is_watched_and_tells_systemd_when_it_is_ready() -> None:
    found = settings(SYSTEMD / "zbridge.service")
    assert (found["Type"], found["NotifyAccess"], "WatchdogSec" in found) == (["notify"], ["main"], True)


def test_a_gateway_of_its_own_may_tell_systemd_which_process_goes_on_after_a_restart() -> None:
    assert settings(SYSTEMD / "zbridge@.service")["NotifyAccess"] == ["main"]


def test_gateways_are_told_to_stop_their_robots_when_the_supervisor_ends_in_whatever_way() -> None:
    found = settings(SYSTEMD / "zbridge.service")
    assert (found["KillMode"], found["WatchdogSignal"], found["OOMPolicy"]) == (
        ["control-group"],
        ["SIGTERM"],
        ["continue"],
    )


@every_unit
def test_commands_of_a_unit_exist_with_their_options(unit: Path) -> None:
    commands = typer.main.get_group(app).commands
    for name, rest in re.findall(r"/opt/zbridge/bin/zbridge (\w+)([^\n]*)", "\n".join(settings(unit)["ExecStart"])):
        known = {option for parameter in commands[name].params for option in parameter.opts}
        options = re.findall(r"(?<!\S)--?[a-z-]+", re.sub(r"\$\([^)]*\)", "", rest))  # those of other commands left out
        assert set(options) <= known, rest


def test_every_credential_of_a_unit_is_used_under_its_name() -> None:
    for name in ("router", "recorder", "console"):
        loaded = settings(SYSTEMD / f"zbridge-{name}.service")["LoadCredential"]
        assert {f"{file}:/etc/zbridge/{name}/{file}" for file in ("ca.pem", "certificate.pem", "key.pem")} <= set(
            loaded
        )


@needs_systemd
@every_unit
def test_systemd_calls_a_unit_hardly_exposed(unit: Path) -> None:
    command = ("systemd-analyze", "security", "--offline=true", f"--threshold={EXPOSURE}", str(unit))
    told = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    if "Unknown option" in told.stderr or "unrecognized option" in told.stderr:
        pytest.skip("this machine's systemd-analyze cannot look at files")
    assert told.returncode == 0, told.stdout[-200:] + told.stderr


@needs_systemd
@every_unit
def test_systemd_understands_every_line_of_a_unit(unit: Path, tmp_path: Path) -> None:
    copy = tmp_path / unit.name
    copy.write_text(unit.read_text().replace("/opt/zbridge/bin/zbridge", "/bin/true"))
    told = subprocess.run(
        ("systemd-analyze", "verify", "--man=no", str(copy)),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert [line for line in told.stderr.splitlines() if str(copy) in line] == []
