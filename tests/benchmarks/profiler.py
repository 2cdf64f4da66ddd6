"""Runs a zbridge command under a sampling profiler of the standard library's own means.

``python -m tests.benchmarks.profiler OUT run FILE``. A timer interrupts the main thread (the event loop's) every
millisecond; the CPU time the thread spent since the last sample goes to the stack it is found in. So the sum is
the thread's real CPU time, C code counts for the Python function that called it, and the code under test
runs at nearly full speed, unlike under a tracing profiler.

A sample taken at the very beginning of a function goes to its caller: the interpreter looks for signals there and
after calls of C code, so the time was spent before. Other Python threads are charged their own CPU time at the
place where they let the main thread continue: their sums are right, their places approximate. SIGUSR1 begins anew.
"""

from __future__ import annotations

import dis
import json
import signal
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from types import CodeType, FrameType

from tests.benchmarks.harness import ROOT
from zbridge.cli import main as zbridge

SAMPLE_S = 0.001
_RESUME = dis.opmap["RESUME"]
_LOOP = "asyncio/runners.py"
_OURS = tuple(str(ROOT / folder) for folder in ("zbridge", "gateways"))
_ROWS = 40


class Profiler:
    """Charges CPU time to functions: their own (with the C code they call), and with what they called."""

    def __init__(self) -> None:
        self._own: Counter[tuple[str, CodeType]] = Counter()
        self._cumulative: Counter[tuple[str, CodeType]] = Counter()
        self._lines: Counter[tuple[str, CodeType, int]] = Counter()
        self._threads: dict[int, str] = {}
        self._spent_ns: dict[int, int] = {}
        self._sampling = False

    def start(self) -> None:
        """Begin to sample."""
        signal.signal(signal.SIGUSR1, lambda *_: self.reset())
        signal.signal(signal.SIGALRM, self._sample)
        signal.setitimer(signal.ITIMER_REAL, SAMPLE_S, SAMPLE_S)

    def stop(self) -> None:
        """Sample no more."""
        signal.setitimer(signal.ITIMER_REAL, 0)

    def reset(self) -> None:
        """Forget what was sampled."""
        for table in (self._own, self._cumulative, self._lines):
            table.clear()

    def report(self) -> dict[str, object]:
        """Give seconds by thread and place, the greatest first, and the threads' names by their native ids."""
        ours = [(key, spent) for key, spent in self._cumulative.most_common() if key[1].co_filename.startswith(_OURS)]
        return {
            "threads": self._threads,
            "own": [(key[0], _place(key[1]), spent / 1e9) for key, spent in self._own.most_common(_ROWS)],
            "cumulative": [(key[0], _place(key[1]), spent / 1e9) for key, spent in ours[:_ROWS]],
            "lines": [(key[0], _place(*key[1:]), spent / 1e9) for key, spent in self._lines.most_common(_ROWS)],
        }

    def _sample(self, _: int, frame: FrameType | None) -> None:
        if self._sampling:  # the timer was faster than the sample before
            return
        self._sampling = True
        frames = sys._current_frames()
        for thread in threading.enumerate():
            if thread.ident is None:
                continue
            main = thread is threading.main_thread()
            found = frame if main else frames.get(thread.ident)
            spent_ns = self._elapsed_ns(thread.ident)
            if found is not None and spent_ns:
                name = "event loop" if main else thread.name
                self._threads[thread.native_id or 0] = name
                self._charge(name, found, spent_ns)
        self._elapsed_ns(threading.main_thread().ident or 0)  # what sampling itself took is nobody's
        self._sampling = False

    def _elapsed_ns(self, ident: int) -> int:
        try:
            now_ns = time.clock_gettime_ns(time.pthread_getcpuclockid(ident))
        except OSError:  # the thread has just ended
            return 0
        before_ns = self._spent_ns.get(ident, now_ns)
        self._spent_ns[ident] = now_ns
        return now_ns - before_ns

    def _charge(self, thread: str, frame: FrameType, spent_ns: int) -> None:
        at: FrameType | None = _busy(frame)
        assert at is not None
        self._own[thread, at.f_code] += spent_ns
        self._lines[thread, at.f_code, at.f_lineno or at.f_code.co_firstlineno] += spent_ns
        seen: set[CodeType] = set()
        while at is not None and _LOOP not in at.f_code.co_filename:
            if at.f_code not in seen:
                self._cumulative[thread, at.f_code] += spent_ns
            seen.add(at.f_code)
            at = at.f_back


def _busy(frame: FrameType) -> FrameType:
    """Find the frame that spent the time: the caller's, where its callee has only just begun."""
    begins = frame.f_lasti < 0 or frame.f_code.co_code[frame.f_lasti] == _RESUME
    return frame.f_back if begins and frame.f_back is not None else frame


def _place(code: CodeType, line: int | None = None) -> str:
    if _LOOP in code.co_filename:
        return "uvloop itself and its system calls"
    file = "/".join(Path(code.co_filename).parts[-2:])
    return f"{file}:{line or code.co_firstlineno} {code.co_qualname}"


def main() -> None:
    """Run the command; write what was sampled when it ends."""
    out = Path(sys.argv[1])
    sys.argv = ["zbridge", *sys.argv[2:]]
    profiler = Profiler()
    profiler.start()
    try:
        zbridge()
    finally:
        profiler.stop()
        out.write_text(json.dumps(profiler.report()))


if __name__ == "__main__":
    main()
