"""A robot that is driven from a browser: how long after its driver is gone does it rest, and how late is an input?

    python -m tests.e2e.measured.browser_drives                    # 20 times each
    python -m tests.e2e.measured.browser_drives --times 5 --way reload --way server_killed
    python -m tests.e2e.measured.browser_drives --way latency

Judged at the socket of a scripted robot behind a real gateway, with a real console and Debian's Chromium in which a
key is held down. After each way of leaving, what was stalled or frozen comes back, the key is still held, and the robot
must not move within ``WATCH_S``. Times are those of this machine's monotonic clock. ``performance.md`` has the table.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import random
import signal
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from statistics import median
from typing import Any

from tests.browser.conftest import CHROMIUM, chromium
from tests.e2e.conftest import Bench
from tests.e2e.rigs.robots import Robot
from tests.e2e.rigs.stalling_proxy import StallingProxy
from tests.ports import HOST, free_port
from zbridge.client import connect

WATCH_S = 2.0
"""How long the robot is watched after all came back."""
STALL_S = 3.0
PRESSES = 100
PAD = """() => {
  const pad = { index: 0, id: 'pad', connected: true, timestamp: 1, axes: [0, 0], buttons: [] };
  navigator.getGamepads = () => [pad];
  window.push = (forward) => { pad.axes = [0, -forward]; pad.timestamp += 1; };
}"""


class Lane:
    """Robot, gateway, console, proxy and browser."""

    def __init__(self, bench: Bench, robot: Robot, proxy: StallingProxy) -> None:
        self.bench, self.robot, self.proxy = bench, robot, proxy
        self.port = free_port()
        self.console: Any = None
        self.chromium: Any = None
        self.page: Any = None

    async def start_console(self) -> None:
        command = ("console", "--listen", f"{HOST}:{self.port}", "--roster", str(self.bench.folder / "roster"))
        self.console = self.bench.zbridge(*command, "--connect", self.bench.endpoint)
        await asyncio.to_thread(self.console.stdout.readline)

    async def drive(self, *, pad: bool = False) -> None:
        """Open a page, take control, and drive."""
        context = await self.chromium.new_context(proxy={"server": self.proxy.address, "bypass": "<-loopback>"})
        self.page = await context.new_page()
        if pad:
            await self.page.add_init_script(f"({PAD})()")
        await self.page.goto(f"http://{HOST}:{self.port}/#/robot/r1")
        await self.page.get_by_role("button", name="Take control").click()
        await self.page.get_by_text("Ready.").wait_for()
        begun = time.monotonic()
        if pad:
            await self.page.evaluate("() => { window.pushing = setInterval(() => push(1), 50); }")
        else:
            await self.page.keyboard.down("w")
        await self.moved(begun)
        await asyncio.sleep(random.uniform(0.3, 0.5))

    async def moved(self, since: float) -> float:
        """Wait for the first frame that moves the robot after a moment; give its time."""
        async with asyncio.timeout(10):
            while not (found := [frame.at for frame in tuple(self.robot.frames) if frame.moves and frame.at > since]):  # noqa: ASYNC110
                await asyncio.sleep(0.002)
        return found[0]

    def last_motion(self) -> float:
        return max((frame.at for frame in tuple(self.robot.frames) if frame.moves), default=0.0)

    def stopped_at(self, since: float) -> float | None:
        """Give when the robot was told to stop, for good, after a moment."""
        last = self.last_motion()
        stops = [frame.at for frame in tuple(self.robot.frames) if not frame.moves and frame.at > max(last, since)]
        return stops[0] if stops else None

    async def processes(self, kind: str) -> list[int]:
        devtools = await self.chromium.new_browser_cdp_session()
        found = (await devtools.send("SystemInfo.getProcessInfo"))["processInfo"]
        return [int(process["id"]) for process in found if process["type"] == kind]


Leave = Callable[[Lane], Awaitable[Callable[[], Awaitable[None]] | None]]
"""Lets the driver be gone, and returns what brings it back."""


async def _close_tab(lane: Lane) -> None:
    await lane.page.close()


async def _kill_browser(lane: Lane) -> None:
    for pid in await lane.processes("browser"):
        os.kill(pid, signal.SIGKILL)


async def _reload(lane: Lane) -> None:
    await lane.page.reload(wait_until="commit")


def _freezing(find: Callable[[Lane], Awaitable[list[int]]]) -> Leave:
    async def freeze(lane: Lane) -> Callable[[], Awaitable[None]]:
        pids = await find(lane)
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)

        async def thaw() -> None:
            for pid in pids:
                os.kill(pid, signal.SIGCONT)

        return thaw

    return freeze


async def _renderers(lane: Lane) -> list[int]:
    return await lane.processes("renderer")


async def _whole_browser(lane: Lane) -> list[int]:
    return [pid for kind in ("renderer", "utility", "GPU", "browser") for pid in await lane.processes(kind)]


async def _server(lane: Lane) -> list[int]:
    return [lane.console.pid]


def _stalling(*directions: str) -> Leave:
    async def stall(lane: Lane) -> Callable[[], Awaitable[None]]:
        lane.proxy.stall(*directions)

        async def heal() -> None:
            lane.proxy.heal()

        return heal

    return stall


async def _kill_server(lane: Lane) -> Callable[[], Awaitable[None]]:
    lane.console.kill()
    return lane.start_console


async def _lose_focus(lane: Lane) -> None:
    await lane.page.evaluate("() => { document.hasFocus = () => false; dispatchEvent(new Event('blur')); }")


async def _hide(lane: Lane) -> None:
    hidden = "Object.defineProperty(document, 'hidden', { value: true, configurable: true })"
    await lane.page.evaluate(f"() => {{ {hidden}; document.dispatchEvent(new Event('visibilitychange')); }}")


async def _freeze_pad(lane: Lane) -> None:
    await lane.page.evaluate("() => clearInterval(window.pushing)")


WAYS: dict[str, tuple[Leave, float]] = {
    "tab_closed": (_close_tab, 0.1),
    "browser_killed": (_kill_browser, 0.1),
    "reload": (_reload, 0.1),
    "focus_lost": (_lose_focus, 0.1),
    "hidden": (_hide, 0.1),
    "renderer_frozen": (_freezing(_renderers), 0.3),
    "browser_frozen": (_freezing(_whole_browser), 0.3),
    "up_link_stalled": (_stalling("up"), 0.3),
    "both_stalled": (_stalling("up", "down"), 0.3),
    "down_link_stalled": (_stalling("down"), 0.6),
    "server_frozen": (_freezing(_server), 0.6),
    "server_killed": (_kill_server, 0.6),
    "gamepad_frozen": (_freeze_pad, 2.1),
}
"""How the driver is gone, and within how many seconds the robot must rest."""


@contextlib.asynccontextmanager
async def lane() -> AsyncIterator[Lane]:
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        bench, robot, proxy = Bench(folder, stack), Robot(), StallingProxy()
        stack.callback(robot.close)
        stack.callback(proxy.close)
        made = Lane(bench, robot, proxy)
        await asyncio.to_thread(bench.serve, robot.port)
        await made.start_console()
        yield made


async def once(scene: Lane, leave: Leave, *, pad: bool) -> float:
    """Let the driver be gone once; give the seconds until the robot was told to rest; raise if it moved again."""
    async with chromium() as scene.chromium:
        await scene.drive(pad=pad)
        began = time.monotonic()
        returns = await leave(scene)
        ends = began + STALL_S
        while time.monotonic() < ends and (returns is not None or scene.stopped_at(began) is None):  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        stopped = scene.stopped_at(began)
        assert stopped is not None, "it was not told to stop"
        if returns is not None:
            await returns()
        await asyncio.sleep(WATCH_S)
        assert scene.last_motion() < stopped, "it moved again without a new neutral"
        with contextlib.suppress(Exception):  # the browser may be dead
            await scene.page.context.close()
    return stopped - began


async def measure(way: str, times: int) -> bool:
    leave, goal = WAYS[way]
    results = []
    for _ in range(times):
        async with lane() as scene:
            results.append(await once(scene, leave, pad=way == "gamepad_frozen"))
    met = max(results) <= goal
    print(
        f"| {way.replace('_', ' ')} | {median(results):.2f} s | {max(results):.2f} s | {goal:g} s |"
        + ("" if met else " missed"),
        flush=True,
    )
    return met


# Latency


async def browser_latencies(scene: Lane) -> list[float]:
    """Press a key again and again; give the seconds from the page's input event to the robot's socket."""
    async with chromium() as running:
        page = await (await running.new_context()).new_page()
        await page.goto(f"http://{HOST}:{scene.port}/#/robot/r1")
        await page.get_by_role("button", name="Take control").click()
        await page.get_by_text("Ready.").wait_for()
        devtools = await page.context.new_cdp_session(page)
        await devtools.send("Performance.enable")
        metrics = (await devtools.send("Performance.getMetrics"))["metrics"]
        origin = next(each["value"] for each in metrics if each["name"] == "NavigationStart")
        await page.evaluate("""() => { window.pressed = [];
          addEventListener('keydown', (event) => event.repeat || pressed.push(event.timeStamp), true); }""")
        found = []
        for _ in range(PRESSES):
            begun = time.monotonic()
            await page.keyboard.down("w")
            arrived = await scene.moved(begun)
            pressed = (await page.evaluate("pressed.at(-1)")) / 1000 + origin
            found.append(arrived - pressed)
            await page.keyboard.up("w")
            await asyncio.sleep(random.uniform(0.2, 0.3))
        await page.get_by_role("button", name="Give back").click()
        await asyncio.sleep(0.5)
    return found


async def client_latencies(scene: Lane) -> list[float]:
    """Drive with the Python client; give the seconds from the call to the robot's socket."""
    found = []
    async with connect(endpoints=[scene.bench.endpoint]) as fleet, fleet["r1"].control("bench") as drive:
        for _ in range(PRESSES):
            begun = time.monotonic()
            await drive(forward=0.5)
            found.append(await scene.moved(begun) - begun)
            await drive()
            await asyncio.sleep(random.uniform(0.2, 0.3))
    return found


async def measure_latency() -> bool:
    async with lane() as scene:
        client, page = median(await client_latencies(scene)), median(await browser_latencies(scene))
    print(f"input event to the robot's socket: {1000 * page:.1f} ms; the Python client {1000 * client:.1f} ms (+5 ms)")
    return page <= client + 0.005


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--way", action="append", choices=[*WAYS, "latency"])
    asked = parser.parse_args()
    if CHROMIUM is None:
        sys.exit("no Chromium (looked in PATH and ZBRIDGE_CHROMIUM)")
    met = []
    if asked.way is None or "latency" in asked.way:
        met.append(asyncio.run(measure_latency()))
    print("| the driver is gone | median | worst | goal |\n|---|---|---|---|")
    met += [asyncio.run(measure(way, asked.times)) for way in WAYS if asked.way is None or way in asked.way]
    sys.exit(not all(met))


if __name__ == "__main__":
    main()
