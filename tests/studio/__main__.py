"""Shows a strict robot, a recording and an incident in Foxglove Studio; drives by Teleop, stops by its button."""

from __future__ import annotations

import asyncio
import contextlib
import math
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright

import zbridge
from tests.e2e.conftest import Bench, until
from tests.e2e.rigs.foxglove_viewer import viewing
from tests.e2e.test_foxglove import Server
from tests.studio.pages import serve_pages
from tests.views.foxglove.recordings import record
from zbridge.blackbox import BoxFolder
from zbridge.fleet.messages import Scan
from zbridge.views.recording.contents import Pictures
from zbridge.views.recording.incident import export_incident

PAGE_PORT = 28080
PAGE = f"http://localhost:{PAGE_PORT}"
SIZE = {"width": 1400, "height": 850}
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
LOAD_S, DRIVE_S = 15.0, 3.0
_WAIT_MS = 60_000


def main(modules: Path, pictures: Path) -> None:
    """Take the pictures; raise AssertionError where something that they should show is not so."""
    pictures.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory()))
        recording = record(folder / "recording.mcap", 20)
        stack.enter_context(serve_pages(modules, PAGE_PORT, folder))
        playwright = stack.enter_context(sync_playwright())
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=FLAGS)
        stack.callback(browser.close)

        def page(query: str) -> Page:
            opened = browser.new_page(viewport=SIZE)  # type: ignore[arg-type]
            opened.goto(f"{PAGE}/?{query}", timeout=_WAIT_MS)
            return opened

        bench = Bench(folder, stack)
        box = folder / "box"
        bench.serve(bench.simulator("tcpudp", "--fragile"), f'[blackbox]\ndir = "{box}"\n')
        until(lambda: bench.fleet.last("r1/pose"), 30, what="a pose")
        stack.enter_context(scans(bench.endpoint))
        server = Server(bench, "--connect", bench.endpoint, "--drive", "--origin", PAGE)
        with contextlib.closing(page(f"ds=foxglove-websocket&ds.url=ws://localhost:{server.port}")) as opened:
            live(opened, bench, pictures)
        keep_incident(bench, box, folder / "incident.mcap")
        player = Server(bench, str(recording), "--origin", PAGE)
        with contextlib.closing(page(f"ds=foxglove-websocket&ds.url=ws://localhost:{player.port}")) as opened:
            played(opened, player.port, pictures)
        for name in ("recording", "incident"):
            with contextlib.closing(page(f"ds=remote-file&ds.url={PAGE}/{name}.mcap")) as opened:
                opened.wait_for_timeout(2 * LOAD_S * 1000)
                tidy(opened)
                opened.keyboard.press("Space")  # play
                opened.wait_for_timeout(LOAD_S * 1000)
                opened.screenshot(path=pictures / f"{name}-file.png", timeout=_WAIT_MS)


def live(page: Page, bench: Bench, pictures: Path) -> None:
    """Watch the robot, drive it by the Teleop panel, stop it by the button."""
    stop = page.get_by_role("button", name="STOP")
    stop.wait_for(timeout=_WAIT_MS)
    page.wait_for_timeout(LOAD_S * 1000)
    tidy(page)
    page.screenshot(path=pictures / "live.png", timeout=_WAIT_MS)
    began = at(bench)
    x, y = teleop(page)
    page.mouse.move(x, y)
    page.mouse.down()
    holder = until(lambda: bench.fleet.last("r1/control").get("holder"), 20, what="a lease")
    assert holder.startswith("foxglove."), holder
    page.wait_for_timeout(DRIVE_S * 1000)
    page.screenshot(path=pictures / "driven.png", timeout=_WAIT_MS)
    moved_m = math.dist(at(bench), began)
    print(f"driven {moved_m:.2f} m by Teleop, held by {holder}")
    assert moved_m > 0.05
    page.mouse.up()
    until(lambda: bench.fleet.last("r1/control").get("holder") is None, 20, what="a free robot")
    stop.click()
    until(lambda: bench.fleet.last("r1/control").get("state") == "stopped", 20, what="a stopped robot")
    print("stopped by the STOP button")


def keep_incident(bench: Bench, box: Path, output: Path) -> None:
    """Let the black box keep the minutes before, and export them."""
    assert bench.fleet.get("fleet/r1/@rpc/blackbox/keep/ann", text="looks odd", kind="chat") == [{}]
    folder = BoxFolder(box, "fleet", "r1")
    (info,) = until(folder.infos, 20, what="the incident")
    time.sleep(3.0)
    found = export_incident(folder.parts(info.name), info, output, Pictures())
    print(f"{found.records} messages of {info.name}")


def tidy(page: Page) -> None:
    """Close the list of topics, and the hint that covers a part of the picture."""
    page.mouse.click(25, 25)
    hint = page.get_by_text("Open settings to configure")
    if hint.count():
        hint.locator("xpath=following::button[1]").click(timeout=_WAIT_MS)
    page.wait_for_timeout(1000)


def teleop(page: Page) -> tuple[float, float]:
    """Give where the button "forward" of the Teleop panel is: the upper arm of its cross."""
    boxes: list[dict[str, Any]] = page.evaluate(
        "[...document.querySelectorAll('svg')].map((e) => e.getBoundingClientRect().toJSON())"
    )
    cross = max(boxes, key=lambda box: box["width"] * box["height"])
    return cross["x"] + cross["width"] / 2, cross["y"] + cross["height"] * 0.15


def played(page: Page, port: int, pictures: Path) -> None:
    """Watch a recording that our server plays; another program presses its buttons."""
    page.wait_for_timeout(LOAD_S * 1000)
    tidy(page)
    with viewing(port) as control:
        control.play(speed=2.0)
        page.wait_for_timeout(6000)
        page.screenshot(path=pictures / "recording.png", timeout=_WAIT_MS)


def at(bench: Bench) -> tuple[float, float]:
    pose = bench.fleet.last("r1/pose")
    return pose["x"], pose["y"]


@contextlib.contextmanager
def scans(endpoint: str) -> Iterator[None]:
    """Feed the robot simulated lidar data: its own protocol has none, and the gateway shows what it is fed."""
    over = threading.Event()

    async def feed() -> None:
        async with zbridge.connect([endpoint]) as fleet:
            number = 0
            while not over.is_set():
                ranges = (2 + 0.3 * np.sin(np.arange(361) / 12 + number / 5)).astype("<f4")
                scan = Scan(
                    angle_min=-math.pi, angle_increment=math.pi / 180, range_min=0.1, range_max=10.0, ranges=ranges
                )
                await fleet["r1"].feed_scan(scan)
                await asyncio.sleep(0.2)
                number += 1

    thread = threading.Thread(target=lambda: asyncio.run(feed()))
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
