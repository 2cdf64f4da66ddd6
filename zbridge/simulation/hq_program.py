"""The scaffold of judges that connect, and one of them to play with: an HQ program, in a person's hands or in a test's.

Shares no code with the gateway. Knows no protocol.
"""

from __future__ import annotations

import asyncio
import contextlib
from abc import abstractmethod
from collections.abc import Iterable
from typing import ClassVar

from zbridge.simulation.fragile import FragilePeer, log_violations, print_line
from zbridge.simulation.sockets import connected

NEUTRAL_S = 1.0
"""Seconds of neutral before motion: a program must centre the stick before it drives."""
LET_GO_S = 0.3
"""Seconds from the last neutral to the end of the connection."""
SHOWN_S = 1.0
"""Seconds between two lines of what it is shown, where that changes."""
_LOOK_S = 0.05
_READ_BYTES = 65536


class HqProgram(FragilePeer):
    """A judge that connects: an HQ program, for one connection.

    A protocol also contributes what a person sees and does: :attr:`agreed`, :meth:`shown`, :meth:`neutral`,
    :meth:`push`.
    """

    OPTIONS: ClassVar[Iterable[tuple[int, int, int]]] = ()
    """Options of its socket."""

    def __init__(self) -> None:
        super().__init__()
        self.connected = asyncio.Event()

    async def run(self, host: str, port: int) -> None:
        """Connect, and serve until cancelled, dead, or the robot closes; raise OSError if nobody listens."""
        try:
            async with connected(host, port, self.OPTIONS) as self._conn:
                self.connected.set()
                await self._run()
        finally:
            self._conn = None
            self._over.set()

    async def simulate(self, host: str, port: int, drive: tuple[float, float] | None) -> None:
        """Run until cancelled, dead or left by the robot; print what happens, and log each violation.

        drive: forward and turn that it drives, once it has sent neutral for a while; None: it does not drive. A
        cancelled program sends neutral before it leaves. Raises OSError if nobody listens.
        """
        self.note = self.note or log_violations()
        print_line(f"connecting to {host}:{port}")
        running, ready = asyncio.ensure_future(self.run(host, port)), asyncio.Event()
        beside = [asyncio.ensure_future(self._print(ready))]
        if drive is not None:
            beside.append(asyncio.ensure_future(self._drive(ready, *drive)))
        try:
            await asyncio.wait((running,))
        except asyncio.CancelledError:
            if drive is not None and self.agreed:
                await self._let_go()
            raise
        finally:
            for task in (running, *beside):
                task.cancel()
            await asyncio.gather(running, *beside, return_exceptions=True)
            if self.death:
                print_line(f"died: {self.death}")
        running.result()

    async def _read(self) -> None:
        """Read once and judge it, or the end of the connection."""
        data, end = b"", "EOF"
        try:
            data = await asyncio.get_running_loop().sock_recv(self._tcp, _READ_BYTES)
        except OSError as error:
            end = repr(error)
        self._take(data, "" if data else end)

    @property
    @abstractmethod
    def agreed(self) -> str:
        """Return what was agreed, once the program can drive; until then an empty text."""

    @abstractmethod
    def shown(self) -> str:
        """Return what the robot shows it now."""

    @abstractmethod
    async def neutral(self) -> None:
        """Centre the stick; the first time also say that it will drive."""

    @abstractmethod
    async def push(self, forward: float, turn: float) -> None:
        """Push the stick: fractions of full scale, ``turn`` counter-clockwise."""

    async def _let_go(self) -> None:
        with contextlib.suppress(OSError, KeyError, TimeoutError):
            async with asyncio.timeout(LET_GO_S):
                await self.neutral()
                print_line("stops driving")
                await asyncio.sleep(LET_GO_S)

    async def _drive(self, ready: asyncio.Event, forward: float, turn: float) -> None:
        """Send neutral for a while, then push the stick."""
        await ready.wait()
        with contextlib.suppress(OSError):  # the connection has ended, as is printed
            print_line("sends neutral")
            await self.neutral()
            await asyncio.sleep(NEUTRAL_S)
            print_line(f"drives: forward {forward:g}, turn {turn:g}")
            await self.push(forward, turn)

    async def _print(self, ready: asyncio.Event) -> None:
        """Print what happens when it happens, and what it is shown once a second at most."""
        loop = asyncio.get_running_loop()
        agreed, shown, due, printed = "", "", 0.0, 0
        while True:
            if self.agreed != agreed:
                agreed = self.agreed
                print_line(agreed)
                ready.set()
            for event in self.events[printed:]:
                printed += 1
                print_line(event)
            if agreed and loop.time() >= due and (now := self.shown()) != shown:
                shown, due = now, loop.time() + SHOWN_S
                print_line(f"is shown {shown}")
            await asyncio.sleep(_LOOK_S)
