"""Drives that nobody may give, in four kinds by turns.

The driver's public lease with a proof made up, the driver's own attachments with another payload, a proof of an ended
lease, none at all.

``python -m tests.benchmarks.adversary ENDPOINT``; ``arm LEASE ENDED FIRST_SEQ LAST_SEQ COUNT`` makes them ready, where
both leases are ``ID:TOKEN``; ``go RATE_HZ`` sends them (0: as fast as Zenoh takes them). They block where the bus is
full, so that every one arrives.
"""

from __future__ import annotations

import gc
import os
import sys
import time

import zenoh

from tests.benchmarks.drives import ADVERSE, DRIVE, drive, packed
from tests.benchmarks.peer import hear, open_session, tell
from tests.proofs import shown

Command = tuple[bytes, bytes | None]
Lease = tuple[bytes, bytes]


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
                commands = _commands(*map(_read_lease, arguments[:2]), *map(int, arguments[2:]))
                tell(armed=len(commands))
            elif word == "go":
                begun_ns = time.perf_counter_ns()
                _send(publisher, commands, float(arguments[0]))
                tell(begun_ns=begun_ns, ended_ns=time.perf_counter_ns())


def _read_lease(written: str) -> Lease:
    lease, token = map(bytes.fromhex, written.split(":"))
    return lease, token


def _commands(lease: Lease, ended: Lease, first_seq: int, last_seq: int, count: int) -> list[Command]:
    """Make one drive after the other, each with a number of its own that is no driver's."""
    used, theirs = last_seq - first_seq + 1, packed(drive(1))
    made: list[Command] = []
    for number in range(count):
        payload = packed(drive(ADVERSE + number))
        match number % 4:
            case 0:
                attachment = packed({"lease": lease[0], "seq": 2**63, "proof": os.urandom(16)})
            case 1:
                attachment = shown(*lease, DRIVE, first_seq + number // 4 % used, theirs)
            case 2:
                attachment = shown(*ended, DRIVE, number, payload)
            case _:
                attachment = None
        made.append((payload, attachment))
    return made


def _send(publisher: zenoh.Publisher, commands: list[Command], rate_hz: float) -> None:
    put, now_ns = publisher.put, time.perf_counter_ns
    begun_ns, period_ns = now_ns(), 1e9 / rate_hz if rate_hz else 0.0
    for number, (payload, attachment) in enumerate(commands):
        wait_ns = begun_ns + number * period_ns - now_ns()
        if rate_hz and wait_ns > 0:
            time.sleep(wait_ns / 1e9)
        put(payload, attachment=attachment)


if __name__ == "__main__":
    main()
