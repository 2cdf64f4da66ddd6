"""The gateway before its judge: fifty mixed commands for each version, by TCP and by UDP."""

from __future__ import annotations

import time
from typing import Any

import pytest

from tests.e2e.conftest import Bench, until
from tests.e2e.fragile import charges, ended, fragile_robot
from tests.e2e.judge import VERSIONS, judge


@pytest.mark.parametrize("udp", [False, True], ids=["tcp", "udp"])
@pytest.mark.parametrize("version", VERSIONS)
def test_a_fragile_robot_survives_fifty_mixed_commands(version: str, udp: bool) -> None:
    judgement = judge(version, udp=udp, commands=50)
    assert judgement.alive
    assert judgement.violations == []
    assert judgement.missing == []
    assert judgement.answered["no pose"] == judgement.answered["no map"] == 0


def serve(bench: Bench, robot: Any) -> None:
    """Start the gateway of a fragile robot and take its lease."""
    bench.serve("r1", int(robot.stdout.readline()))
    bench.fleet.hold("r1")


@pytest.mark.parametrize(("version", "udp"), [("1.1", False), ("1.3", True)])
def test_a_poor_second_connection_is_named_and_not_driven(bench: Bench, version: str, udp: bool) -> None:
    """It loses half of all packets in both directions and sends no telemetry; its client id is 3."""
    fleet = bench.fleet
    with fragile_robot(f"tcpudp-{version}{'-udp' * udp}", client_id=2, again=True) as robot:
        serve(bench, robot)
        fleet.put("r1/@cmd/drive", forward=0.5)
        until(lambda: len(fleet.seen.get("fleet/r1/pose", [])) > 1, 20, what="telemetry")
        time.sleep(5.0)  # the time in which the gateway learns that this robot talks by itself
        assert fleet.last("r1/status")["reason"] is None
        robot.stdin.write("cut\n")
        robot.stdin.flush()
        until(lambda: fleet.state("r1") == "offline", what="the loss")
        until(lambda: (fleet.last("r1/status").get("reason") or "").startswith("client id 3"), what="the hint")
        until(lambda: "no telemetry" in (fleet.last("r1/status").get("reason") or ""), 20, what="the second sign")
        assert fleet.state("r1") == "established"
        fleet.put("r1/@cmd/drive")
        fleet.put("r1/@cmd/drive", forward=0.9)
        refusal = until(
            lambda: [each for each in fleet.last("r1/control")["refusals"] if "in doubt" in each["reason"]],
            what="the refusal",
        )[0]
        assert (refusal["command"], refusal["code"]) == ("drive", "not_ready")
        fleet.put("r1/@cmd/stop")
        time.sleep(1.5)
        report = ended(robot)
    assert not report["moving"], "of the stops enough arrived"
    assert report["alive"]
    assert [body for _, _, packet_id, body in report["received"] if packet_id == 11 and body.endswith("6666663f")] == []


@pytest.mark.parametrize("version", ["1.1", "1.2"])
def test_a_lidar_mode_that_a_robot_misread_arrives_all_the_same(bench: Bench, version: str) -> None:
    """The robot misreads a third of them, in an order of its own, but none of these twice running."""
    fleet = bench.fleet
    with fragile_robot(f"tcpudp-{version}", seed=20, misread=0.34, times={"unasked_s": 0}) as robot:
        serve(bench, robot)
        for number in range(8):
            on = number % 2 == 0
            fleet.put("r1/@cmd/lidar", on=on)
            until(lambda on=on: fleet.last("r1/lidar").get("on") is on, what=f"lidar {on}")
            time.sleep(0.4)
        report = ended(robot)
    misread = len([1 for _, _, packet_id, _ in report["misread"] if packet_id == 50])
    assert misread >= 6, "of the first 14; who repeats because the answer was late sends more"
    if misread + len([1 for _, _, packet_id, _ in report["received"] if packet_id == 50]) == 14:
        assert misread == 6
    assert charges(report["violations"]) == []


@pytest.mark.parametrize("mode", ["manual", "autonomous"])
@pytest.mark.parametrize("version", ["1.1", "1.4"])
def test_a_robot_that_moves_when_it_is_stopped_is_at_rest(bench: Bench, version: str, mode: str) -> None:
    """In mode 3 its own program drives, whatever 13 says."""
    fleet = bench.fleet
    with fragile_robot(f"tcpudp-{version}") as robot:
        serve(bench, robot)
        fleet.put("r1/@cmd/mode", mode=mode)
        if mode == "manual":
            fleet.put("r1/@cmd/drive", forward=0.5)
        time.sleep(0.5)
        fleet.put("r1/@cmd/stop")
        time.sleep(0.5)
        report = ended(robot)
    assert not report["moving"]
    modes = [body for _, _, packet_id, body in report["received"] if packet_id == 10]
    assert ("01000000" in modes) is (mode == "autonomous")
    assert charges(report["violations"]) == []
