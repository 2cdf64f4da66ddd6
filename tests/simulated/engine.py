"""The world of one simulation: a heap of events, hosts with clocks, and processes with an event loop each.

Theory of operation. Everything that happens is an event at a time of the world. A process is code that the simulation
runs on an event loop of its own (:class:`SimLoop`), or a robot or program that only uses :meth:`Process.after`. A
paused process keeps what becomes due, and does it when it resumes; a dead one forgets it. Each part draws random
numbers from a generator of its own name, so that a change of one part leaves the others' choices alone.
"""

from __future__ import annotations

import asyncio
import hashlib
import heapq
import random
from asyncio import events
from collections import deque
from collections.abc import Callable
from typing import Any

WAKE_S = 2e-4
"""Most seconds that a process takes to wake up."""
THREAD_S = 1e-3
"""Most seconds that work on another thread takes."""
_RESOLUTION_S = 1e-6


class World:
    """The heap of events, the time, and the trace."""

    def __init__(self, seed: int | str, *, keep_trace: bool = False) -> None:
        self.seed = seed
        self.now = 0.0
        self.over = False
        """Whether it is being taken apart: what the garbage of processes does is of no account."""
        self.lines: list[str] | None = [] if keep_trace else None
        self.events = 0
        self.errors: list[str] = []
        """Exceptions that nobody handled, and logged errors that are our own bugs."""
        self.watchers: list[Callable[[str, str, tuple[Any, ...]], None]] = []
        """Called with every note of the trace: faults that wait for a state, and the checker."""
        self.by_pid: dict[int, Process] = {}
        self._heap: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0
        self._hash = hashlib.blake2b(digest_size=16)

    def rng(self, name: str) -> random.Random:
        """Return the generator of one part."""
        return random.Random(f"{self.seed} {name}")

    def at(self, when: float, event: Callable[[], None]) -> None:
        """Do something at a time."""
        self._count += 1
        heapq.heappush(self._heap, (when, self._count, event))

    def after(self, delay_s: float, event: Callable[[], None]) -> None:
        """Do something after so many seconds."""
        self.at(self.now + delay_s, event)

    def note(self, who: str, what: str, *fields: Any) -> None:
        """Enter an event into the trace."""
        if self.over:
            return
        line = f"{self.now:.6f} {who} {what} {fields}"
        self._hash.update(line.encode())
        if self.lines is not None:
            self.lines.append(line)
        for watcher in self.watchers:
            watcher(who, what, fields)

    @property
    def trace_hash(self) -> str:
        """The hash of all that was noted."""
        return self._hash.hexdigest()

    def run_until(self, when: float) -> None:
        """Let time pass."""
        heap, pop = self._heap, heapq.heappop
        while heap and heap[0][0] <= when:
            self.now, _, event = pop(heap)
            self.events += 1
            event()
        self.now = when


class Host:
    """A machine: its clocks have an offset and drift; the wall clock may jump, and the machine may be suspended."""

    def __init__(self, world: World, name: str, drift: float = 0.0, offset_s: float = 1000.0) -> None:
        self.world = world
        self.name = name
        self.wall_offset_s = 1.7e9
        self.suspended_s = 0.0
        self.thread_s = THREAD_S
        """Longest time of what a thread does, such as writing to a disk; seconds."""
        self._rate = 1.0 + drift
        self._raw_rate = 1.0 + drift * 1.5
        self._offset_s = offset_s

    def __repr__(self) -> str:
        return f"<Host {self.name}>"

    def monotonic(self) -> float:
        """Return CLOCK_MONOTONIC, seconds."""
        return self._offset_s + (self.world.now - self.suspended_s) * self._rate

    def when(self, monotonic_s: float) -> float:
        """Return the time of the world at which the monotonic clock shows this."""
        return (monotonic_s - self._offset_s) / self._rate + self.suspended_s

    def raw_ms(self) -> float:
        """Return CLOCK_MONOTONIC_RAW, milliseconds."""
        return (self._offset_s * 3 + (self.world.now - self.suspended_s) * self._raw_rate) * 1e3

    def wall_ns(self) -> int:
        """Return Unix time."""
        return int((self.wall_offset_s + self.world.now) * 1e9)


class Process:
    """Something that runs on a host, can be paused, and can die. ``loop``: where it has an event loop."""

    def __init__(self, host: Host, name: str) -> None:
        self.host = host
        self.world = host.world
        self.name = name
        self.alive = True
        self.paused = False
        self.rng = self.world.rng(name)
        self.loop: SimLoop | None = None
        self.on_death: list[Callable[[], None]] = []
        """What the operating system does when the process has ended: closes its sockets and bus sessions."""
        self.on_pause: list[Callable[[bool], None]] = []
        self.on_go: list[Callable[[], None]] = []
        """What happens when another process has handed everything over to this one."""
        self.paused_at = 0.0
        self.resumed_at = 0.0
        self.descriptors: dict[int, Any] = {}
        self.pid = len(self.world.by_pid) + 1
        self.world.by_pid[self.pid] = self
        self._next_descriptor = 3
        self._late: list[Callable[[], None]] = []

    def __repr__(self) -> str:
        return f"<Process {self.name} {'paused' if self.paused else 'running' if self.alive else 'dead'}>"

    def after(self, delay_s: float, work: Callable[[], None]) -> None:
        """Let the process, one of its threads or its kernel's callbacks do something; late while it is paused."""

        def run() -> None:
            if not self.alive:
                return
            if self.paused or self._late:
                self._late.append(work)
            else:
                work()

        self.world.after(delay_s, run)

    def pause(self) -> None:
        """Stop it, as SIGSTOP does."""
        if self.alive and not self.paused:
            self.paused, self.paused_at = True, self.world.now
            self.world.note(self.name, "paused")
            for tell in self.on_pause:
                tell(True)

    def resume(self) -> None:
        """Let it run again: what came meanwhile is done in the order of its coming, within a moment."""
        if not self.alive or not self.paused:
            return
        self.paused, self.resumed_at = False, self.world.now
        self.world.note(self.name, "resumed")
        self._catch_up()
        for tell in self.on_pause:
            tell(False)
        if self.loop is not None:
            self.loop.wake(self.world.now + self.rng.random() * 2e-3)

    def _catch_up(self) -> None:
        """Do the oldest of what came meanwhile, and soon the next; what comes now waits behind it."""
        if self._late and self.alive and not self.paused:
            self._late[0]()
            del self._late[0]
            self.world.after(self.rng.random() * 1e-4, self._catch_up)

    def kill(self) -> None:
        """End it at once, as SIGKILL does."""
        if not self.alive:
            return
        self.world.note(self.name, "killed")
        self.exit()

    def exit(self) -> None:
        """Let the operating system clean up: what no other process has open is closed."""
        if not self.alive:
            return
        self.alive = False
        for tell in self.on_death:
            tell()
        things, self.descriptors = tuple(self.descriptors.values()), {}
        for thing in things:
            thing.left(self)
        if self.loop is not None:
            self.loop.abandon()

    def descriptor(self, thing: Any) -> int:
        """Give something a number."""
        self._next_descriptor += 1
        self.descriptors[self._next_descriptor] = thing
        return self._next_descriptor


class SimLoop(asyncio.AbstractEventLoop):
    """The event loop of one process. An iteration does what other threads brought, then I/O, then timers."""

    def __init__(self, process: Process) -> None:
        self.process = process
        process.loop = self
        self.world = process.world
        self.io: deque[Callable[[], None]] = deque()
        """What the kernel has ready."""
        self.network: Any = None
        self.abandoned: list[Any] = []
        self._readers: dict[int, Callable[[], None]] = {}
        self._ready: deque[asyncio.Handle] = deque()
        self._timers: list[tuple[float, int, asyncio.TimerHandle]] = []
        self._number = 0
        self._closed = False
        self._wake_at = float("inf")
        self._monotonic = process.host.monotonic

    def __repr__(self) -> str:
        return f"<SimLoop of {self.process.name}>"

    # Time

    def time(self) -> float:
        return self._monotonic()

    def wake(self, when: float) -> None:
        """Run an iteration at this time of the world, or earlier."""
        if when < self._wake_at and not self._closed:
            self._wake_at = when
            self.world.at(when, lambda: self._woken(when))

    def _woken(self, when: float) -> None:
        if when == self._wake_at and not self._closed:
            self._wake_at = float("inf")
            if not self.process.paused:
                self._iterate()

    def _iterate(self) -> None:
        ready = self._ready
        before = events._get_running_loop()
        events._set_running_loop(self)
        try:
            for _ in range(len(ready)):
                handle = ready.popleft()
                if not handle._cancelled:
                    handle._run()
                if self._closed:
                    return
            for _ in range(len(self.io)):
                self.io.popleft()()
            now, timers = self.time() + _RESOLUTION_S, self._timers
            due = []
            while timers and (timers[0][0] <= now or timers[0][2]._cancelled):
                due.append(heapq.heappop(timers)[2])
            for handle in due:
                if not handle._cancelled:
                    handle._run()
        finally:
            events._set_running_loop(before)
        self._arm()

    def _arm(self) -> None:
        if self._closed:
            return
        if self._ready or self.io:
            self.wake(self.world.now + 2e-5)
        elif self._timers:
            when = self.process.host.when(self._timers[0][0])
            self.wake(max(self.world.now, when) + self.process.rng.random() * WAKE_S)

    def poke(self) -> None:
        """Note that the kernel has something ready."""
        self.wake(self.world.now + self.process.rng.random() * WAKE_S)

    # What asyncio calls

    def call_soon(self, callback, *args, context=None):  # type: ignore[no-untyped-def, override]
        handle = asyncio.Handle(callback, args, self, context)
        self._ready.append(handle)
        if events._get_running_loop() is not self:
            self.poke()
        return handle

    def call_soon_threadsafe(self, callback, *args, context=None):  # type: ignore[no-untyped-def, override]
        if self._closed:
            raise RuntimeError("Event loop is closed")
        return self.call_soon(callback, *args, context=context)

    def call_later(self, delay, callback, *args, context=None):  # type: ignore[no-untyped-def, override]
        return self.call_at(self.time() + delay, callback, *args, context=context)

    def call_at(self, when, callback, *args, context=None):  # type: ignore[no-untyped-def, override]
        handle = asyncio.TimerHandle(when, callback, args, self, context)
        self._number += 1
        heapq.heappush(self._timers, (when, self._number, handle))
        if events._get_running_loop() is not self:
            self.wake(max(self.world.now, self.process.host.when(when)) + self.process.rng.random() * WAKE_S)
        return handle

    def _timer_handle_cancelled(self, handle: asyncio.TimerHandle) -> None:
        pass

    def create_future(self) -> asyncio.Future[Any]:
        return asyncio.Future(loop=self)

    def create_task(self, coro, *, name=None, context=None):  # type: ignore[no-untyped-def, override]
        task = asyncio.Task(coro, loop=self, name=name, context=context)
        self.abandoned.append(task)
        if len(self.abandoned) > 256:
            self.abandoned = [each for each in self.abandoned if not each.done()]
        return task

    def run_in_executor(self, executor, func, *args):  # type: ignore[no-untyped-def, override]
        future = self.create_future()

        def work() -> None:
            try:
                outcome, error = func(*args), None
            except Exception as raised:
                outcome, error = None, raised
            if not future.done():
                self.call_soon(_settle, future, outcome, error)

        self.process.after(self.process.rng.random() * self.process.host.thread_s, work)
        return future

    def call_exception_handler(self, context: dict[str, Any]) -> None:
        if not self._closed and self.process.alive:
            error = context.get("exception")
            self.world.errors.append(f"{self.process.name}: {context.get('message')}: {error!r}")
            self.world.note(self.process.name, "exception", repr(error))

    def get_debug(self) -> bool:
        return False

    def is_running(self) -> bool:
        return not self._closed

    def is_closed(self) -> bool:
        return self._closed

    async def shutdown_asyncgens(self) -> None:
        pass

    # I/O

    def add_reader(self, fd, callback, *args):  # type: ignore[no-untyped-def, override]
        thing = self.process.descriptors[fd]
        thing.watch(self, lambda: callback(*args))

    def remove_reader(self, fd):  # type: ignore[no-untyped-def, override]
        thing = self.process.descriptors.get(fd)
        if thing is not None:
            thing.watch(self, None)
        return thing is not None

    async def create_connection(self, protocol_factory, host=None, port=None, *, sock=None, **_):  # type: ignore[no-untyped-def, override]
        return await self.network.connect(self, protocol_factory, host, port, sock)

    async def create_server(self, protocol_factory, host=None, port=None, *, sock=None, **_):  # type: ignore[no-untyped-def, override]
        return self.network.serve(self, protocol_factory, host, port, sock)

    # The end

    @property
    def left(self) -> tuple[list[Any], int]:
        """The tasks that have not ended, and how many timers and callbacks wait."""
        tasks = [task for task in self.abandoned if not task.done()]
        timers = sum(not handle._cancelled for _, _, handle in self._timers)
        return tasks, timers + len(self._ready)

    @property
    def waiting(self) -> list[str]:
        """What the timers would call."""
        return [str(handle._callback) for _, _, handle in self._timers if not handle._cancelled]

    def abandon(self) -> None:
        """Run nothing any more."""
        self._closed = True
        self._ready.clear()
        self._timers.clear()
        self.io.clear()


def _settle(future: asyncio.Future[Any], outcome: Any, error: Exception | None) -> None:
    if future.done():
        return
    if error is None:
        future.set_result(outcome)
    else:
        future.set_exception(error)
