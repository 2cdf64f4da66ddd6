"""The consumer of the benchmark: a subscriber in a process of its own that only counts or stores.

``python -m tests.benchmarks.consumer KIND ENDPOINT KEEP SHARED``; KEEP 1 stores every payload with its time
of arrival and reads the running numbers after the run; SHARED 0 declines shared memory, for both sides.
"""

from __future__ import annotations

import sys
from typing import Any

from tests.benchmarks.peer import KEYS, Sink, open_session, tell
from tests.benchmarks.wire import sequence_of


def main() -> None:
    """Subscribe and do what the harness says."""
    kind, endpoint, keep, shared = sys.argv[1], sys.argv[2], sys.argv[3] == "1", sys.argv[4] == "1"
    sink = Sink(keep=keep, read_sequences=_read_sequences)
    with open_session(connect=endpoint, shared_memory=shared) as session:
        session.declare_subscriber(KEYS[kind], sink.take)
        tell(ready=True)
        sink.obey()


def _read_sequences(samples: list[Any]) -> list[int]:
    return [sequence_of(sample.payload.to_bytes()) for sample in samples]


if __name__ == "__main__":
    main()
