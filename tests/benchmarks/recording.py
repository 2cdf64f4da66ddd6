"""Recordings: what recording costs, how fast it can be, how large files are, and how exactly a replay keeps time.

python -m tests.benchmarks.recording [--seconds 10] [--runs 3]
"""

from __future__ import annotations

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median, quantiles

from mcap.writer import CompressionType, Writer

from tests.benchmarks.harness import ROOT, Process
from tests.benchmarks.recording_source import POSE_HZ, SCAN_HZ, scans
from tests.ports import free_port
from tests.views.recording import files
from zbridge.views.recording.player import Player
from zbridge.views.recording.reader import RecordingReader
from zbridge.views.recording.selection import Selection

ROBOTS = 30
PAIR_S, PAIRS = 1.0, 8
"""Seconds of a replay and of a bare loop, which take turns, and how often they do in a run."""
_TICKS = os.sysconf("SC_CLK_TCK")


def cpu_s(pid: int) -> float:
    """Seconds of processor time of a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


class Recorded:
    """One run of ``zbridge record`` beside a source."""

    def __init__(self, path: Path, robots: int, seconds: float, *options: str) -> None:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        source = Process("tests.benchmarks.recording_source", endpoint, robots, seconds)
        source.hear()
        command = [sys.executable, "-m", "zbridge", "record", "--all", "-o", str(path), "--connect", endpoint, *options]
        recorder = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        assert recorder.stderr is not None
        recorder.stderr.readline()
        time.sleep(0.5)
        before = cpu_s(recorder.pid)
        source.say("go")
        heard = source.hear(abs(seconds) + 60)
        time.sleep(0.5)
        self.seconds = heard["seconds"]
        self.cpu = (cpu_s(recorder.pid) - before) / self.seconds
        recorder.send_signal(signal.SIGTERM)
        self.said = recorder.stderr.read()
        recorder.wait()
        source.end()
        self.sent = int(heard["sent"])
        with path.open("rb") as file:
            topics = [message.channel.topic for message in RecordingReader(file).messages()]
        self.written = sum(topic.startswith("fleet/b") and "@" not in topic for topic in topics)
        self.counted = sum(map(int, re.findall(r"^lost, .*: (\d+)$", self.said, re.MULTILINE)))


def size_ratio(path: Path, folder: Path) -> float:
    """Compare a recording with what the library makes of the same messages."""
    with path.open("rb") as file, (folder / "plain.mcap").open("wb") as plain:
        writer = Writer(plain, compression=CompressionType.ZSTD)
        writer.start()
        channels: dict[str, int] = {}
        for message in RecordingReader(file).messages():
            topic = message.channel.topic
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "msgpack", 0)
            writer.add_message(channels[topic], message.log_ns, message.data, message.publish_ns, message.sequence)
        writer.finish()
    return path.stat().st_size / (folder / "plain.mcap").stat().st_size


def lateness(play: Callable[[Callable[[], None]], None], hz: float) -> tuple[float, float]:
    """Run something that calls back ``hz`` times a second; give median and 95 % of the lateness, microseconds."""
    moments: list[float] = []
    play(lambda: moments.append(time.monotonic()))
    late = [1e6 * (moment - moments[0] - number / hz) for number, moment in enumerate(moments)]
    earliest = min(late)
    ordered = [each - earliest for each in late]
    return median(ordered), quantiles(ordered, n=20)[-1]


def bare(seconds: float, hz: float) -> Callable[[Callable[[], None]], None]:
    """A loop that sleeps until each moment, and nothing else."""

    def play(put: Callable[[], None]) -> None:
        began = time.monotonic()
        for number in range(int(seconds * hz)):
            time.sleep(max(0.0, began + number / hz - time.monotonic()))
            put()

    return play


def replayed(path: Path) -> Callable[[Callable[[], None]], None]:
    """The player of a recording."""

    def play(put: Callable[[], None]) -> None:
        ended = threading.Event()
        Player(path, Selection(), lambda message, selected: put(), lambda fault: ended.set()).start()
        ended.wait()

    return play


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--runs", type=int, default=3)
    wanted = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for what, options in (("with pictures", ()), ("--only fleet", ("--only", "fleet"))):
            runs = [
                Recorded(folder / f"fleet{len(options)}{number}.mcap", ROBOTS, wanted.seconds, *options)
                for number in range(wanted.runs)
            ]
            cores = ", ".join(f"{100 * run.cpu:.1f}" for run in runs)
            lost = sum(run.sent - run.written for run in runs)
            print(f"{ROBOTS} robots, {SCAN_HZ} Hz scans, {POSE_HZ} Hz poses, {what}: {cores} % of a core, {lost} lost")
        ratio = size_ratio(folder / "fleet20.mcap", folder)
        print(f"file of --only fleet: {ratio:.3f} x the plain writer's with the same messages")
        runs = [
            Recorded(folder / f"one{number}.mcap", 1, -min(wanted.seconds, 4.0), "--only", "fleet")
            for number in range(wanted.runs)
        ]
        for run in runs:
            rate, lost = run.written / run.seconds, run.sent - run.written
            flow = f"{rate:.0f} of {run.sent / run.seconds:.0f} scans/s written"
            cpu = f"{100 * run.cpu:.0f} % of a core: {rate / run.cpu:.0f} scans per second of processor time"
            print(f"a saturated robot: {flow}, {lost} lost, {run.counted} counted, {cpu}")
        hz = 100.0
        payloads = scans(100)
        times = [number / hz for number in range(int(PAIR_S * hz))]
        messages = [("fleet/r1/scan", at, payloads[int(at * hz) % 100]) for at in times]
        path = files.written(folder / "paced.mcap", messages)
        pairs = [(lateness(bare(PAIR_S, hz), hz), lateness(replayed(path), hz)) for _ in range(PAIRS * wanted.runs)]
        for name, index in (("p50", 0), ("p95", 1)):
            ours, theirs = (median(pair[which][index] for pair in pairs) for which in (1, 0))
            print(f"lateness {name} at put: replay {ours:.0f} us, bare loop {theirs:.0f} us, {ours / theirs:.2f} x")


if __name__ == "__main__":
    main()
