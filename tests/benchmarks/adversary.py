"""Drives that nobody may give, in four kinds by turns: a token that was never given, the driver's own attachments
again, the token of an ended lease, none at all.

``python -m tests.benchmarks.adversary ENDPOINT``; ``arm TOKEN ENDED FIRST_SEQ LAST_SEQ COUNT`` makes them ready,
``go RATE_HZ`` sends them (0: as fast as Zenoh takes them). They block where the bus is full, so that every one arrives.
"""

from __future__ import annotations

import gc
import os
import sys
import time

import zenoh

from tests.benchmarks.drives import ADVERSE, DRIVE, attachment, drive, packed
from tests.benchmarks.peer import hear, open_session, tell

Command = tuple[bytes, bytes | None]


def main() -> None:
    """Do what the harness says until it is gone."""
    gc.disable()  # it lives for seconds
    with open_session(connect=sys.argv[1]) as session:
        publisher = session.declare_publisher(
            DRIVE,
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=zenoh.CongestionControl.BLOCK,
            express=True,
        )
        commands: list[Command] = []
        tell(ready=True)
        while True:
            word, *arguments = (hear() or "").split() or [""]
            if word == "arm":
                token, ended = map(bytes.fromhex, arguments[:2])
                commands = _commands(token, ended, *map(int, arguments[2:]))
                tell(armed=len(commands))
            elif word == "go":
                begun_ns = time.perf_counter_ns()
                _send(publisher, commands, float(arguments[0]))
                tell(begun_ns=begun_ns, ended_ns=time.perf_counter_ns())


def _commands(token: bytes, ended: bytes, first_seq: int, last_seq: int, count: int) -> list[Command]:
    """Make one drive after the other, each with a number of its own that is no driver's."""
    used = last_seq - first_seq + 1
    kinds = (
        lambda number: attachment(os.urandom(16), number),
        lambda number: attachment(token, first_seq + number // 4 % used),
        lambda number: attachment(ended, number),
        lambda number: None,
    )
    return [(packed(drive(ADVERSE + number)), kinds[number % 4](number)) for number in range(count)]


def _send(publisher: zenoh.Publisher, commands: list[Command], rate_hz: float) -> None:
    put, now_ns = publisher.put, time.perf_counter_ns
    begun_ns, period_ns = now_ns(), 1e9 / rate_hz if rate_hz else 0.0
    for number, (payload, shown) in enumerate(commands):
        wait_ns = begun_ns + number * period_ns - now_ns()
        if rate_hz and wait_ns > 0:
            time.sleep(wait_ns / 1e9)
        put(payload, attachment=shown)


if __name__ == "__main__":
    main()
