"""MAVSDK, unmodified, drives robots of other protocols through a real gateway; the robot itself tells how it moves."""

from __future__ import annotations

import contextlib
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.conftest import HOST, repeated, until
from tests.e2e.rigs.ground_stations import FASTEST_M_S, FULL_M_S, SYSTEM, GroundStationScene, Mavsdk, RawStation
from tests.e2e.rigs.loss import LATE_S
from tests.e2e.rigs.processes import Part, module
from tests.machine import contended_s
from tests.ports import free_port

for needed in ("mavsdk", "pymavlink"):
    pytest.importorskip(needed)
DEADMAN_S = 0.5
STEP_S = 0.02
"""The robot tells how it is once a step."""
AT_ONCE_S, SILENT_S = LATE_S + STEP_S, DEADMAN_S + LATE_S + STEP_S
CONNECTED_S = 2.0
RESTS_S = 0.4
"""Seconds for which a stick must rest once it counts: 0.3, and the time between two."""
TEMPORARILY_REJECTED, FAILED = 1, 4
ARM, SET_MODE, MANUAL = 400, 176, 0
YAW_DEG_S, YAW_RAD_S = 20.0, 0.349
TEXT_BYTES = 50
ORIGIN = "origin = { latitude = 47.0, longitude = 8.0 }"


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as opened:
        yield opened


@pytest.mark.parametrize(
    ("protocol", "link"),
    [("alf", "tcp"), ("mavlink", "udp"), ("ros2", "spoken"), ("tcpudp", "tcp"), ("wc2ec", "udp")],
)
def test_mavsdk_connects_sees_and_drives_a_robot(
    tmp_path: Path, stack: contextlib.ExitStack, protocol: str, link: str
) -> None:
    scene = GroundStationScene(tmp_path, stack, protocol, options=ORIGIN)
    contended = contended_s()
    half, program = FASTEST_M_S[protocol] / 2, scene.mavsdk(link)
    assert program.connected() < CONNECTED_S + contended_s() - contended
    until(lambda: program.last("healthy"), what="health is ok")
    assert len(program.do("params")["params"]) > 5
    program.offboard(FULL_M_S / 2)
    scene.drives(half, 0.0)
    assert program.last("armed") is True
    assert program.last("mode") == "OFFBOARD"
    program.do("setpoint", FULL_M_S / 2, -YAW_DEG_S)
    along = 1
    if protocol == "tcpudp":  # it moves or turns: the larger part counts, the other one is reported
        until(lambda: any("combine" in text for text in program.values("text")), what="what is left out")
        scene.drives(half, 0.0)
        along = 0
        program.do("setpoint", 0.0, -YAW_DEG_S)
    exact = protocol != "alf"  # a vehicle that steers turns as its wheels say
    scene.drives(along * half, YAW_RAD_S if exact else None)
    until(lambda: scene.robot.motion().turn > 0.1, what="it turns to the left")
    program.do("setpoint", -along * FULL_M_S / 2, YAW_DEG_S)
    scene.drives(-along * half, -YAW_RAD_S if exact else None)
    until(lambda: scene.robot.motion().turn < -0.1, what="it turns to the right")
    asked = time.monotonic()
    program.do("hold")
    scene.stops(asked, AT_ONCE_S)
    until(lambda: program.last("armed") is False and program.last("mode") == "HOLD", what="HOLD, disarmed")
    assert program.values("link") in ([], [True])


def test_mavsdk_sees_where_a_robot_is(tmp_path: Path, stack: contextlib.ExitStack) -> None:
    scene = GroundStationScene(tmp_path, stack, "ros2", options=ORIGIN)
    program = scene.mavsdk()
    program.connected()
    program.offboard(FULL_M_S, -YAW_DEG_S)
    until(lambda: scene.robot.moments[-1].truth.x > 0.3, what="it is away from the middle")
    program.do("hold")
    until(scene.robot.still, what="it stands still")

    def agrees() -> bool:
        truth, seen = scene.robot.moments[-1].truth, program.saw()
        local, yaw = seen["local"], seen["attitude"]["yaw_deg"]
        assert seen["position"]["count"] > 0
        near = abs(local["x"] - truth.y) < 0.05 and abs(local["y"] - truth.x) < 0.05
        return near and abs((90.0 - yaw) * 0.0174533 - truth.heading) < 0.05

    until(agrees, what="pose and telemetry agree")


@pytest.mark.parametrize(("link", "killed_s"), [("tcp", AT_ONCE_S), ("udp", SILENT_S)])
def test_a_robot_stops_when_mavsdk_is_told_to_or_is_lost(
    tmp_path: Path, stack: contextlib.ExitStack, link: str, killed_s: float
) -> None:
    scene = GroundStationScene(tmp_path, stack, "wc2ec")
    program, doomed = scene.mavsdk(link), scene.mavsdk(link)
    program.connected()
    for word in ("hold", "disarm"):
        _drive(scene, program)
        asked = time.monotonic()
        program.tell(word)
        scene.stops(asked, AT_ONCE_S)
        scene.free()
    _drive(scene, program)
    frozen = time.monotonic()
    program.part.signal(signal.SIGSTOP)
    scene.stops(frozen, SILENT_S)
    program.part.signal(signal.SIGCONT)  # it repeats its setpoint, which moves nothing until it is neutral
    thawed = time.monotonic()
    time.sleep(DEADMAN_S)
    assert scene.robot.still(thawed), "it moves on by itself"
    program.do("hold")
    scene.free()
    doomed.connected()
    _drive(scene, doomed)
    killed = time.monotonic()
    doomed.part.signal(signal.SIGKILL)
    scene.stops(killed, killed_s)


def _drive(scene: GroundStationScene, program: Mavsdk) -> None:
    scene.driven(program, FULL_M_S / 2)


def test_a_second_program_is_refused_by_name_and_may_stop_the_first(
    tmp_path: Path, stack: contextlib.ExitStack
) -> None:
    scene = GroundStationScene(tmp_path, stack, "wc2ec")
    programs = {"tcp": scene.mavsdk("tcp"), "udp": scene.mavsdk("udp")}
    for program in programs.values():
        program.connected()
    for first, second in (("tcp", "udp"), ("udp", "tcp")):
        driver, other = programs[first], programs[second]
        since = len(other.said)
        _drive(scene, driver)
        assert other.ask("arm")["result"] == "COMMAND_DENIED"
        other.do("setpoint", -FULL_M_S / 2, 0.0)
        assert other.ask("start")["result"] == "COMMAND_DENIED"
        _told(other, since, scene.control["holder"])
        assert scene.drives(FULL_M_S / 2)
        asked = time.monotonic()
        other.do("hold")
        scene.stops(asked, AT_ONCE_S)
        until(lambda driver=driver: driver.last("armed") is False, what="the driver is shown that it is disarmed")
        until(lambda driver=driver: driver.last("mode") == "HOLD", what="the driver is shown HOLD")
        scene.free()


def test_mavsdk_and_programs_of_other_protocols_take_turns(tmp_path: Path, stack: contextlib.ExitStack) -> None:
    port = free_port()
    old = f'[[hq]]\nname = "old"\nprotocol = "tcpudp"\nlisten = "tcp://{HOST}:{port}"\n'
    scene = GroundStationScene(tmp_path, stack, "wc2ec", old)
    program = scene.mavsdk()
    program.connected()
    fleet = scene.bench.fleet
    fleet.hold("r1", "desk", lease_s=10.0)
    until(lambda: scene.control["holder"] == "desk", what="the holder is shown")
    time.sleep(0.1)  # to the listener, too
    since = len(program.said)
    assert program.ask("arm")["result"] == "COMMAND_DENIED"
    _told(program, since, "desk")
    fleet.release("r1")
    scene.free()
    stick = Part(stack, *module("tests.e2e.rigs.hq_programs", "tcpudp", HOST, port))
    assert stick.line() == "ready"
    stick.say("push")
    until(lambda: not scene.robot.still(), what="the old program drives")
    time.sleep(0.1)
    since = len(program.said)
    assert program.ask("arm")["result"] == "COMMAND_DENIED"
    _told(program, since, "old")
    asked = time.monotonic()
    program.do("hold")
    scene.stops(asked, AT_ONCE_S)
    stick.kill()
    scene.free()
    _drive(scene, program)
    refused = Part(stack, *module("tests.e2e.rigs.hq_programs", "tcpudp", HOST, port))
    assert refused.line() == "ready"
    refused.say("push")
    until(lambda: scene.bench.fleet.refusal(code="held"), what="the old program is refused")
    assert scene.drives(FULL_M_S / 2)


def _told(program: Mavsdk, since: int, holder: str) -> None:
    """A refused program was told why, and who drives, in one chunk; it was never shown as armed."""
    until(
        lambda: any(holder in one.get("text", "") for one in program.said[since:]), what=f"a text that names {holder}"
    )
    said = program.said[since:]
    assert {one["refused"] for one in said if one.get("command") in (ARM, SET_MODE)} == {TEMPORARILY_REJECTED}
    assert all(len(one["text"].encode()) <= TEXT_BYTES for one in said if "text" in one)
    assert not any(one.get("armed") for one in said)


def test_what_a_rover_would_do_by_itself_is_refused_and_its_end_is_a_stop(
    tmp_path: Path, stack: contextlib.ExitStack
) -> None:
    scene = GroundStationScene(tmp_path, stack, "wc2ec", options=ORIGIN)
    program, began = scene.mavsdk(), time.monotonic()
    program.connected()
    program.do("arm")
    assert program.ask("home")["result"] == "COMMAND_DENIED"
    assert program.ask("goto", 47.001, 8.001, 0.0, 0.0)["result"] == "UNSUPPORTED"
    assert scene.robot.still(began)
    for word in ("kill", "terminate"):
        _drive(scene, program)
        asked = time.monotonic()
        program.do(word)
        scene.stops(asked, AT_ONCE_S)
        until(lambda: program.last("armed") is False, what="it is shown as disarmed")
        scene.free()


def test_of_two_robots_at_one_port_a_program_drives_its_own(tmp_path: Path, stack: contextlib.ExitStack) -> None:
    scene = GroundStationScene(tmp_path, stack, "wc2ec")
    other, began = scene.another(), time.monotonic()
    program = scene.mavsdk("spoken", SYSTEM + 1)
    program.connected()
    program.offboard(FULL_M_S / 2)
    until(lambda: other.moves(FULL_M_S / 2), what="the other robot moves")
    assert scene.robot.still(began), "both robots move"
    assert scene.control["holder"] is None
    asked = time.monotonic()
    program.do("hold")
    assert other.stopped(asked, AT_ONCE_S) < 1.0


def test_mavsdk_loses_a_robot_that_is_lost_and_does_not_drive_it_when_it_is_back(
    tmp_path: Path, stack: contextlib.ExitStack
) -> None:
    scene = GroundStationScene(tmp_path, stack, "wc2ec")
    program = scene.mavsdk()
    program.connected()
    _drive(scene, program)
    scene.robot.close()
    until(lambda: program.last("link") is False, what="MAVSDK takes the robot for lost")
    scene.robot.begin()
    back = time.monotonic()
    until(lambda: program.last("link") is True, what="MAVSDK is connected again")
    until(lambda: program.last("armed") is False, what="it is shown as disarmed")
    assert scene.robot.still(back)
    _drive(scene, program)


def test_a_stick_of_mavsdk_drives_ahead_and_steers(tmp_path: Path, stack: contextlib.ExitStack) -> None:
    scene = GroundStationScene(tmp_path, stack, "wc2ec")
    program = scene.mavsdk()
    program.connected()
    program.do("stick", 0.0, 0.0)
    program.do("manual")
    program.do("arm")
    time.sleep(RESTS_S)
    program.do("stick", 0.5, 0.3)
    scene.drives(FULL_M_S / 2, -0.3)
    asked = time.monotonic()
    program.do("release")
    scene.stops(asked, AT_ONCE_S + 0.05)


def test_a_stick_that_rests_at_half_throttle_moves_no_robot(tmp_path: Path, stack: contextlib.ExitStack) -> None:
    scene = GroundStationScene(tmp_path, stack, "wc2ec")
    station = RawStation(stack, scene.tcp)
    until(lambda: station.of("HEARTBEAT"), what="HEARTBEAT")
    assert station.command(SET_MODE, 1, MANUAL) == 0
    assert station.command(ARM, 1) == 0
    began = time.monotonic()
    with repeated(lambda: station.stick(500), 0.04):
        until(lambda: any("release the stick" in text.lower() for text in station.texts), what="it is told to release")
        until(lambda: time.monotonic() > began + 1.0)
        assert station.command(ARM, 1) == FAILED
    assert scene.robot.still(began)
    with repeated(lambda: station.stick(0), 0.04):
        until(lambda: time.monotonic() > began + 1.2)
        assert station.command(SET_MODE, 1, MANUAL) == 0
        assert station.command(ARM, 1) == 0
    with repeated(lambda: station.stick(-500), 0.04):
        scene.drives(-FULL_M_S / 2)
