"""The bare loop: ``publisher.put`` of the payloads the gateway publishes, and nothing else.

``python -m tests.benchmarks.bare KIND ENDPOINT COUNT RATE_HZ``; saturated with BLOCK, so that nothing is lost;
paced with ``express``, as the gateway sends what it does not have to batch.
"""

from __future__ import annotations

import sys
import time

import zenoh

from tests.benchmarks.peer import KEYS, drive, open_session
from tests.benchmarks.wire import Kind, payload


def main() -> None:
    """Publish as told."""
    kind: Kind = "map" if sys.argv[1] == "map" else "pose"
    endpoint, count, rate_hz = sys.argv[2], int(sys.argv[3]), float(sys.argv[4])
    congestion = zenoh.CongestionControl.DROP if rate_hz else zenoh.CongestionControl.BLOCK
    with open_session(listen=endpoint) as session:
        publisher = session.declare_publisher(KEYS[kind], congestion_control=congestion, express=bool(rate_hz))
        stamp_ns = time.time_ns()
        same = payload(kind, 0, stamp_ns)
        numbered = [payload(kind, number, stamp_ns) for number in range(count + 1)] if rate_hz else [same]

        def flood() -> None:
            put = publisher.put
            for _ in range(count):
                put(same)

        drive(count, rate_hz, lambda number: publisher.put(numbered[number]), flood)
        sys.stdin.readline()  # until the harness ends this process


if __name__ == "__main__":
    main()
