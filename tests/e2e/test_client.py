"""The client, ``zbridge drive`` and ``zbridge stop`` with a real gateway, a simulated robot and real Zenoh."""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import zbridge
from tests.e2e.conftest import WAIT_S, Bench, end, free_port, until
from zbridge.client import Fleet
from zbridge.errors import BusError, Held, LeaseLost, Refused

ROBOT = "r1"
ME, OTHER = "ann@here", "bob@there"
KEY_S = 1 / 30
"""Between two repetitions of a held key."""
DRIVER = f"""
import asyncio, signal, sys, zbridge

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a shell runs in the background

async def main():
    async with zbridge.connect([sys.argv[1]]) as fleet, fleet["{ROBOT}"].control("{ME}", deadman_s=0.3) as drive:
        print("driving", flush=True)
        await drive.during(60.0, turn=0.5)

asyncio.run(main())
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    """One robot for all tests of this file; each leaves it as it found it."""
    with contextlib.ExitStack() as stack:
        bench = Bench(tmp_path_factory.mktemp("client"), stack)
        port = free_port()
        bench.simulator(port)
        bench.gateway(ROBOT, port)
        until(lambda: bench.fleet.state(ROBOT) == "established", what="the robot")
        until(lambda: control(bench) and bench.fleet.last(f"{ROBOT}/pose"), what="control and a pose")
        yield bench


@pytest.fixture(autouse=True)
def _left_alone(bench: Bench) -> Iterator[None]:
    """Nobody drives when a test begins, nor when it has ended."""
    until(lambda: control(bench)["state"] != "held", what="a robot that nobody holds")
    yield
    until(lambda: control(bench)["state"] != "held", what="the end of the lease")
    until(lambda: not any("operator" in token for token in bench.fleet.tokens("fleet/*/@alive/*")), what="no tokens")


@contextlib.asynccontextmanager
async def client(bench: Bench) -> AsyncIterator[Fleet]:
    """A program of its own on the bus."""
    async with zbridge.connect([bench.endpoint]) as fleet:
        yield fleet


def control(bench: Bench) -> dict[str, Any]:
    """Give what ``control`` shows; it is there as long as the gateway."""
    return bench.fleet.last(f"{ROBOT}/control")


def heading(bench: Bench) -> float:
    return float(bench.fleet.last(f"{ROBOT}/pose")["heading"])


def turned(bench: Bench, since: float) -> float:
    return abs(math.remainder(heading(bench) - since, math.tau))


def poses(bench: Bench) -> list[dict[str, Any]]:
    return bench.fleet.seen[f"fleet/{ROBOT}/pose"]


def stands(bench: Bench) -> bool:
    """Tell whether the next poses are all the same; they come ten times a second."""
    seen = len(poses(bench))
    until(lambda: len(poses(bench)) >= seen + 4, what="poses")
    return len({(pose["x"], pose["y"], pose["heading"]) for pose in poses(bench)[-3:]}) == 1


def stops_within(bench: Bench, seconds: float) -> None:
    withheld_s, began = bench.withheld_s, time.monotonic()
    until(lambda: stands(bench), what="a robot that stands")
    assert time.monotonic() - began < seconds + 0.5 + bench.withheld_s - withheld_s


def zbridge_command(bench: Bench, *arguments: str, **more: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "zbridge", *arguments, "--connect", bench.endpoint],
        capture_output=True,
        text=True,
        timeout=30,
        **more,
    )


async def lost(drive: Any) -> str:
    """Wait until a driver hears of its loss; give what it says."""
    await asyncio.wait_for(drive.lost.wait(), WAIT_S)
    with pytest.raises(LeaseLost) as raised:
        await drive(turn=0.5)
    return str(raised.value)


async def drives_now_and_then(drive: Any) -> None:
    """Drive less often than the deadman wants it, until that is refused."""
    for _ in range(20):
        await drive(turn=0.5)
        await asyncio.sleep(0.3)


# The client


async def test_see_ask_and_drive_as_the_readme_says(bench: Bench) -> None:
    async with client(bench) as fleet:
        assert list(await fleet.robots()) == [ROBOT]
        robot = fleet[ROBOT]
        status = await robot.status.last()
        assert status is not None
        assert (status.state, status.version) == ("established", "1.3")
        before = await robot.ask_pose()
        cells = (await robot.ask_map()).cells
        assert (cells.dtype, cells.shape) == (np.uint8, (100, 100))
        async with robot.control() as drive:
            await drive.during(0.5, turn=0.5)
            held = await robot.control.last()
            assert held is not None
            assert (held.state, held.holder) == ("held", drive.who)
            assert held.refusals == ()
        assert abs(math.remainder((await robot.ask_pose()).heading - before.heading, math.tau)) > 0.15
        free = await robot.control.last()
        assert free is not None
        assert free.state == "free"
        async with asyncio.timeout(2.0):
            async for pose in robot.pose:
                assert math.isfinite(pose.x + pose.y + pose.heading)
                break
            async for seen in robot.control:
                assert seen.state == "free"
                break


async def test_the_second_is_told_who_has_the_robot_and_can_take_it_over(bench: Bench) -> None:
    async with client(bench) as mine, client(bench) as others:
        async with mine[ROBOT].control(ME) as drive:
            with pytest.raises(Held, match=rf"^{ROBOT} is held by {ME} \(priority 0\)") as held:
                await others[ROBOT].control(OTHER).__aenter__()
            assert held.value.holder == ME
            await drive(turn=0.5)
            async with others[ROBOT].control(OTHER, takeover=True) as taken:
                assert await lost(drive) == f"{ROBOT}: the lease has ended (taken over by {OTHER}); held by {OTHER}"
                before = heading(bench)
                await taken.during(0.4, turn=-0.5)
                until(lambda: turned(bench, before) > 0.1, what="the other one drives")
                assert taken.loss is None
        until(lambda: control(bench)["state"] == "free", what="a robot that was given back")


async def test_a_stop_of_a_passer_by_ends_the_lease_and_the_motion(bench: Bench) -> None:
    async with client(bench) as mine, client(bench) as others, mine[ROBOT].control(ME) as drive:
        driving = asyncio.create_task(drive.during(30.0, turn=0.5))
        await asyncio.sleep(0.3)
        await others[ROBOT].stop()
        assert await lost(drive) == f"{ROBOT}: the lease has ended (stop)"
        with pytest.raises(Refused):
            await driving
        stops_within(bench, 0.5)
        until(lambda: control(bench)["state"] == "stopped", what="news of the stop")


async def test_a_second_wish_of_the_same_program_costs_the_first_nothing(bench: Bench) -> None:
    async with client(bench) as fleet, fleet[ROBOT].control(ME) as drive:
        with pytest.raises(Held):
            await fleet[ROBOT].control(OTHER).__aenter__()
        await asyncio.sleep(0.3)
        await drive(turn=0.1)
        assert drive.loss is None
        until(lambda: control(bench)["holder"] == ME, what="the holder")


async def test_an_idle_driver_keeps_the_robot_and_a_tired_one_must_send_neutral(bench: Bench) -> None:
    async with client(bench) as fleet, fleet[ROBOT].control(ME, lease_s=1.0, deadman_s=0.1) as drive:
        await asyncio.sleep(2.0)
        with pytest.raises(Refused, match=rf"^{ROBOT}: drive: deadman: send a neutral drive first$"):
            await drives_now_and_then(drive)
        before = heading(bench)
        async with asyncio.timeout(WAIT_S):
            while turned(bench, before) < 0.05:
                with contextlib.suppress(Refused):  # on a busy machine the deadman comes between two drives
                    await drive()
                    await drive.during(0.3, turn=0.5)
        assert drive.loss is None


async def test_what_the_robot_cannot_do_is_said_by_the_next_command(bench: Bench) -> None:
    async with client(bench) as fleet, fleet[ROBOT].control(ME) as drive:
        await drive.motor("arm", 1.0)
        await asyncio.sleep(0.2)
        with pytest.raises(Refused, match=rf"^{ROBOT}: motor/arm: a TCP/UDP robot has no such command$"):
            await drive()
        await drive()


async def test_modes_and_drives_in_quick_succession_are_all_taken(bench: Bench) -> None:
    async with client(bench) as fleet, fleet[ROBOT].control(ME) as drive:
        for _ in range(20):
            await asyncio.gather(drive.mode("manual"), drive(turn=0.1), drive.mode("none"), drive())
        await asyncio.sleep(0.2)
        mine = [refusal for refusal in control(bench)["refusals"] if "order" in refusal["reason"]]
        assert mine == []


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT], ids=lambda number: number.name)
def test_a_robot_whose_driver_is_ended_stops(bench: Bench, number: signal.Signals) -> None:
    driver = subprocess.Popen(
        [sys.executable, "-c", DRIVER, bench.endpoint], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    with driver:
        assert driver.stdout is not None
        assert driver.stdout.readline() == b"driving\n"
        before = heading(bench)
        until(lambda: turned(bench, before) > 0.1, what="motion")
        until(lambda: control(bench)["holder"] == ME, what="the holder")
        driver.send_signal(number)
        until(lambda: control(bench)["state"] != "held", what="the end of the lease")
        stops_within(bench, 0.3)


def test_the_same_without_async(bench: Bench) -> None:
    with zbridge.blocking.connect([bench.endpoint]) as fleet:
        robot = fleet[ROBOT]
        assert list(fleet.robots()) == [ROBOT]
        before = robot.ask_pose().heading
        with robot.control(ME) as drive:
            drive.during(0.5, turn=0.5)
            with pytest.raises(Held, match=ME), robot.control(OTHER):
                pass
            last = robot.control.last()
            assert last is not None
            assert last.holder == ME
        for pose in robot.pose:
            assert abs(math.remainder(pose.heading - before, math.tau)) > 0.15
            break
        assert robot.ask_map().cells.shape == (100, 100)
        with robot.control(ME) as drive:
            drive(turn=0.5)
            robot.stop()
            with pytest.raises(LeaseLost, match=r"the lease has ended \(stop\)"):
                drive.during(1.0, turn=0.5)
        assert fleet.stop() == {ROBOT: None}


async def test_without_a_gateway_or_a_router_the_error_says_so(bench: Bench) -> None:
    async with client(bench) as fleet:
        nobody = fleet["nobody"]
        assert await nobody.status.last() is None
        with pytest.raises(BusError, match=r"^nobody: no gateway answered within 0\.3 s$"):
            await nobody.control(wait_s=0.3).__aenter__()
        with pytest.raises(BusError, match=r"^nobody: no gateway answered"):
            await nobody.ask_pose()
    with pytest.raises(BusError):
        await zbridge.connect([f"tcp/127.0.0.1:{free_port()}"]).__aenter__()


# zbridge drive


class Terminal:
    """A terminal in which ``zbridge drive`` runs, and somebody's fingers."""

    def __init__(self, bench: Bench, *arguments: str) -> None:
        self._mine, self._its = pty.openpty()
        self.settings = termios.tcgetattr(self._its)
        self.shown = ""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "zbridge", "drive", ROBOT, "--connect", bench.endpoint, *arguments],
            stdin=self._its,
            stdout=self._its,
            stderr=self._its,
            start_new_session=True,
        )

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for descriptor in (self._mine, self._its):
            os.close(descriptor)

    def type(self, text: str) -> None:
        os.write(self._mine, text.encode())

    def hold(self, key: str, seconds: float) -> None:
        """Hold a key as terminals report it, without the wait before the first repetition."""
        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            self.type(key)
            time.sleep(KEY_S)

    def read(self) -> str:
        """Give all that was shown up to now."""
        while select.select([self._mine], [], [], 0)[0]:
            self.shown += os.read(self._mine, 4096).decode()
        return self.shown

    def shows(self, text: str) -> None:
        until(lambda: text in self.read(), what=repr(text))

    def ended(self) -> int:
        """Wait for the end; give the exit code."""
        until(lambda: self.read() is not None and self.process.poll() is not None, what="the end of drive")
        assert termios.tcgetattr(self._its) == self.settings, "the terminal is as it was"
        self.read()
        return int(self.process.returncode)


def test_the_keyboard_drives_while_a_key_is_held_stops_and_takes_the_lease_again(bench: Bench) -> None:
    with Terminal(bench, "--who", ME, "--speed", "0.5") as terminal:
        until(lambda: control(bench).get("holder") == ME, what="the lease")
        terminal.shows("speed 0.5")
        before = heading(bench)
        terminal.type("a")
        time.sleep(0.4)
        assert turned(bench, before) == 0, "a single press moves nothing"
        terminal.hold("a", 0.8)
        until(lambda: turned(bench, before) > 0.2, what="motion")
        terminal.shows("turn +0.50")
        stops_within(bench, 0.3)
        assert control(bench)["state"] == "held"
        before = heading(bench)
        terminal.hold("\x1b[C", 0.4)
        until(lambda: turned(bench, before) > 0.05, what="motion by an arrow")
        terminal.hold("d", 0.4)
        terminal.type(" ")
        until(lambda: control(bench)["state"] == "stopped", what="the stop")
        terminal.shows(f"{ROBOT}: stopped")
        terminal.shows("Enter: take the lease again")
        stops_within(bench, 0.3)
        before = heading(bench)
        terminal.hold("a", 0.3)
        assert turned(bench, before) == 0, "nothing moves without the lease"
        terminal.type("\r")
        until(lambda: control(bench).get("holder") == ME, what="the lease again")
        terminal.hold("a", 0.5)
        until(lambda: turned(bench, before) > 0.05, what="motion again")
        terminal.type("x")
        assert terminal.ended() == 0
        assert "Traceback" not in terminal.shown
        until(lambda: control(bench)["state"] == "free", what="a robot that was given back")


def test_the_keyboard_of_a_robot_that_somebody_drives(bench: Bench) -> None:
    with zbridge.blocking.connect([bench.endpoint]) as fleet, fleet[ROBOT].control(OTHER) as drive:
        with Terminal(bench, "--who", ME) as terminal:
            assert terminal.ended() == 1
            assert f"zbridge: {ROBOT} is held by {OTHER} (priority 0)" in terminal.shown
            assert "Traceback" not in terminal.shown
        assert drive.loss is None
        with Terminal(bench, "--who", ME, "--takeover") as terminal:
            until(lambda: control(bench).get("holder") == ME, what="the takeover")
            until(lambda: drive.loss is not None, what="news of the takeover")
            fleet[ROBOT].stop()
            terminal.shows(f"{ROBOT}: the lease has ended (stop). Enter: take the lease again, x: end")
            terminal.type("x")
            assert terminal.ended() == 0


def test_the_keyboard_interrupted_gives_the_robot_back_and_the_terminal_too(bench: Bench) -> None:
    with Terminal(bench, "--who", ME) as terminal:
        until(lambda: control(bench).get("holder") == ME, what="the lease")
        terminal.hold("a", 0.3)
        terminal.process.send_signal(signal.SIGINT)
        assert terminal.ended() == 0
        assert "Traceback" not in terminal.shown
        until(lambda: control(bench)["state"] == "free", what="a robot that was given back")
        stops_within(bench, 0.3)


def test_the_keyboard_needs_a_terminal(bench: Bench) -> None:
    ran = zbridge_command(bench, "drive", ROBOT, stdin=subprocess.DEVNULL)
    assert (ran.returncode, ran.stdout) == (1, "")
    assert ran.stderr == "zbridge: drive needs a terminal to read keys from\n"
    assert control(bench)["state"] != "held"


# zbridge stop


def test_stop_says_for_each_robot_whether_it_stands(bench: Bench, tmp_path: Path) -> None:
    with zbridge.blocking.connect([bench.endpoint]) as fleet, fleet[ROBOT].control(ME) as drive:
        drive(turn=0.5)
        ran = zbridge_command(bench, "stop", ROBOT)
        assert (ran.returncode, ran.stdout, ran.stderr) == (0, f"{ROBOT}: stopped\n", "")
        until(lambda: drive.loss is not None, what="news of the stop")
    stops_within(bench, 0.3)
    unreachable = bench.gateway("r2", free_port())
    until(lambda: bench.fleet.state("r2") is not None, what="the second gateway")
    ran = zbridge_command(bench, "stop", "--all")
    assert (ran.returncode, ran.stdout) == (1, f"{ROBOT}: stopped\n")
    assert ran.stderr.startswith("r2: stop taken, but the robot is ")
    end(unreachable)
    ran = zbridge_command(bench, "stop", "--all", "--realm", "lab")
    assert (ran.returncode, ran.stdout, ran.stderr) == (1, "", "no gateways on lab/\n")


def test_stop_of_a_robot_that_is_not_there_fails(bench: Bench) -> None:
    ran = zbridge_command(bench, "stop", "nobody")
    assert (ran.returncode, ran.stdout) == (1, "")
    assert ran.stderr == "nobody: stop sent, but no gateway confirmed it within 2 s\n"
