"""Runs targets: with atheris, which looks at what each input reaches, or with a mutator of our own, which is blind.

The blind one needs nothing, is faster, and repeats itself from a seed. Both begin
with the corpus and the seeds of a target, end a reader that hangs, and bound the memory of the process.
"""

from __future__ import annotations

import contextlib
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from tests.fuzz.target import CORPUS, Target

HANG_S = 5.0
"""One input that takes longer is a hang; of the processor's time, which a busy machine does not stretch."""
MEMORY_BYTES = 4 << 30
"""Address space of a process that fuzzes: a reader that wants more raises MemoryError."""
NUMBERS = (b"\0", b"\xff", b"\x7f", b"\x80", b"\xff\xff\xff\xff", b"\0\0\0\x80", b"\xff\xff\xff\x7f", b"\0" * 8,
           b"\xff" * 8, b"\0\0\0\0\0\0\xf0\x7f", b"\0\0\0\0\0\0\xf8\x7f", b"-1", b"nan", b"1e999",
           b"\r\n\r\n")  # fmt: skip


class HangError(Exception):
    """A reader did not come to an end."""


_reported: set[Path] = set()


@dataclass
class Tally:
    """What a run came to."""

    inputs: int = 0
    bytes: int = 0
    findings: int = 0


def bound_memory() -> None:
    """Bound the address space of this process."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))


@contextlib.contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raise HangError where the body takes longer."""

    def on_alarm(signum: int, frame: FrameType | None) -> None:
        raise HangError(f"no end within {seconds:g} s")

    former = signal.signal(signal.SIGPROF, on_alarm)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, former)


def run_blind(target: Target, seconds: float, seed: int, most_bytes: int | None = None) -> Tally:
    """Mutate inputs of a target for so long, or up to so many bytes; write down what is a finding, and continue."""
    chance, tally = random.Random(f"{target.name}/{seed}"), Tally()
    pool = [data for _, data in target.corpus()] + list(target.seeds())
    end = time.monotonic() + seconds
    while time.monotonic() < end and (most_bytes is None or tally.bytes < most_bytes):
        with within(HANG_S * 64):
            for _ in range(64):
                data = mutated(pool, chance, target.most_bytes)
                started = time.process_time()
                try:
                    target.run(data)
                    assert time.process_time() - started < HANG_S, "too slow"
                except Exception as error:
                    tally.findings += 1
                    report(target, data, error)
                tally.inputs += 1
                tally.bytes += len(data)
    return tally


def mutated(pool: list[bytes], chance: random.Random, most_bytes: int) -> bytes:
    """Make an input: one of the pool, bent in a few places; or several joined."""
    data = bytearray(chance.choice(pool))
    for _ in range(chance.choice((1, 1, 1, 2, 4, 8, 32))):
        at = chance.randrange(len(data) + 1)
        way = chance.randrange(8)
        if way == 0:
            data[at : at + 1] = bytes([chance.randrange(256)])
        elif way == 1:
            number = chance.choice(NUMBERS)
            data[at : at + len(number)] = number
        elif way == 2:
            data[at:at] = chance.choice(NUMBERS)
        elif way == 3:
            del data[at : at + chance.choice((1, 1, 2, 4, 16, 100))]
        elif way == 4:
            data[at:at] = data[at : at + chance.choice((1, 4, 16, 64, 1000))] * chance.choice((1, 1, 3))
        elif way == 5:
            other = chance.choice(pool)
            start = chance.randrange(len(other) + 1)
            data[at:at] = other[start : start + chance.choice((4, 16, 64, 4096))]
        elif way == 6 and at < len(data):
            data[at] ^= 1 << chance.randrange(8)
        else:
            del data[at + chance.randrange(200) :]
    return bytes(data[:most_bytes])


def report(target: Target, data: bytes, error: Exception) -> None:
    """Write a finding down and say where, once for each line that raises."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    where = [f"{Path(each.f_code.co_filename).name}-{each.f_code.co_name}" for each in frames][-2:]
    place = Path(tempfile.gettempdir()) / "zbridge-fuzz" / target.name
    place.mkdir(parents=True, exist_ok=True)
    path = place / "-".join((type(error).__name__, *where))
    if path not in _reported:
        _reported.add(path)
        path.write_bytes(data)
        print(f"{target.name}: {type(error).__name__}: {str(error)[:1000]}\n  {path}", flush=True)


def run_guided(target: Target, seconds: float, seed: int) -> int:
    """Run atheris on a target in a process of its own, which it ends; return its exit status."""
    place = Path(tempfile.gettempdir()) / "zbridge-fuzz" / target.name
    found = place / "found"
    found.mkdir(parents=True, exist_ok=True)
    for number, data in enumerate(target.seeds()):
        (found / f"seed-{number}").write_bytes(data)
    options = [f"-max_total_time={max(1, int(seconds))}", f"-seed={seed}", f"-max_len={target.most_bytes}",
               f"-timeout={HANG_S:.0f}", "-rss_limit_mb=2048",
               f"-artifact_prefix={place}/", "-print_final_stats=1"]  # fmt: skip
    folders = [str(found), *([str(CORPUS / target.name)] if (CORPUS / target.name).is_dir() else [])]
    command = [sys.executable, "-m", "tests.fuzz.guided", target.name, *options, *folders]
    return subprocess.run(command, check=False).returncode
