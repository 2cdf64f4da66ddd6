"""Recordings end to end: made of real robots, killed, replayed to old HQ programs, and to a gateway as the robot."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest

from gateways.mavlink.conformance.fragile_hq import FragileStation
from gateways.mavlink.conformance.machine import HOLD
from gateways.mavlink.conformance.vehicle_rules import VehicleTimes
from tests import captures
from tests.e2e.conftest import HOST, Bench, device, end, until
from tests.e2e.measured.hq_judge import Alf, Ec, Program, Tcp
from tests.e2e.rigs.fragile import ARMS
from tests.e2e.rigs.hq_scene import playing, pushed, soon
from tests.ports import free_port
from tests.views.recording import files
from zbridge.views.recording.reader import RecordingReader

STAMPS = ("stamp_ns", "device_ms")


def record(bench: Bench, path: Path, *options: str) -> Any:
    """Start a recording, and wait until it listens."""
    process = bench.zbridge("record", "-o", str(path), "--connect", bench.endpoint, *options)
    assert process.stdout is not None
    assert "recording fleet/" in process.stdout.readline()
    return process


def messages(path: Path) -> list[tuple[str, bytes]]:
    """Read a file that may be cut off."""
    with path.open("rb") as file:
        return [(message.channel.topic, message.data) for message in RecordingReader(file).messages()]


def test_a_robot_is_recorded_with_its_commands_refusals_marks_and_frames(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    process = record(bench, path, "r1", "--wire")
    gateway = bench.serve(bench.simulator())
    assert bench.zbridge("mark", "here", "--who", "me", "--connect", bench.endpoint).wait(timeout=30) == 0
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    bench.fleet.hold(who="op1")
    until(lambda: bench.fleet.last("r1/control").get("holder") == "op1", what="the holder")
    until(lambda: bench.fleet.refusal(code="no_lease"), what="refusal")
    before = until(lambda: bench.fleet.last("r1/pose"), what="pose")
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    until(
        lambda: bench.fleet.last("r1/pose")["x"] != before["x"], what="motion: the recorder has heard the command, too"
    )
    said = end(process)
    assert process.returncode == 0, said
    assert "nothing lost" in said
    gateway.end()
    read = files.read(path)
    keys = {topic for topic, *_ in read}
    assert keys >= {"fleet/r1/pose", "/r1/pose", "/r1/tf", "fleet/r1/status", "fleet/r1/@alive/gateway", "fleet/@mark"}
    assert {"fleet/r1/@wire/robot/in", "fleet/r1/@wire/robot/out"} <= keys
    sent = [msgpack.unpackb(data) for topic, _, _, data in read if topic == "fleet/r1/@cmd/drive/@sent"]
    assert [(each["holder"], bool(each["attachment"])) for each in sent] == [(None, False), ("op1", True)]
    controls = [msgpack.unpackb(data) for topic, _, _, data in read if topic == "fleet/r1/control"]
    assert any(refusal["code"] == "no_lease" for control in controls for refusal in control["refusals"])


def test_a_recorder_that_is_killed_leaves_a_file_that_is_readable_to_the_cut(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    bench.serve(bench.simulator())
    process = record(bench, path, "--all", "--only", "fleet")
    until(lambda: len(messages(path)) > 20, what="messages on the disk")
    end(process, signal.SIGKILL)
    kept = messages(path)
    assert len(kept) > 20
    with path.open("rb") as file:
        reader = RecordingReader(file)
        assert len(list(reader.messages())) == len(kept)
        assert not reader.ended
    said = bench.zbridge("info", str(path)).communicate(timeout=30)[0]
    assert "incomplete: cut off" in said
    assert "fleet/r1/pose" in said


# To old HQ programs


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """One robot of each protocol, recorded for as long as each needs to be seen."""
    folder = tmp_path_factory.mktemp("recording")
    with contextlib.ExitStack() as stack:
        bench = Bench(folder, stack)
        process = record(bench, folder / "all.mcap", "--all", "--only", "fleet")
        for robot, protocol, options in ROBOTS:
            bench.gateway(device(bench.simulator(protocol), protocol, options), robot=robot)
        for robot, _, _ in ROBOTS:
            until(lambda: bench.fleet.state(robot) == "established", what=f"{robot} established")  # noqa: B023
        # What this session has heard may not have reached the recorder yet.
        until(lambda: {key for key, _ in messages(folder / "all.mcap")} >= NEEDED, what="what each is known by")
        end(process)
        yield folder / "all.mcap"


_BEARINGS = ", ".join(f"ds{number} = {45.0 * number}" for number in range(8))
_TABLES = ", ".join(f"ds{number} = [[0.0, 0.0], [1000.0, 2.0]]" for number in range(8))
_SENSORS = {f"ds{number}" for number in range(8)}
WEBOTS = {*_SENSORS, "left wheel", "right wheel", "lift"}
ROVER = ("m1/pose", "m1/scan", "m1/battery")
_SHOWN = (
    *ROVER,
    "t1/map",
    "t1/pose",
    "a1/scan",
    "a1/motion",
    "w1/devices",
    *(f"w1/sensor/{name}" for name in _SENSORS),
)
NEEDED = {f"fleet/{path}" for path in _SHOWN}
ROBOTS = [
    ("m1", "mavlink", ARMS),
    ("t1", "tcpudp", ""),
    ("a1", "alf", ""),
    ("w1", "wc2ec", f"scan_range_m = [0.0, 2.0]\nbearings_deg = {{ {_BEARINGS} }}\ntables = {{ {_TABLES} }}\n"),
]


class GroundStation(Program):
    """QGroundControl, which looks on."""

    name, protocol, options = "qgc", "mavlink", "options = { system_id = 1 }"

    def __init__(self) -> None:
        self.judge = FragileStation("qgc", times=VehicleTimes(heartbeat_s=3.0))  # four processes start beside it

    def sees(self, robot: str) -> bool:
        """Attitude and position of a robot that has a pose, in HOLD; its heartbeat at least."""
        shown = {row[1] for row in self.judge.received}
        poses = {"ATTITUDE", "LOCAL_POSITION_NED"} if robot in ("mavlink", "tcpudp-1.3") else {"HEARTBEAT"}
        return poses <= shown and self.judge.mode == HOLD and not self.judge.armed


@pytest.mark.parametrize(("robot", "protocol"), [(robot, protocol) for robot, protocol, _ in ROBOTS])
async def test_old_programs_of_every_protocol_see_a_replay_as_the_robot_and_none_complains(
    bench: Bench, recording: Path, robot: str, protocol: str
) -> None:
    programs: list[Program] = [Tcp("1.3", udp=True), Alf("text"), Ec(), GroundStation()]
    ports = {program.name: free_port() for program in programs}
    tables = "".join(
        f'[[hq]]\nname = "{one.name}"\nprotocol = "{one.protocol}"\nlisten = "tcp://{HOST}:{ports[one.name]}"\n{one.options}\n'
        for one in programs
    )
    (bench.folder / "listeners.toml").write_text(tables)
    process = bench.zbridge(
        *("replay", str(recording), "--robot", f"{robot}=again", "--loop", "--connect", bench.endpoint),
        *("--hq", str(bench.folder / "listeners.toml")),
    )
    assert process.stdout is not None
    for _ in range(1 + len(programs)):
        process.stdout.readline()
    async with playing(*(program.judge.run(HOST, ports[program.name]) for program in programs)):
        await soon(lambda: all(program.ready for program in programs), "all connected")
        await soon(lambda: not [one.name for one in programs if not sees(one, protocol)], "all see the robot", 30.0)
        await pushed(programs[0], 0.5, lambda: bench.fleet.refusal("again", code="unsupported"), "the drive refused")
        for program in programs:
            await program.leave()
    assert bench.fleet.last("again/status")["protocol"] == "replay"
    assert [violation for program in programs for violation in program.judge.violations] == []
    assert all(program.judge.alive for program in programs)
    end(process)
    assert process.returncode == 0


def sees(program: Program, protocol: str) -> bool:
    """Tell whether a program was shown what the robot has: of its own protocol all of it."""
    if not isinstance(program, Ec):
        return program.sees({"tcpudp": "tcpudp-1.3"}.get(protocol, protocol))
    names = {name for _, name in program.judge.devices.values()}
    if protocol == "wc2ec":
        return names == WEBOTS and len(program.judge.values) == 8
    return {"left", "right"} <= names


# To a gateway, as the robot


def wired(name: str, path: Path, links: dict[str, tuple[str, int]]) -> Path:
    """Write captures as raw frames of robot r1: for each link a capture and the robot's port in it."""
    frames = []
    for link, (capture, port) in links.items():
        for each in captures.payloads(capture):
            direction = "in" if each.source == port else "out"
            kind = "#datagram" if each.transport == "UDP" else ""
            frames.append((f"fleet/r1/@wire/{link}/{direction}{kind}", each.seconds, each.payload))
    return files.written(path, sorted(frames, key=lambda frame: frame[1]))


CAPTURES: dict[str, tuple[str, dict[str, tuple[str, int]], str, set[str]]] = {
    "tcpudp 1.3 by UDP": ("tcpudp", {"robot": ("tcpudp-1.3-udp.hex", 11001)}, "", {"pose", "map", "text"}),
    "tcpudp 1.1": ("tcpudp", {"robot": ("tcpudp-1.1-tcp.hex", 11001)}, "", {"pose", "map"}),
    "alf by two links": (
        "alf",
        {"drive": ("alf-drive.hex", 16668), "laser": ("alf-laser.hex", 16667)},
        "",
        {"scan", "scanner"},
    ),
    "wc2ec": ("wc2ec", {"robot": ("wc2ec-deployed.hex", 27515)}, "", {"devices"}),
}


STATES = {"devices", "map", "scanner", "lidar", "camera"}


def shown(path: Path, robot: str) -> dict[str, list[dict[str, Any]]]:
    """What a robot published, by key, without what depends on the time; the frames too."""
    seen: dict[str, list[dict[str, Any]]] = {}
    for topic, data in messages(path):
        realm, _, rest = topic.partition(f"/{robot}/")
        if realm == "fleet" and not rest.startswith(("@", "status", "control", "motion")):
            fields = msgpack.unpackb(data)
            told = seen.setdefault(rest, [])
            fields = {name: fields[name] for name in fields if name not in STAMPS}
            if rest in STATES:  # a newer state replaces one that waits to be sent
                told.clear()
            if told[-1:] != [fields]:
                told.append(fields)
    return seen


@pytest.mark.long
@pytest.mark.parametrize("name", CAPTURES)
def test_replayed_frames_of_a_capture_give_the_messages_that_the_capture_gave(
    bench: Bench, tmp_path: Path, name: str
) -> None:
    protocol, links, options, expected = CAPTURES[name]
    first = wired(name, tmp_path / "capture.mcap", links)
    given = []
    replays = [("1", first)] + [("2", tmp_path / "r1.mcap")]
    for number, source in replays:
        robot, path = f"r{number}", tmp_path / f"r{number}.mcap"
        replay = bench.zbridge(
            *("replay", str(source), "--as-robot", protocol, "--speed", "4"),
            *(argument for _ in links for argument in ("--listen", f"tcp://{HOST}:0")),
            *(("--robot", "r1") if number == "2" else ()),
        )
        recorder = record(bench, path, robot, "--wire", "--only", "fleet")  # starts while the replay does
        assert replay.stdout is not None
        ports = [int(replay.stdout.readline().rpartition(":")[2]) for _ in links]
        gateway = bench.gateway(device(ports[0], protocol, options, *ports[1:]), robot=robot, bus='stream = "block"')
        said = replay.communicate(timeout=60)[0]
        assert replay.returncode == 0, said
        gateway.end()
        end(recorder)
        given.append(shown(path, robot))
    assert set(given[0]) >= expected, given[0].keys()
    assert given[0] == given[-1]
