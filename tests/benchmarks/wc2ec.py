"""The benchmark of WC2EC: 54 sensors at 50 Hz, and as many readings as go through, against a bare loop of puts.

    python -m tests.benchmarks.wc2ec [--quick]

Like :mod:`tests.benchmarks.gateway`: a real gateway process, real sockets, real Zenoh, paired runs, the consumer in a
process of its own. ``--be robot COUNT RATE_HZ``, ``bare ENDPOINT COUNT`` and ``consumer ENDPOINT`` are its other
processes; a count is of steps of all 54 sensors.
"""

from __future__ import annotations

import argparse
import contextlib
import socket
import struct
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import zenoh

from tests.benchmarks.flow import QUIET_S, RUN_S, SETTLE_S
from tests.benchmarks.harness import Process, Spread, cpu_s, pairs, process
from tests.benchmarks.peer import ROBOT, Sink, drive, open_session, tell
from tests.ports import free_port
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Reading

SENSORS = 54
STEP_HZ = 50.0
MODULE = "tests.benchmarks.wc2ec"
_JOINED = 8
"""Steps in one write of a saturated run."""
_TYPE = 37


def main() -> None:
    """Measure, or be one of the processes."""
    if sys.argv[1:2] == ["--be"]:
        {"robot": robot, "bare": bare, "consumer": consumer}[sys.argv[2]](*sys.argv[3:])
        return
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    quick = parser.parse_args().quick
    share = Spread.of([steady(6.0 if quick else 20.0) for _ in range(1 if quick else 3)])
    steps = 1500 if quick else 4000
    runs = pairs(2 if quick else 5, lambda: saturated(steps, through=True), lambda: saturated(8 * steps, through=False))
    ratio = Spread.of([through / bare for through, bare in runs])
    print(f"readings/s through the gateway {Spread.of([through for through, _ in runs])}")
    print(f"readings/s of the bare loop    {Spread.of([bare for _, bare in runs])}")
    _line("54 sensors at 50 Hz: share of a core, %", share, 10.0, ok=share.middle <= 10.0)
    _line("readings: rate / the bare loop's", ratio, 0.2, ok=ratio.middle >= 0.2)


def _line(name: str, reached: Spread, target: float, *, ok: bool) -> None:
    print(f"{name:<42} {reached!s:>24}   target {target:g}   {'ok' if ok else 'short'}")


# Runs


@contextlib.contextmanager
def _stage(count: int, rate_hz: float, *, through: bool) -> Iterator[tuple[Process, Process, Process]]:
    """Start source, process under test and consumer; give them when readings flow and the source holds."""
    with contextlib.ExitStack() as stack:
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        sink = stack.enter_context(process(MODULE, "--be", "consumer", endpoint))
        sink.hear()
        if through:
            source = stack.enter_context(process(MODULE, "--be", "robot", count, rate_hz))
            file = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "gateway.toml"
            file.write_text(_configuration(source.hear()["port"], endpoint))
            tested = stack.enter_context(process("zbridge", "run", file))
        else:
            source = tested = stack.enter_context(process(MODULE, "--be", "bare", endpoint, count))
        sink.hear()
        source.say("hold")
        source.hear()
        time.sleep(SETTLE_S)
        sink.say("reset")
        sink.hear()
        yield source, tested, sink


def saturated(steps: int, *, through: bool) -> float:
    """Send as fast as it is taken; give readings per second. Raises RuntimeError where one was lost."""
    with _stage(steps, 0.0, through=through) as (source, _, sink):
        sink.say(f"await {steps * SENSORS} {QUIET_S} {RUN_S}")
        source.say("go")
        begun_ns = source.hear(RUN_S)["begun_ns"]
        got = sink.hear(RUN_S + QUIET_S)
        if got["count"] != steps * SENSORS:
            raise RuntimeError(f"{got['count']} of {steps * SENSORS} readings arrived")
        return float(steps * SENSORS / ((got["last_ns"] - begun_ns) / 1e9))


def steady(seconds: float) -> float:
    """Let one robot send all its sensors at 50 Hz; give the gateway's share of a core in percent."""
    with _stage(round(STEP_HZ * seconds), STEP_HZ, through=True) as (source, tested, _):
        begun_s, cpu = time.monotonic(), cpu_s(tested.pid)
        source.say("go")
        source.hear(seconds + RUN_S)
        return (cpu_s(tested.pid) - cpu) / (time.monotonic() - begun_s) * 100


def _configuration(port: int, endpoint: str) -> str:
    return f"""
[robot]
name = "{ROBOT}"
[device]
protocol = "wc2ec"
connect = ["tcp://127.0.0.1:{port}"]
[bus]
mode = "peer"
listen = ["{endpoint}"]
multicast = false
stream = "block"
"""


# The other processes


def robot(count: str, rate_hz: str) -> None:
    """Register 54 distance sensors and send all their readings, as told."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(RUN_S)
        tell(port=server.getsockname()[1])
        link, _ = server.accept()
    with link:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        names = [b"sensor %d" % number for number in range(SENSORS)]
        link.sendall(b"".join(bytes((0, _TYPE, n, len(name))) + name for n, name in enumerate(names)))
        step = b"".join(struct.pack("<BBBd", 1, _TYPE, number, 123.456 + number) for number in range(SENSORS))

        def flood() -> None:
            for low in range(0, int(count), _JOINED):
                link.sendall(step * min(_JOINED, int(count) - low))

        drive(int(count), float(rate_hz), lambda _: link.sendall(step), flood)
        sys.stdin.readline()


def bare(endpoint: str, count: str) -> None:
    """Put the payloads the gateway publishes, and nothing else."""
    now_ns = time.time_ns()
    with open_session(listen=endpoint) as session:
        puts = []
        for number in range(SENSORS):
            key = f"fleet/{ROBOT}/sensor/sensor%20{number}"
            publisher = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
            reading = Reading(123.456 + number, "distance", number, stamp_ns=now_ns)
            puts.append((publisher.put, payloads.encode(reading)))

        def step() -> None:
            for put, payload in puts:
                put(payload)

        def flood() -> None:
            for _ in range(int(count)):
                step()

        drive(int(count), 0.0, lambda _: step(), flood)
        sys.stdin.readline()


def consumer(endpoint: str) -> None:
    """Count readings."""
    sink = Sink(keep=False, read_sequences=lambda _: [])
    with open_session(connect=endpoint) as session:
        session.declare_subscriber(f"fleet/{ROBOT}/sensor/*", sink.take)
        tell(ready=True)
        sink.obey()


if __name__ == "__main__":
    main()
