"""One gateway process, end to end: scripted robot, real sockets, real Zenoh, and what fails around them."""

from __future__ import annotations

import contextlib
import json
import signal
import struct
import threading
import time
from pathlib import Path

import pytest

from tests.e2e.conftest import Bench, device, end, until
from tests.e2e.rigs.loss import router
from tests.e2e.rigs.robots import MOVE, SETTINGS, STOP, Robot
from tests.ports import free_port
from tests.scraped import scrape, totals

TEXT, MODE = 1, 10


def drive(bench: Bench, robot: Robot) -> None:
    """Take the lease and drive until the robot is told to move."""
    bench.fleet.hold()
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: robot.packets(MOVE), what="motion")


def test_rubbish_from_a_moving_robot_ends_its_session_only_and_the_next_one_begins_with_a_stop(bench, robot) -> None:
    gateway = bench.serve(robot.port)
    drive(bench, robot)
    robot.send(b"\xff" * 1000)
    until(lambda: any("broken stream" in (status["reason"] or "") for status in bench.fleet.seen["fleet/r1/status"]))
    until(lambda: robot.connections == 2 and bench.fleet.state() == "established", what="connected again")
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: bench.fleet.refusal(command="drive", code="neutral_first"), what="refusal")
    until(lambda: robot.packets(STOP, robot.ended[0]), what="a stop on the new connection")
    assert not robot.packets(MOVE, robot.ended[0])
    gateway.end()


def test_a_gateway_that_is_ended_leaves_a_robot_that_stands_whatever_its_driver_goes_on_to_say(bench, robot) -> None:
    gateway, over = bench.serve(robot.port), threading.Event()

    def go_on() -> None:
        while not over.wait(0.02):
            bench.fleet.put("r1/@cmd/drive")
            bench.fleet.put("r1/@cmd/drive", forward=0.5)

    drive(bench, robot)
    driver = threading.Thread(target=go_on)
    driver.start()
    gateway.signal(signal.SIGTERM)
    try:
        bench.ended_within(gateway.process, 2.0)
    finally:
        over.set()
        driver.join()
    until(lambda: robot.ended, what="the end of the connection")
    came = [frame.packet_id for frame in robot.frames]
    stops = [place for place, packet_id in enumerate(came) if packet_id == STOP]
    assert came[-1] == STOP
    assert MOVE not in came[stops[-5] :]
    until(lambda: (bench.fleet.state(), bench.fleet.reason()) == ("offline", "gateway stopped"), what="status")


@pytest.mark.parametrize("bus", ["not there yet", "standing still"])
def test_a_gateway_ends_in_time_whatever_its_bus_is_like(bench: Bench, robot: Robot, bus: str) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with contextlib.ExitStack() as stack:
        gateway = bench.gateway(device(robot.port), endpoint=endpoint)
        until(lambda: "no bus" in gateway.log, what="a word about the bus")
        if bus == "standing still":
            standing = router(stack, endpoint)
            until(lambda: robot.packets(STOP), what="the greeting stop")
            standing.signal(signal.SIGSTOP)
            time.sleep(1.5)
        gateway.signal(signal.SIGTERM)
        bench.ended_within(gateway.process, 3.0)


def test_a_second_gateway_leaves_the_robot_alone_when_the_router_dies_too_and_takes_over_a_dead_ones(
    bench: Bench, robot: Robot
) -> None:
    first = bench.serve(robot.port)
    second = bench.gateway(device(robot.port), name="second")
    until(lambda: "another gateway serves r1" in second.log, what="a word about the first")
    with bench.bus_away():
        time.sleep(3.0)
    until(lambda: bench.fleet.state() == "established", what="the first gateway on the bus again")
    time.sleep(1.5)
    assert robot.connections == 1
    end(first.process, signal.SIGKILL)
    until(lambda: robot.connections == 2, timeout_s=40.0, what="the second gateway's connection")
    until(lambda: bench.fleet.tokens() == ["fleet/r1/@alive/gateway"], what="the second gateway's token")
    until(lambda: bench.fleet.state() == "established", what="established")
    bench.fleet.session.close()


def test_limits_and_the_audit_log_are_as_configured(bench: Bench, robot: Robot) -> None:
    file = bench.folder / "audit" / "r1.jsonl"
    bench.serve(robot.port, f'[control]\nlease_s = 1.0\nrate_hz = 5\nslew_per_s = 1.0\naudit = "{file}"\n')
    bench.fleet.hold(who="hq")
    for _ in range(5):
        bench.fleet.put("r1/@cmd/drive", forward=1.0)
    until(lambda: bench.fleet.refusal(reason="more than 5 commands a second", who="hq", count=3), what="refusals")
    (speed,) = struct.unpack("<f", robot.packets(MOVE)[0].body[-4:])
    assert speed == pytest.approx(0.25, abs=0.02)
    bench.fleet.put("r1/@cmd/drive")
    bench.fleet.put("r1/@cmd/mode", mode="autonomous")
    mode = until(lambda: robot.packets(MODE), what="a mode in which the robot moves by itself")[0]
    assert bench.fleet.last("r1/control")["state"] == "held", "as long as it is renewed"
    bench.fleet.close()
    until(lambda: robot.packets(STOP, mode.at), what="the stop of a lease that ran out")
    until(lambda: '"ended"' in file.read_text(), what="the last line")
    events = [json.loads(line)["event"] for line in file.read_text().splitlines()]
    assert [event for event in events if event != "refused"] == ["acquired", "ended"]


def test_a_gateway_that_cannot_write_its_audit_log_says_so_once_serves_the_robot_and_ends(
    bench: Bench, robot: Robot, tmp_path: Path
) -> None:
    metrics, file = free_port(), tmp_path / "r1.jsonl"
    file.symlink_to("/dev/full")
    gateway = bench.serve(robot.port, f'[control]\naudit = "{file}"\n[metrics]\nlisten = "127.0.0.1:{metrics}"\n')
    for _ in range(3):
        bench.fleet.hold("r1", "driver", how="takeover")
    reason = "the audit log is not written: No space left on device"
    until(lambda: bench.fleet.reason() == reason, what="status that says so")
    assert bench.fleet.state() == "established"
    assert totals(scrape(metrics))["audit_write_failures"] >= 1
    gateway.signal(signal.SIGTERM)
    bench.ended_within(gateway.process, 4.0)
    log = gateway.end()
    assert log.count("ERROR") == 1
    assert f"{reason} ({file})" in log


def test_a_robot_whose_datagrams_never_come_is_used_by_tcp(bench: Bench) -> None:
    """The robot offers UDP and starts it, and answers nothing: the gateway gives up after its two seconds."""
    with_udp = SETTINGS.replace(b"1.3\x00", b"1.3\x01")
    robot = Robot(with_udp + bytes.fromhex("020000000104"))
    try:
        bench.serve(robot.port)
        until(lambda: len(robot.frames) > 1, what="3 and 7")
        drive(bench, robot)
        assert (robot.frames[1].packet_id, robot.frames[1].body) == (7, b"\x00")
    finally:
        robot.close()
