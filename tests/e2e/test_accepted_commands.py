"""What ``status`` says a robot accepts is what its gateway carries out, and nothing else; of each protocol."""

from __future__ import annotations

from typing import Any

import pytest

from tests.e2e.conftest import Bench, device, until

COMMANDS: dict[str, dict[str, Any]] = {
    "drive": {},
    "mode": {"mode": "manual"},
    "light": {"on": True},
    "lidar": {"on": True},
    "camera": {"on": True},
    "text": {"text": "hello"},
    "scan": {"angle_min": 0.0, "angle_increment": 1.0, "range_min": 0.1, "range_max": 9.0, "ranges": bytes(4 * 6)},
    "motor/left wheel": {"value": 0.0},
    "sensor/ds0": {"enable": True},
    "raw/tcpudp": {"id": 40, "body": b"hello"},
}
"""One of each command that a fleet knows, which moves nothing."""
WHEELS = """
[device.options.differential]
left = ["left wheel"]
right = ["right wheel"]
wheel_radius_m = 0.02
track_m = 0.05
"""
ACCEPTED = {
    "tcpudp": {"drive", "stop", "mode", "lidar", "text", "raw"},
    "alf": {"drive", "stop", "light"},
    "wc2ec": {"drive", "stop", "motor"},
}


@pytest.mark.parametrize("protocol", ACCEPTED)
def test_what_status_lists_is_carried_out_and_the_rest_is_refused(bench: Bench, protocol: str) -> None:
    bench.gateway(device(bench.simulator(protocol), protocol, WHEELS if protocol == "wc2ec" else ""))
    until(lambda: set(bench.fleet.last("r1/status").get("commands", ())) >= ACCEPTED[protocol], what="what it accepts")
    listed = set(bench.fleet.last("r1/status")["commands"])
    assert listed - {"scan"} == ACCEPTED[protocol]
    bench.fleet.hold()
    for name, fields in COMMANDS.items():
        bench.fleet.put(f"r1/@cmd/{name.replace(' ', '%20')}", **fields)
    bench.fleet.put("r1/@cmd/dance")
    until(lambda: bench.fleet.refusal(command="dance", code="unsupported"), what="the last one refused")
    refusals = bench.fleet.last("r1/control")["refusals"]
    unsupported = {entry["command"].partition("/")[0] for entry in refusals if entry["code"] == "unsupported"}
    assert unsupported == ({name.partition("/")[0] for name in COMMANDS} | {"dance"}) - listed, refusals


def test_a_robot_that_is_away_accepts_nothing(bench: Bench) -> None:
    port = bench.simulator("alf")
    bench.gateway(device(port, "alf"))
    until(lambda: bench.fleet.last("r1/status").get("commands"), what="what it accepts")
    bench.simulators[port].kill()
    until(lambda: not bench.fleet.last("r1/status")["commands"], what="nothing is accepted")
