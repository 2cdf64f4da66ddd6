"""STOP ALL of the console against real gateways in trouble: the sentence is true each time, and Release gives back."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from tests.e2e.conftest import HOST, Bench, Gateway, device, end, until

CONFIRMED = "stopped (their gateways sent it)"
ROBOTS = {"a1": "alf", "t1": "tcpudp", "w1": "wc2ec"}


class Page:
    """A page of the console: what it was told, all put together."""

    def __init__(self, opened: ClientConnection) -> None:
        self._opened = opened
        self.rows: dict[str, dict[str, Any]] = {}
        self.notices: dict[str, dict[str, Any]] = {}

    def until(self, condition: Callable[[], Any], what: str, timeout_s: float = 20.0) -> None:
        """Read until a condition is met."""

        def read() -> Any:
            with contextlib.suppress(TimeoutError):
                self._note(json.loads(self._opened.recv(timeout=0.1)))
            return condition()

        until(read, timeout_s, what)

    def ask(self, do: str, robot: str = "") -> str:
        """Ask for something; give the sentence that comes of it."""
        before = time.time()
        self._opened.send(json.dumps({"do": do, "robot": robot}))

        def known() -> bool:
            notice = self.notices.get(robot, {})
            return notice.get("good") is not None and notice["at"] > before

        self.until(known, f"what came of {do}")
        return str(self.notices[robot]["text"])

    def states(self) -> dict[str, str]:
        return {name: row["state"] for name, row in self.rows.items()}

    def _note(self, message: dict[str, Any]) -> None:
        if message.get("full"):
            self.rows.clear()
        self.rows.update({row["name"]: row for row in message.get("rows", ())})
        for name in message.get("gone", ()):
            self.rows.pop(name, None)
        self.notices = message.get("notices", self.notices)


class Scene:
    """A robot of each protocol behind its gateway, and the console with a page."""

    def __init__(self, bench: Bench, stack: contextlib.ExitStack) -> None:
        self.bench, self.simulators, self.gateways = bench, dict[str, int](), dict[str, Gateway]()
        for robot, protocol in ROBOTS.items():
            port = self.simulators[robot] = bench.simulator(protocol)
            self.gateways[robot] = bench.gateway(device(port, protocol), robot=robot)
        command = ("console", "--listen", f"{HOST}:0", "--roster", str(bench.folder / "roster"))
        self.console = bench.zbridge(*command, "--connect", bench.endpoint)
        assert self.console.stdout is not None
        at = self.at = self.console.stdout.readline().split()[-1]
        opened = connect(f"ws{at.removeprefix('http')}/socket", origin=at, proxy=None)  # type: ignore[arg-type]
        self.page = Page(stack.enter_context(opened))
        self.page.until(lambda: self.page.states() == dict.fromkeys(ROBOTS, "established"), "all robots", 30.0)

    def freeze(self, pid: int) -> None:
        """Stop a process until the end of the test."""
        os.kill(pid, signal.SIGSTOP)
        self.bench.stack.callback(_thaw, pid)


def _thaw(pid: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, signal.SIGCONT)


@pytest.fixture
def scene(bench: Bench) -> Iterator[Scene]:
    with contextlib.ExitStack() as stack:
        yield Scene(bench, stack)


def test_all_are_stopped_and_released_and_the_console_ends_orderly(scene: Scene) -> None:
    page = scene.page
    assert page.ask("stop_all") == f"3 of 3 {CONFIRMED}"
    page.until(lambda: set(page.states().values()) == {"LATCHED"}, "all latched")
    assert page.ask("release") == "3 of 3 released"
    page.until(lambda: set(page.states().values()) == {"established"}, "all released")
    assert page.ask("stop", "t1") == "t1 stopped (its gateway sent it)"
    end(scene.console)
    assert scene.console.returncode == 0


@pytest.mark.long
def test_a_killed_gateway_is_missing_a_frozen_one_confirms_nothing_and_a_robot_is_away(scene: Scene) -> None:
    page = scene.page
    scene.gateways["t1"].signal(signal.SIGKILL)
    scene.freeze(scene.gateways["w1"].process.pid)
    scene.bench.simulators[scene.simulators["a1"]].kill()
    page.until(lambda: page.states()["t1"] == "NO GATEWAY", "t1 missing")
    page.until(lambda: page.states()["w1"] == "SILENT", "w1 silent")
    page.until(lambda: page.states()["a1"] in ("offline", "connecting"), "a1 away")
    first, *parts = page.ask("stop_all").split("; ")
    assert first == f"0 of 3 {CONFIRMED}"
    assert set(parts) == {
        "a1 away",
        "t1 without a gateway, which nothing can stop from here",
        "w1 not confirmed",
    }


def test_a_frozen_robot_is_not_said_to_have_stopped_before_its_link_takes_the_stop(scene: Scene) -> None:
    page = scene.page
    scene.freeze(scene.bench.simulators[scene.simulators["a1"]].pid)
    text = page.ask("stop_all")
    waits = f"2 of 3 {CONFIRMED}; a1 not reached yet: its link is stalled"
    assert text in (f"3 of 3 {CONFIRMED}", waits), "its kernel may have accepted the stop: then the gateway has sent it"


@pytest.mark.long
def test_a_robot_that_was_seen_by_an_earlier_console_is_missing_in_the_next(scene: Scene) -> None:
    bench = scene.bench
    end(scene.console)
    scene.gateways["w1"].end()
    command = ("console", "--listen", f"{HOST}:0", "--roster", str(bench.folder / "roster"))
    console = bench.zbridge(*command, "--connect", bench.endpoint)
    assert console.stdout is not None
    at = console.stdout.readline().split()[-1]
    with connect(f"ws{at.removeprefix('http')}/socket", origin=at, proxy=None) as opened:  # type: ignore[arg-type]
        page = Page(opened)
        page.until(lambda: page.states().get("w1") == "NO GATEWAY", "w1 missing")
        assert "w1 without a gateway" in page.ask("stop_all")
    end(console)


def test_two_consoles_on_one_bus_agree(scene: Scene) -> None:
    bench = scene.bench
    options = ("--listen", f"{HOST}:0", "--roster", str(bench.folder / "other"))
    other = bench.zbridge("console", *options, "--connect", bench.endpoint)
    assert other.stdout is not None
    at = other.stdout.readline().split()[-1]
    with connect(f"ws{at.removeprefix('http')}/socket", origin=at, proxy=None) as opened:  # type: ignore[arg-type]
        second = Page(opened)
        second.until(lambda: second.states() == dict.fromkeys(ROBOTS, "established"), "all robots", 30.0)
        assert scene.page.ask("stop_all") == f"3 of 3 {CONFIRMED}"
        for page in (scene.page, second):
            page.until(lambda: set(page.states().values()) == {"LATCHED"}, "all latched")  # noqa: B023
        assert second.ask("release") == "3 of 3 released"
        for page in (scene.page, second):
            page.until(lambda: set(page.states().values()) == {"established"}, "all released")  # noqa: B023
    end(other)


def test_a_console_that_is_killed_stops_the_robot_that_it_drives_and_disturbs_nothing_else(scene: Scene) -> None:
    fleet = scene.bench.fleet
    fleet.hold("a1")
    scene.page.until(lambda: scene.page.rows["a1"]["driver"] == "test", "the driver of a1")
    at = scene.at
    with connect(f"ws{at.removeprefix('http')}/drive/t1", origin=at, proxy=None) as drive:  # type: ignore[arg-type]
        drive.send(json.dumps({"do": "take"}))
        seq = moved = 0
        while moved < 5:
            message = json.loads(drive.recv(timeout=10))
            if "tick" not in message:
                continue
            seq += 1
            moved += seq > 5
            command = {"do": "drive", "seq": seq, "tick": message["tick"], "forward": 0.5 if moved else 0.0}
            drive.send(json.dumps(command))
        assert fleet.last("t1/control")["holder"].startswith("console.browser")
        scene.console.kill()
        killed = time.monotonic()
        until(lambda: fleet.last("t1/control")["state"] == "stopped", what="t1 is stopped")
        assert fleet.last("t1/control")["at"] - killed < 1.0 + scene.bench.withheld_s
    assert fleet.last("a1/control")["holder"] == "test"
    assert not fleet.lost("a1")
    fleet.put("a1/@cmd/drive", forward=0.1)
    assert all(fleet.state(robot) == "established" for robot in ROBOTS)
