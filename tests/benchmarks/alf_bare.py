"""The bare loop: ``publisher.put`` of the scan the gateway publishes, and nothing else.

``python -m tests.benchmarks.alf_bare ENDPOINT COUNT``; with BLOCK, so that nothing is lost.
"""

from __future__ import annotations

import sys
import time

import zenoh

from tests.benchmarks.alf_wire import SCAN_KEY, payload
from tests.benchmarks.peer import drive, open_session


def main() -> None:
    """Publish as told."""
    endpoint, count = sys.argv[1], int(sys.argv[2])
    same = payload(count, 1000, time.time_ns())
    with open_session(listen=endpoint) as session:
        publisher = session.declare_publisher(SCAN_KEY, congestion_control=zenoh.CongestionControl.BLOCK)

        def flood() -> None:
            put = publisher.put
            for _ in range(count):
                put(same)

        drive(count, 0.0, lambda _: publisher.put(same), flood)
        sys.stdin.readline()  # until the harness ends this process


if __name__ == "__main__":
    main()
