"""One gateway process, end to end: simulator or scripted robot, real sockets, real Zenoh."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import msgpack
import pytest

from tests.e2e.conftest import Bench, Fleet, end, free_port, until
from tests.e2e.robots import ScriptedRobot, position
from tests.machine import Patience

DEADMAN = "[control]\ndeadman_s = 0.3\n"


@pytest.fixture
def robot() -> Iterator[ScriptedRobot]:
    scripted = ScriptedRobot()
    yield scripted
    scripted.close()


def established(bench: Bench, robot: str = "r1") -> bool:
    return bench.fleet.state(robot) == "established"


def test_a_robot_is_seen_driven_and_asked(bench: Bench) -> None:
    port = free_port()
    bench.simulator(port)
    bench.gateway("r1", port)
    fleet = bench.fleet
    until(lambda: established(bench), what="established")
    status = fleet.get("fleet/r1/status")[0]
    assert (status["version"], status["protocol"]) == ("1.3", "tcpudp")
    assert "joystick" in status["features"]
    assert fleet.tokens() == ["fleet/r1/@alive/gateway"]
    before = until(lambda: fleet.last("r1/pose"))
    fleet.hold("r1")
    for _ in range(10):
        fleet.put("r1/@cmd/drive", forward=1.0)
        time.sleep(0.05)
    until(lambda: math.hypot(fleet.last("r1/pose")["x"] - before["x"], fleet.last("r1/pose")["y"] - before["y"]) > 0.1)
    fleet.put("r1/@cmd/text", text="hello")
    until(lambda: fleet.last("r1/text").get("text") == "echo: hello", what="answer to the text")
    fleet.put("r1/@cmd/lidar", on=False)
    until(lambda: fleet.last("r1/lidar").get("on") is False, what="lidar off")
    (answered,) = fleet.get("fleet/r1/@rpc/map")
    assert (answered["rows"], answered["columns"], len(answered["cells"])) == (100, 100, 10_000)
    assert {1, 2} <= set(answered["cells"])
    (answered,) = fleet.get("fleet/*/@rpc/pose")
    assert answered.keys() == {"x", "y", "heading", "stamp_ns"}


def test_a_late_joiner_gets_the_last_states_by_plain_get(bench: Bench, robot: ScriptedRobot) -> None:
    bench.serve("r1", robot.port)
    robot.send(bytes.fromhex("06000000013301000000"))  # lidar status: on
    until(lambda: bench.fleet.last("r1/lidar"))
    assert bench.fleet.get("fleet/r1/lidar")[0]["on"] is True
    assert {"established", "free"} <= {state["state"] for state in bench.fleet.get("fleet/r1/*") if "state" in state}


def test_position_bytes_become_a_pose_in_metres_and_radians(bench: Bench, robot: ScriptedRobot) -> None:
    bench.serve("r1", robot.port)
    robot.send(position(150.0, -225.0, 90.0))
    pose = until(lambda: bench.fleet.last("r1/pose"))
    assert pose["x"] == pytest.approx(1.5)
    assert pose["y"] == pytest.approx(-2.25)
    assert pose["heading"] == pytest.approx(math.pi)
    assert abs(pose["stamp_ns"] - time.time_ns()) < 5e9


def test_robot_killed_and_restarted_data_flows_again(bench: Bench) -> None:
    port = free_port()
    simulator = bench.simulator(port)
    bench.serve("r1", port)
    end(simulator, signal.SIGKILL)
    until(lambda: bench.fleet.state("r1") == "offline", what="offline")
    assert bench.fleet.last("r1/status")["reason"]
    bench.simulator(port)
    until(lambda: established(bench), what="established again")
    poses = bench.fleet.seen.setdefault("fleet/r1/pose", [])
    count = len(poses)
    until(lambda: len(poses) > count + 3, what="poses again")


def test_a_robot_that_is_not_there_is_offline_and_says_why(bench: Bench) -> None:
    bench.gateway("r1", free_port())
    until(lambda: "refused" in (bench.fleet.last("r1/status").get("reason") or ""))
    assert bench.fleet.state("r1") in ("offline", "connecting")


def test_kill_9_removes_the_liveliness_token(bench: Bench, robot: ScriptedRobot) -> None:
    gateway = bench.gateway("r1", robot.port)
    until(lambda: bench.fleet.tokens() == ["fleet/r1/@alive/gateway"])
    end(gateway, signal.SIGKILL)
    until(lambda: bench.fleet.tokens() == [], timeout_s=2.0, what="token gone")
    assert bench.fleet.get("fleet/r1/status", timeout_s=1.0) == []


def test_sigterm_stops_the_robot_and_ends_within_two_seconds(bench: Bench, robot: ScriptedRobot) -> None:
    gateway = bench.serve("r1", robot.port)
    bench.fleet.hold("r1")
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: robot.packets(11), what="drive at the robot")
    gateway.send_signal(signal.SIGTERM)
    bench.ended_within(gateway, 2.0)
    assert gateway.returncode == 0
    until(lambda: robot.reads[-1][1] == STOP, what="the last words")
    assert robot.reads[-1][1] == bytes.fromhex("02000000020d")
    until(lambda: bench.fleet.state("r1") == "offline")
    assert bench.fleet.last("r1/status")["reason"] == "gateway stopped"


@pytest.mark.parametrize("repetition", range(3))
def test_driver_killed_the_robot_stops_within_the_deadman(bench: Bench, robot: ScriptedRobot, repetition: int) -> None:
    bench.serve("r1", robot.port, DEADMAN)
    with driving(bench, robot) as driver:
        withheld_s = bench.withheld_s
        driver.kill()
        killed = time.monotonic()
        stop_at, stop = until(lambda: stops_since(robot, killed), what="stop")[0]
        # The last accepted command came before the kill, so this is the stricter bound seen from outside.
        assert stop_at - killed < 0.3 + 0.05 + bench.withheld_s - withheld_s
    assert stop == bytes.fromhex("02000000020d")
    eighth_at, _ = until(lambda: stops_since(robot, killed)[7:], what="eight stops")[0]
    assert eighth_at - stop_at < 1.0 + bench.withheld_s - withheld_s
    until(lambda: time.monotonic() > stop_at + 1.3)
    stops = stops_since(robot, killed)
    assert len(stops) <= 11 + time.monotonic() - stop_at, "ten a second for a second, then one a second"
    assert not [at for at, _ in robot.packets(11) if at > stop_at]


@contextlib.contextmanager
def driving(bench: Bench, robot: ScriptedRobot, *alive: str) -> Iterator[subprocess.Popen[str]]:
    """A process that acquires the robot and drives it every 20 ms; ``alive``: its liveliness token."""
    driver = subprocess.Popen([sys.executable, "-c", DRIVER, bench.endpoint, *alive], stdout=subprocess.PIPE, text=True)
    try:
        until(lambda: len(robot.packets(11)) > 10, what="driving")
        yield driver
    finally:
        driver.kill()
        driver.communicate()


def refusals(bench: Bench) -> dict[str, Any]:
    """What ``control`` shows as refused, by its reason."""
    return {entry["reason"]: entry for entry in bench.fleet.last("r1/control").get("refusals", [])}


def test_a_killed_driver_that_announced_itself_is_missed_long_before_the_deadman(bench, robot) -> None:
    bench.serve("r1", robot.port)
    with driving(bench, robot, "operator.1") as driver:
        assert bench.fleet.last("r1/control")["holder"] == "driver"
        withheld_s = bench.withheld_s
        killed = time.monotonic()
        driver.kill()
        stop_at, _ = until(lambda: stops_since(robot, killed), what="stop")[0]
        late_s = bench.withheld_s - withheld_s
    assert stop_at - killed < 0.5 + late_s  # the deadman would take 2 s
    until(lambda: bench.fleet.last("r1/control")["state"] == "stopped")
    assert not [at for at, _ in robot.packets(11) if at > stop_at]


def test_a_driver_that_froze_and_goes_on_moves_nothing_before_it_sends_neutral(bench, robot) -> None:
    bench.serve("r1", robot.port, DEADMAN)
    with driving(bench, robot, "operator.1") as driver:
        withheld_s = bench.withheld_s
        os.kill(driver.pid, signal.SIGSTOP)
        frozen = time.monotonic()
        stop_at, _ = until(lambda: stops_since(robot, frozen), what="stop")[0]
        assert stop_at - frozen < 0.3 + 0.05 + bench.withheld_s - withheld_s
        os.kill(driver.pid, signal.SIGCONT)
        until(lambda: refusals(bench).get("deadman: send a neutral drive first", {}).get("count", 0) > 10)
    assert not [at for at, _ in robot.packets(11) if at > stop_at]


def test_a_gateway_that_froze_and_goes_on_stops_the_robot_whatever_came_meanwhile(bench, robot) -> None:
    gateway = bench.serve("r1", robot.port, DEADMAN)
    with driving(bench, robot):
        os.kill(gateway.pid, signal.SIGSTOP)
        time.sleep(1.0)
        withheld_s = bench.withheld_s
        woken = time.monotonic()
        os.kill(gateway.pid, signal.SIGCONT)
        stop_at, _ = until(lambda: stops_since(robot, woken), what="stop")[0]
        assert stop_at - woken < 0.2 + bench.withheld_s - withheld_s
        until(lambda: refusals(bench).get("deadman: send a neutral drive first", {}).get("count", 0) > 10)
    assert not [at for at, _ in robot.packets(11) if at > stop_at]


def test_a_lease_lasts_while_it_is_renewed_and_its_end_stops_a_robot_that_moves_on_its_own(bench, robot) -> None:
    bench.serve("r1", robot.port, "[control]\nlease_s = 0.6\n")
    bench.fleet.hold("r1")
    time.sleep(1.2)  # the stop that greets the robot is repeated for a second
    bench.fleet.put("r1/@cmd/mode", mode="autonomous")
    sent_at, _ = until(lambda: robot.packets(10), what="autonomous mode")[0]
    time.sleep(1.0)
    assert stops_since(robot, sent_at) == []
    assert bench.fleet.last("r1/control")["state"] == "held"
    withheld_s = bench.withheld_s
    left = time.monotonic()
    bench.fleet.let_go("r1")
    stop_at, _ = until(lambda: stops_since(robot, sent_at), what="stop")[0]
    assert stop_at - left < 0.6 + 0.1 + bench.withheld_s - withheld_s
    until(lambda: bench.fleet.last("r1/control")["state"] == "stopped")


def test_of_two_programs_the_holder_drives_until_the_other_takes_over(bench: Bench, robot: ScriptedRobot) -> None:
    bench.serve("r1", robot.port)
    fleet, other = bench.fleet, Fleet(bench.fleet.session)
    fleet.hold("r1", "first")
    assert [denied["holder"] for denied in fleet.get("fleet/r1/@rpc/control/acquire/second", who="second")] == ["first"]
    other.put("r1/@cmd/drive", forward=0.5)
    until(lambda: "no lease: acquire first" in refusals(bench), what="refusal")
    assert not robot.packets(11)
    fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: robot.packets(11), what="the first program's motion")
    other.hold("r1", "second", how="takeover")
    other.put("r1/@cmd/drive", turn=0.5)
    until(lambda: robot.packets(12), what="the second program's motion")
    fleet.put("r1/@cmd/drive", forward=0.5)
    refused = until(lambda: refusals(bench).get("the lease has ended (taken over by second)"), what="refusal")
    assert (refused["who"], refused["command"]) == ("first", "drive")
    came = [data[5] for _, data in robot.reads]  # two may have come in one read, at one time
    assert 13 in came[came.index(11) : came.index(12)], "stopped in between"
    assert 11 not in came[came.index(12) :]
    assert fleet.last("r1/control")["holder"] == "second"
    other.close()


def test_a_question_about_the_lease_that_cannot_be_read_is_answered_with_what_was_expected(bench, robot) -> None:
    bench.serve("r1", robot.port)
    (error,) = bench.fleet.get("fleet/r1/@rpc/control/acquire/me", priority=1)
    assert error["code"] == "malformed"
    assert error["reason"].startswith("Acquire: ")
    assert "who" in error["reason"]


def test_limits_and_the_audit_log_are_as_configured(bench: Bench, robot: ScriptedRobot) -> None:
    file = bench.folder / "audit" / "r1.jsonl"
    bench.serve("r1", robot.port, f'[control]\nrate_hz = 5\nslew_per_s = 1.0\naudit = "{file}"\n')
    lease = bench.fleet.hold("r1", "hq")
    for _ in range(5):
        bench.fleet.put("r1/@cmd/drive", forward=1.0)
    refused = until(lambda: refusals(bench).get("more than 5 commands a second"), what="refusals")
    assert refused["count"] == 3
    speed = struct.unpack("<f", until(lambda: robot.packets(11))[0][1][-4:])[0]
    assert speed == pytest.approx(0.25, abs=0.02)
    assert lease.release()["ok"]
    until(lambda: "released" in file.read_text(), what="the last line")
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    assert [line["event"] for line in lines if line["event"] != "refused"] == ["acquired", "released"]
    assert {line["who"] for line in lines} == {"hq"}


def stops_since(robot: ScriptedRobot, since: float) -> list[tuple[float, bytes]]:
    """The stops after a moment: the ones that greet the robot do not count."""
    return [(at, data) for at, data in robot.packets(13) if at > since]


DRIVER = """
import sys, time, msgpack, zenoh
from tests.proofs import Holder
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", '["%s"]' % sys.argv[1])
with zenoh.open(config) as session:
    request = {"who": "driver"}
    if len(sys.argv) > 2:
        alive = session.liveliness().declare_token("fleet/r1/@alive/" + sys.argv[2])
        request["alive"] = sys.argv[2]
    (reply,) = session.get("fleet/r1/@rpc/control/acquire/driver", payload=msgpack.packb(request), timeout=3)
    held = Holder.of(msgpack.unpackb(reply.ok.payload.to_bytes()))
    drive = session.declare_publisher("fleet/r1/@cmd/drive")
    while True:
        command = msgpack.packb({"forward": 0.5})
        drive.put(command, attachment=held.attachment("drive", command))
        time.sleep(0.02)
"""


def test_the_bus_lost_while_driving_stops_the_robot_at_once(bench: Bench, robot: ScriptedRobot) -> None:
    bench.serve("r1", robot.port)
    bench.fleet.hold("r1")
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: robot.packets(11))
    withheld_s = bench.withheld_s
    cut = time.monotonic()
    bench.fleet.session.close()
    stop_at, _ = until(lambda: stops_since(robot, cut), what="stop")[0]
    assert stop_at - cut < 0.5 + bench.withheld_s - withheld_s  # far below the deadman of 2 s
    bench.fleet = Fleet(bench.router())
    until(lambda: established(bench), what="the gateway on the bus again")
    assert bench.fleet.get("fleet/r1/control")[0]["state"] == "stopped"
    bench.fleet.session.close()


def test_one_packet_per_write_and_never_back_to_back(bench: Bench, robot: ScriptedRobot) -> None:
    bench.serve("r1", robot.port)
    bench.fleet.hold("r1")
    for number in range(20):
        bench.fleet.put("r1/@cmd/text", text=f"number {number}")
        bench.fleet.put("r1/@cmd/drive", forward=number / 20, turn=0.01)
    until(lambda: len(robot.packets(1)) == 20, what="all texts")
    for _, data in robot.reads:
        assert len(data) == 4 + int.from_bytes(data[:4], "little")
    texts = [data[10:].decode() for _, data in robot.packets(1)]
    assert texts == [f"number {number}" for number in range(20)]
    # By the kernel's time of arrival, however late this process reads; what it joined took as long as its packets do
    for (earlier, _), (later, packets) in itertools.pairwise(robot.arrivals[1:]):
        assert later - earlier > 0.0095 * packets


def test_refusals_show_on_control(bench: Bench, robot: ScriptedRobot) -> None:
    bench.serve("r1", robot.port)
    bench.fleet.hold("r1", "hq")
    bench.fleet.put("r1/@cmd/drive", forward=7.0)
    bench.fleet.put("r1/@cmd/camera", on=True)
    bench.fleet.put("r1/@cmd/raw/tcpudp", id=70, body=b"x")
    bench.fleet.put("r1/@cmd/dance")
    bench.fleet.put_payload("r1/@cmd/drive", b"\xc1")

    until(lambda: len(refusals(bench)) == 5, what="five refusals")
    reasons = refusals(bench)
    assert {entry["command"] for entry in reasons.values()} == {"drive", "camera", "raw/tcpudp", "dance"}
    proven = {entry["command"] for entry in reasons.values() if entry["who"] == "hq"}
    assert proven == {"drive", "raw/tcpudp"}, "of commands that need no lease nobody looks at the proof"
    assert {entry["who"] for entry in reasons.values()} == {"hq", None}
    assert any("<= 1.0" in reason for reason in reasons)
    assert not robot.packets(11)
    assert not robot.packets(70)


def test_a_robot_of_another_version_is_told_and_left(bench: Bench) -> None:
    old = ScriptedRobot(bytes.fromhex("0f00000001020103000000312e390000000000"))  # lists "1.9" only
    try:
        bench.gateway("r1", old.port)
        until(lambda: "no common version" in (bench.fleet.last("r1/status").get("reason") or ""))
        assert b"no common version" in until(lambda: old.packets(1))[0][1]
    finally:
        old.close()


def test_rubbish_from_the_robot_ends_its_session_and_nothing_else(bench: Bench, robot: ScriptedRobot) -> None:
    gateway = bench.serve("r1", robot.port)
    robot.send(b"\xff" * 1000)
    until(lambda: "broken stream" in (bench.fleet.last("r1/status").get("reason") or ""))
    until(lambda: robot.connections > 1 and established(bench), what="connected again")
    output = end(gateway)
    assert gateway.returncode == 0
    assert "Traceback" not in output


def test_a_second_gateway_waits_and_takes_over(bench: Bench, robot: ScriptedRobot) -> None:
    first = bench.serve("r1", robot.port)
    second = bench.gateway("r1", robot.port)
    assert second.stderr is None
    assert second.stdout is not None
    assert "another gateway serves r1" in second.stdout.readline()
    assert robot.connections == 1
    end(first, signal.SIGKILL)
    robot.drop()
    until(lambda: robot.connections == 2, what="the second gateway's connection")
    until(lambda: established(bench))


def test_a_second_gateway_leaves_the_robot_alone_when_the_router_dies(bench: Bench, robot: ScriptedRobot) -> None:
    bench.serve("r1", robot.port)
    second = bench.gateway("r1", robot.port)
    assert second.stdout is not None
    assert "another gateway serves r1" in second.stdout.readline()
    bench.fleet.session.close()
    time.sleep(3.0)
    assert robot.connections == 1
    bench.fleet = Fleet(bench.router())
    until(lambda: established(bench), what="the first gateway on the bus again")
    time.sleep(1.5)
    assert robot.connections == 1
    bench.fleet.session.close()


def test_a_driver_that_goes_on_while_the_gateway_ends_moves_nothing(bench: Bench, robot: ScriptedRobot) -> None:
    gateway = bench.serve("r1", robot.port)
    bench.fleet.hold("r1")
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: robot.packets(11))
    gateway.send_signal(signal.SIGTERM)
    patience = Patience(4.0)
    while gateway.poll() is None and not patience.over:
        bench.fleet.put("r1/@cmd/drive")
        bench.fleet.put("r1/@cmd/drive", forward=0.5)
        time.sleep(0.02)
    assert gateway.returncode == 0
    until(lambda: len(robot.reads) > 5 and robot.reads[-1][1] == STOP, what="the last words")
    came = [data[5] for _, data in robot.reads]
    stops = [place for place, packet_id in enumerate(came) if packet_id == 13]
    assert 11 not in came[stops[-5] :]


def test_a_robot_is_stopped_when_its_connection_returns(bench: Bench, robot: ScriptedRobot) -> None:
    bench.serve("r1", robot.port)
    bench.fleet.hold("r1")
    bench.fleet.put("r1/@cmd/drive", forward=0.5)
    until(lambda: robot.packets(11))
    before = len(robot.reads)
    robot.drop()
    until(lambda: robot.connections == 2)
    until(lambda: [data for _, data in robot.reads[before:] if data == STOP], what="a stop on the new connection")
    assert not [data for _, data in robot.reads[before:] if data[5] == 11]


def test_sigterm_ends_the_gateway_although_the_router_stands_still(bench: Bench, robot: ScriptedRobot) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = subprocess.Popen([sys.executable, "-c", ROUTER, endpoint], stdout=subprocess.PIPE, text=True)
    try:
        assert router.stdout is not None
        router.stdout.readline()
        file = bench.configuration("r1", robot.port)
        file.write_text(file.read_text().replace(bench.endpoint, endpoint))
        gateway = bench.zbridge("run", str(file))
        until(lambda: robot.packets(3), what="the handshake")
        until(lambda: robot.packets(13), what="the greeting stop")
        os.kill(router.pid, signal.SIGSTOP)
        time.sleep(1.5)
        gateway.send_signal(signal.SIGTERM)
        bench.ended_within(gateway, 2.0)
        assert gateway.returncode == 0
    finally:
        router.kill()
        router.communicate()


STOP = bytes.fromhex("02000000020d")
ROUTER = """
import sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", '["%s"]' % sys.argv[1])
config.insert_json5("scouting/multicast/enabled", "false")
with zenoh.open(config):
    print("open", flush=True)
    time.sleep(60)
"""


def test_a_gateway_waits_for_a_bus_that_is_not_there_yet(bench: Bench, robot: ScriptedRobot) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    file = bench.configuration("r1", robot.port)
    file.write_text(file.read_text().replace(bench.endpoint, endpoint))
    gateway = bench.zbridge("run", str(file))
    assert gateway.stdout is not None
    assert "no bus" in gateway.stdout.readline()
    gateway.send_signal(signal.SIGTERM)
    bench.ended_within(gateway, 3.0)
    assert gateway.returncode == 0


def test_raw_frames_are_published_while_somebody_listens(bench: Bench, robot: ScriptedRobot) -> None:
    bench.serve("r1", robot.port)
    frames: list[bytes] = []
    watch = bench.fleet.session.declare_subscriber(
        "fleet/r1/@wire/*/*", lambda sample: frames.append(sample.payload.to_bytes())
    )
    packet = position(1.0, 2.0, 3.0)
    until(lambda: (robot.send(packet), packet in frames)[1], what="frame in")
    bench.fleet.put("r1/@cmd/text", text="hi")
    until(lambda: bytes.fromhex("080000000201020000006869") in frames, what="frame out")
    watch.undeclare()


def test_counters_are_served_to_prometheus(bench: Bench, robot: ScriptedRobot) -> None:
    import urllib.request

    port = free_port()
    bench.serve("r1", robot.port, f'[metrics]\nlisten = "127.0.0.1:{port}"\n')
    robot.send(position(1.0, 2.0, 3.0))
    until(lambda: bench.fleet.last("r1/pose"))
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=3) as page:
        text = page.read().decode()
    assert "zbridge_published_total 1" in text


def test_msgpack_and_zenoh_are_all_a_reader_needs(bench: Bench, robot: ScriptedRobot) -> None:
    """What the README shows: the payload is a plain MessagePack map, the encoding names it."""
    bench.serve("r1", robot.port)
    samples: list[Any] = []
    watch = bench.fleet.session.declare_subscriber("fleet/r1/pose", samples.append)
    until(lambda: (robot.send(position(100.0, 0.0, 0.0)), samples)[1])
    assert str(samples[0].encoding) == "application/msgpack;zbridge.Pose.v1"
    assert msgpack.unpackb(samples[0].payload.to_bytes())["x"] == pytest.approx(1.0)
    watch.undeclare()
