"""Record the README's moving picture, ``demo.webp``, from the real ``zbridge demo`` and its console.

    python docs/images/record_demo.py            # half a minute; writes docs/images/demo.webp
    python docs/images/record_demo.py --stills   # two minutes; takes docs/images/console-*.png instead

Needs zbridge with the extras ``console`` and ``ros2``, ``pip install playwright pillow pyte``, and on Debian
``apt-get install chromium fonts-dejavu-core``. ``ZBRIDGE_CHROMIUM`` names another Chromium.

The demo runs in a pseudo terminal and the console in a headless Chromium; both are photographed in real time. Only the
typing, the caption, the keys and the pointer are drawn. The seconds in which the demo starts and prints nothing are
cut. The demo runs as user ``ann`` on host ``lab``, so that the pictures name neither the user nor the machine.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import contextlib
import fcntl
import io
import os
import pty
import re
import shutil
import signal
import struct
import sys
import tempfile
import termios
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import pyte
from PIL import Image, ImageDraw, ImageFont
from playwright.async_api import Browser, Error, Locator, Page, async_playwright
from playwright.async_api import TimeoutError as PageTimeoutError

IMAGES = Path(__file__).parent
CHROMIUM = os.environ.get("ZBRIDGE_CHROMIUM") or shutil.which("chromium")
ROBOT = "ros21"
"""The robot that is driven: it publishes a map and a scan."""
FRAME_S = 1 / 7
START_S, END_S = 30.0, 10.0
"""Longest time in which the demo starts, and ends."""
POINT_S, CLICK_S = 0.4, 0.15
"""How long the pointer moves, and how long a click shows, before and after it."""
LAST_S = 2.2
"""How long the last frame stays."""
COLUMNS, LINES = 110, 14
FONTS = Path("/usr/share/fonts/truetype/dejavu")
CELL_W, CELL_H, MARGIN = 8, 18, 8
ARGUMENTS = ("--no-sandbox", "--disable-gpu", "--disable-quic", "--disable-background-networking")
TAKES = 3
"""Most attempts: on a busy machine the console lets nobody drive."""
SCREEN, PHONE = {"width": 1280, "height": 800}, {"width": 360, "height": 740}
PAGE, SCALE = {"width": 1000, "height": 500}, 0.9
WIDTH, CAPTION_H, ADDRESS_H = 900, 44, 30
TERMINAL_H = LINES * CELL_H + 2 * MARGIN
PAGE_Y = CAPTION_H + TERMINAL_H + ADDRESS_H
HEIGHT = PAGE_Y + round(PAGE["height"] * SCALE)
POINTER = ((0, 0), (0, 19), (5, 15), (8, 22), (11, 21), (8, 14), (14, 14))


def font(name: str, size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(FONTS / f"{name}.ttf", size)


MONO, MONO_BOLD = font("DejaVuSansMono", 14), font("DejaVuSansMono-Bold", 14)
SANS, SANS_BOLD = font("DejaVuSans", 13), font("DejaVuSans-Bold", 17)


def as_ann(folder: str) -> dict[str, str]:
    """Return the environment of a program that takes itself to be run by ann on the host lab."""
    Path(folder, "sitecustomize.py").write_text("import socket\nsocket.gethostname = lambda: 'lab'\n")
    return {**os.environ, "TERM": "xterm", "LOGNAME": "ann", "PYTHONPATH": folder}


class Demo:
    """``zbridge demo`` in a pseudo terminal, from the typed command to Ctrl-C."""

    def __init__(self) -> None:
        self.screen = pyte.Screen(COLUMNS, LINES)
        self._stream = pyte.ByteStream(self.screen)
        self._text = ""

    @contextlib.asynccontextmanager
    async def run(self) -> AsyncIterator[Demo]:
        """Run it while the context lasts."""
        ours, its = pty.openpty()
        fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("4H", LINES, COLUMNS, 0, 0))
        with tempfile.TemporaryDirectory() as folder:
            command, env = Path(sys.executable).with_name("zbridge"), as_ann(folder)
            process = await asyncio.create_subprocess_exec(command, "demo", stdin=its, stdout=its, stderr=its, env=env)
            os.close(its)
            asyncio.get_running_loop().add_reader(ours, self._read, ours)
            try:
                yield self
            finally:
                with contextlib.suppress(ProcessLookupError):
                    process.send_signal(signal.SIGINT)  # as Ctrl-C does; the demo ends what it started
                try:
                    await asyncio.wait_for(process.wait(), END_S)
                except TimeoutError:
                    process.kill()
                asyncio.get_running_loop().remove_reader(ours)
                os.close(ours)

    async def address(self) -> str:
        """Wait until the demo has printed where its console is, and drawn its table."""
        return (await self._prints(r"STOP ALL: (http\S+)[\s\S]*established"))[1]

    async def turns(self) -> None:
        """Wait until the robot, which drives a triangle, turns away from the wall, to the free part of its room."""
        self._text = ""
        await self._prints(rf"{ROBOT} .* (1[3-7]\d|-1[0-7]\d)°")

    async def _prints(self, pattern: str) -> re.Match[str]:
        async with asyncio.timeout(START_S):
            while not (found := re.search(pattern, self._text)):  # noqa: ASYNC110
                await asyncio.sleep(0.02)
        return found

    def show(self, text: str) -> None:
        """Show what is typed."""
        self._stream.feed(text.encode())

    def cells(self) -> list[list[tuple[str, bool]]]:
        """Return the lines of the screen: characters, and whether they are bold."""
        lines = ([self.screen.buffer[line][column] for column in range(COLUMNS)] for line in range(LINES))
        return [[(cell.data, cell.bold) for cell in line] for line in lines]

    def _read(self, descriptor: int) -> None:
        with contextlib.suppress(OSError):  # the demo has ended
            data = os.read(descriptor, 65536)
            self._text += data.decode(errors="replace")
            self._stream.feed(data)


@dataclass
class Shot:
    """All that a frame shows."""

    caption: str = ""
    keys: str = ""
    pointer: tuple[float, float] | None = None
    clicks: bool = False
    address: str = ""
    page: bytes = b""
    cells: list[list[tuple[str, bool]]] = field(default_factory=list)
    at: float = 0.0

    def draw(self) -> Image.Image:
        """Compose the frame."""
        image = Image.new("RGB", (WIDTH, HEIGHT), "#12161c")
        draw = ImageDraw.Draw(image)
        draw.rectangle((0, 0, WIDTH, CAPTION_H - 1), "#1f4e8f")
        draw.text((14, CAPTION_H / 2), self.caption, "white", SANS_BOLD, "lm")
        for index, key in enumerate("WASD" if self.keys else ""):
            pressed, left = key in self.keys, WIDTH - 154 + 36 * index
            draw.rounded_rectangle((left, 7, left + 30, 36), 5, "#ffd24d" if pressed else "#1f4e8f", "white", 2)
            draw.text((left + 15, 22), key, "black" if pressed else "white", SANS_BOLD, "mm")
        self._draw_terminal(draw)
        if self.page:
            draw.rectangle((0, PAGE_Y - ADDRESS_H, WIDTH, PAGE_Y - 1), "#d5dae1")
            draw.rounded_rectangle((14, PAGE_Y - 26, WIDTH - 14, PAGE_Y - 5), 10, "white")
            draw.text((28, PAGE_Y - 15), self.address, "#1c2430", SANS, "lm")
            image.paste(opened(self.page), (0, PAGE_Y))
        if self.pointer:
            self._draw_pointer(draw, *self.pointer)
        return image

    def _draw_terminal(self, draw: ImageDraw.ImageDraw) -> None:
        for row, line in enumerate(self.cells):
            for column, (character, bold) in enumerate(line):
                where = 2 * MARGIN + column * CELL_W, CAPTION_H + MARGIN + row * CELL_H
                if character != " ":
                    draw.text(where, character, "white" if bold else "#d3dae4", MONO_BOLD if bold else MONO)

    def _draw_pointer(self, draw: ImageDraw.ImageDraw, x: float, y: float) -> None:
        x, y = x * SCALE, PAGE_Y + y * SCALE
        if self.clicks:
            draw.ellipse((x - 16, y - 16, x + 16, y + 16), outline="#ff9d00", width=4)
        draw.polygon([(x + dx, y + dy) for dx, dy in POINTER], "black", "white")


class Film:
    """Photographs the demo and the console's page, and moves the hand that uses the page."""

    def __init__(self, demo: Demo, page: Page) -> None:
        self.now, self.shots = Shot(), list[Shot]()
        self._demo, self._page = demo, page

    @contextlib.asynccontextmanager
    async def roll(self) -> AsyncIterator[None]:
        """Photograph while the context lasts; what was photographed before is followed without a gap."""
        task = asyncio.create_task(self._photograph())
        try:
            yield
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    async def _photograph(self) -> None:
        devtools = await self._page.context.new_cdp_session(self._page)  # its pictures cost half of playwright's
        how = {"optimizeForSpeed": True, "clip": {"x": 0, "y": 0, **PAGE, "scale": SCALE}}
        cut = time.monotonic() - (self.shots[-1].at + FRAME_S if self.shots else 0.0)
        while True:
            began = time.monotonic()
            shot = replace(self.now, cells=self._demo.cells(), at=began - cut)
            with contextlib.suppress(Error):  # between two pages there is nothing to photograph
                if self._page.url.startswith("http"):
                    taken = await devtools.send("Page.captureScreenshot", how)
                    shot.page, shot.address = base64.b64decode(taken["data"]), self._page.url
                self.shots.append(shot)
            await asyncio.sleep(began + FRAME_S - time.monotonic())

    async def click(self, what: Locator) -> None:
        """Move the pointer to an element, and click there."""
        box = await what.bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        x0, y0 = self.now.pointer or (PAGE["width"] / 2, PAGE["height"] * 0.8)
        began, part = time.monotonic(), 0.0
        while part < 1.0:
            await asyncio.sleep(0.03)
            part = min(1.0, (time.monotonic() - began) / POINT_S)
            self.now.pointer = x0 + (x - x0) * part, y0 + (y - y0) * part
        self.now.clicks = True
        await asyncio.sleep(CLICK_S)
        await self._page.mouse.click(x, y)
        await asyncio.sleep(CLICK_S)
        self.now.clicks = False

    async def hold(self, keys: str, seconds: float = 0.0) -> None:
        """Hold these keys, and no others, for some seconds or longer."""
        for key in {*self.now.keys} - {*keys}:
            await self._page.keyboard.up(key.lower())
        for key in {*keys} - {*self.now.keys}:
            await self._page.keyboard.down(key.lower())
        self.now.keys = keys
        if keys:
            await self._page.get_by_text("Driving.").wait_for(timeout=3000)
        await asyncio.sleep(seconds)

    def save(self, path: Path) -> None:
        """Write the animation; the last frame stays for some seconds."""
        times = [shot.at for shot in self.shots]
        durations = [round(1000 * (end - begin)) for begin, end in pairwise([*times, times[-1] + LAST_S])]
        first, *others = (shot.draw() for shot in self.shots)
        how = {"lossless": True, "method": 4, "minimize_size": True}
        first.save(path, save_all=True, append_images=others, duration=durations, loop=0, **how)
        sys.stdout.write(f"{path}: {path.stat().st_size} bytes, {len(times)} frames, {sum(durations) / 1000:.1f} s\n")


async def record(browser: Browser) -> None:
    """Record the moving picture: the command is typed, and the demo is used."""
    page = await browser.new_page(viewport=PAGE)
    demo = Demo()
    film = Film(demo, page)
    film.now.caption = "One command starts simulated robots of four protocols"
    async with film.roll():
        demo.show("$ ")
        for character in "zbridge demo":
            await asyncio.sleep(0.08)
            demo.show(character)
        await asyncio.sleep(0.3)
    demo.show("\r\n")
    async with demo.run():
        address = await demo.address()
        async with film.roll():
            await asyncio.sleep(1.8)
            await use(page, address, demo, film)
    film.save(IMAGES / "demo.webp")


async def use(page: Page, address: str, demo: Demo, film: Film) -> None:
    """Show the fleet, drive a robot, stop all while it drives, and show the fleet again."""
    now, button = film.now, partial(page.get_by_role, "button", exact=True)
    await page.goto(address)
    now.caption = "All of them in one table, and in the browser"
    await asyncio.sleep(2.0)
    await film.click(page.get_by_role("link", name=ROBOT))
    now.caption = "Drive any of them from the browser"
    await demo.turns()
    await film.click(button(name="Take control"))
    await film.click(button(name="Take over"))
    await page.get_by_role("slider").fill("100")
    await page.get_by_text("Ready.").wait_for()
    now.pointer = None
    await film.hold("W", 1.2)
    await film.hold("WA", 0.8)
    await film.hold("W", 0.8)
    now.caption = "STOP ALL stops every robot"
    await film.click(button(name="STOP ALL"))
    await film.hold("")
    await page.get_by_text("4 robots latched.").wait_for()
    await film.click(page.get_by_text("All robots"))
    await page.get_by_text("4 of 4 stopped").wait_for()
    await asyncio.sleep(0.2)


async def photograph(browser: Browser) -> None:
    """Take the pictures of the console: the fleet after a minute, and a robot that is driven, also on a phone."""
    async with Demo().run() as demo:
        at = await demo.address()
        page = await browser.new_page(viewport=SCREEN)
        await page.goto(at)
        await asyncio.sleep(62)  # the lines show the last minute
        keep(opened(await page.screenshot()), "console-fleet.png")
        await take_stick(page, f"{at}/#/robot/tcpudp1")
        keep(opened(await page.screenshot()), "console-robot.png")
        await page.mouse.up()
        await page.get_by_role("button", name="Give back").click()
        phone = await browser.new_page(viewport=PHONE, has_touch=True, is_mobile=True)
        await take_stick(phone, f"{at}/#/robot/tcpudp1")
        driven = opened(await phone.screenshot())
        await phone.mouse.up()
        await phone.get_by_role("button", name="Give back").click()
        await phone.get_by_text("nobody drives").first.wait_for()
        await phone.goto(at)
        await phone.get_by_text("4 robots").wait_for()
        await asyncio.sleep(2)
        both = Image.new("RGB", (2 * PHONE["width"] + 20, PHONE["height"]), "#888888")
        both.paste(opened(await phone.screenshot()), (0, 0))
        both.paste(driven, (PHONE["width"] + 20, 0))
        keep(both, "console-phone.png")


def opened(png: bytes) -> Image.Image:
    return Image.open(io.BytesIO(png)).convert("RGB")


def keep(image: Image.Image, name: str) -> None:
    image.quantize(dither=Image.Dither.NONE).save(IMAGES / name, optimize=True)


async def take_stick(page: Page, robot: str) -> None:
    """Take control of a robot on its page, drive a curve by keys, and push the stick forward."""
    await page.goto(robot)
    await page.get_by_role("button", name="Take control").click()
    take_over = page.get_by_role("button", name="Take over")
    await take_over.or_(page.get_by_text("Ready.")).wait_for()
    if await take_over.is_visible():
        await take_over.click()
    await page.get_by_text("Ready.").wait_for()
    for key in "awdw":
        await page.keyboard.down(key)
        await asyncio.sleep(2.0)
        await page.keyboard.up(key)
    stick = page.get_by_label("Stick: drag to drive")
    await stick.hover()
    await page.mouse.down()
    box = await stick.bounding_box()
    assert box is not None
    await page.mouse.move(box["x"] + box["width"] / 2, box["y"])
    await page.get_by_text("Driving.").wait_for(timeout=3000)
    await asyncio.sleep(0.5)


async def main(work: Callable[[Browser], Awaitable[None]]) -> None:
    """Do the work with a Chromium; do it again if the machine was too busy to drive a robot."""
    async with async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        try:
            for left in reversed(range(TAKES)):
                try:
                    return await work(browser)
                except (TimeoutError, PageTimeoutError) as error:
                    sys.stderr.write(f"too busy: {error}\n{left} takes are left\n")
        finally:
            await browser.close()
    sys.exit(1)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Record the README's moving picture.")
    parser.add_argument("--stills", action="store_true", help="take the pictures of the console instead")
    asyncio.run(main(photograph if parser.parse_args().stills else record))
