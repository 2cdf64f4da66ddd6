"""The supervisor of several robots, whose runners are played: files, watchdogs, the status line, and systemd."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from zbridge.errors import ConfigError
from zbridge.host import supervisor as module
from zbridge.host.files import Changes, Follower, RobotFile
from zbridge.host.replacement import RunnerState, ServerState, SupervisorState
from zbridge.host.runners import LATE_S, READY_S, STATUS_S, Reports, Runners
from zbridge.host.supervisor import Supervisor
from zbridge.host.watchdog import DRIVEN_S, EXTENSION_S, IDLE_S, Watchdog

pytestmark = pytest.mark.jumping


def file(name: str, content: bytes = b"", **fields: Any) -> RobotFile:
    return RobotFile(Path(f"{name}.toml"), content, ("fleet", name), **fields)


class Process:
    """A gateway process whose watchdog the test has."""

    def __init__(self, now: float = 0.0) -> None:
        self.watchdog = Watchdog(now)
        self.over: asyncio.Future[int] = asyncio.get_running_loop().create_future()
        self.killed: list[str] = []
        self.heartbeats = False
        self.now = now

    def receive(self) -> None:
        """Take a beat that has arrived meanwhile."""
        if self.heartbeats:
            self.watchdog.heartbeat(self.now, driven=False)

    def reap(self) -> None:
        """It is alive."""

    def kill(self, why: str, *, hung: bool) -> None:
        assert hung
        self.killed.append(why)


class Runner:
    """Notes what it is told to do."""

    def __init__(self, robot: RobotFile, *_: object, **__: object) -> None:
        self.file = robot
        self.done: list[Any] = []
        self.state = "down"
        self.restarts = 0
        self.is_idle = True
        self.process: Process | None = None
        self.goes = asyncio.Event()
        self.goes.set()

    @property
    def processes(self) -> tuple[Process, ...]:
        return (self.process,) if self.process is not None else ()

    @property
    def snapshot(self) -> RunnerState:
        return RunnerState(str(self.file.path), self.file.content, self.file.identity)

    async def run(self) -> None:
        self.done.append("run")

    def restart(self, robot: RobotFile) -> None:
        self.done.append(robot)

    async def end(self) -> None:
        self.done.append("end")
        await self.goes.wait()


class Systemd:
    """Notes what it is told. hears: whether there is room for it."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.hears = True
        self.watchdog_s = 0.0

    def notify(self, *lines: str) -> bool:
        self.told += lines if self.hears else ()
        return self.hears


class ForkClient:
    stamp: bytes | None = b"one"
    refused = unsettled = False
    state = ServerState(7, 8, b"one")

    async def renew(self) -> None:
        """The installation is as it was."""


class Scene:
    """The runners of some files, and what systemd is told of them."""

    def __init__(self, *, stagger_s: float = 0.0) -> None:
        self.systemd = Systemd()
        self.runners = Runners(Runner, self._changed, stagger_s=stagger_s)  # type: ignore[arg-type]
        self.reports = Reports(self.systemd, self.runners)  # type: ignore[arg-type]

    def _changed(self) -> None:
        self.reports.changed()

    def runner(self, name: str) -> Any:
        return self.runners.by_path[Path(f"{name}.toml")]

    async def apply(self, *, first: bool = False, **changes: Any) -> None:
        await self.runners.apply(Changes(**changes), first=first)
        await asyncio.sleep(0)

    def poll(self, now: float) -> float:
        """Check the watchdogs at this time; give when they are checked next."""
        self.runners.check(now)
        return self.runners.check_at


@pytest.fixture
async def scene() -> AsyncIterator[Scene]:
    made = Scene()
    yield made
    made.reports.close()


class Supervised(Scene):
    """The same of a supervisor, at 100 s."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.systemd = Systemd()
        clock = SimpleNamespace(monotonic=lambda: 100.0, monotonic_ns=lambda: 100_000_000_000)
        monkeypatch.setattr(module, "time", clock)
        monkeypatch.setattr(module, "Runner", Runner)
        monkeypatch.setattr(module, "Systemd", lambda: self.systemd)
        forks: Any = ForkClient()
        self.supervisor = Supervisor(SupervisorState(()), forks)
        self.runners = self.supervisor.runners


# Files


async def test_robots_start_restart_and_end_with_their_files(scene: Scene) -> None:
    await scene.apply(came=(file("r1"), file("r2")))
    one, two = scene.runner("r1"), scene.runner("r2")
    assert one.done == two.done == ["run"]
    await scene.apply(changed=(file("r1", b"other"),), gone=(Path("r2.toml"),))
    assert one.done == ["run", file("r1", b"other")]
    assert two.done == ["run", "end"]
    assert list(scene.runners.by_path) == [Path("r1.toml")]


async def test_a_file_that_is_renamed_keeps_its_runner(scene: Scene) -> None:
    await scene.apply(came=(file("r1"),))
    before, renamed = scene.runner("r1"), file("other")
    await scene.apply(moved=((Path("r1.toml"), renamed),))
    assert scene.runner("other") is before
    assert (before.file, before.done) == (renamed, ["run"])
    assert len(scene.runners.by_path) == 1


async def test_faulty_files_are_counted_until_they_are_sound_or_gone(scene: Scene) -> None:
    await scene.apply(came=(file("r1"),))
    await scene.apply(faulty=(file("r1", fault="colour"), file("r2", fault="taste"), file("r3", fault="smell")))
    assert scene.runners.status == "1 robots, 1 down, 3 faulty files"
    assert scene.runner("r1").done == ["run"], "its robot continues as before"
    await scene.apply(changed=(file("r1"),), came=(file("r2"),))
    assert scene.runners.status == "2 robots, 2 down, 1 faulty files"


@pytest.mark.parametrize("stagger_s", [0.0, 10.0])
async def test_robots_start_one_after_the_other(stagger_s: float) -> None:
    scene, loop = Scene(stagger_s=stagger_s), asyncio.get_running_loop()
    began = loop.time()
    await scene.apply(came=(file("r1"),))
    assert loop.time() == began, "the first one at once"
    await scene.apply(came=(file("r2"), file("r3"), file("r4")))
    assert 2 * 0.5 * stagger_s <= loop.time() - began <= 2 * 1.5 * stagger_s
    scene.reports.close()


async def test_files_are_read_again_at_sighup_and_systemd_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Supervised(monkeypatch)
    looks: list[bool] = []

    def poll(_: Follower, running: dict[Path, RobotFile], *, twice: bool) -> Changes:
        looks.append(twice)
        if len(looks) > 1:
            raise ConfigError("two files name one robot")
        return Changes(came=(file("r1"),))

    async def inline(work: Any, *arguments: Any, **named: Any) -> Any:
        return work(*arguments, **named)

    monkeypatch.setattr(Follower, "poll", poll)
    monkeypatch.setattr(asyncio, "to_thread", inline)
    following = asyncio.ensure_future(scene.supervisor.follow())
    await asyncio.sleep(100.0)
    assert (looks, scene.systemd.told) == ([], []), "nobody asked"
    for count in (1, 2):
        scene.systemd.told.clear()
        scene.supervisor.reload()
        await asyncio.sleep(0.001)
        assert looks == [False] * count
        told = [each for each in scene.systemd.told if not each.startswith("STATUS")]
        assert told == ["RELOADING=1", "MONOTONIC_USEC=100000000", "READY=1"]
    assert list(scene.runners.by_path) == [Path("r1.toml")]
    following.cancel()
    await asyncio.wait([following])


# Watchdogs


async def test_a_process_that_is_silent_for_too_long_is_killed_and_the_next_deadline_awaited(scene: Scene) -> None:
    await scene.apply(came=(file("r1"), file("r2")))
    driven, idle = Process(), Process()
    scene.runner("r1").process, scene.runner("r2").process = driven, idle
    driven.watchdog.heartbeat(100.0, driven=True)
    idle.watchdog.heartbeat(100.0, driven=False)
    assert scene.poll(100.0) == pytest.approx(100.0 + DRIVEN_S)
    scene.poll(100.0 + DRIVEN_S)
    assert driven.killed == [f"sent no heartbeat for {DRIVEN_S} s"]
    driven.over.set_result(9)
    assert scene.poll(101.0) == 102.0, "once a second at least"
    assert idle.killed == []
    scene.runners.check_at = 100.0 + IDLE_S
    scene.poll(100.0 + IDLE_S)
    assert (len(driven.killed), len(idle.killed)) == (1, 1)


async def test_what_a_process_told_before_it_is_looked_at_counts(scene: Scene) -> None:
    await scene.apply(came=(file("r1"),))
    scene.runner("r1").process = process = Process()
    process.watchdog.heartbeat(100.0, driven=True)
    process.heartbeats, process.now = True, 100.0 + DRIVEN_S
    scene.runners.check_at = 100.0 + DRIVEN_S
    scene.poll(100.0 + DRIVEN_S)
    assert process.killed == []


@pytest.mark.parametrize(
    ("late_s", "killed"),
    [(LATE_S - 0.01, True), (LATE_S + 0.01, False), (EXTENSION_S - 0.01, False), (EXTENSION_S + 0.01, True)],
)
async def test_a_supervisor_that_was_held_up_itself_waits_a_little_longer(
    scene: Scene, late_s: float, killed: bool
) -> None:
    await scene.apply(came=(file("r1"),))
    scene.runner("r1").process = process = Process()
    process.watchdog.heartbeat(100.0, driven=True)
    scene.runners.check_at = 100.0 + DRIVEN_S
    scene.poll(100.0 + DRIVEN_S + late_s)
    assert bool(process.killed) is killed


async def test_a_process_of_a_robot_whose_file_is_gone_is_watched_until_it_has_ended(scene: Scene) -> None:
    await scene.apply(came=(file("r1"),))
    runner = scene.runner("r1")
    runner.process = process = Process()
    runner.goes.clear()
    await scene.apply(gone=(Path("r1.toml"),))
    process.watchdog.heartbeat(100.0, driven=True)
    scene.runners.check_at = 101.0
    scene.poll(101.0)
    assert process.killed
    runner.goes.set()
    await asyncio.sleep(0.001)
    assert scene.runners.processes == ()


# The status line, and systemd


async def test_the_status_counts_robots_by_state_restarts_and_faults(scene: Scene) -> None:
    assert scene.runners.status == "0 robots"
    await scene.apply(came=(file("r1"), file("r2"), file("r3")), faulty=(file("r4", fault="colour"),))
    scene.runner("r1").state = scene.runner("r2").state = "established"
    scene.runner("r1").restarts, scene.runner("r3").restarts = 2, 3
    assert scene.runners.status == "3 robots, 1 down, 2 established, 5 restarts, 1 faulty files"


async def test_the_service_is_ready_once_when_every_gateway_has_beaten(scene: Scene) -> None:
    await scene.apply(came=(file("r1"), file("r2")), first=True)
    for name in ("r1", "r2"):
        scene.reports.changed()
        await asyncio.sleep(READY_S + 0.01)
        assert "READY=1" not in scene.systemd.told
        scene.runner(name).process = Process()
        scene.runner(name).process.watchdog.heartbeat(0.0, driven=False)
    scene.systemd.hears = False
    scene.reports.changed()
    await asyncio.sleep(READY_S + 0.01)
    assert not scene.reports.is_ready, "systemd has not heard it"
    scene.systemd.hears = True
    await asyncio.sleep(READY_S + 0.01)
    assert scene.systemd.told.count("READY=1") == 1
    scene.reports.changed()
    scene.reports.changed()
    told = len(scene.systemd.told)
    await asyncio.sleep(READY_S + 0.01)
    assert len(scene.systemd.told) == told
    await asyncio.sleep(STATUS_S)
    assert scene.systemd.told[told:] == ["STATUS=2 robots, 2 down"], "one line, and no second word of being ready"


async def test_a_service_whose_robots_are_not_all_started_is_not_ready(scene: Scene) -> None:
    scene.reports.changed()
    await asyncio.sleep(READY_S + 0.01)
    assert scene.systemd.told == ["STATUS=0 robots"]


async def test_the_watchdog_of_systemd_is_fed_where_there_is_one(scene: Scene) -> None:
    await scene.reports.live()
    assert scene.systemd.told == []
    scene.systemd.watchdog_s = 15.0
    living = asyncio.ensure_future(scene.reports.live())
    await asyncio.sleep(31.0)
    assert scene.systemd.told == ["WATCHDOG=1"] * 3
    living.cancel()
    await asyncio.wait([living])


# Its own code


async def test_everything_is_kept_for_the_code_in_its_place_when_nothing_is_under_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = Supervised(monkeypatch)
    supervisor = scene.supervisor
    await scene.apply(came=(file("r1", b"one"), file("r3")))
    assert supervisor.snapshot() is None, "not all have started"
    faulty = (file("r2", fault="colour"), file("\udcff", fault="name"))
    scene.runner("r3").goes.clear()
    leaving = scene.runner("r3")
    await scene.apply(faulty=faulty, gone=(Path("r3.toml"),), first=True)
    assert supervisor.snapshot() is None, "one is still ending"
    leaving.goes.set()
    await asyncio.sleep(0.001)
    state = supervisor.snapshot()
    assert state is not None
    assert (state.at, state.server) == (100.0, ForkClient.state)
    assert [(each.path, each.content) for each in state.runners] == [("r1.toml", b"one")]
    assert state.faults == {"r2.toml": "colour"}, "a name that cannot be written is looked at anew"
    scene.runner("r1").is_idle = False
    assert supervisor.snapshot() is None
    scene.runner("r1").is_idle = True
    await scene.runners.end()
    assert supervisor.snapshot() is None
