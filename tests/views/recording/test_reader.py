"""The reader of recordings: what the library wrote, what was cut off, what lies."""

from __future__ import annotations

import io
import random
import resource
import struct
import tracemalloc
from pathlib import Path

import pytest
import zstandard

from tests.views.recording import files
from zbridge.views.recording.reader import MAGIC, RECORD_BYTES, RecordingReader

SCANS = [("fleet/r1/scan", number / 10, bytes([number]) * 300) for number in range(100)]


def test_what_the_library_wrote_is_read_with_times_and_topics(tmp_path: Path) -> None:
    with files.written(tmp_path / "a.mcap", SCANS).open("rb") as file:
        reader = RecordingReader(file)
        read = [(each.channel.topic, each.log_ns, each.data) for each in reader.messages()]
    assert read == [(key, files.BEGAN_NS + int(seconds * 1e9), data) for key, seconds, data in SCANS]
    assert (reader.ended, reader.fault) == (True, None)


def test_a_file_cut_off_anywhere_gives_what_stands_before_the_cut(tmp_path: Path) -> None:
    whole = files.written(tmp_path / "a.mcap", SCANS).read_bytes()
    counts = []
    for size in range(len(MAGIC), len(whole) - 400, 37):
        reader = RecordingReader(io.BytesIO(whole[:size]))
        read = [each.data for each in reader.messages()]
        assert read == [data for _, _, data in SCANS[: len(read)]]
        assert reader.ended or (reader.fault or "").startswith("cut off")
        counts.append(len(read))
    assert counts == sorted(counts)
    assert (counts[0], counts[-1]) == (0, 100)


LIES = {
    "no magic": (b"not MCAP at all", "not an MCAP file"),
    "a record longer than allowed": (files.record(0x05, b"", RECORD_BYTES + 1), "exceeds"),
    "a record longer than the file": (files.record(0x05, b"abc", 10_000), "cut off"),
    "a message of an unknown channel": (files.message(7), "not declared"),
    "a message too short": (files.record(0x05, b"abc"), "a message of 3 bytes"),
    "a channel with an unknown schema": (files.channel(1, "k", schema=9), "not declared"),
    "a channel that becomes another": (files.channel(1, "k") + files.channel(1, "j"), "and then"),
    "a text longer than its record": (files.record(0x04, struct.pack("<HHI", 1, 0, 1000) + b"k"), "a field of 1000"),
    "a text of 4 GB": (files.record(0x04, struct.pack("<HHI", 1, 0, 2**32 - 1)), "exceeds"),
    "a topic that is no text": (files.record(0x04, struct.pack("<HHI", 1, 0, 2) + b"\xff\xff"), "UTF-8"),
    "a schema larger than allowed": (
        files.record(0x03, struct.pack("<H", 1) + files.text("s") * 2 + b"\xff" * 4),
        "exceeds",
    ),
    "a chunk of another size": (files.chunk(b"", size=5), "says that it has 5"),
    "a chunk of 4 EB": (files.chunk(b"", size=2**62), "exceeds"),
    "a chunk with another checksum": (files.chunk(files.channel(1, "k"), checksum=1), "checksum"),
    "a chunk of unknown compression": (files.chunk(b"", compression="rar"), "unknown"),
    "a chunk that is no zstd": (files.chunk(b"", size=9, compression="zstd", of=b"garbage"), "decompressed"),
    "a chunk that is no lz4": (files.chunk(b"", size=9, compression="lz4", of=b"garbage"), "decompressed"),
    "a record longer than its chunk": (files.chunk(files.record(0x05, b"", 999)), "a record of 999"),
    "a chunk that ends in a head": (files.chunk(b"\x05\x00"), "head"),
}


@pytest.mark.parametrize("name", LIES)
def test_a_lie_ends_the_file_and_says_what_is_wrong(name: str) -> None:
    lie, why = LIES[name]
    before = files.channel(3, "fleet/r1/pose") + files.message(3)
    data = lie if name == "no magic" else MAGIC + files.HEADER + before + lie + files.message(3)
    reader = RecordingReader(io.BytesIO(data))
    read = list(reader.messages())
    assert len(read) == (name != "no magic")
    assert why in (reader.fault or "")
    assert not reader.ended


def test_a_bomb_takes_no_more_memory_than_its_chunk_may_have() -> None:
    bomb = files.chunk(b"", size=2**20, compression="zstd", of=zstandard.compress(bytes(2**28)))
    tracemalloc.start()
    try:
        reader = RecordingReader(files.stream(bomb))
        assert list(reader.messages()) == []
        assert tracemalloc.get_traced_memory()[1] < 16 * 2**20
    finally:
        tracemalloc.stop()
    assert "says that it has" in (reader.fault or "")


def test_more_channels_than_are_kept_end_the_file_within_its_bounds() -> None:
    one = b"".join(files.channel(number, f"fleet/r1/sensor/{number}{'x' * 900}") for number in range(65_536))
    reader = RecordingReader(files.stream(one, files.channel(1, "other")))
    assert list(reader.messages()) == []
    assert "and then" in (reader.fault or "") or "more than" in (reader.fault or "")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    again = RecordingReader(files.stream(*[files.channel(1, "k")] * 100_000, files.END))
    assert list(again.messages()) == []
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB: the file itself is in memory


def test_random_bytes_never_raise(tmp_path: Path) -> None:
    rng = random.Random(1)
    whole = files.written(tmp_path / "a.mcap", SCANS[:20]).read_bytes()
    for _ in range(400):
        spoiled = bytearray(whole)
        for _ in range(rng.randrange(1, 6)):
            spoiled[rng.randrange(8, len(spoiled))] = rng.randrange(256)
        reader = RecordingReader(io.BytesIO(bytes(spoiled)))
        assert len(list(reader.messages())) <= 20
    for _ in range(200):
        list(RecordingReader(io.BytesIO(MAGIC + rng.randbytes(rng.randrange(300)))).messages())
