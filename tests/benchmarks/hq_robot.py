"""The robot of the benchmark of listeners, played on the bus: 50 Hz of small messages, for ALF clients 10 Hz of scans.

``python -m tests.benchmarks.hq_robot KIND ENDPOINT COUNT``: COUNT small messages, and a scan beside every fifth.
"""

from __future__ import annotations

import sys

import zenoh

from tests.benchmarks import hq_wire
from tests.benchmarks.hq_wire import SCANS_HZ, SMALL_HZ, Kind
from tests.benchmarks.peer import drive, open_session

PROBED = 20
"""Calls of the source's for a probe that one is published at: hundreds of clients get it."""
_EVERY = SMALL_HZ // SCANS_HZ


def main() -> None:
    """Publish as told."""
    kind: Kind = next(kind for kind in hq_wire.KINDS if kind == sys.argv[1])
    endpoint, count = sys.argv[2], int(sys.argv[3])
    drop = zenoh.CongestionControl.DROP
    with open_session(connect=endpoint, shared_memory=False) as session:
        token = session.liveliness().declare_token(hq_wire.ALIVE_KEY)  # lasts as long as it is referred to
        small = session.declare_publisher(hq_wire.small_key(kind), congestion_control=drop, express=True)
        scan = session.declare_publisher(hq_wire.SCAN_KEY, congestion_control=drop, express=True)
        probes = 0

        def send(number: int) -> None:
            nonlocal probes
            if not number:
                probes += 1
                if probes % PROBED:
                    return
                session.put(hq_wire.STATUS_KEY, hq_wire.status(kind))
            small.put(hq_wire.small(kind, number))
            if kind == "alf" and number % _EVERY == 0:
                scan.put(hq_wire.scan(number))

        drive(count, SMALL_HZ, send, lambda: None)
        sys.stdin.readline()  # until the harness ends this process
        del token


if __name__ == "__main__":
    main()
