"""The client and ``zbridge drive`` with a real gateway, a simulated robot and real Zenoh."""

from __future__ import annotations

import asyncio
import math
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from typing import Any

import pytest

import zbridge
from tests.e2e.conftest import WAIT_S, Bench, until
from zbridge.errors import Held, LeaseLost, Refused

ROBOT = "r1"
ME, OTHER = "ann@here", "bob@there"
KEY_S = 1 / 30
"""Between two repetitions of a held key."""


@pytest.fixture(autouse=True)
def _robot(bench: Bench) -> Iterator[None]:
    """A simulated robot; whoever drove it leaves no token behind."""
    bench.serve(bench.simulator())
    until(lambda: control(bench) and bench.fleet.last("r1/pose"), what="control and a pose")
    yield
    until(lambda: not any("operator" in token for token in bench.fleet.tokens("fleet/*/@alive/*")), what="no tokens")


def control(bench: Bench) -> dict[str, Any]:
    """Give what ``control`` shows; it is there as long as the gateway."""
    return bench.fleet.last("r1/control")


def heading(bench: Bench) -> float:
    return float(bench.fleet.last("r1/pose")["heading"])


def turns(bench: Bench, since: float) -> None:
    """Wait until the robot looks elsewhere than before."""
    until(lambda: abs(math.remainder(heading(bench) - since, math.tau)) > 0.05, what="motion")


def stops_within(bench: Bench, seconds: float) -> None:
    """Wait until the next poses are all the same; they come ten times a second."""
    poses, withheld_s, began = bench.fleet.seen["fleet/r1/pose"], bench.withheld_s, time.monotonic()

    def stands() -> bool:
        seen = len(poses)
        until(lambda: len(poses) >= seen + 4, what="poses")
        return len({(pose["x"], pose["y"], pose["heading"]) for pose in poses[-3:]}) == 1

    until(stands, what="a robot that stands")
    assert time.monotonic() - began < seconds + 0.5 + bench.withheld_s - withheld_s


async def lost(drive: Any) -> str:
    """Wait until a driver hears of its loss; give what it says."""
    await asyncio.wait_for(drive.lost.wait(), WAIT_S)
    with pytest.raises(LeaseLost) as raised:
        await drive(turn=0.5)
    return str(raised.value)


async def test_the_second_is_told_who_has_the_robot_and_can_take_it_over_and_anybody_can_stop_it(bench: Bench) -> None:
    async with zbridge.connect([bench.endpoint]) as mine, zbridge.connect([bench.endpoint]) as others:
        async with mine[ROBOT].control(ME) as drive:
            for program in (mine, others):
                with pytest.raises(Held, match=rf"^{ROBOT} is held by {ME} \(priority 0\)"):
                    await program[ROBOT].control(OTHER).__aenter__()
            await drive(turn=0.5)
            async with others[ROBOT].control(OTHER, takeover=True) as taken:
                assert await lost(drive) == f"{ROBOT}: the lease has ended (taken over by {OTHER}); held by {OTHER}"
                before = heading(bench)
                driving = asyncio.create_task(taken.during(30.0, turn=-0.5))
                await asyncio.to_thread(turns, bench, before)
                await mine[ROBOT].stop()
                assert await lost(taken) == f"{ROBOT}: the lease has ended (stop)"
                with pytest.raises(Refused):
                    await driving
                await asyncio.to_thread(stops_within, bench, 0.5)
        until(lambda: control(bench)["state"] == "stopped", what="news of the stop")


# zbridge drive


class Terminal:
    """A terminal in which ``zbridge drive`` runs, and somebody's fingers."""

    def __init__(self, bench: Bench, *arguments: str) -> None:
        self._mine, self._its = pty.openpty()
        self.settings = termios.tcgetattr(self._its)
        self.shown = ""
        self.process = subprocess.Popen(
            [sys.executable, "-m", "zbridge", "drive", ROBOT, "--connect", bench.endpoint, "--who", ME, *arguments],
            stdin=self._its,
            stdout=self._its,
            stderr=self._its,
            start_new_session=True,
        )

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
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
        assert "Traceback" not in self.read()
        return int(self.process.returncode)


def test_the_keyboard_drives_while_a_key_is_held_stops_and_takes_the_lease_again(bench: Bench) -> None:
    with Terminal(bench, "--speed", "0.5") as terminal:
        until(lambda: control(bench).get("holder") == ME, what="the lease")
        before = heading(bench)
        terminal.type("a")
        time.sleep(0.4)
        assert heading(bench) == before, "a single press moves nothing"
        terminal.hold("a", 0.8)
        turns(bench, before)
        terminal.shows("turn +0.50")
        stops_within(bench, 0.3)
        assert control(bench)["state"] == "held"
        terminal.hold("\x1b[C", 0.4)
        terminal.type(" ")
        until(lambda: control(bench)["state"] == "stopped", what="the stop")
        terminal.shows("Enter: take the lease again")
        stops_within(bench, 0.3)
        before = heading(bench)
        terminal.hold("a", 0.3)
        assert heading(bench) == before, "nothing moves without the lease"
        terminal.type("\r")
        until(lambda: control(bench).get("holder") == ME, what="the lease again")
        terminal.hold("a", 0.5)
        turns(bench, before)
        terminal.type("x")
        assert terminal.ended() == 0
        until(lambda: control(bench)["state"] == "free", what="a robot that was given back")


def test_the_keyboard_of_a_robot_that_somebody_drives_and_an_interrupt_gives_the_robot_back(bench: Bench) -> None:
    with zbridge.blocking.connect([bench.endpoint]) as fleet, fleet[ROBOT].control(OTHER) as drive:
        with Terminal(bench) as terminal:
            assert terminal.ended() == 1
            assert f"zbridge: {ROBOT} is held by {OTHER} (priority 0)" in terminal.shown
        assert drive.loss is None
        with Terminal(bench, "--takeover") as terminal:
            until(lambda: control(bench).get("holder") == ME, what="the takeover")
            until(lambda: drive.loss is not None, what="news of the takeover")
            terminal.hold("a", 0.3)
            terminal.process.send_signal(signal.SIGINT)
            assert terminal.ended() == 0
        until(lambda: control(bench)["state"] == "free", what="a robot that was given back")
        stops_within(bench, 0.3)
