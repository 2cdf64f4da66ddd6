"""A recording for tests, written with the plain ``mcap`` library: a map, a state, poses and scans."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, Writer

from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage, Map, Pose, Scan, Status
from zbridge.fleet.topics import Topic
from zbridge.views.pictures import FoxglovePictures

BEGIN_NS = 1_700_000_000_000_000_000
POSE_NS = 50_000_000
"""Between two poses; every second one comes with a scan."""


def record(path: Path, seconds: int, *, finish: bool = True) -> Path:
    """Write so many seconds of a robot that drives in a circle; not finished: as if the recorder was killed."""
    pictures, numbers = FoxglovePictures("r1"), dict[str, int]()
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=8192, compression=CompressionType.ZSTD)
        writer.start()
        fleet = writer.register_channel("fleet/r1/pose", "msgpack", 0)

        def put(topic: Topic, message: FleetMessage, at_ns: int) -> None:
            for picture in pictures.draw(topic, message, at_ns):
                channel = picture.channel
                if channel.topic not in numbers:
                    schema = writer.register_schema(channel.schema.name, channel.schema.encoding, channel.schema.data)
                    encoding = channel.schema.message_encoding
                    numbers[channel.topic] = writer.register_channel(channel.topic, encoding, schema)
                writer.add_message(numbers[channel.topic], at_ns, picture.payload, at_ns)

        cells = np.pad(np.ones((38, 38), np.uint8), 1, constant_values=2)
        put(topics.MAP, Map(rows=40, columns=40, cell=0.25, origin=(-5.0, -5.0), cells=cells), BEGIN_NS)
        put(topics.STATUS, Status("established"), BEGIN_NS)
        for number in range(seconds * 20):
            at_ns, angle = BEGIN_NS + number * POSE_NS, number / 40
            writer.add_message(fleet, at_ns, b"\x80", at_ns)
            put(topics.POSE, Pose(2 * math.cos(angle), 2 * math.sin(angle), angle + math.pi / 2), at_ns)
            if number % 2 == 0:
                put(topics.SCAN, _scan(angle), at_ns)
        if finish:
            writer.finish()
    return path


def _scan(angle: float) -> Scan:
    ranges = (3 + np.sin(np.arange(181) / 10 + angle)).astype("<f4")
    return Scan(angle_min=-2.0, angle_increment=4 / 180, range_min=0.1, range_max=10.0, ranges=ranges)
