"""The simulation in the normal tests: fixed and rotating seeds, kept scenarios, and that it notices what it must."""

from __future__ import annotations

import json
import struct
import time
from pathlib import Path

import msgpack
import pytest

from tests.simulated.accounts import Command, Grant, motions
from tests.simulated.engine import Host, Process, SimLoop, World
from tests.simulated.generate import PROFILES, scenario
from tests.simulated.mutants import ALL, ROOT, caught_by
from tests.simulated.mutants_data import MUTANTS
from tests.simulated.scenario import run
from tests.simulated.shrink import shrink

KEPT = sorted((Path(__file__).parent / "scenarios").glob("*.json"))
TODAY = int(time.time() // 86_400)
"""Each day other seeds: a failure names its seed, which shows it again on any day."""


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("seed", [1, 2, 10 * TODAY])
def test_no_rule_is_broken(seed: int, profile: str) -> None:
    assert run(scenario(seed, profile)).violations == []


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.stem)
def test_what_was_found_once_is_not_found_again(path: Path) -> None:
    assert run(json.loads(path.read_text())).violations == []


@pytest.mark.parametrize("profile", ["mixed", "ownership", "hq"])
def test_the_same_scenario_gives_the_same_trace(profile: str) -> None:
    first, again = (run(scenario(7, profile)) for _ in range(2))
    assert first.hash == again.hash
    assert first.hash != run(scenario(8, profile)).hash


@pytest.mark.parametrize("name", ["autonomous mode survives a stall", "ownership never yields (split brain)"])
def test_the_findings_that_began_it_are_found_again(name: str, tmp_path: Path) -> None:
    mutant = next(each for each in MUTANTS if each.name == name)
    assert caught_by(mutant, tmp_path, seconds=60.0, seed=20_000) is not None


def test_every_broken_variant_still_finds_what_it_breaks() -> None:
    found = {each.name: (ROOT / each.file).read_text().count(each.old) for each in ALL}
    assert {name: times for name, times in found.items() if times != 1} == {}


def test_a_failing_scenario_is_made_smaller(monkeypatch: pytest.MonkeyPatch) -> None:
    made = scenario(3, "link")
    culprit = {"t": 5.0, "who": "op1", "do": "drive", "for": 1.0, "deadman_s": 0.5}
    made["steps"] = [*made["steps"], culprit]
    monkeypatch.setattr("tests.simulated.shrink.run", lambda given: _Broken(culprit in given["steps"]))
    assert shrink(made, {"rule"})["steps"] == [culprit]


class _Broken:
    def __init__(self, broken: bool) -> None:
        self.rules = {"rule"} if broken else set()


# The parts


def test_a_paused_process_does_what_became_due_when_it_resumes() -> None:
    world = World(1)
    process = Process(Host(world, "h"), "p")
    loop, done = SimLoop(process), list[float]()
    loop.call_later(1.0, lambda: done.append(world.now))
    world.at(0.5, process.pause)
    world.at(3.0, process.resume)
    world.run_until(5.0)
    assert len(done) == 1
    assert 3.0 <= done[0] < 3.01


def test_a_dead_process_does_nothing_any_more() -> None:
    world = World(1)
    process = Process(Host(world, "h"), "p")
    loop, done = SimLoop(process), list[str]()
    loop.call_later(1.0, lambda: done.append("timer"))
    process.after(1.0, lambda: done.append("thread"))
    world.at(0.5, process.kill)
    world.run_until(5.0)
    assert done == []


@pytest.mark.parametrize(
    ("protocol", "data", "expected"),
    [
        ("tcpudp", "0e000000030b000000000000803f0000003f", [("motion", 0.5)]),
        ("tcpudp", "02000000030d", []),
        ("tcpudp", "06000000030a03000000", [("mode", 3.0)]),
        ("alf", b"3|50|0|0|0;".hex(), [("motion", 0.5)]),
        ("alf", b"3|0|0|0|0;".hex(), []),
        ("alf", "0332005a00", [("motion", 0.5)]),
        ("wc2ec", "823500" + "0000000000001440", [("motion", 0.5)]),
    ],
)
def test_the_checker_reads_the_frames_of_the_protocol_pages(
    protocol: str, data: str, expected: list[tuple[str, float]]
) -> None:
    assert motions(protocol, bytes.fromhex(data)) == expected


def test_the_checker_knows_that_neutral_calls_a_mode_off() -> None:
    grant = Grant("gw", "op", {"lease": b"12345678", "expires_in_s": 3.0}, {}, 0.0)
    modes = [_said("mode", {"mode": "autonomous"}, 1), _said("mode", {"mode": "autonomous"}, 4)]
    commands = [modes[0], _said("drive", {"forward": 0.0}, 0), _said("drive", {"forward": 0.0}, 3), modes[1]]
    for now, command in enumerate(commands):
        grant.received(command, float(now))
    assert [mode.called_off for mode in modes] == [2.0, None]


def _said(kind: str, fields: dict[str, object], number: int) -> Command:
    shown = {"lease": b"12345678", "seq": number}
    return Command(f"fleet/r1/@cmd/{kind}", msgpack.packb(fields), shown, "op", 0.0)


def test_the_checker_knows_that_motion_after_the_deadman_needs_a_neutral() -> None:
    grant = Grant("gw", "op", {"lease": b"12345678", "expires_in_s": 3.0}, {"deadman_s": 0.5}, 0.0)
    grant.deadman_s, grant.base_s = 0.5, 0.0

    def said(value: float, now: float) -> Command:
        payload = b"\x81\xa7forward\xcb" + struct.pack(">d", value)
        command = Command("fleet/r1/@cmd/drive", payload, {"lease": b"12345678"}, "op", now)
        command.received["gw"] = now
        grant.received(command, now)
        return command

    assert said(0.5, 1.0).forbidden is None
    assert said(0.5, 1.4).forbidden is None
    assert said(0.5, 2.5).forbidden == "neutral first"
    assert said(0.0, 2.6).forbidden is None
    assert said(0.5, 2.7).forbidden is None
