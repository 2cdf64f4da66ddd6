"""How fast MAVLink is read and written: ``python -m tests.benchmarks.mavlink``; pymavlink beside it. Goal: 300 000/s.

Half of the messages are attitudes, half positions; reads of 4 096 bytes; the fastest of many rounds counts.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

from gateways.mavlink.frames import LIMIT_BYTES, frame_end, read_frame, write_frame
from gateways.mavlink.messages.telemetry import Attitude, GlobalPositionInt
from zbridge.wire.frames import FrameBuffer

COUNT, ROUNDS, READ_BYTES = 10_000, 7, 4096
ATTITUDE = Attitude(1000, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
POSITION = GlobalPositionInt(1000, 473_977_418, 85_455_939, 500_000, 1_000, 10, 20, 30, 9_000)


def fastest(work: Callable[[], object]) -> float:
    """Return the messages a second of the fastest round."""
    times = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        work()
        times.append(time.perf_counter() - begun)
    return COUNT / min(times)


def main() -> None:
    """Print the rates."""
    messages = [ATTITUDE, POSITION] * (COUNT // 2)
    data = b"".join(write_frame(each, number, 1, 1) for number, each in enumerate(messages))
    reads = [data[at : at + READ_BYTES] for at in range(0, len(data), READ_BYTES)]

    def read() -> None:
        buffer = FrameBuffer(frame_end, LIMIT_BYTES)
        count = sum(read_frame(frame).message is not None for piece in reads for frame in buffer.feed(piece))
        assert count == COUNT

    def write() -> None:
        for number, each in enumerate(messages):
            write_frame(each, number, 1, 1)

    print(f"read {fastest(read):.0f}/s, written {fastest(write):.0f}/s")
    os.environ["MAVLINK20"] = "1"
    from pymavlink.dialects.v20 import ardupilotmega as judge

    parser: Any = judge.MAVLink(None)

    def judged() -> None:
        assert sum(len(parser.parse_buffer(piece) or ()) for piece in reads) == COUNT

    print(f"pymavlink reads {fastest(judged):.0f}/s")


if __name__ == "__main__":
    main()
