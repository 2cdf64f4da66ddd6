"""What the processes of the benchmark share: a line of JSON to the harness, a word from it, a Zenoh session."""

from __future__ import annotations

import json
import select
import sys
import time
from array import array
from collections.abc import Callable
from typing import Any

import zenoh

KEYS = {"pose": "fleet/bench/pose", "map": "fleet/bench/map", "all": "fleet/bench/**"}
ROBOT = "bench"
PROBE_S = 0.005
"""Seconds between two probes, sent until the harness has seen one arrive."""
_WORD_S = 30.0


def tell(**facts: Any) -> None:
    """Write one line to the harness."""
    print(json.dumps(facts), flush=True)


def hear(timeout_s: float = _WORD_S) -> str | None:
    """Wait for one line of the harness; None when none came. Ends the process when the harness is gone."""
    if not select.select([sys.stdin], [], [], timeout_s)[0]:
        return None
    line = sys.stdin.readline()
    if not line:
        raise SystemExit(0)
    return line.strip()


def open_session(*, listen: str | None = None, connect: str | None = None, shared_memory: bool = True) -> zenoh.Session:
    """Open a peer on one endpoint, without scouting; one that connects tries again every 10 ms.

    ``shared_memory`` is on in Zenoh's own defaults: payloads of 3 kB and more then bypass the network.
    """
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("transport/shared_memory/enabled", json.dumps(shared_memory))
    config.insert_json5("listen/endpoints", json.dumps([listen] if listen else []))
    if connect:
        config.insert_json5("connect/endpoints", json.dumps([connect]))
        retry = {"period_init_ms": 10, "period_max_ms": 10, "period_increase_factor": 1}
        config.insert_json5("connect/retry", json.dumps(retry))
    return zenoh.open(config)


def drive(count: int, rate_hz: float, send: Callable[[int], None], flood: Callable[[], None]) -> None:
    """Be a source: probe until told to hold, then on ``go`` send numbers 1 to ``count`` and report.

    ``rate_hz`` 0: all at once by ``flood``; else one by one on an absolute schedule, the send times reported.
    """
    probes = 0
    while (word := hear(PROBE_S)) is None:
        send(0)
        probes += 1
    tell(held=probes)
    while word != "go":
        word = hear()
    begun_ns = time.perf_counter_ns()
    sent_ns = array("q")
    if rate_hz:
        _pace(count, rate_hz, send, sent_ns)
    else:
        flood()
    tell(begun_ns=begun_ns, ended_ns=time.perf_counter_ns(), sent_ns=list(sent_ns))


def _pace(count: int, rate_hz: float, send: Callable[[int], None], sent_ns: array[int]) -> None:
    now_ns = time.perf_counter_ns
    begun_ns, period_ns = now_ns(), 1e9 / rate_hz
    for sequence in range(1, count + 1):
        wait_ns = begun_ns + sequence * period_ns - now_ns()
        if wait_ns > 0:
            time.sleep(wait_ns / 1e9)
        sent_ns.append(now_ns())
        send(sequence)


class Sink:
    """What arrived: counted, and kept with its time where every single one matters."""

    def __init__(self, *, keep: bool, read_sequences: Callable[[list[Any]], list[int]]) -> None:
        self.count = 0
        self.last_ns = 0
        self._keep = keep
        self._kept: list[tuple[int, Any]] = []
        self._read_sequences = read_sequences

    def take(self, item: Any) -> None:
        """Take one arrival; the first is told to the harness."""
        now_ns = self.last_ns = time.perf_counter_ns()
        self.count += 1
        if self._keep:
            self._kept.append((now_ns, item))

    def obey(self) -> None:
        """Do what the harness says until it is gone: ``reset``, or ``await COUNT QUIET_S TIMEOUT_S``."""
        end = time.monotonic() + _WORD_S
        while self.count == 0:
            if time.monotonic() > end:
                raise SystemExit(f"nothing arrived within {_WORD_S:g} s")
            time.sleep(0.001)
        tell(first_ns=self.last_ns)
        while True:
            word, *arguments = (hear() or "").split() or [""]
            if word == "reset":
                self.count = 0
                self._kept.clear()
                tell(reset=True)
            elif word == "await":
                self._await(int(arguments[0]), float(arguments[1]), float(arguments[2]))
                self._report()

    def _await(self, count: int, quiet_s: float, timeout_s: float) -> None:
        """Wait until ``count`` have come, or none for ``quiet_s``, or ``timeout_s`` are over."""
        end, seen, changed = time.monotonic() + timeout_s, 0, time.monotonic()
        while self.count < count and time.monotonic() < end:
            time.sleep(0.005)
            if self.count != seen:
                seen, changed = self.count, time.monotonic()
            elif seen and time.monotonic() - changed > quiet_s:
                return

    def _report(self) -> None:
        sequences = self._read_sequences([item for _, item in self._kept])
        arrivals = [(number, at_ns) for number, (at_ns, _) in zip(sequences, self._kept, strict=True)]
        tell(count=self.count, last_ns=self.last_ns, arrivals=arrivals)
