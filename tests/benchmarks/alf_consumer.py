"""The consumer of the ALF benchmark: a subscriber in a process of its own that counts scans.

``python -m tests.benchmarks.alf_consumer ENDPOINT``. It declines shared memory, for both sides: as between two
machines, the payloads have to travel.
"""

from __future__ import annotations

import sys

from tests.benchmarks.alf_wire import SCAN_KEY
from tests.benchmarks.peer import Sink, open_session, tell


def main() -> None:
    """Subscribe and do what the harness says."""
    sink = Sink(keep=False, read_sequences=lambda _: [])
    with open_session(connect=sys.argv[1], shared_memory=False) as session:
        session.declare_subscriber(SCAN_KEY, sink.take)
        tell(ready=True)
        sink.obey()


if __name__ == "__main__":
    main()
