"""Programs that connect, shake hands and leave, thousands of times: what of them does the gateway keep?

    python -m tests.e2e.measured.hq_churn --cycles 10000

They leave with a FIN or a RST, before the handshake, after it, or in the middle of driving. Afterwards the gateway's
process has no more descriptors, threads or liveliness tokens than before, not much more memory, and room for all
clients there can be.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from tests.e2e.conftest import Bench, device, listener
from tests.e2e.rigs.hq_scene import NEUTRAL, ByHand, sessions, soon
from tests.e2e.rigs.processes import Finding, report
from tests.ports import free_port

CLIENTS = 254
AT_ONCE = 8
WARM_UP = 500
GROWTH = {"files": 0, "threads": 4, "kB": 4096}
"""Growth beyond the warm-up that is put down to pools that have not grown to their bound, and to the allocator."""
JOYSTICK = bytes.fromhex("06000000 00 0a 02000000")
FORWARD = bytes.fromhex("0e000000 00 0b 00000000 0000803f 0000003f")
"""Packets 10 and 11 as a program sends them: control mode 2, and forward at half speed."""
SHOWN = (1, 53, 55)
"""What a program is sent first once it is established: a text, the map or the position."""


def use(pid: int) -> dict[str, int]:
    """ReadPayload at what a process uses."""
    process = Path(f"/proc/{pid}")
    memory_kb = int((process / "status").read_text().partition("VmRSS:")[2].split()[0])
    counts = {"files": "fd", "threads": "task"}
    return {**{what: len([*(process / folder).iterdir()]) for what, folder in counts.items()}, "kB": memory_kb}


@dataclass
class Churn(Finding):
    """What came of it."""

    ways: Counter[str] = field(default_factory=Counter)
    before: dict[str, int] = field(default_factory=dict)
    after: dict[str, int] = field(default_factory=dict)
    seconds: float = 0.0

    def __str__(self) -> str:
        rate_hz = self.ways.total() / self.seconds
        return (
            f"{dict(self.ways)} in {self.seconds:.1f} s ({rate_hz:.0f}/s)\nbefore: {self.before}\nafter:  {self.after}"
        )


async def cycle(port: int, number: int) -> str:
    """Connect, and leave in one way or another; tell which."""
    program = await ByHand.connect(port)
    try:
        if number % 10 == 0:
            await program.packet()
            return "before the handshake"
        await program.shake()
        if number % 10 == 1:
            return "in the handshake"
        await program.until(*SHOWN)
        if number % 10 == 2:
            program.writer.write(NEUTRAL)
            await program.writer.drain()
            program.writer.write(JOYSTICK + FORWARD)
            for _ in range(2):  # at least until the next, a tenth of a second: then it drives, if it may
                await program.until(55)
            return "driving"
        return "established"
    finally:
        await program.leave(abruptly=number % 4 == 0)


async def room_is_left(port: int) -> bool:
    """Connect as many programs as there can be, and one more; tell whether that one alone was closed."""
    programs = [await ByHand.connect(port) for _ in range(CLIENTS)]
    for program in programs:
        await program.shake()
    for program in programs:
        await program.until(*SHOWN)
    last = await ByHand.connect(port)
    try:
        async with asyncio.timeout(5):
            return await last.reader.read(1) == b""
    except (TimeoutError, ConnectionError):
        return False
    finally:
        for program in (last, *programs):
            await program.leave()


async def churn(cycles: int, warm_up: int = WARM_UP) -> Churn:
    """Run so many cycles, after some that count for nothing."""
    result = Churn()
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        bench, port = Bench(Path(folder), stack), free_port()
        more = "accept_hz = 10000\noptions = { quiet_s = 0 }"
        process = bench.gateway(listener("v13", "tcpudp", port, more), device(bench.simulator()))
        await soon(lambda: process.listens(1) and bench.fleet.last("r1/map"), "the robot and its listener")
        await _run(port, warm_up, Counter())
        await _settled(bench)
        result.before = use(process.process.pid)
        began = time.monotonic()
        await _run(port, cycles, result.ways)
        result.seconds = time.monotonic() - began
        await _settled(bench)
        result.after = use(process.process.pid)
        grown = {what: result.after[what] - result.before[what] for what in GROWTH}
        result.faults += [f"{grown[what]} {what} more" for what in GROWTH if grown[what] > GROWTH[what]]
        if not await room_is_left(port):
            result.faults.append(f"client {CLIENTS + 1} was not refused")
        if " drives r1" not in process.end():
            result.faults.append("none of them drove")
    return result


async def _run(port: int, cycles: int, ways: Counter[str]) -> None:
    numbers = iter(range(cycles))

    async def work() -> None:
        for number in numbers:
            async with asyncio.timeout(10):
                ways[await cycle(port, number)] += 1

    async with asyncio.TaskGroup() as tasks:
        for _ in range(AT_ONCE):
            tasks.create_task(work())


async def _settled(bench: Bench) -> None:
    """Wait until every program is known to be gone, and the robot is nobody's."""

    def here() -> list[str]:
        return [one["name"] for one in sessions(bench) if one["role"] == "robot" and one["state"] != "closed"]

    await soon(lambda: not here(), "no session")
    await soon(lambda: bench.fleet.last("r1/control").get("state") == "free", "free")
    await soon(lambda: bench.fleet.tokens("fleet/*/@alive/*") == ["fleet/r1/@alive/gateway"], "no token")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cycles", type=int, default=10_000)
    wanted = parser.parse_args()
    report([asyncio.run(churn(wanted.cycles))])


if __name__ == "__main__":
    main()
