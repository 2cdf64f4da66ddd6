"""The device side with a TCP/UDP robot, from its first connection to its last stop; ``scene`` explains the scripts."""

from __future__ import annotations

import asyncio
import json
import math
import re
from collections.abc import Callable
from typing import Any
from urllib.parse import unquote

import msgpack
import pytest
import zenoh

from gateways.tcpudp.translate import TcpUdpRobot
from tests.clock import scene_of
from tests.proofs import lease, packed, shown
from tests.robot.scene import (
    COMMANDS,
    NEUTRAL,
    SETTINGS,
    STOP,
    TWO_METRES,
    OpenBus,
    Program,
    Rig,
    established,
    serving,
)
from zbridge.bus import PriorityClass, Sample
from zbridge.control.events import StopCause
from zbridge.control.motion_limits import MotionLimits
from zbridge.errors import Malformed, RateLimited
from zbridge.fleet import topics
from zbridge.robot.device import HEARTBEAT_S
from zbridge.robot.telemetry import ATTEND_EVERY

__all__ = ["NEUTRAL", "Program", "Rig", "established", "serving"]

pytestmark = pytest.mark.jumping

# flags of our answer: nothing but LidarSim
ANSWER = bytes.fromhex("18000000 02 03 0b000000") + b"1.1,1.2,1.3" + bytes.fromhex("00000000000100")
POSITION = bytes.fromhex("0e000000 01 37 00001643 000048c2 0000b442")
MAP = bytes.fromhex("0f000000 01 35 09000000 000102 020200 010001")
LIDAR_IS_ON = bytes.fromhex("06000000 01 33 01000000")
BYE = bytes.fromhex("09000000 01 01 03000000 627965")
LEFT = COMMANDS["left"][1]

rig = scene_of(established)


# Handshake and status


async def test_the_robot_speaks_first_and_its_settings_are_answered_and_shown() -> None:
    async with serving() as rig:
        await asyncio.sleep(1.0)
        assert rig.link.written == []
        rig.sends(SETTINGS)
        assert rig.link.written == [ANSWER]
        states = [(status["state"], status["reason"]) for status in rig.values("status")]
        assert [state for state, _ in states[:3]] == ["offline", "connecting", "handshaking"]
        assert (states[0], states[-1]) == (("offline", "not yet connected"), ("established", None))
        status = rig.last("status")
        assert (status["protocol"], status["version"], status["stamp_ns"]) == ("tcpudp", "1.3", 1234)
        assert status["features"] == ["cam", "joystick", "chat", "lidar", "lidar_sim", "slam_map"]
        peer = {"name": "robot", "state": "established", "peer": "tcp://robot.test:11001", "reason": None}
        assert status["links"] == [peer]


async def test_a_warning_of_the_session_is_shown_and_forbids_nothing() -> None:
    async with established() as rig:
        rig.conversations[-1].session.warnings = ("it drives on for 3 s",)
        await asyncio.sleep(HEARTBEAT_S)
        assert rig.last("status")["reason"] == "it drives on for 3 s"
        rig.command("drive", {"forward": 1.0})
        await asyncio.sleep(0.05)
        assert rig.written()


async def test_an_unreachable_robot_shows_the_reason_every_second_and_is_tried_ever_more_rarely() -> None:
    async with serving(unreachable="no route") as rig:
        assert (rig.last("status")["state"], rig.last("status")["reason"]) == ("offline", "no route")
        await asyncio.sleep(60.0)
        assert 7 <= [status["state"] for status in rig.values("status")].count("connecting") <= 14
        before = len(rig.values("control"))
        await asyncio.sleep(3 * HEARTBEAT_S)
        assert len(rig.values("control")) == before + 3
        assert len(rig.values("status")) >= before + 3


async def test_a_lost_robot_is_offline_with_the_reason_remembered_and_publishes_again_when_it_returns(rig: Rig) -> None:
    (session,) = rig.manager.snapshots()
    assert (session.name, session.peer, session.state) == ("robot", "tcp://robot.test:11001", "established")
    rig.goes("connection lost: reset")
    status = rig.last("status")
    assert (status["state"], status["reason"]) == ("offline", "connection lost: reset")
    assert (status["version"], status["features"]) == (None, [])
    await rig.settle()
    assert [session.reason for session in rig.manager.snapshots()] == ["connection lost: reset"]
    await rig.play("1 established")
    assert (len(rig.links), rig.last("status")["state"]) == (2, "established")
    rig.sends(POSITION)
    assert len(rig.values("pose")) == 1


# Telemetry


async def test_what_a_read_brings_is_published_in_order_and_counted_and_what_has_no_meaning_only_counted(rig) -> None:
    seen: list[str] = []
    rig.hq.subscribe("fleet/r1/*", lambda sample: seen.append(sample.key.rpartition("/")[2]))
    before = rig.metrics.total("bus_messages")
    no_square, no_mode = bytes.fromhex("0b000000 01 35 05000000 0000000000"), bytes.fromhex("06000000 01 33 07000000")
    rig.sends(POSITION + BYE + no_square + no_mode + POSITION + LIDAR_IS_ON)
    assert sorted(seen) == ["lidar", "pose", "pose", "text"]
    rig.sends(MAP)
    assert seen[4:] == ["map"]
    assert rig.metrics.total("bus_messages") == before + 5
    assert rig.metrics.total("untranslatable_messages") == 2
    assert rig.last("lidar") == {"on": True, "stamp_ns": 1234}
    assert rig.last("pose")["x"] == pytest.approx(1.5)  # 150 cm
    assert rig.last("map")["cells"] == bytes([0, 2, 1, 1, 2, 0, 2, 0, 1])
    late: list[str] = []
    rig.bus.join("3").subscribe("fleet/r1/*", lambda sample: late.append(sample.key.rpartition("/")[2]), history=True)
    assert sorted(late) == ["control", "lidar", "map", "status"], "what is a state is there for latecomers too"


async def test_a_malformed_packet_costs_itself_and_a_broken_stream_the_session_but_not_what_came_before(rig) -> None:
    seen: list[str] = []
    rig.hq.subscribe("fleet/r1/pose", lambda sample: seen.append("pose"))
    rig.hq.subscribe("fleet/r1/status", lambda sample: seen.append(msgpack.unpackb(sample.payload)["state"]))
    rig.sends(bytes.fromhex("03000000 01 37 00") + POSITION)
    assert (seen, rig.metrics.total("malformed_frames")) == (["pose"], 1)
    rig.sends(POSITION + bytes(6))
    await rig.settle()
    assert seen == ["pose", "pose", "offline"]
    assert "broken stream" in rig.last("status")["reason"]
    assert rig.links[0].closed


async def test_commands_are_served_in_the_midst_of_a_large_read(rig: Rig) -> None:
    attended: list[int] = []
    rig.bus.attend = lambda: attended.append(len(rig.values("pose")))  # type: ignore[method-assign]
    rig.sends(POSITION * (3 * ATTEND_EVERY))
    assert len(attended) == 3
    assert len(rig.values("pose")) == 3 * ATTEND_EVERY


async def test_raw_frames_are_shown_only_to_those_who_listen() -> None:
    async with established() as rig:
        assert rig.bus.values("fleet/r1/@wire/**") == []
    bus = OpenBus()
    seen: list[tuple[str, bytes]] = []
    bus.join("3").subscribe("fleet/r1/@wire/**", lambda sample: seen.append((sample.key, sample.payload)))
    async with established(bus=bus) as rig:
        rig.sends(POSITION + b"\x02\x00")
        assert seen[:2] == [("fleet/r1/@wire/robot/in", SETTINGS), ("fleet/r1/@wire/robot/out", ANSWER)]
        assert seen[-1] == ("fleet/r1/@wire/robot/in", POSITION)
        assert {frame for _, frame in seen[2:-1]} == {STOP}, "the stop that greets the robot"


async def test_a_bus_that_is_full_pauses_the_link_or_the_next_one_until_it_takes_more(rig: Rig) -> None:
    rig.bus.takes = False
    rig.sends(POSITION)
    assert rig.link.paused
    await rig.play("lost 1 established")
    assert not rig.link.paused, "a new link is read until the bus says so again"
    rig.sends(POSITION)
    assert rig.link.paused
    rig.bus.relieve()
    assert not rig.link.paused
    rig.sends(POSITION)
    assert not rig.link.paused


# Commands, the lease and stops: scripts. The first line may say how the robot, the gateway or the scene differs.


SCENES = {
    # What leaves, and in which order
    "a stop leaves before neutral and motion of the next holder that follow at once": """
        left > left
        stop acquire neutral turn 0.05 > stop turn""",
    "a robot that takes nothing is not flooded and its stop goes first as soon as it takes something": """
        link_full 80*text stop >
        link_free > stop
        refused - text: 64 packets wait x16
        0.35 >> text""",
    # Stops
    "a stop is repeated for a second, refused drives do not end it, and nobody drives before acquiring anew": """
        left 0.1 > left
        stop 0.2 left 5 > stop x10-11
        control stopped
        neutral 0.1 left 0.1 >
        renew
        refused driver drive: the lease has ended (stop) x3 | driver renew: the lease has ended (stop)
        acquire left > left""",
    "a stop for a robot that cannot be stopped is refused and its motion ends all the same": """
        with handshaking=1
        announces_nothing established stop >
        control stopped
        refused - stop: joystick""",
    # Silence
    "a silent driver's robot is stopped after the deadman time, and the lease stays but needs neutral": """
        with deadman_s=0.6
        left 0.59 > left x3
        0.02 > stop
        3 > stop x9-10
        control held driver
        left >
        refused driver drive: deadman: send a neutral drive first
        neutral 0.1 left >> left""",
    "nothing but the holder's fresh drives keeps the robot moving": """
        with deadman_s=0.6
        left 0.145 text dance too_fast motor renew other:left other:acquire > left text
        0.145 text dance too_fast motor renew other:left other:acquire > left text
        0.145 text dance too_fast motor renew other:left other:acquire > text
        0.145 text dance too_fast motor renew other:left other:acquire > left text
        0.03 >> stop""",
    "a drive after the deadman time is refused although the gateway was frozen meanwhile": """
        with deadman_s=0.6
        left 0.1 > left
        frozen turn > stop
        refused driver drive: deadman: send a neutral drive first
        2 > stop x9-10
        neutral 0.1 turn >> turn""",
    # Who may drive
    **{
        f"{word} is carried out for the holder of the lease alone": f"""
        with hold=0
        other:{word} >
        other:acquire takeover turn 0.05 > turn
        3*other:{word} >
        refused - {name}: no lease: acquire first | other {name}: the lease has ended (taken over by driver) x3
        control held driver
        turn > turn"""
        for word in ("left", "neutral", "manual", "raw", "motor")
        for name in [COMMANDS[word][0]]
    },
    "what moves nothing needs no lease": """
        with hold=0
        text 0.1 lidar 0.1 scan 0.1 stop > text lidar scan stop
        refused""",
    **{
        f"the stop of a moving robot that changes hands by {how} goes before the new holder's motion": f"""
        with deadman_s=60
        left 0.1 > left
        other:{how} other:turn > stop
        2 > turn x7-8
        left
        refused driver drive: the lease has ended (taken over by other)
        control held other"""
        for how in ("takeover", "outrank")
    },
    "a standing robot that changes hands, is released, or whose holder's lease expires is sent nothing": """
        with lease_s=1 hold=0
        acquire other:takeover 0.5 other:release 0.5 >
        control free
        acquire manual 0.1 > manual
        3 >
        control stopped""",
    "renewing keeps a robot going that moves on its own, but a frozen gateway finds the lease expired": """
        with lease_s=1 deadman_s=0.3 hold=0
        acquire autonomous 0.9 renew 0.9 renew 0.9 renew 0.9 > autonomous
        control held driver
        frozen left 0.01 > none stop
        refused driver drive: the lease has ended (lease expired)""",
    "a moving robot that is released is stopped for a second and free": """
        left 0.1 > left
        release > stop
        control free
        2 > stop x9-10
        left >
        refused driver drive: the lease has ended (released)
        other:acquire
        control held other""",
    # The end of a lease
    **{
        f"a lease that expires stops a robot that was sent {word}": f"""
        with lease_s=1 deadman_s=5 hold=0
        acquire 0.5 {word} 0.99 > {word} x1-4
        0.02 >> {stop}
        3 > {stop} x9-10
        control stopped
        neutral left >
        refused driver drive: the lease has ended (lease expired) x2
        acquire left > left"""
        for word, stop in (("left", "stop"), ("autonomous", "none stop"), ("raw", "stop"))
    },
    # The robot goes and comes
    "a robot lost while moving keeps its holder, needs neutral when it returns and gets no old motion": """
        with deadman_s=60
        left 0.1 > left
        lost 1 renew other:acquire established 1 >
        control held driver
        left autonomous >
        refused other acquire: held by driver | driver drive: robot lost: send a neutral | driver mode: robot lost
        neutral 0.1 left > stop left""",
    "the deadman of a lost robot does not fire": """
        with deadman_s=0.5
        left unreachable lost 2 reachable 3 established left >
        refused driver drive: robot lost""",
    "a lease that expires while the robot is away has ended when it returns": """
        with lease_s=2 hold=0
        acquire left unreachable lost 3 reachable 3 established
        control stopped
        refused
        neutral left >""",
    "a robot lost before it was established needs no neutral": """
        with handshaking=1
        lost 1 established left > left""",
    **{
        f"during the handshake {acts} is refused and then motion needs neutral": f"""
        with handshaking=1
        lidar {acts} >
        refused - lidar: handshaking | driver drive: handshaking x{count}
        established left >
        neutral 0.1 left > stop left"""
        for acts, count in (("left", 1), ("left neutral", 2))
    },
    "an offline robot's stop is taken and all else refused, and it is tried again": """
        with unreachable=1
        lidar stop
        control stopped
        refused - lidar: offline
        reachable 1 established acquire left > left""",
    "a robot that is busy with its handshake is stopped, and the lease stays but needs neutral": """
        with deadman_s=60
        left 0.1 > left
        asks_for_datagrams left neutral
        refused driver drive: handshaking x2
        2.5 >> stop
        left
        refused driver drive: handshaking x2 | driver drive: no longer busy: send a neutral drive first
        control held driver
        neutral 0.1 left >> left""",
    "a robot that announces nothing is sent nothing it may not know": """
        with handshaking=1
        announces_nothing established left manual lidar raw 1 >
        refused driver drive: announce | driver mode: announce | - lidar: announce | driver raw/tcpudp: announce""",
    # The bus goes and comes
    "the loss of the bus stops a moving robot and ends the lease": """
        left 0.1 > left
        bus_lost > stop
        2 > stop x9-10
        bus_back neutral left >
        refused driver drive: the lease has ended (bus lost) x2
        1.0 acquire left > left""",
    "the loss of the bus ends the lease of a standing robot and sends it nothing": """
        bus_lost 1 >
        control stopped""",
    # Limits
    "a robot is not sent faster changes than its owner allows, and slowing down is never slowed": """
        with slew_per_s=1
        ahead0.6 0.1 ahead0.6 0.1 ahead0.6 0.1 ahead0.6 0.1 > ahead0.25 ahead0.35 ahead0.45 ahead0.55
        ahead0.6 0.1 ahead0.1 > ahead0.6 ahead0.1""",
    "the limits begin anew after a stop whatever comes first": """
        with slew_per_s=1
        ahead1.0 0.25 ahead1.0 0.25 stop 2 acquire autonomous 0.1 >> autonomous
        ahead1.0 0.05 >> ahead0.25""",
    "drives that come too fast are refused and neutral never is": """
        with rate_hz=10
        5*left neutral 0.05 > left stop
        refused driver drive: more than 10 commands a second x3
        0.1 left >> left""",
}


@pytest.mark.parametrize("script", SCENES.values(), ids=SCENES)
async def test_the_robot_gets_what_it_should(script: str) -> None:
    settings: dict[str, Any] = {name: float(value) for name, value in re.findall(r"(\w+)=(\S+)", script)}
    limits = MotionLimits(settings.pop("rate_hz", math.inf), settings.pop("slew_per_s", math.inf))
    unreachable = "no route" if settings.pop("unreachable", False) else None
    handshaking = settings.pop("handshaking", False) or unreachable
    async with (serving if handshaking else established)(limits=limits, unreachable=unreachable, **settings) as rig:
        await rig.play(script)


@pytest.mark.parametrize(
    ("key", "payload"),
    [
        *[(key, b"") for key in ("fleet/*/@cmd/stop", "fleet/**/@cmd/stop", "*/*/@cmd/stop", "fleet/r$*/@cmd/stop")],
        *[("fleet/r1/@cmd/stop", payload) for payload in (b"stop", b"\xc1", packed({"stamp_ns": "now"}))],
    ],
)
async def test_a_stop_stops_the_robot_whatever_its_payload_and_alone_may_have_wildcards(rig: Rig, key, payload) -> None:
    """Who subscribed to what a key expression meets is found by Zenoh's own rules."""
    await rig.play("left 0.1 > left")
    for subscribed, take in rig.bus.network.subscribers:
        if zenoh.KeyExpr(subscribed).intersects(zenoh.KeyExpr(key)):
            take(Sample(key, payload))
    await rig.play("0 > stop\n control stopped\n refused")


@pytest.mark.parametrize(
    "key", ["fleet/*/@cmd/drive", "*/r1/@cmd/drive", "fleet/r1/@cmd/*", "fleet/r1/@cmd/**", "fleet/r1/@cmd/motor/*"]
)
async def test_a_command_whose_key_has_wildcards_is_refused_whoever_proves_it(rig: Rig, key: str) -> None:
    held, payload = rig.driver.held, packed(LEFT)
    assert held is not None
    rig.hq.publisher(key, topics.CMD_DRIVE).put(payload, shown(held.lease, held.token, key, 1, payload))
    assert rig.written() == []
    assert await rig.refused() == [(None, key.rpartition("@cmd/")[2], "its key has wildcards", 1)]
    assert rig.last("control")["refusals"][0]["code"] == "malformed"


# Questions about the lease


@pytest.mark.scene(hold=False, lease_s=3.0)
async def test_whoever_acquires_is_given_the_lease_and_shown_as_the_holder_but_the_token_is_never_shown(rig) -> None:
    free = {"state": "free", "holder": None, "lease": None, "priority": None, "expires_in_s": None}
    assert rig.control == free
    lease, token = bytes([1]) * 8, bytes([1]) * 32
    granted = {"ok": True, "lease": lease, "token": token, "expires_in_s": 3.0, "holder": "driver"}
    assert rig.hold(priority=4) == {**granted, "reason": None, "code": None}
    assert rig.control == {"state": "held", "holder": "driver", "lease": lease, "priority": 4, "expires_in_s": 3.0}
    denied = {"lease": None, "token": None, "holder": "driver", "reason": "held by driver (priority 4)"}
    assert rig.other.acquire() == {"ok": False, **denied, "expires_in_s": 3.0, "code": "held"}
    await asyncio.sleep(2 * HEARTBEAT_S)
    assert 1.0 <= rig.control["expires_in_s"] <= 2.0
    assert rig.driver.renew()["expires_in_s"] == 3.0
    await rig.play("left > left\n stop")
    assert not any(token in payload for payload in rig.bus.values("fleet/r1/*"))
    assert not any(token in (sample.attachment or b"") for sample in rig.bus.network.history)


@pytest.mark.scene(deadman_s=60.0, hold=False)
async def test_a_holder_whose_liveliness_token_goes_is_lost_and_the_robot_stopped_in_the_same_moment(rig: Rig) -> None:
    keys = (
        "r1/@alive/operator.driver.7",
        "r1/@alive/operator.driver.8",
        "r2/@alive/operator.driver.7",
        "r1/@alive/gateway",
    )
    own, *others = [rig.hq.announce(f"fleet/{key}") for key in keys]
    assert rig.hold(alive="operator.driver.7")["ok"]
    await rig.play("left 0.1 > left")
    for token in others:
        token.close()
    await rig.play("0.5 > left x2")
    own.close()
    await rig.play("""
        0 > stop
        control stopped
        neutral left
        refused driver drive: the lease has ended (holder lost) x2
        2 > stop x9-10
        acquire left > left""")


def telling(*refusals: dict[str, Any]) -> bytes:
    """What a listener tells: refusals of a program of its own, with what is said otherwise."""
    whole = {"who": "hq.desk.3", "command": "drive", "code": "neutral_first", "reason": "let go first", "count": 1}
    return packed({"refusals": [{**whole, **refusal} for refusal in refusals]})


REFUSED_QUESTIONS: list[tuple[str, str, bytes, str]] = [
    # the robot and the name in the key; the question; the reason
    *[
        ("r1", f"{how}/{at}", packed({"who": who}), f"who = {who!r}: expected {name!r}, or that and '.suffix'")
        for how in ("acquire", "takeover")
        for at, name, who in (("op1", "op1", "op12"), ("op1.laptop", "op1.laptop", "op1"), ("%6Fp1", "op1", "op1"))
    ],
    *[
        (
            "r1",
            f"{how}/{at}",
            packed({"who": at, "alive": alive}),
            f"alive = {alive!r}: expected a token of its own name",
        )
        for how in ("acquire", "takeover")
        for at, alive in (
            *(("op1", each) for each in ("operator.op2.7", "operator.op12.7", "operator.op1", "op1.7", "gateway", "")),
            ("hq.desk", "hq.desk2.7"),
            ("hq.desk", "operator.desk.7"),
        )
    ],
    *[("r1", f"{how}/ann", bad, "Acquire: ") for how in ("acquire", "takeover") for bad in (b"", b"\xc1")],
    *[
        ("r1", how, bad, "malformed authorization: expected {lease, seq, proof}")
        for how in ("renew", "release")
        for bad in (b"", b"\xc1", packed({"who": 5, "lease": 5}))
    ],
    ("r1", "acquire/*", packed({"who": "other"}), "its key has wildcards"),
    ("*", "takeover/other", packed({"who": "other"}), "its key has wildcards"),
    *[("*", how, lease(1, robot="*").question(how), "its key has wildcards") for how in ("renew", "release")],
    # A listener tells of refusals in nobody else's name
    *[("r1", f"refused/{at}", telling({"who": f"{at}.3"}), "does not begin with 'hq.'") for at in ("driver", "hq")],
    *[
        ("r1", "refused/hq.desk", telling({}, {"who": who}), "who")
        for who in ("driver", "hq.desk2.3", "hq.other.3", "")
    ],
    *[("r1", "refused/hq.desk", bad, "Refusals: ") for bad in (b"\xc1", packed({}), telling(*17 * [{}]))],
]


@pytest.mark.parametrize(("robot", "name", "payload", "reason"), REFUSED_QUESTIONS)
async def test_a_question_in_another_name_with_wildcards_or_malformed_is_refused(
    rig: Rig, robot: str, name: str, payload: bytes, reason: str
) -> None:
    (reply,) = rig.ask(f"control/{name}", payload, asked=f"fleet/{robot}/@rpc/control/{name}").replies
    assert isinstance(reply.error, Malformed)
    assert reason in str(reply.error)
    how, _, at = name.partition("/")
    bound = unquote(at) if at not in ("", "*") and robot == "r1" else "-"
    await rig.play(f"refused {bound} {how}: {reply.error}\n control held driver")


async def test_more_than_five_takeovers_a_second_are_refused_and_the_last_one_keeps_the_robot(rig: Rig) -> None:
    taken = [rig.ask("control/takeover/n", packed({"who": f"n.{number}"})).replies[0] for number in range(8)]
    assert [type(reply.error) for reply in taken] == [type(None)] * 5 + [RateLimited] * 3
    await rig.play("control held n.4\n refused n takeover: more than 5 takeovers a second x3\n 0.25")
    assert rig.ask("control/takeover/me%40here", packed({"who": "me@here"})).replies[0].error is None


async def test_what_a_listener_refused_its_programs_is_shown_with_who_command_code_reason_and_by_whom(rig: Rig) -> None:
    (reply,) = rig.ask("control/refused/hq.desk", telling({"count": 7}, {"who": "hq.desk.4"})).replies
    assert (reply.error, msgpack.unpackb(reply.payload)) == (None, {})
    rig.ask("control/refused/hq.desk", telling({"count": 5}))
    await rig.play("left 0.1 > left\n control held driver")
    told = {"command": "drive", "code": "neutral_first", "reason": "let go first", "by": "hq.desk"}
    assert rig.last("control")["refusals"] == [
        {"who": "hq.desk.4", "count": 1, **told},
        {"who": "hq.desk.3", "count": 12, **told},
    ]


async def test_tellings_are_bounded_and_so_is_what_they_say(rig: Rig) -> None:
    rig.ask("control/refused/hq.desk", telling({"reason": "r" * 10_000, "command": "c" * 10_000, "count": 2**60}))
    rig.ask("control/refused/hq.desk", telling({"code": "of tomorrow", "count": -5}))
    await asyncio.sleep(0.06)
    long, unknown = rig.last("control")["refusals"]
    assert (len(long["reason"]), len(long["command"]), long["count"]) == (200, 64, 1_000_000)
    assert (unknown["code"], unknown["count"]) == ("unsupported", 1)
    for number in range(200):
        last = rig.ask("control/refused/hq.desk", telling({"reason": f"reason {number}"}))
    assert isinstance(last.replies[0].error, RateLimited)
    await asyncio.sleep(0.06)
    codes = [entry["code"] for entry in rig.last("control")["refusals"]]
    assert (len(codes), codes.count("rate")) == (16, 1)
    await asyncio.sleep(1.0)
    assert rig.ask("control/refused/hq.desk", telling({})).replies[0].error is None


# Other refusals


@pytest.mark.parametrize(
    ("name", "fields", "reason", "sent"),
    [
        *[(name, {"on": True, "value": 1.0, "id": 1}, "no such command", "") for name in ("dance", "drive/fast")],
        *[(name, {"on": True, "id": 1}, "no such command", "") for name in ("light", "raw/other", "sensor/x")],
        ("camera", {"on": True}, "camera", ""),
        ("text", {"text": "x" * 5000}, "4096", ""),
        ("drive", {"left": 1.0, "turn": 0.5}, "turn", "left"),
        ("drive", b"\xc1", "Drive: MessagePack", ""),
        ("drive", b"\x01", "got `int`", ""),
        ("drive", {"forward": float("nan")}, "forward", ""),
        ("drive", {"forward": "fast"}, "forward", ""),
    ],
)
async def test_a_command_or_part_of_it_that_cannot_be_carried_out_is_refused_with_the_reason(
    rig: Rig, name: str, fields: dict[str, Any] | bytes, reason: str, sent: str
) -> None:
    rig.command(name, fields)
    who = "driver" if name in ("drive", "raw/other") else "-"
    await rig.play(f"0.1 > {sent}\n refused {who} {name}: {reason}")
    assert (rig.metrics.total("bus_messages", direction="in"), rig.metrics.total("refused")) == (1, 1)


async def test_a_scan_that_is_sent_to_the_robot_is_shown_on_the_bus(rig: Rig) -> None:
    await rig.play("scan > scan")
    assert rig.last("scan")["ranges"] == TWO_METRES


# What is written down, counted, and with which priority it is served


@pytest.mark.scene(hold=False, deadman_s=0.5)
async def test_the_audit_log_tells_who_drove_what_was_refused_and_what_stopped_the_robot(rig: Rig) -> None:
    rig.hold(priority=2)
    await rig.play("other:acquire left 1 neutral left other:takeover other:release acquire other:stop lost")
    assert rig.audited == [
        {"event": "acquired", "who": "driver", "priority": 2},
        {"event": "refused", "who": "other", "command": "acquire", "reason": "held by driver (priority 2)"},
        {"event": "stopped", "who": "driver", "reason": "deadman", "stops": True},
        {"event": "ended", "who": "driver", "reason": "taken over by other", "stops": True},
        {"event": "taken over", "who": "other", "priority": 0},
        {"event": "released", "who": "other", "reason": "released"},
        {"event": "acquired", "who": "driver", "priority": 0},
        {"event": "stopped", "who": "driver", "reason": "stop", "stops": True},
        {"event": "stopped", "reason": "robot lost"},
    ]
    assert {json.loads(line)["robot"] for line in rig.audit_lines} == {"r1"}
    counted = {(name, labels[0][1]): value for name, labels, value in rig.metrics if name in ("lease_changes", "stops")}
    changes = {"acquired": 2, "ended": 1, "taken_over": 1, "released": 1}
    causes = {**dict.fromkeys(StopCause, 0), "deadman": 1, "taken_over": 1, "command": 1, "robot_lost": 1}
    assert counted == {("lease_changes", change): count for change, count in changes.items()} | {
        ("stops", cause): count for cause, count in causes.items()
    }


def gate(rig: Rig, path: str) -> Callable[..., PriorityClass | None]:
    """Return the admission filter of a key; the key has one of its own."""
    priority = rig.bus.priorities[f"fleet/r1/{path}"]
    assert not isinstance(priority, PriorityClass)
    return priority


async def test_the_holders_commands_and_questions_wait_for_nobody_elses_and_a_stop_for_nothing(rig: Rig) -> None:
    commands, held = gate(rig, "@cmd/**"), rig.driver.held
    assert held is not None
    proven = held.attachment("drive", b"")
    priorities = [commands("fleet/r1/@cmd/drive", attachment, 60, bytes) for attachment in (None, proven, proven)]
    assert priorities == [PriorityClass.OTHER, PriorityClass.COMMAND, PriorityClass.OTHER]
    assert (
        commands("fleet/r1/@cmd/stop", None, 0, bytes)
        is commands("fleet/*/@cmd/stop", None, 0, bytes)
        is PriorityClass.STOP
    )
    for key in ("@rpc/control/renew", "@rpc/control/release"):
        assert (
            gate(rig, key)(f"fleet/r1/{key}", held.question(key.rpartition("/")[2]), 60, bytes) is PriorityClass.COMMAND
        )
    for key in ("@rpc/control/acquire/", "@rpc/control/takeover/"):
        assert gate(rig, f"{key}*")(f"fleet/r1/{key}me", packed({"who": "me"}), 10, bytes) is PriorityClass.OTHER


async def test_what_the_gates_keep_back_is_shown_once_a_second_and_counted_like_any_refusal(rig: Rig) -> None:
    commands, acquires = gate(rig, "@cmd/**"), gate(rig, "@rpc/control/acquire/*")
    passed = [commands("fleet/r1/@cmd/drive", None, 10, bytes) for _ in range(1000)].count(PriorityClass.OTHER)
    asked = [acquires("fleet/r1/@rpc/control/acquire/n", b"", 0, bytes) for _ in range(1000)].count(PriorityClass.OTHER)
    for _ in range(2):  # shown and counted once
        await asyncio.sleep(1.1)
        kept_back = [
            (each["who"], each["command"], each["code"], each["count"]) for each in rig.last("control")["refusals"]
        ]
        assert kept_back == [(None, "commands", "no_lease", 1000 - passed), (None, "acquire", "rate", 1000 - asked)]
        assert rig.metrics.total("refused") == 2000 - passed - asked


async def test_a_stop_right_after_a_stop_is_not_carried_out_again(rig: Rig) -> None:
    priority, stop = gate(rig, "@cmd/**"), ("fleet/r1/@cmd/stop", None, 0, bytes)
    await rig.play("stop")
    assert priority(*stop) is None
    await asyncio.sleep(1.1)
    assert priority(*stop) is PriorityClass.STOP
    assert rig.metrics.total("stops_folded") == 1


async def test_refusals_are_gathered_before_control_shows_them(rig: Rig) -> None:
    before = len(rig.values("control"))
    await rig.play("100*dance")
    assert len(rig.values("control")) == before
    await rig.play("refused - dance: no such command x100")
    assert (len(rig.values("control")), rig.metrics.total("refused")) == (before + 1, 100)


# Questions for the robot


async def test_all_who_ask_are_answered_with_what_the_robot_sends_and_it_is_asked_once(rig: Rig) -> None:
    poses, (for_map,) = [rig.ask("pose"), rig.ask("pose")], [rig.ask("map")]
    await asyncio.sleep(0.1)
    assert rig.written() == [bytes.fromhex("02000000 02 36"), bytes.fromhex("02000000 02 34")]
    rig.sends(POSITION)
    rig.sends(POSITION)
    assert [[msgpack.unpackb(reply.payload) for reply in each.replies] for each in poses] == [[rig.last("pose")]] * 2
    assert for_map.replies == []
    rig.sends(MAP)
    assert [msgpack.unpackb(reply.payload) for reply in for_map.replies] == [rig.last("map")]
    rig.written()
    lost = rig.ask("map")
    assert len(rig.written()) == 1, "the next one asks anew"
    rig.goes()
    assert [str(reply.error) for reply in lost.replies] == ["the robot was lost"]


async def test_a_question_that_the_robot_cannot_be_asked_is_refused_at_once() -> None:
    async with serving() as rig:
        await rig.play("announces_nothing established")
        assert "slam_map" in str(rig.ask("map").replies[0].error)
        await rig.play("unreachable lost")
        assert str(rig.ask("map").replies[0].error) == "offline"


# Leave-taking


@pytest.mark.parametrize(
    ("acts", "stops", "least_s", "most_s"),
    [
        ("left 0.1 > left", "stop x10-17", 1.0, 1.7),
        ("autonomous 0.1 > autonomous", "none stop x10-17", 1.0, 1.7),
        ("left 0.1 neutral > left stop", "stop x4", 1.0, 1.1),
        ("0 >", "", 0.0, 0.1),
    ],
    ids=["moving", "autonomous", "just stopped", "standing"],
)
async def test_a_robot_that_moves_is_stopped_before_the_gateway_ends(acts, stops, least_s, most_s) -> None:
    async with established(deadman_s=60.0) as rig:
        await rig.play(acts)
        start = rig.loop.time()
    assert least_s <= rig.loop.time() - start <= most_s
    await rig.play(f"0 > {stops}")
    assert rig.link.closed
    assert (rig.last("status")["state"], rig.last("status")["reason"]) == ("offline", "gateway stopped")
    assert "robot lost" not in [line.get("reason") for line in rig.audited]
    assert await rig.hq.ask("fleet/r1/@rpc/control/acquire/ann", packed({"who": "ann"})) == []
    shown_last = rig.last("control")
    await rig.play("stop 1")
    assert rig.last("control") == shown_last, "the robot's keys are left to others"


async def test_a_gateway_that_ends_ends_the_lease_and_gives_none_any_more_although_it_is_cancelled_again() -> None:
    rig = Rig(deadman_s=60.0)
    task = asyncio.create_task(rig.device.run())
    await rig.establish()
    await rig.play("acquire left 0.1 > left")
    task.cancel()
    await rig.play("0 0 0 0 0 > stop")
    for name in ("acquire/driver", "takeover/driver", "renew", "release"):
        (reply,) = rig.ask(f"control/{name}", packed({"who": "driver"})).replies
        assert (str(reply.error), getattr(reply.error, "code", None)) == ("gateway stopped", "closing")
    await rig.play("neutral turn\n control stopped")
    assert rig.audited[-2:] == [
        {"event": "stopped", "who": "driver", "reason": "gateway stopped", "stops": True},
        {"event": "refused", "who": "driver", "command": "drive", "reason": "the lease has ended (gateway stopped)"},
    ]
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await asyncio.sleep(2.0)
    assert set(rig.written()) <= {STOP}
    assert (rig.link.closed, rig.last("status")["reason"]) == (True, "gateway stopped")


# Faults of the protocol's own code


def raise_key_error(*arguments: object) -> None:
    raise KeyError(1)


KEY_ERROR = r"a fault of the protocol: KeyError: 1 in \S+ \(test_device.py:\d+\)"
NO_OUTCOME = r"a fault of the protocol: TypeError: RobotSide.command returned no Outcome in \S+ \(commands.py:\d+\)"


@pytest.mark.parametrize(
    ("method", "fault", "command", "said"),
    [
        ("command", raise_key_error, "left", KEY_ERROR),
        ("command", raise_key_error, "lidar", KEY_ERROR),
        ("command", lambda *arguments: None, "left", NO_OUTCOME),
        ("stop", raise_key_error, "stop", KEY_ERROR),
    ],
)
async def test_a_fault_of_the_protocol_in_a_command_or_stop_is_a_refusal_and_is_logged_once(
    rig: Rig, method: str, fault: Callable[..., None], command: str, said: str, monkeypatch, caplog
) -> None:
    monkeypatch.setattr(TcpUdpRobot, method, fault)
    await rig.play(f"3*{command} >")
    ((refused, reason, count),) = await rig.refusals()
    assert (refused, count) == (COMMANDS[command][0], 3)
    assert re.fullmatch(said, reason)
    assert rig.last("control")["refusals"][0]["code"] == "unsupported"
    assert len([record for record in caplog.records if record.exc_info]) == 1
    assert rig.last("status")["reason"] == (f"cannot be stopped: {reason}" if method == "stop" else None)


async def test_a_fault_of_the_protocol_in_a_question_is_its_answer(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(TcpUdpRobot, "known", raise_key_error)
    (reply,) = await rig.hq.ask("fleet/r1/@rpc/map")
    assert re.fullmatch(KEY_ERROR, str(reply.error))
