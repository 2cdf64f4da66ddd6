"""The black box with real processes: what is left of a gateway that was killed, hung, restarted, or had no disk."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgpack
import pytest

import zbridge.blackbox.segment_writer
from gateways.tcpudp.conformance.fragile_hq import FragileTcpUdpHq
from tests.e2e.conftest import HOST, WAIT_S, Bench, device, end, repeated, start, until
from tests.e2e.conftest import Gateway as Process
from tests.e2e.measured.restarts import Restarted
from tests.e2e.rigs.boxes import Box
from tests.e2e.rigs.fragile import charges
from tests.e2e.rigs.hq_scene import playing, soon
from tests.e2e.rigs.processes import ROOT
from tests.e2e.rigs.robots import MOVE, STOP, Robot, position
from tests.e2e.rigs.secure import SecureBus
from tests.e2e.rigs.supervised import Supervised
from tests.e2e.test_secure_gateway import ROLES, established, member, settings, tls
from tests.machine import Withheld
from tests.ports import free_port
from tests.scraped import scrape, value
from tests.views.recording import files
from zbridge.app import Gateway, load
from zbridge.blackbox import IncidentInfo
from zbridge.blackbox.box import CLOSE_S
from zbridge.cli.incidents import export_fetched, list_fleet, show_fetched
from zbridge.cli.recording import put_mark
from zbridge.errors import BusRefused

LOST_S = 2.0
"""At most so many seconds before a process was killed are not on the disk."""
DISORDER_NS = 100_000_000
"""Lines of the log come from all threads: a later one may stand before a message."""
FORWARD = 0.5


def boxed(folder: Path) -> str:
    """Write ``[blackbox]``."""
    return f'[blackbox]\ndir = "{folder}"\n'


def fault(bench: Bench, code: str, robot: str = "r1") -> dict[str, Any] | None:
    """Find an open fault on ``status``."""
    faults = bench.fleet.last(f"{robot}/status").get("faults", [])
    return next((each for each in faults if each["code"] == code), None)


@dataclass
class Drive:
    """Drives a scripted robot that reports where it is: each report has another number."""

    bench: Bench
    robot: Robot
    poses: int = 0
    drives: int = 0

    def step(self) -> None:
        with contextlib.suppress(OSError):  # its gateway was killed
            self.robot.send(position(float(self.poses + 1), 0.0, 0.0))
            self.poses += 1
        self.drives += 1
        self.bench.fleet.put("r1/@cmd/drive", forward=FORWARD)


# A process that is killed


def test_a_killed_gateway_leaves_all_but_the_last_seconds_and_the_next_one_keeps_them_as_one_incident(
    bench: Bench, robot: Robot
) -> None:
    folder = bench.folder / "box"
    box, drive = Box(folder), Drive(bench, robot)
    gateway = bench.serve(robot.port, boxed(folder))
    pid = gateway.process.pid
    bench.fleet.hold(who="op1")
    with repeated(drive.step):
        until(lambda: len(box.ring().of("@cmd/drive")) >= 10, what="drives on the disk")
        withheld_s, killed_ns = bench.withheld_s, time.time_ns()
        gateway.signal(signal.SIGKILL)
        gateway.process.wait()
    before, withheld_s = box.ring(), bench.withheld_s - withheld_s
    assert (killed_ns - before.records[-1].at_ns) / 1e9 < LOST_S + withheld_s
    sent = [frame.packet_id for frame in robot.frames]
    bench.serve(robot.port, boxed(folder))
    until(lambda: fault(bench, "gateway_died"), what="the fault")
    (info,) = until(lambda: box.incidents, what="the incident")
    until(lambda: len(box.kept(info).records) >= len(before.records), what="the segments of the ring")
    kept = box.kept(info)
    assert box.codes == [["gateway_died"]]
    assert f"process {pid} did not shut down cleanly" in info.causes[0].text
    assert kept.records[: len(before.records)] == before.records
    assert before.pids == {info.frame["pid"]} == {pid}
    assert kept.findings.damaged == kept.findings.lost == 0
    assert all(record.attachment for record in before.of("@cmd/drive"))
    out = [record.payload[5] for record in before.of("@wire/robot/out")]
    assert MOVE in out
    assert out == sent[: len(out)]
    numbers = [round(pose["x"] * 100) for pose in before.messages("pose")]
    assert len(before.of("@wire/robot/in")) >= len(set(numbers)) >= 10
    assert sorted(set(numbers)) == [*range(min(numbers), max(numbers) + 1)]
    assert before.messages("control")[-1]["holder"] == info.frame["control"]["holder"] == "op1"
    assert any("acquired op1" in line for line in before.lines), before.lines


class Host:
    """A supervisor of scripted robots with black boxes."""

    def __init__(self, bench: Bench, robots: tuple[str, ...]) -> None:
        self.bench, self.folder = bench, bench.folder / "robots"
        self.folder.mkdir()
        self.boxes = {name: Box(bench.folder / "box", name) for name in robots}
        for name in robots:
            robot = bench.stack.enter_context(contextlib.closing(Robot()))
            parts = f'[robot]\nname = "{name}"\n{device(robot.port)}'
            bus = f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n'
            (self.folder / f"{name}.toml").write_text(parts + bus)
        (self.folder / "host.toml").write_text(boxed(bench.folder / "box"))

    def run(self) -> Supervised:
        """Start the supervisor, and wait until every robot is established."""
        self.bench.fleet.seen.clear()
        supervisor = Supervised(self.bench.stack, self.folder)
        until(lambda: {self.bench.fleet.state(name) for name in self.boxes} == {"established"}, 30, "all robots")
        return supervisor

    @contextlib.contextmanager
    def driven(self) -> Iterator[None]:
        """Drive all robots until the block ends, which begins when drives of all are on the disk."""
        for name in self.boxes:
            self.bench.fleet.hold(name, "op1")

        def step() -> None:
            for name in self.boxes:
                self.bench.fleet.put(f"{name}/@cmd/drive", forward=FORWARD)

        with repeated(step):
            until(lambda: all(box.ring().of("@cmd/drive") for box in self.boxes.values()), what="drives on the disk")
            yield

    def incident(self, name: str, code: str) -> tuple[IncidentInfo, str]:
        """Wait for the one incident of a robot that has this cause; give it, and the text of the cause."""

        def found() -> list[tuple[IncidentInfo, str]]:
            infos = self.boxes[name].incidents
            assert len(infos) <= 1
            return [(info, cause.text) for info in infos for cause in info.causes if cause.code == code]

        return until(found, 20, f"{code} of {name}")[0]


@pytest.mark.pages
def test_a_supervisor_says_of_a_gateway_whether_it_hung_or_was_killed_and_the_whole_host_may_be_killed(
    bench: Bench,
) -> None:
    host = Host(bench, ("frozen", "killed", "untouched"))
    supervisor = host.run()
    pids = {name: supervisor.gateway(name) for name in host.boxes}
    with host.driven():
        os.kill(pids["frozen"], signal.SIGSTOP)
        os.kill(pids["killed"], signal.SIGKILL)
        info, text = host.incident("frozen", "gateway_hung")
        assert f"process {pids['frozen']} sent no heartbeat" in text
        assert info.frame["control"]["holder"] == "op1"
        until(lambda: host.boxes["frozen"].kept(info).of("@cmd/drive"), what="its drives")
        info, text = host.incident("killed", "gateway_died")
        assert text == f"process {pids['killed']} was killed by SIGKILL"
        assert info.frame["control"]["holder"] == "op1"
        until(lambda: fault(bench, "gateway_hung", "frozen"), what="the fault of the one that hung")
        until(lambda: fault(bench, "gateway_died", "killed"), what="the fault of the one that was killed")
        processes = [supervisor.process.pid, *descendants(supervisor.process.pid)]
        assert pids["untouched"] in processes
        for pid in processes:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        supervisor.process.wait()
    before = host.boxes["untouched"].ring()
    assert before.of("@cmd/drive")
    host.run()
    info, text = host.incident("untouched", "gateway_died")
    assert f"process {pids['untouched']} did not shut down cleanly" in text
    until(lambda: len(host.boxes["untouched"].kept(info).records) >= len(before.records), what="its segments")
    records = host.boxes["untouched"].kept(info).records
    assert records[: len(before.records)] == before.records
    assert info.frame["control"]["holder"] == "op1"
    for name, codes in (("frozen", ["gateway_hung", "gateway_died"]), ("killed", ["gateway_died", "gateway_died"])):
        host.incident(name, "gateway_died")
        until(lambda name=name, codes=codes: host.boxes[name].codes == [codes], what=f"both causes of {name}")  # type: ignore[misc]


def descendants(pid: int) -> list[int]:
    """List the processes below another one."""
    found = []
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            for child in map(int, (thread / "children").read_text().split()):
                found += [child, *descendants(child)]
    return found


# One incident, kept by two processes, and what is made of it


@dataclass
class Story:
    """What happened to a robot: a deadman, a latched stop, a mark and a restart, and where the incident is."""

    box: Box
    drive: Drive
    pids: list[int]
    faults: list[str] = field(default_factory=list)
    metrics: dict[str, float] = field(default_factory=dict)
    alive: list[list[str]] = field(default_factory=list)
    """The processes that wrote: before the restart, after it, and in the end."""
    said: str = ""
    """What the mark printed."""

    @property
    def info(self) -> IncidentInfo:
        (info,) = self.box.incidents
        return info


def only(processes: list[str]) -> list[str]:
    """Give what is one; else nothing."""
    return processes if len(processes) == 1 else []


@pytest.fixture(scope="module")
def story(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Story]:
    folder, port = tmp_path_factory.mktemp("story"), free_port()
    with contextlib.ExitStack() as stack:
        stack.enter_context(pytest.MonkeyPatch.context()).setenv("XDG_STATE_HOME", str(folder / "state"))
        bench, robot = Bench(folder, stack), stack.enter_context(contextlib.closing(Robot()))
        parts = (boxed(folder / "box"), f'[metrics]\nlisten = "{HOST}:{port}"\n')
        gateway = Restarted(bench, bench.serve(robot.port, *parts))
        story = Story(Box(folder / "box"), Drive(bench, robot), [gateway.pid])
        bench.fleet.hold(who="op1", deadman_s=0.3)
        for _ in range(10):
            story.drive.step()
            time.sleep(0.02)
        until(lambda: fault(bench, "deadman"), what="the deadman")
        bench.fleet.put("r1/@cmd/stop", latch=True, id=os.urandom(16), who="ann", reason="wet floor")
        until(lambda: fault(bench, "latched"), what="the latched stop")
        page = scrape(port)
        for code in ("deadman", "latched"):
            story.faults.append(fault(bench, code)["text"])  # type: ignore[index]
            for name in ("fault_open", "faults_total"):
                story.metrics[f"{name} {code}"] = value(page, f"zbridge_{name}", code=code)
        mark = start("mark", "a dent", "--keep", "--who", "ann", "--connect", bench.endpoint)
        story.said = mark.communicate(timeout=60)[0]
        until(lambda: story.box.incidents, what="the incident on the disk")
        story.alive.append(story.box.alive)
        assert gateway.ask() == [{}], gateway.gateway.log
        story.pids.append(gateway.pid)
        until(lambda: story.box.kept(story.info).pids == set(story.pids), what="segments of both processes")
        story.alive.append(until(lambda: only(story.box.alive), what="the leave of the first process"))
        story.drive.poses += 1
        robot.send(position(float(story.drive.poses), 0.0, 0.0))
        until(lambda: bench.fleet.last("r1/pose").get("x") == story.drive.poses / 100, what="the last pose")
        gateway.end()
        story.alive.append(story.box.alive)
        yield story


@pytest.mark.pages
def test_a_deadman_a_latched_stop_and_a_mark_within_a_minute_are_one_incident_over_a_restart(story: Story) -> None:
    assert story.box.codes == [["deadman", "latched", "mark"]]
    assert "op1" in story.faults[0]
    assert "wet floor" in story.faults[1]
    assert story.metrics == dict.fromkeys(story.metrics, 1.0)
    assert len(story.metrics) == 4
    assert "kept: r1" in story.said
    assert story.info.causes[2].text == "a dent (ann)"
    assert story.info.frame["control"]["holder"] == "op1"


@pytest.mark.pages
def test_a_restart_is_no_incident_and_no_process_of_it_counts_as_one_that_crashed(story: Story) -> None:
    former, successor = map(str, story.pids)
    assert story.alive == [[former], [successor], []]
    assert story.box.kept(story.info).pids == set(story.pids)
    assert len(story.box.incidents) == 1


@pytest.mark.pages
def test_a_cause_just_before_a_restart_is_continued_by_the_next_process_and_the_commands_show_and_delete_it(
    bench: Bench, robot: Robot
) -> None:
    box, here = Box(bench.folder / "box"), ("--dir", str(bench.folder / "box"))
    gateway = Restarted(bench, bench.serve(robot.port, boxed(bench.folder / "box")))
    until(lambda: box.ring().pids, what="the black box")
    assert bench.fleet.get("fleet/r1/@rpc/blackbox/keep/ann", text="a dent", kind="chat") == [{}]
    assert gateway.ask() == [{}]
    until(lambda: box.codes == [["mark"]] and only(box.alive), what="the incident, and the leave of the first process")
    gateway.end()
    (info,) = box.incidents
    assert box.alive == []
    assert info.name in printed("ls", *here)
    shown = printed("show", info.name, *here)
    assert "mark: a dent (ann)" in shown
    assert "messages in" in shown
    assert "damaged" not in shown
    assert "the disk was too slow" not in shown
    assert "deleted" in printed("rm", info.name, *here)
    assert "no incidents" in printed("ls", *here)


def printed(*arguments: str) -> str:
    """Give what ``zbridge blackbox`` prints."""
    process = start("blackbox", *arguments)
    said = process.communicate(timeout=60)[0]
    assert process.returncode == 0, said
    return said


@pytest.mark.pages
def test_an_export_has_every_message_once_as_the_library_reads_it(story: Story, tmp_path: Path) -> None:
    path = exported(story, tmp_path)
    read = files.read(path)
    assert len([topic for topic, *_ in read if topic == "fleet/r1/@cmd/drive"]) == story.drive.drives
    sent = [msgpack.unpackb(data) for topic, _, _, data in read if topic == "fleet/r1/@cmd/drive/@sent"]
    assert [each["holder"] for each in sent] == story.drive.drives * ["op1"]
    poses = [msgpack.unpackb(data) for topic, _, _, data in read if topic == "fleet/r1/pose"]
    numbers = [round(pose["x"] * 100) for pose in poses]
    assert sorted(set(numbers)) == [*range(1, story.drive.poses + 1)]
    stamps = [log_ns for _, log_ns, *_ in read]
    assert max(before - after for before, after in itertools.pairwise(stamps)) < DISORDER_NS
    marks = [msgpack.unpackb(data)["text"] for topic, _, _, data in read if topic == "fleet/@mark"]
    assert [mark.partition(":")[0] for mark in marks] == ["deadman", "latched", "mark"]
    topics = {topic for topic, *_ in read}
    assert topics >= {"fleet/r1/@wire/robot/in", "fleet/r1/@wire/robot/out", "fleet/r1/@log", "/r1/pose", "/r1/tf"}
    said = end(start("info", str(path)), 0, within_s=30.0)
    assert "complete" in said
    assert "incomplete" not in said


@pytest.mark.pages
async def test_an_old_hq_program_sees_a_replay_of_an_export_as_the_robot(
    bench: Bench, story: Story, tmp_path: Path
) -> None:
    path, port = exported(story, tmp_path), free_port()
    process = bench.zbridge("replay", str(path), "--loop", "--connect", bench.endpoint, "--hq", f"tcpudp:{HOST}:{port}")
    assert process.stdout is not None
    for _ in range(2):
        await asyncio.to_thread(process.stdout.readline)
    program = FragileTcpUdpHq()
    async with playing(program.run(HOST, port)):
        await soon(lambda: program.position and program.position[0] > 0, "a position", 30.0)
    assert charges(program.violations) == []
    end(process)
    assert process.returncode == 0


def exported(story: Story, folder: Path) -> Path:
    """Export the incident by the command."""
    path = folder / "incident.mcap"
    said = printed("export", story.info.name, "--dir", str(story.box.folder.path.parent), "-o", str(path))
    assert "damaged" not in said
    assert "lost" not in said
    return path


# A disk that fails


@pytest.mark.pages
def test_a_robot_is_driven_on_without_its_folder_the_loss_is_shown_and_counted_and_heals(
    bench: Bench, robot: Robot
) -> None:
    link, disk, port, drive = bench.folder / "box", bench.folder / "disk", free_port(), Drive(bench, robot)
    box = Box(disk)

    def driven_on() -> None:
        since, count = time.monotonic(), len(robot.frames)
        until(lambda: len(robot.packets(MOVE, since)) >= 5, what="the robot drives on")
        assert not [frame for frame in robot.frames[count:] if frame.packet_id == STOP]

    def lost() -> float:
        return value(scrape(port), "zbridge_blackbox_lost_total", reason="disk")

    link.symlink_to(disk)  # to nothing
    gateway = bench.serve(robot.port, boxed(link), f'[metrics]\nlisten = "{HOST}:{port}"\n')
    bench.fleet.hold(who="op1")
    with repeated(drive.step):
        until(lambda: robot.packets(MOVE), what="the robot drives")
        until(lambda: fault(bench, "black_box"), what="the fault at the start")
        driven_on()
        assert lost() > 0
        disk.mkdir()
        until(lambda: box.ring().of("@cmd/drive"), what="drives on the disk")
        until(lambda: "the black box is written again" in gateway.log, what="the disk takes it")
        counted = lost()
        assert counted == lost()
        disk.rename(bench.folder / "away")
        disk.write_text("a file in its place")
        # What is open can be written: only the next segment is none, which a cause begins.
        assert bench.fleet.get("fleet/r1/@rpc/blackbox/keep/ann", text="a dent", kind="chat") == [{}]
        until(lambda: "Not a directory" in (fault(bench, "black_box") or {"text": ""})["text"], what="the fault")
        until(lambda: lost() > counted, what="the loss is counted")
        driven_on()
        disk.unlink()
        (bench.folder / "away").rename(disk)
        until(lambda: box.codes == [["mark"]], what="the cause that waited")
        until(lambda: fault(bench, "black_box") is None, 20, "the fault heals")
        assert not bench.fleet.lost()
        counted = lost()
    assert gateway.end().count("the black box is written again") == 2
    (info,) = box.incidents
    kept = box.kept(info)
    assert kept.findings.damaged == 0
    assert 0 < kept.findings.lost <= counted


@pytest.mark.pages
def test_a_robot_is_driven_on_while_the_disk_is_full_and_what_was_written_can_be_read(
    bench: Bench, robot: Robot
) -> None:
    disk, port, drive, file = bench.folder / "disk", free_port(), Drive(bench, robot), bench.folder / "r1.toml"
    disk.mkdir()
    bus = f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n[metrics]\nlisten = "{HOST}:{port}"\n'
    file.write_text(f'[robot]\nname = "r1"\n{device(robot.port)}{boxed(disk)}{bus}')
    gateway, log = on_a_small_disk(bench, disk, "run", str(file))
    inside = Path(f"/proc/{gateway.pid}/root{disk}")
    box, filler = Box(inside), inside / "filler"

    def lost() -> float:
        return value(scrape(port), "zbridge_blackbox_lost_total", reason="disk")

    until(lambda: bench.fleet.state() == "established", what="established")
    bench.fleet.hold(who="op1")
    with repeated(drive.step):
        until(lambda: box.ring().of("@cmd/drive"), what="drives on the disk")
        with contextlib.suppress(OSError), filler.open("wb", buffering=0) as full:
            while full.write(bytes(4096)):
                pass
        until(lambda: lost() > 0, what="the loss is counted")
        until(lambda: "No space left" in (fault(bench, "black_box") or {"text": ""})["text"], what="the fault")
        since = time.monotonic()
        until(lambda: len(robot.packets(MOVE, since)) >= 5, what="the robot drives on")
        assert not bench.fleet.lost()
        filler.unlink()
        number = drive.poses
        until(lambda: any(pose["x"] * 100 > number for pose in box.ring().messages("pose")), what="the poses after it")
    assert box.ring().findings.damaged == 0
    end(gateway)
    assert gateway.returncode == 0
    assert "Traceback" not in log.read_text()


def on_a_small_disk(bench: Bench, disk: Path, *arguments: str) -> tuple[subprocess.Popen[str], Path]:
    """Start a command of zbridge with a small tmpfs at a folder, which others see below its root; and its log."""
    path = bench.folder / "small.log"
    mounted = f"mount -t tmpfs -o size=256k none {disk} && touch {disk}/mounted && exec {sys.executable} -m zbridge $@"
    command = ["unshare", "--map-root-user", "--mount", "sh", "-c", mounted, "sh", *arguments]
    with path.open("wb") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log, text=True, cwd=ROOT)
    bench.stack.callback(end, process, signal.SIGKILL)
    until(lambda: process.poll() is not None or Path(f"/proc/{process.pid}/root{disk}/mounted").exists())
    if process.poll() is not None:
        pytest.skip(f"no small disk here: {path.read_text().strip()}")
    return process, path


class BlockedWrites:
    """The module ``os``, but whose ``write`` blocks while ``free`` is not set."""

    def __init__(self) -> None:
        self.free = threading.Event()
        self.waiting = threading.Event()

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)

    def write(self, descriptor: int, data: bytes) -> int:
        self.waiting.set()
        self.free.wait()
        return os.write(descriptor, data)


async def test_a_disk_that_hangs_delays_neither_drives_nor_the_loop_and_the_end_by_a_second_only(
    bench: Bench, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk, withheld, file = BlockedWrites(), Withheld(), bench.folder / "r1.toml"
    bench.stack.callback(disk.free.set)
    monkeypatch.setattr(zbridge.blackbox.segment_writer, "os", disk)
    bus = f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n'
    file.write_text(f'[robot]\nname = "r1"\n{device(robot.port)}{bus}{boxed(bench.folder / "box")}')
    running = asyncio.create_task(Gateway(load(file)).run())
    await soon(lambda: bench.fleet.state() == "established", "established")
    await asyncio.to_thread(bench.fleet.hold)
    await soon(disk.waiting.is_set, "a write that hangs")
    late_s, before_s = 0.0, withheld.seconds()
    for number in range(1, 21):
        since, forward = time.monotonic(), number / 100
        await asyncio.to_thread(bench.fleet.put, "r1/@cmd/drive", forward=forward)
        while not (frames := robot.packets(MOVE, since)):
            asked = time.monotonic()
            await asyncio.sleep(0.005)
            late_s = max(late_s, time.monotonic() - asked)
            assert asked - since < WAIT_S
        late_s = max(late_s, frames[0].at - since)
    assert late_s < 0.3 + withheld.seconds() - before_s
    before_s, ending = withheld.seconds(), time.monotonic()
    running.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await running
    ended, patience_s = time.monotonic(), withheld.seconds() - before_s
    assert robot.packets(STOP, ending)[0].at - ending < 0.3 + patience_s
    assert ended - ending < CLOSE_S + 1.5 + patience_s
    disk.free.set()


# A secure bus


@pytest.mark.pages
async def test_a_viewer_lists_incidents_an_operator_keeps_them_and_a_supervisor_reads_them_on_a_secure_bus(
    bench: Bench, robot: Robot, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bus, box = SecureBus(tmp_path / "bus", ROLES), Box(bench.folder / "box")
    bench.stack.callback(bus.stop)
    parts = (device(robot.port), boxed(bench.folder / "box"), tls(bus, "g1"))
    gateway = Process(bench.stack, tmp_path / "r1.toml", bus.endpoint, *parts)
    async with member(bus, "v1") as viewer:
        await established(viewer)
    with pytest.raises(BusRefused, match=r"viewer\.v1 may not write a mark"):
        await put_mark(settings(bus, "v1"), "fleet", "a dent", None, keep=True)
    assert await put_mark(settings(bus, "op1"), "fleet", "a dent", None, keep=True)
    await soon(lambda: box.codes == [["mark"]], "the incident")
    assert "kept: r1" in capsys.readouterr().out
    (info,) = box.incidents
    await list_fleet(settings(bus, "v1"), "fleet", as_json=True)
    assert json.loads(capsys.readouterr().out)["name"] == info.name
    for name, role in (("v1", "viewer"), ("op1", "operator")):
        with pytest.raises(BusRefused, match=rf"{role}\.{name} may not read its incidents"):
            await export_fetched(settings(bus, name), "fleet", info.name, tmp_path / "refused.mcap", pictures=False)
    assert not (tmp_path / "refused.mcap").exists()
    await show_fetched(settings(bus, "sup1"), "fleet", info.name, as_json=True)
    assert json.loads(capsys.readouterr().out)["causes"][0]["text"] == "a dent (op1)"
    await export_fetched(settings(bus, "sup1"), "fleet", info.name, tmp_path / "a.mcap", pictures=False)
    fetched = [entry for entry in files.read(tmp_path / "a.mcap") if entry[0] == "fleet/r1/@wire/robot/out"]
    assert fetched
    (mark,) = [msgpack.unpackb(data) for topic, _, _, data in files.read(tmp_path / "a.mcap") if topic == "fleet/@mark"]
    assert mark["text"] == "mark: a dent (op1)"
    gateway.end()
