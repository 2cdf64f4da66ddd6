"""The gateway before its judges: robots that forgive nothing, of every version and dialect."""

from __future__ import annotations

import contextlib
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import zbridge
from tests.e2e.conftest import Bench, Fleet, device, end, until
from tests.e2e.measured.hq_judge import commanded
from tests.e2e.measured.judge import VERSIONS, judge
from tests.e2e.measured.wc2ec_judge import judge as wc2ec_judge
from tests.e2e.rigs.fragile import DISTURBED, Fragile, charges, disturbed, fragile_robot


@pytest.mark.parametrize("udp", [False, True], ids=["tcp", "udp"])
@pytest.mark.parametrize("version", VERSIONS)
def test_a_fragile_robot_survives_fifty_mixed_commands(version: str, udp: bool) -> None:
    judgement = judge(version, udp=udp, commands=50)
    assert judgement.clean, [judgement, *judgement.faults]


@pytest.mark.parametrize("dialect", ["deployed", "draft"])
def test_a_fragile_controller_survives_a_hundred_mixed_commands(dialect: str) -> None:
    judgement = wc2ec_judge(dialect, commands=100)
    assert judgement.clean, [judgement, *judgement.faults]


@pytest.mark.parametrize("dialect", ["text", "binary"])
def test_a_fragile_vehicle_with_two_links_finds_nothing_to_complain_of(bench: Bench, dialect: str) -> None:
    any_port = ("--listen", "tcp://127.0.0.1:0")
    vehicle = bench.zbridge("simulate", "alf", "--fragile", "--dialect", dialect, *any_port, *any_port)
    assert vehicle.stdout is not None
    ports = [int(word.split(":")[2]) for word in vehicle.stdout.readline().split() if word.startswith("tcp://")]
    gateway = bench.gateway(device(ports[0], "alf", f'dialect = "{dialect}"', ports[1]))
    until(lambda: bench.fleet.state() == "established", what="established")
    withheld_s = bench.withheld_s
    with zbridge.blocking.connect(bench.endpoint) as fleet, fleet["r1"].control() as drive:
        for number in range(60):
            drive(forward=(number % 21 - 10) / 10, turn=(number % 13 - 6) / 6, light=bool(number % 2))
            time.sleep(0.02)
    late_s = bench.withheld_s - withheld_s
    gateway.end()
    said = end(vehicle)
    assert len(bench.fleet.seen["fleet/r1/scan"]) > 5
    assert charges([line for line in said.splitlines() if "violation" in line], late_s) == [], said
    assert "died" not in said, said


def played(story: Callable[[Fleet, Fragile], None], name: str, **options: Any) -> None:
    """Play a story with a fragile robot and its gateway; again where the robot's own lateness spoilt the handshake."""
    for _ in range(DISTURBED):
        with contextlib.ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
            bench = Bench(Path(folder), stack)
            robot = stack.enter_context(fragile_robot(name, **options))
            bench.gateway(device(robot.port, robot.kind.protocol, robot.kind.options))
            try:
                until(lambda bench=bench: bench.fleet.state() == "established", what="established")  # type: ignore[misc]
                story(bench.fleet, robot)
            except AssertionError as error:
                if not disturbed(robot.ended()):
                    raise AssertionError(f"{error}; the robot says {robot.ended()['events']}") from error
            else:
                return
    raise AssertionError(f"{name} was disturbed {DISTURBED} times")


@pytest.mark.parametrize("name", ["tcpudp-1.3", "alf", "wc2ec"])
def test_nobody_moves_a_robot_without_a_lease(name: str) -> None:
    def story(fleet: Fleet, robot: Fragile) -> None:
        fleet.put("r1/@cmd/drive", forward=0.5)
        fleet.put("r1/@cmd/mode", mode="autonomous")
        fleet.put("r1/@cmd/motor/lift", value=1.0)
        for command in ("drive", "mode", "motor/lift"):
            until(lambda command=command: fleet.refusal(command=command, code="no_lease"), what=command)  # type: ignore[misc]
        report = robot.ended()
        assert {commanded(name, row) for row in report["received"]} <= {None, (0.0, 0.0)}
        assert not report["moving"]

    played(story, name)


@pytest.mark.long
@pytest.mark.parametrize(("version", "udp"), [("1.1", False), ("1.3", True)])
def test_a_poor_second_connection_is_named_and_not_driven(version: str, udp: bool) -> None:
    """It loses half of all packets in both directions and sends no telemetry; its client id is 3."""

    def story(fleet: Fleet, robot: Fragile) -> None:
        fleet.hold()
        fleet.put("r1/@cmd/drive", forward=0.5)
        until(lambda: len(fleet.seen.get("fleet/r1/pose", [])) > 1, 20, what="telemetry")
        time.sleep(5.0)  # the time in which the gateway learns that this robot talks by itself
        assert fleet.reason() == ""
        robot.say("cut")
        until(lambda: fleet.state() == "offline", what="the loss")
        until(lambda: "no telemetry" in fleet.reason(), 20, what="the second sign")
        assert fleet.reason().startswith("client id 3"), "the first sign"
        assert fleet.state() == "established"
        fleet.put("r1/@cmd/drive")
        fleet.put("r1/@cmd/drive", forward=0.9)
        refusal = until(lambda: fleet.refusal(command="drive", code="not_ready"), what="the refusal")
        assert "in doubt" in refusal["reason"]
        fleet.put("r1/@cmd/stop")
        time.sleep(1.5)
        report = robot.ended()
        assert not report["moving"], "of the stops enough arrived"
        assert report["alive"]
        assert not [1 for _, _, packet_id, body in report["received"] if packet_id == 11 and body.endswith("6666663f")]

    played(story, f"tcpudp-{version}{'-udp' * udp}", client_id=2, again=True)


def test_a_robot_that_its_own_program_drives_is_at_rest_when_it_is_stopped() -> None:
    """In mode 3 it drives whatever 13 says: first it must be told another mode."""

    def story(fleet: Fleet, robot: Fragile) -> None:
        fleet.hold()
        fleet.put("r1/@cmd/mode", mode="autonomous")
        time.sleep(0.5)
        fleet.put("r1/@cmd/stop")
        time.sleep(0.5)
        report = robot.ended()
        assert not report["moving"]
        assert (10, "01000000") in [(packet_id, body) for _, _, packet_id, body in report["received"]]
        assert charges(report["violations"]) == []

    played(story, "tcpudp-1.4")


@pytest.mark.parametrize("name", ["tcpudp-1.3", "tcpudp-1.2"])
def test_a_robot_that_stalls_while_its_mode_is_changed_does_not_drive_itself_afterwards(name: str) -> None:
    """It drops what piled up, the other mode included; only the mode in the idle stops ends its mode 3."""

    def story(fleet: Fleet, robot: Fragile) -> None:
        fleet.hold()
        fleet.put("r1/@cmd/mode", mode="autonomous")
        time.sleep(0.5)
        robot.signal(signal.SIGSTOP)
        time.sleep(0.5)
        fleet.put("r1/@cmd/mode", mode="manual")
        time.sleep(0.4)  # to robots of 1.2 it is sent again meanwhile
        fleet.release()
        time.sleep(1.6)
        robot.signal(signal.SIGCONT)
        time.sleep(1.5 + 1.0)  # two packets of a pair and the one that 1.2 ignores
        report = robot.ended()
        assert not report["moving"], report["received"][-4:]
        assert (10, "03000000") in [(packet_id, body) for _, _, packet_id, body in report["received"]]
        assert report["piled"], "nothing was lost: the robot did not stall"
        assert charges(report["violations"]) == []

    played(story, name)


def test_a_sensor_of_the_document_measures_only_while_somebody_listens(bench: Bench) -> None:
    session, heard = bench.fleet.session, list[object]()
    bench.fleet.subscriber.undeclare()
    with fragile_robot("wc2ec-draft", values=3) as robot:
        bench.gateway(device(robot.port, robot.kind.protocol, robot.kind.options))
        first = session.declare_subscriber("fleet/r1/sensor/light1", heard.append)
        until(lambda: heard, what="a reading")
        second = session.declare_subscriber("fleet/r1/sensor/light1", heard.append)
        first.undeclare()
        time.sleep(0.3)
        count = len(heard)
        until(lambda: len(heard) > count + 1, what="readings for who is left")
        second.undeclare()
        time.sleep(0.5)
        report = robot.ended()
    commands = [(command, number) for _, command, _, number, _ in report["received"]]
    *enabled, disabled = commands
    assert sorted(enabled) == [(128, 1), (128, 3)], "for the first listener; and the pinned one"
    assert disabled == (129, 1), "after the last listener"
