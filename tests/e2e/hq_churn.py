"""Programs that connect, shake hands and leave, thousands of times: what of them does the gateway keep?

    python -m tests.e2e.hq_churn --cycles 10000

They leave with a FIN or a RST, before the handshake, after it, or in the middle of driving. Afterwards the gateway's
process has no more descriptors, threads or liveliness tokens than before, not much more memory, and room for all
clients there can be.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.e2e.conftest import Bench
from tests.e2e.hq_scene import NEUTRAL, ByHand, Gateway, device, gateway, listener, ports, sessions, soon

CLIENTS = 254
AT_ONCE = 8
WARM_UP = 500
GROWTH_KB = 4096
"""Growth of the gateway's memory, beyond what the warm-up took, that is put down to its allocator."""
POOLED = 4
"""Threads more that are put down to pools that have not grown to their bound."""
JOYSTICK = bytes.fromhex("06000000 00 0a 02000000")
FORWARD = bytes.fromhex("0e000000 00 0b 00000000 0000803f 0000003f")
"""Packets 10 and 11 as a program sends them: control mode 2, and forward at half speed."""
SHOWN = (1, 53, 55)
"""What a program is sent first once it is established: a text, the map or the position."""


@dataclass
class Use:
    """What a process uses."""

    sockets: int
    files: int
    threads: int
    memory_kb: int

    @classmethod
    def of(cls, pid: int) -> Use:
        """Look at a process."""
        process = Path(f"/proc/{pid}")
        targets = []
        for descriptor in (process / "fd").iterdir():
            with contextlib.suppress(FileNotFoundError):
                targets.append(str(descriptor.readlink()))
        status = (process / "status").read_text()
        memory_kb = int(status.partition("VmRSS:")[2].split()[0])
        sockets = sum(target.startswith("socket:") for target in targets)
        return cls(sockets, len(targets), len([*(process / "task").iterdir()]), memory_kb)

    def __str__(self) -> str:
        return f"{self.files} files, {self.sockets} of them sockets; {self.threads} threads; {self.memory_kb} kB"


@dataclass
class Churn:
    """What came of it."""

    ways: Counter[str] = field(default_factory=Counter)
    before: Use | None = None
    after: Use | None = None
    faults: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def __str__(self) -> str:
        ways = ", ".join(f"{count} {way}" for way, count in sorted(self.ways.items()))
        rate_hz = self.ways.total() / self.seconds
        return f"{ways} in {self.seconds:.1f} s ({rate_hz:.0f}/s)\nbefore: {self.before}\nafter:  {self.after}"


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


async def crowd(port: int) -> tuple[list[ByHand], bool]:
    """Connect as many programs as there can be, and one more: give those, and whether that one was closed."""
    programs: list[ByHand] = []
    for _ in range(CLIENTS):
        programs.append(await ByHand.connect(port))
        await programs[-1].shake()
    for program in programs:
        await program.until(*SHOWN)
    last = await ByHand.connect(port)
    try:
        async with asyncio.timeout(5):
            refused = await last.reader.read(1) == b""
    except (TimeoutError, ConnectionError):
        refused = False
    await last.leave()
    return programs, refused


async def churn(cycles: int, warm_up: int = WARM_UP) -> Churn:
    """Run so many cycles, after some that count for nothing."""
    result = Churn()
    with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
        bench = Bench(Path(folder), stack)
        robot, port = ports(2)
        bench.simulator(robot)
        more = "accept_hz = 10000\noptions = { quiet_s = 0 }"
        process = gateway(bench, stack, listener("v13", "tcpudp", port, more), device("tcpudp", robot))
        await soon(lambda: process.listens(1) and bench.fleet.last("r1/map"), "the robot and its listener")
        await _run(port, warm_up, Counter())
        await _settled(bench, process)
        result.before = Use.of(process.process.pid)
        began = time.monotonic()
        await _run(port, cycles, result.ways)
        result.seconds = time.monotonic() - began
        await _settled(bench, process)
        result.after = Use.of(process.process.pid)
        await _judge(bench, port, result)
        if " drives r1" not in process.log:
            result.faults.append("none of them drove")
        process.end()
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


async def _settled(bench: Bench, process: Gateway) -> None:
    """Wait until every program is known to be gone, and the robot is nobody's."""
    await soon(lambda: not _connected(bench), "no session")
    await soon(lambda: bench.fleet.last("r1/control").get("state") == "free", "free")
    await soon(lambda: bench.fleet.tokens("fleet/*/@alive/*") == ["fleet/r1/@alive/gateway"], "no token")


def _connected(bench: Bench) -> list[dict[str, Any]]:
    return [entry for entry in sessions(bench) if entry["role"] == "robot" and entry["state"] != "closed"]


async def _judge(bench: Bench, port: int, result: Churn) -> None:
    before, after = result.before, result.after
    assert before is not None
    assert after is not None
    if after.files > before.files or after.sockets > before.sockets:
        result.faults.append("descriptors are left")
    if after.threads > before.threads + POOLED:
        result.faults.append("threads are left")
    if after.memory_kb - before.memory_kb > GROWTH_KB:
        result.faults.append(f"memory has grown by {after.memory_kb - before.memory_kb} kB")
    programs, refused = await crowd(port)
    if not refused:
        result.faults.append(f"client {CLIENTS + 1} was not refused")
    for program in programs:
        await program.leave()


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cycles", type=int, default=10_000)
    wanted = parser.parse_args()
    result = asyncio.run(churn(wanted.cycles))
    print(result)
    for fault in result.faults:
        print("   ", fault)
    sys.exit(bool(result.faults))


if __name__ == "__main__":
    main()
