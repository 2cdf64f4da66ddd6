"""A recording on the bus: seen as a robot that says what it is, and moved by nobody."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import msgpack
import pytest

from tests.fake_bus import FakeBus
from tests.machine import Patience
from tests.views.recording import files
from zbridge.errors import ConfigError, Held
from zbridge.fleet import topics
from zbridge.views.recording.replay import Replay, ReplayPlan, plan_listeners, plan_names, survey
from zbridge.views.recording.selection import Selection

MAP = files.packed(rows=1, columns=1, cell=0.1, origin=[0, 0], cells=b"\x01")
STATUS = files.packed(state="established", protocol="tcpudp", version="1.3", features=["lidar"], reason="low battery")
HELD = files.packed(state="held", holder="op1", lease=bytes(8), refusals=[])
TOLD = [
    ("fleet/r1/status", 0.0, STATUS),
    ("fleet/r1/map", 0.0, MAP),
    ("fleet/r1/control", 0.1, HELD),
    ("fleet/r1/pose", 0.2, files.packed(stamp_ns=files.BEGAN_NS + 150_000_000, x=1.0, y=2.0, heading=0.0)),
    ("fleet/r1/@cmd/drive", 0.2, files.packed(forward=1.0)),
    ("fleet/r1/@cmd/drive/@sent", 0.2, files.packed(lease=None)),
    ("/r1/pose", 0.2, b"\x80"),
    ("fleet/r2/pose", 0.2, files.packed(x=9.0, y=9.0, heading=0.0)),
    ("fleet/r1/pose", 600.0, b"\x80"),
]


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return files.written(tmp_path / "a.mcap", TOLD)


def test_a_survey_has_the_first_established_status_of_each_robot(recording: Path) -> None:
    seen = survey(recording)
    assert seen.robots == ("r1", "r2")
    assert {name: status.protocol for name, status in seen.statuses.items()} == {"r1": "tcpudp"}


class Stage:
    """A replay of r1 as ``again`` on a fake bus."""

    def __init__(self, path: Path, **plan: Any) -> None:
        self.bus = FakeBus()
        seen = survey(path)
        self.plan = ReplayPlan(path, "fleet", {"r1": "again"}, statuses=seen.statuses, **plan)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[Stage]:
        task = asyncio.ensure_future(Replay(self.bus.join("2"), self.plan).run())
        try:
            await self.soon(lambda: self.last("status"))
            yield self
        finally:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    async def soon(self, condition: Any) -> Any:
        patience = Patience(10.0)
        while not (value := condition()):
            assert not patience.over
            await asyncio.sleep(0.005)
        return value

    def last(self, path: str) -> dict[str, Any]:
        values = self.bus.values(f"fleet/again/{path}")
        return msgpack.unpackb(values[-1]) if values else {}


async def test_a_replay_shows_the_robot_under_its_new_name_and_says_that_it_is_a_recording(recording: Path) -> None:
    async with Stage(recording).running() as stage:
        await stage.soon(lambda: stage.last("pose"))
        status = stage.last("status")
        assert (status["protocol"], status["state"], status["features"]) == ("replay", "established", ["lidar"])
        assert status["reason"] == "a recording of r1; low battery"
        assert stage.bus.values("fleet/again/map") == [MAP]
        assert stage.bus.values("fleet/again/@cmd/**") == []
        assert stage.bus.values("fleet/r1/**") == stage.bus.values("fleet/r2/**") == []


async def test_stamps_keep_their_age(recording: Path) -> None:
    async with Stage(recording).running() as stage:
        pose = await stage.soon(lambda: stage.last("pose"))
        shown = await stage.soon(lambda: stage.last("control"))
        assert pose["x"] == 1.0
        assert pose["stamp_ns"] > files.BEGAN_NS + 10**16  # months later
        assert -5.0 < (shown["stamp_ns"] - pose["stamp_ns"]) / 1e9 < 5.0


async def test_the_recorded_holder_is_shown_without_the_lease(recording: Path) -> None:
    async with Stage(recording).running() as stage:
        control = await stage.soon(lambda: stage.last("control").get("holder") and stage.last("control"))
        assert (control["state"], control["holder"], control["lease"]) == ("held", "op1", None)


async def test_commands_and_leases_are_refused_and_shown(recording: Path) -> None:
    async with Stage(recording).running() as stage:
        await stage.soon(lambda: stage.last("pose"))
        for path, topic in (("@cmd/drive", topics.CMD_DRIVE), ("@cmd/stop", topics.CMD_STOP)):
            stage.bus.publisher(f"fleet/again/{path}", topic).put(b"\x80")
        for name in ("acquire/me", "takeover/me", "renew", "release"):
            (answer,) = await stage.bus.ask(f"fleet/again/@rpc/control/{name}")
            assert str(answer.error) == "a recording"
        refused = await stage.soon(
            lambda: len(stage.last("control")["refusals"]) == 6 and stage.last("control")["refusals"]
        )
        commands = {"drive", "stop", "acquire", "takeover", "renew", "release"}
        assert {refusal["command"] for refusal in refused} == commands
        assert {(refusal["code"], refusal["reason"]) for refusal in refused} == {("unsupported", "a recording")}


async def test_map_and_pose_can_be_asked_for(recording: Path) -> None:
    async with Stage(recording).running() as stage:
        await stage.soon(lambda: stage.last("pose"))
        (answer,) = await stage.bus.ask("fleet/again/@rpc/map")
        assert answer.payload == MAP
        (answer,) = await stage.bus.ask("fleet/again/@rpc/pose")
        assert msgpack.unpackb(answer.payload)["x"] == 1.0


async def test_a_part_begins_with_the_states_from_before_it(recording: Path) -> None:
    chosen = Selection(since_ns=files.BEGAN_NS + 150_000_000)
    async with Stage(recording, selection=chosen).running() as stage:
        await stage.soon(lambda: stage.last("pose"))
        assert stage.bus.values("fleet/again/map") == [MAP]


async def test_a_paused_replay_shows_the_robot_and_plays_when_it_is_told(recording: Path) -> None:
    stage = Stage(recording, paused=True)
    replay = Replay(stage.bus.join("2"), stage.plan)
    task = asyncio.ensure_future(replay.run())
    await stage.soon(lambda: len(stage.bus.values("fleet/again/status")) > 1)  # repeated after a second
    assert (replay.player.paused, replay.player.played, stage.last("map")) == (True, 0, {})
    replay.player.resume()
    await stage.soon(lambda: stage.last("map"))
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await task


async def test_a_name_that_is_alive_is_refused(recording: Path) -> None:
    stage = Stage(recording)
    stage.bus.announce("fleet/again/@alive/gateway")
    with pytest.raises(Held, match="again is alive"):
        async with asyncio.timeout(20):  # a replay that begins continues
            await Replay(stage.bus.join("2"), stage.plan).run()
    assert stage.bus.values("fleet/again/**") == []


async def test_a_gateway_that_claims_the_name_later_waits(recording: Path) -> None:
    async with Stage(recording).running() as stage:
        (answer,) = await stage.bus.ask("fleet/again/@rpc/claim/gateway")
        assert msgpack.unpackb(answer.payload)["held_s"] > 0


async def test_nothing_is_left_on_the_bus(recording: Path) -> None:
    async with Stage(recording).running() as stage:
        pass
    assert stage.bus.network.tokens == []
    assert await stage.bus.ask("fleet/again/*") == []


NAMES = [
    (["r1"], [], {"r1": "r1-replay"}),
    (["r1"], ["x"], {"r1": "x"}),
    (["r1", "r2"], [], {"r1": "r1-replay", "r2": "r2-replay"}),
    (["r1", "r2"], ["r2=x"], {"r2": "x"}),
]


@pytest.mark.parametrize(("robots", "wanted", "expected"), NAMES)
def test_each_robot_has_a_new_name(robots: list[str], wanted: list[str], expected: dict[str, str]) -> None:
    assert plan_names(robots, wanted) == expected


@pytest.mark.parametrize(
    ("wanted", "why"),
    [(["x"], "r1=x"), (["r3=x"], "has r1, r2"), (["r1=a/b"], "letters"), (["r1=x", "r2=x"], "its own")],
)
def test_a_name_that_cannot_be_is_refused(wanted: list[str], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        plan_names(["r1", "r2"], wanted)


def test_listeners_are_named_by_protocol_and_port(tmp_path: Path) -> None:
    (tmp_path / "hq.toml").write_text('[[hq]]\nprotocol = "alf"\nlisten = "tcp://127.0.0.1:3"\n')
    plans = plan_listeners(["tcpudp:11002", "wc2ec:0.0.0.0:2", str(tmp_path / "hq.toml")])
    assert [(plan.protocol.name, str(plan.address)) for plan in plans] == [
        ("tcpudp", "tcp://127.0.0.1:11002"),
        ("wc2ec", "tcp://0.0.0.0:2"),
        ("alf", "tcp://127.0.0.1:3"),
    ]
    for text in ("tcpudp", "tcpudp:x", "nobody:1"):
        with pytest.raises(ConfigError):
            plan_listeners([text])


def test_a_file_without_robots_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no robot"):
        survey(files.written(tmp_path / "a.mcap", [("/r1/pose", 0.0, b"")]))
