"""What doctor says of what a gateway publishes: each failure that the pages describe has a finding of its own."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec
import pytest

from zbridge.client.fleet_model import RobotEntry
from zbridge.doctor import robot as judge
from zbridge.doctor.findings import Finding, Layer, Verdict
from zbridge.errors import Code
from zbridge.fleet.messages import Control, Fault, Latch, LinkStatus, Refusal, Status
from zbridge.fleet.processes import DiskSpace, ListenerStats, ProcessStats, Stats
from zbridge.protocol.plugin import Advice, find_protocol

PROCESS = ProcessStats("hub", 7, "0.1.0", uptime_s=4000.0, resident_bytes=60_000_000, files=30, most_files=1024)
STATS = Stats(PROCESS, {"pose": 20.0})
LINK = LinkStatus("robot", "established", "tcp://10.0.0.7:11001")
GOOD = Status("established", protocol="tcpudp", version="1.3", features=("udp",), links=(LINK,), host="hub")
SERVED = RobotEntry("r1", True, GOOD, Control("free"), STATS, published_at=1.0)


def only(findings: Iterable[Finding]) -> Finding:
    (finding,) = findings
    return finding


def changed(entry: RobotEntry, **fields: object) -> RobotEntry:
    return msgspec.structs.replace(entry, **fields)


@pytest.mark.parametrize(
    ("entry", "silent", "verdict", "code", "says"),
    [
        (SERVED, False, Verdict.OK, "ok", "zbridge 0.1.0 on hub, process 7, up 1.1 h"),
        (RobotEntry("r1"), True, Verdict.ERROR, "no_gateway", "no gateway serves r1: fleet/ has r2, r3, vehicle"),
        (changed(SERVED, alive=False), True, Verdict.ERROR, "gateway_left", "the gateway on hub has left the bus"),
        (SERVED, True, Verdict.ERROR, "gateway_silent", "(process 7) is on the bus, and has published nothing for 3 s"),
        (changed(SERVED, stats=None), False, Verdict.NOTE, "no_stats", "tells nothing of itself"),
        (
            changed(SERVED, stats=Stats(msgspec.structs.replace(PROCESS, uptime_s=4.0))),
            False,
            Verdict.NOTE,
            "restarted",
            "up 4.0 s: it has just started, or was restarted",
        ),
    ],
)
def test_a_gateway_is_there_silent_gone_or_new(
    entry: RobotEntry, silent: bool, verdict: Verdict, code: str, says: str
) -> None:
    finding = judge.judge_gateway(entry, silent=silent, known=["r2", "r3", "vehicle"])
    assert (finding.layer, finding.verdict, finding.code) == (Layer.GATEWAY, verdict, code)
    assert says in finding.text


@pytest.mark.parametrize("state", ["offline", "connecting", "handshaking", "closing"])
def test_a_robot_that_is_not_established_is_an_error_with_the_reason_and_its_port_is_not_tried(state: str) -> None:
    status = msgspec.structs.replace(GOOD, state=state, reason=None)
    finding = only(judge.judge_link(status, {}, (), "tcp://10.0.0.7:11001: Connection refused"))
    assert (finding.verdict, finding.code) == (Verdict.ERROR, f"robot_{state}")
    assert finding.text == f"{state}: tcp://10.0.0.7:11001: Connection refused"
    assert finding.remedy is not None
    assert "a legacy robot gives one connection for each start of its program" in finding.remedy


def test_what_the_protocol_knows_replaces_the_general_finding() -> None:
    advice = Advice("sign", "used_up", "its connection is used up", "restart it")
    status = msgspec.structs.replace(GOOD, state="handshaking")
    finding = only(judge.judge_link(status, {}, (advice,)))
    assert (finding.verdict, finding.code, finding.remedy) == (Verdict.ERROR, "used_up", "restart it")


def test_events_of_the_last_minute_are_warnings_and_what_lasts_is_told_elsewhere() -> None:
    faults = (
        Fault("deadman", "no command (ann)", 1, 3),
        Fault("latched", "latched by bob", 1),
        Fault("robot_lost", "x", 1),
    )
    finding = only(judge.judge_faults(Status("established", faults=faults)))
    assert (finding.code, finding.verdict) == ("fault_deadman", Verdict.WARNING)
    assert "3 times in the last minutes: no command (ann)" in finding.text
    assert "zbridge blackbox ls" in (finding.remedy or "")


@pytest.mark.parametrize(
    ("status", "rates", "verdict", "code"),
    [
        (GOOD, {"pose": 20.0}, Verdict.OK, "ok"),
        (GOOD, None, Verdict.OK, "ok"),
        (GOOD, {}, Verdict.NOTE, "robot_quiet"),
        (msgspec.structs.replace(GOOD, stalled=True), {}, Verdict.ERROR, "link_stalled"),
        (msgspec.structs.replace(GOOD, reason="cannot be stopped: no joystick"), {}, Verdict.WARNING, "condition"),
    ],
)
def test_an_established_robot_may_be_quiet_stalled_or_have_a_condition(
    status: Status, rates: dict[str, float] | None, verdict: Verdict, code: str
) -> None:
    finding = only(judge.judge_link(status, rates, ()))
    assert (finding.layer, finding.verdict, finding.code) == (Layer.ROBOT, verdict, code)


def test_who_drives_is_named_with_what_others_may_do() -> None:
    finding = only(judge.judge_driving(Control("held", holder="ann@pc", priority=1, expires_in_s=2.5), "r1"))
    assert (finding.verdict, finding.code) == (Verdict.NOTE, "held")
    assert finding.text == "ann@pc drives (priority 1), and others are refused; unless renewed the lease ends in 2.5 s"
    assert only(judge.judge_driving(Control("free"), "r1")).verdict is Verdict.OK


@pytest.mark.parametrize(("fleet", "command"), [(False, "zbridge unlatch r1"), (True, "zbridge unlatch --all")])
def test_a_latched_stop_is_a_warning_that_names_who_why_and_its_release(fleet: bool, command: str) -> None:
    control = Control("latched", latches=(Latch(b"1" * 16, "ann", "wet floor", fleet),))
    finding = only(judge.judge_driving(control, "r1"))
    assert (finding.verdict, finding.code) == (Verdict.WARNING, "latched")
    assert finding.text == "latched by ann (wet floor): nobody may drive"
    assert finding.remedy == f"once it is safe: {command}"
    assert only(judge.judge_driving(Control("latched"), "r1")).code == "latched"


@pytest.mark.parametrize("code", Code)
def test_every_code_of_a_refusal_has_a_remedy(code: Code) -> None:
    refusal = Refusal(who="ann", command="drive", code=code, reason="the reason", count=3)
    _, finding = judge.judge_driving(Control("free", refusals=(refusal,)), "r1")
    assert (finding.verdict, finding.code) == (Verdict.NOTE, f"refused_{code}")
    assert finding.text == "since the gateway started ann was refused drive 3 times: the reason"
    assert finding.remedy


@pytest.mark.parametrize(
    ("listener", "verdict", "code"),
    [
        (ListenerStats("desk", "tcpudp", "tcp://0.0.0.0:11002", 2), Verdict.OK, "ok"),
        (ListenerStats("desk", "tcpudp", "tcp://127.0.0.1:11002"), Verdict.NOTE, "listener_loopback"),
        (ListenerStats("desk", "tcpudp", "tcp://[::1]:11002"), Verdict.NOTE, "listener_loopback"),
        (ListenerStats("desk", "tcpudp", "tcp://0.0.0.0:11002", listening=False), Verdict.ERROR, "listener_down"),
    ],
)
def test_a_listener_that_other_machines_do_not_reach_is_noticed(
    listener: ListenerStats, verdict: Verdict, code: str
) -> None:
    finding = only(judge.judge_listeners((listener,), "hub"))
    assert (finding.layer, finding.verdict, finding.code) == (Layer.LISTENERS, verdict, code)
    assert listener.address in finding.text


@pytest.mark.parametrize(
    ("fields", "verdict", "code"),
    [
        ({}, Verdict.OK, "ok"),
        ({"files": 900}, Verdict.WARNING, "descriptors"),
        ({"files": 1000}, Verdict.ERROR, "descriptors"),
        ({"late_s": 0.3}, Verdict.WARNING, "late"),
        ({"cpu": 0.95}, Verdict.WARNING, "busy"),
        ({"proportional_bytes": 600_000_000}, Verdict.WARNING, "memory"),
    ],
)
def test_what_a_process_lacks_is_noticed(fields: dict[str, object], verdict: Verdict, code: str) -> None:
    finding = only(judge.judge_process(msgspec.structs.replace(PROCESS, **fields)))
    assert (finding.layer, finding.verdict, finding.code) == (Layer.PROCESS, verdict, code)


@pytest.mark.parametrize(
    ("free", "verdict", "code"),
    [(10**9, Verdict.OK, "ok"), (10**8, Verdict.WARNING, "disk_low"), (10**6, Verdict.ERROR, "disk_full")],
)
def test_a_disk_is_full_before_nothing_is_left(free: int, verdict: Verdict, code: str) -> None:
    finding = only(judge.judge_disks((DiskSpace("audit", "/var/log/r1", free),)))
    assert (finding.layer, finding.verdict, finding.code) == (Layer.DISK, verdict, code)


@pytest.mark.parametrize(
    ("offset_s", "uncertainty_s", "code"),
    [(0.9, 0.0, "ok"), (-1.5, 0.7, "ok"), (1.5, 0.1, "clock"), (3600.0, 0.02, "clock"), (-3600.0, 0.02, "clock")],
)
def test_a_clock_is_wrong_beyond_a_second_and_what_the_question_took(
    offset_s: float, uncertainty_s: float, code: str
) -> None:
    finding = judge.judge_clock("hub", offset_s, uncertainty_s)
    assert (finding.layer, finding.code) == (Layer.CLOCKS, code)
    if offset_s == 3600.0:
        assert "the clock of hub is 1.0 h ahead of this machine's (+-0.02 s)" in finding.text


USED_UP = "connected, but no settings within 5 s: its one connection may be used up, restart the robot program"
REASONS = {
    "tcpudp": {
        USED_UP: "used_up",
        "connection in doubt: client id 3: another program is connected, or the one usable connection is used up; x": (
            "used_up"
        ),
        "no telemetry and no answer to the probe within 5 s": "mute",
        "no telemetry within 5 s, unlike on the connection before": "mute",
        "malformed packets": "garbled",
        "no common version: the peer speaks '9.9', this gateway 1.1, 1.2": "wrong_version",
        "no settings that can be read within 5 s: packet 77": "wrong_protocol",
        "broken stream: frame of 759714647 bytes exceeds 4194368": "wrong_protocol",
        "tcp://10.0.0.7:11001: Connection refused": None,
    },
    "wc2ec": {"connected, but no device was registered within 5 s": "no_device"},
    "mavlink": {
        "no HEARTBEAT within 10 s: expected a rover or boat": "no_heartbeat",
        "no HEARTBEAT but 7 frames of others within 10 s: expected system 1": "only_others",
        "udp-in://0.0.0.0:14550: no datagram within 5 s": "no_datagram",
        "vehicle 1 has a PX4 (autopilot 12): only ArduPilot is supported": "px4",
        "vehicle 1 is of type 2, autopilot 3: expected an ArduRover": "no_rover",
        "two vehicles have the id 1": "two_vehicles",
        "nothing came for 3 s": "heartbeat_lost",
        "MAV_GCS_SYSID is 254: the rover ignores the sticks of system 255": "other_station",
        "HOLD was not confirmed: mode MANUAL": "not_held",
        "GUID_TIMEOUT is 3 s: the rover drives on for so long if the gateway dies": None,
    },
}


@pytest.mark.parametrize(
    ("protocol", "reason", "code"), [(name, *each) for name, known in REASONS.items() for each in known.items()]
)
def test_a_protocol_knows_what_its_own_reasons_mean(protocol: str, reason: str, code: str | None) -> None:
    assert [each.code for each in find_protocol(protocol).advise([reason])] == ([code] if code is not None else [])
