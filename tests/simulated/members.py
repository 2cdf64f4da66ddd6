"""The processes of a simulation that have an event loop: gateways, and programs that drive with the Python client."""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import itertools
from collections.abc import Coroutine
from typing import Any

import msgpack

from tests.simulated.bus import Fabric, SimSession
from tests.simulated.bus_session import SimBus
from tests.simulated.engine import Host, Process, SimLoop
from tests.simulated.hq_programs import WHEEL_FULL
from tests.simulated.net import Network
from zbridge.client.fleet import Fleet
from zbridge.errors import Held, LeaseLost, NeutralFirst, Refused, ZbridgeError
from zbridge.metrics import Metrics

ROBOT = "r1"
_NOTHING = object()
GARBLED_STOP = msgpack.packb({"id": bytes(16)}).replace(b"\x81", b"\x82") + b"\xa3who\xa2J\xf6"
"""A stop whose text is Latin-1: whoever sends it must be heard."""
WHEELS = {"l": "left", "r": "right"}
WAYS = {
    "forward": ("forward", 1.0),
    "back": ("forward", -1.0),
    "left": ("left", 1.0),
    "right": ("left", -1.0),
    "turn left": ("turn", 1.0),
    "turn right": ("turn", -1.0),
}
"""Fields of a drive, and their signs."""
RESTART_S = 10.0
"""Longest wait for the answer to a restart."""


class Member:
    """A process with an event loop and a bus session; it can be started again."""

    def __init__(self, host: Host, name: str, network: Network, fabric: Fabric, router: str) -> None:
        self.host = host
        self.name = name
        self.network = network
        self.fabric = fabric
        self.router = router
        self.process: Process
        self.session: SimSession
        self.task: asyncio.Task[None] | None = None
        self.starts = 0
        self.ending = False
        self._graves: list[Any] = []
        """What killed processes left: collected at the end, since its garbage would run code."""

    @property
    def running(self) -> bool:
        """Whether the process lives and is not paused."""
        return self.task is not None and self.process.alive and not self.process.paused and not self.task.done()

    @property
    def alive(self) -> bool:
        """Whether the process lives."""
        return self.task is not None and self.process.alive and not self.task.done()

    def start(self) -> None:
        """Start the process, once the one before has ended."""
        if self.alive:
            if self.ending:
                self.host.world.after(1.0, self.start)
            return
        self.ending = False
        if self.task is not None:
            self._graves.append((self.process, self.task))
        self.process = self.new_process(self.name)
        self.session = SimSession(self.fabric, self.process, self.router)
        assert self.process.loop is not None
        self.task = self.process.loop.create_task(self._main())
        self.task.add_done_callback(self._look)

    def new_process(self, name: str) -> Process:
        """Begin a process with an event loop."""
        self.starts += 1
        process = Process(self.host, name)
        process.rng = self.host.world.rng(f"{self.name} {self.starts}")
        self.host.world.note(name, "started")
        SimLoop(process).network = self.network
        return process

    def _look(self, task: asyncio.Task[None]) -> None:
        """An exception that ends a process is a violation."""
        if not task.cancelled() and (error := task.exception()) is not None:
            self.host.world.errors.append(f"{self.name} ended: {error!r}")

    async def _main(self) -> None:
        bus = SimBus(self.session, Metrics())
        try:
            await self.run(bus)
        finally:
            if self.session.process.alive:
                await bus.close()
                self.host.world.note(self.name, "ended")

    async def run(self, bus: SimBus) -> None:
        """Do the work of the process."""
        raise NotImplementedError

    def stop(self) -> None:
        """End it in order, as SIGTERM does; a second one changes nothing."""
        if self.alive and not self.ending:
            assert self.process.loop is not None
            assert self.task is not None
            self.ending = True
            self.host.world.note(self.name, "told to end")
            self.process.loop.call_soon(self.task.cancel)

    def kill(self) -> None:
        """End it at once."""
        if self.alive:
            self.process.kill()


class DriverMember(Member):
    """A program that drives. number: of its values. ``client``: with the Python client; else with a client of its own.

    It notes ``gives`` (value), ``granted``, ``lost`` and ``released``.
    """

    def __init__(
        self,
        host: Host,
        name: str,
        network: Network,
        fabric: Fabric,
        router: str,
        number: int,
        options: dict[str, Any],
    ) -> None:
        super().__init__(host, name, network, fabric, router)
        self.number = number
        self.options = options
        self.busy = False
        self.watches = bool(options.get("client", True))
        """Whether it learns of the loss of its lease."""
        self._attempts = itertools.count(1)
        self._count = 0
        self.bus: SimBus | None = None

    async def run(self, bus: SimBus) -> None:
        self.bus, self.busy = bus, False
        await asyncio.Event().wait()

    def value(self) -> float:
        """Return a fraction of full scale that no other program gives, and this one not again for a while."""
        self._count += 1
        percent = 10 + (4 * self._count + self.number) % 88
        return percent / 100 if self.options.get("percent") else percent / 100 + (self._count % 500) * 1e-5

    def do(self, step: dict[str, Any]) -> None:
        """Begin a step, in a task of its own."""
        if not self.alive or self.bus is None:
            return
        loop = self.process.loop
        assert loop is not None
        work: Coroutine[Any, Any, None]
        if step["do"] == "drive":
            if self.busy:
                return
            self.busy = True
            work = self._drive(step) if self.options.get("client", True) else self._drive_raw(step)
        else:
            work = self._other(step)
        task = loop.create_task(self._contained(work))
        task.add_done_callback(lambda _: None)

    async def _contained(self, work: Coroutine[Any, Any, None]) -> None:
        try:
            await work
        except (ZbridgeError, Refused) as error:
            self.note("failed", type(error).__name__)

    def note(self, what: str, *fields: Any) -> None:
        """Enter something into the program's log."""
        self.host.world.note(self.name, what, *fields)

    def _fleet(self) -> Fleet:
        assert self.bus is not None
        clock_ms, secret = self.host.raw_ms, self.process.rng.randbytes
        return Fleet(self.bus, name=self.name, clock_ms=clock_ms, attempts=self._attempts, secret=secret)

    async def _other(self, step: dict[str, Any]) -> None:
        assert self.bus is not None
        fleet = self._fleet()
        robot = fleet[ROBOT]
        if step["do"] in ("light", "garbled stop"):
            light, payload = step["do"] == "light", msgpack.packb({"on": True})
            key = f"fleet/{ROBOT}/@cmd/{'light' if light else 'stop'}"
            self.bus.put(key, payload if light else GARBLED_STOP, None, droppable=False)
        elif step["do"] == "stop":
            await robot.stop()
        elif step["do"] == "latch" and step.get("fleet"):
            if (await fleet.latch()).get(ROBOT, _NOTHING) is not None:
                return
        elif step["do"] == "latch":
            await robot.latch()
        elif step["do"] == "unlatch":
            await (fleet.unlatch() if step.get("fleet") else robot.unlatch())
        elif step["do"] == "restart":
            await self.bus.ask(f"fleet/{ROBOT}/@rpc/restart/{self.name}", timeout_s=RESTART_S)
        self.note("done", step["do"])

    async def _drive(self, step: dict[str, Any]) -> None:
        """Acquire, drive for a while, and give the robot back: with the Python client."""
        assert self.bus is not None
        fleet = self._fleet()
        control = fleet[ROBOT].control
        try:
            async with control(
                self.name,
                deadman_s=step.get("deadman_s", 0.5),
                takeover=step.get("takeover", False),
                priority=step.get("priority", 0),
                wait_s=4.0,
            ) as drive:
                self.note("granted")
                try:
                    await self._push(drive, step)
                except LeaseLost:
                    self.note("lost")
                finally:
                    self.note("released")
        except Held:
            self.note("held by another")
        finally:
            self.busy = False

    def _wiggles(self, step: dict[str, Any]) -> bool:
        """Whether the stick is centred now, as people do while they drive."""
        return bool(step.get("wiggles")) and self.process.rng.random() < 0.3

    async def _push(self, drive: Any, step: dict[str, Any]) -> None:
        loop = asyncio.get_running_loop()
        ends_at, hz = loop.time() + step.get("for", 2.0), step.get("hz", 10.0)
        if step.get("mode"):
            self.note("gives mode", step["mode"])
            await drive.mode(step["mode"])
        modes = loop.create_task(self._contained(self._repeat_mode(drive))) if step.get("modes") else None
        try:
            await self._give(drive, step, ends_at, hz)
        finally:
            if modes is not None:
                modes.cancel()

    async def _repeat_mode(self, drive: Any) -> None:
        """Choose the mode again and again, beside what else is given: another task of the same program."""
        while True:
            await drive.mode("manual")
            await asyncio.sleep(0.3)

    async def _give(self, drive: Any, step: dict[str, Any], ends_at: float, hz: float) -> None:
        loop = asyncio.get_running_loop()
        begins_at = loop.time() + step.get("quiet", 0.0)
        while loop.time() < ends_at and not drive.lost.is_set():
            try:
                if not step.get("silent") and loop.time() >= begins_at:
                    value = 0.0 if self._wiggles(step) else self.value()
                    self.note("gives", value)
                    await self._command(drive, step, value)
            except NeutralFirst:
                self.note("gives", 0.0)
                await drive.neutral()
            except LeaseLost:
                raise
            except Refused:
                await asyncio.sleep(0.2)
            await asyncio.sleep(1 / hz)
        if step.get("then") and not drive.lost.is_set():
            self.note("gives mode", step["then"])
            await drive.mode(step["then"])
            await asyncio.sleep(0.5)
        if drive.lost.is_set():
            self.note("lost")
        elif step.get("neutral", True):
            self.note("gives", 0.0)
            await drive()
            await asyncio.sleep(step.get("holds", 0.0))

    async def _command(self, drive: Any, step: dict[str, Any], value: float) -> None:
        way, sign = WAYS[step.get("way", "forward")]
        if "motor" in step:
            await drive.motor(step["motor"], sign * value * WHEEL_FULL)
        else:
            await drive(**{way: sign * value})

    # A client of its own, as docs/reference/keys.md describes it: no liveliness token, and dates only where asked to

    async def _drive_raw(self, step: dict[str, Any]) -> None:
        assert self.bus is not None
        bus, key = self.bus, f"fleet/{ROBOT}/"
        question: dict[str, Any] = {"who": self.name, "deadman_s": step.get("deadman_s", 0.5), "lease_s": 3.0}
        dated = self.options.get("dated", False)
        if dated:
            question["t"] = int(self.host.raw_ms())
        verb = "takeover" if step.get("takeover") else "acquire"
        try:
            answers = await bus.ask(f"{key}@rpc/control/{verb}/{self.name}", msgpack.packb(question))
            lease = next((msgpack.unpackb(each.payload) for each in answers if each.error is None), {})
            if lease.get("ok"):
                self.note("granted")
                await (self._push_wheels if step.get("wheels") else self._push_raw)(step, lease, dated)
                self.note("released")
        finally:
            self.busy = False

    async def _push_raw(self, step: dict[str, Any], lease: dict[str, Any], dated: bool) -> None:
        bus, loop = self.bus, asyncio.get_running_loop()
        ends_at, number = loop.time() + step.get("for", 2.0), 0
        while True:
            over = loop.time() >= ends_at
            value = 0.0 if over or self._wiggles(step) else self.value()
            self.note("gives", value)
            number += 1
            way, sign = WAYS[step.get("way", "forward")]
            payload = msgpack.packb({"forward": 0.0, "left": 0.0, "turn": 0.0, way: sign * value})
            key = f"fleet/{ROBOT}/@cmd/drive"
            shown = self._proof(lease, number, key, payload, dated)
            if not (over and not step.get("neutral", True)):
                bus.put(key, payload, shown, droppable=True)
            if over:
                break
            await asyncio.sleep(1 / step.get("hz", 10.0))
        if step.get("releases", True):
            key = f"fleet/{ROBOT}/@rpc/control/release"
            await bus.ask(key, self._proof(lease, 1, key, b"", dated=False))

    async def _push_wheels(self, step: dict[str, Any], lease: dict[str, Any], dated: bool) -> None:
        """Push both wheels, fall silent, push on; then let one go only, and push the other one."""
        number, bus = itertools.count(1), self.bus
        assert bus is not None
        for wheels, seconds in (("lr", 1.0), ("", 0.8), ("lr", step["for"]), ("L", 0.1), ("r", 1.0), ("LR", 0.1)):
            ends_at = asyncio.get_running_loop().time() + seconds
            while asyncio.get_running_loop().time() < ends_at:
                for wheel in wheels:
                    value = self.value() if wheel.islower() else 0.0
                    self.note("gives", value)
                    key = f"fleet/{ROBOT}/@cmd/motor/{WHEELS[wheel.lower()]}"
                    payload = msgpack.packb({"value": value * WHEEL_FULL})
                    bus.put(key, payload, self._proof(lease, next(number), key, payload, dated), droppable=True)
                await asyncio.sleep(1 / step["hz"])

    def _proof(self, lease: dict[str, Any], number: int, key: str, payload: bytes, dated: bool) -> bytes:
        shown: dict[str, Any] = {"lease": lease["lease"], "seq": number}
        text = key.encode() + (b"\1" if dated else b"\0") + number.to_bytes(8, "big")
        if dated:
            shown["t"] = int(self.host.raw_ms())
            text += shown["t"].to_bytes(8, "big")
        shown["proof"] = hmac.digest(lease["token"], text + payload, hashlib.sha256)[:16]
        return msgpack.packb(shown)
