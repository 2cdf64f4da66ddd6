"""What a stop is: packet 13, in mode 3 the pair 1, 13; what it drops, what keeps it. Bytes from the protocol page."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable

import pytest

from gateways.tcpudp.session import HqRole
from gateways.tcpudp.translate import Options, TcpUdpRobot
from tests.gateways.tcpudp.frames import LISTED, SIZE_100_10, START, server_settings
from tests.robot.test_device import Program, Rig, established, serving
from zbridge.errors import Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Switch, Text
from zbridge.fleet.topics import Topic
from zbridge.protocol.session import State

pytestmark = pytest.mark.jumping

NONE, MANUAL, AUTONOMOUS = (bytes.fromhex(f"06000000 02 0a 0{mode}000000") for mode in (1, 2, 3))
STOP = bytes.fromhex("02000000 02 0d")
PAIR = [NONE, STOP]
LIDAR_ON, LIDAR_OFF = bytes.fromhex("06000000 02 32 01000000"), bytes.fromhex("06000000 02 32 02000000")
MOVE_LEFT = bytes.fromhex("0e000000 02 0b 000080bf 00000000 0000803f")
MOVE_RIGHT = bytes.fromhex("0e000000 02 0b 0000803f 00000000 0000803f")
SETTINGS = {
    "1.1": server_settings(b"1.1", "0001010101", 2),
    "1.2": server_settings(b"1.2", "000101010101", 2),
    "1.3": server_settings(LISTED, "00010101010101" + SIZE_100_10, 2),
    "1.4": server_settings(LISTED + b",1.4", "00010101010101" + SIZE_100_10, 2),
}
NO_JOYSTICK = server_settings(LISTED, "00010001010101" + SIZE_100_10, 2)
each_version = pytest.mark.parametrize("version", SETTINGS)
misreading = pytest.mark.parametrize("version", ["1.1", "1.2"])


class Stage:
    """A robot with an established session since second 0, and what leaves it when; acts may be chained."""

    def __init__(self, version: str = "1.3", options: Options | None = None) -> None:
        self.robot = TcpUdpRobot(options or Options())
        self.now = 0.0
        self.sent: list[tuple[float, bytes]] = []
        self.connect(SETTINGS[version])

    def connect(self, settings: bytes) -> None:
        """Connect, again if it was connected."""
        if self.now:
            self.session.lost("closed by peer")
        self.session: HqRole = self.robot.session("robot", "tcp://robot.test:1")
        self.session.open(self.now)
        self.session.receive(settings, self.now)
        self.session.outgoing(self.now)
        self.now += 1.0

    def until(self, now: float) -> list[bytes]:
        """Let time pass; give what left meanwhile."""
        before = len(self.sent)
        while True:
            frame = self.session.outgoing(self.now)
            if frame is not None:
                self.sent.append((self.now, bytes(frame)))
                continue
            due = self.session.deadline()
            if due is None or due > now:
                break
            self.now = max(self.now, due)
            self.session.expire(self.now)
        self.now = now
        return [frame for _, frame in self.sent[before:]]

    def after(self, seconds: float) -> list[bytes]:
        return self.until(self.now + seconds)

    def command(self, topic: Topic, command: FleetMessage) -> Stage:
        self.robot.command(topic, command, self.now)
        return self

    def mode(self, mode: str) -> Stage:
        return self.command(topics.CMD_MODE, Mode(mode=mode))  # type: ignore[arg-type]

    def lidar(self, on: bool) -> Stage:
        return self.command(topics.CMD_LIDAR, Switch(on=on))

    def drive(self, left: float = 0.0) -> Stage:
        return self.command(topics.CMD_DRIVE, Drive(left=left))

    def text(self) -> Stage:
        return self.command(topics.CMD_TEXT, Text(text="hi"))

    def stop(self, for_s: float = 1.0) -> Stage:
        self.robot.stop(self.now, self.now + for_s)
        return self


def in_3(version: str = "1.3", seconds: float = 0.1, options: Options | None = None) -> Stage:
    """A robot that was sent mode 3 so many seconds ago."""
    stage = Stage(version, options).mode("autonomous")
    stage.after(seconds)
    return stage


def pairs(frames: list[bytes]) -> int:
    """Count the pairs that frames are; nothing else may be among them."""
    assert frames == PAIR * (len(frames) // 2)
    return len(frames) // 2


# Mode 3: every stop is the pair, until another mode is commanded


@each_version
def test_a_robot_that_was_never_in_mode_3_is_never_sent_a_1(version: str) -> None:
    stage = Stage(version)
    for act in (
        stage.stop,
        stage.drive,
        lambda: stage.mode("manual"),
        stage.stop,
        lambda: stage.drive(1.0),
        stage.stop,
    ):
        act()
        assert NONE not in stage.after(1.5)


@each_version
def test_a_stop_in_mode_3_is_the_pair_quick_and_repeated_until_another_mode_is_sent(version: str) -> None:
    stage = Stage(version).mode("autonomous")
    assert set(stage.after(1.0)) == {AUTONOMOUS}
    start = stage.now
    assert 9 <= pairs(stage.stop().after(3.0)) <= 11
    times = [at for at, frame in stage.sent if at >= start]
    assert times[:2] == [start, pytest.approx(start + 0.01)]
    assert all(second - first >= 0.00999 for first, second in itertools.pairwise(times))
    assert pairs(stage.stop().after(0.35)) == 4, "the 1 of a stop is no other mode"
    assert pairs(stage.stop().after(3.0)) >= 9


@each_version
def test_a_routine_stop_is_sent_exactly_once_and_ends_motion_that_still_stood(version: str) -> None:
    for stage, stop in ((in_3(version, 1.0), PAIR), (Stage(version), [STOP])):
        for _ in range(3):
            assert stage.stop(0.0).after(1.0) == stop
    stage = Stage(version).drive(1.0)
    stage.after(0.1)
    assert stage.stop(0.0).after(3.0) == [STOP]


def test_after_another_mode_a_stop_is_13_alone_again_and_mode_3_that_comes_again_is_mode_3_again() -> None:
    stage = Stage()
    for mode, frame in (("none", NONE), ("manual", MANUAL)):
        assert stage.mode("autonomous").after(0.1) == [AUTONOMOUS]
        assert pairs(stage.stop().after(2.0)) >= 9
        assert stage.mode(mode).after(0.1) == [frame]
        assert set(stage.stop().after(2.0)) == {STOP}
        assert stage.mode("autonomous").after(0.1) == [AUTONOMOUS]
        assert stage.mode(mode).after(0.1) == [frame]
        assert set(stage.stop().after(2.0)) == {STOP}


def test_after_a_reconnection_it_is_the_pair_and_never_a_3() -> None:
    stage = in_3()
    for _ in range(3):
        stage.connect(SETTINGS["1.3"])
        assert pairs(stage.stop().after(3.0)) >= 9
    stage.mode("none")
    stage.connect(SETTINGS["1.3"])
    assert pairs(stage.stop().after(3.0)) >= 9, "the other mode did not leave before the connection ended"
    assert [frame for _, frame in stage.sent].count(AUTONOMOUS) == 1


def test_a_3_that_still_waits_when_the_stop_comes_never_leaves_and_no_1_either() -> None:
    stage = Stage().text()
    assert len(stage.after(0.0)) == 1
    assert set(stage.mode("autonomous").stop().after(3.0)) == {STOP}


def test_another_mode_that_still_waits_when_the_stop_comes_leaves_behind_the_pair() -> None:
    assert in_3(seconds=0.0).mode("manual").stop().after(0.05) == [*PAIR, MANUAL]


def test_the_mode_of_the_next_holder_is_not_undone_by_the_stop_before_it() -> None:
    stage = in_3()
    assert pairs(stage.stop().after(0.05)) == 1
    assert sorted(stage.mode("manual").after(0.02)) == sorted([MANUAL, STOP])
    rest = stage.after(3.0)
    assert set(rest) == {STOP}
    assert 8 <= len(rest) <= 10, "for the rest of the second"


def test_a_stop_ends_where_the_next_holder_lets_the_robot_move_by_itself() -> None:
    stage = in_3()
    assert pairs(stage.stop().after(0.05)) == 1
    assert stage.mode("autonomous").after(3.0) == [AUTONOMOUS]


@pytest.mark.parametrize(("mode", "frame"), [("manual", MANUAL), ("autonomous", AUTONOMOUS)])
def test_the_mode_of_a_holder_who_drives_does_not_end_its_drive(mode: str, frame: bytes) -> None:
    stage = Stage().stop()
    stage.after(0.05)
    stage.drive(1.0).after(0.05)
    assert set(stage.mode(mode).after(1.0)) == {frame, MOVE_LEFT}


def test_neutral_in_mode_3_is_a_stop() -> None:
    stage = in_3()
    assert stage.drive().after(0.02) == PAIR
    assert pairs(stage.after(3.0)) in (3, 4)
    assert stage.drive().drive(1.0).after(0.05) == [*PAIR, MOVE_LEFT]


def test_neutral_after_another_mode_was_commanded_is_13_alone_although_that_mode_still_waits() -> None:
    stage = in_3(seconds=0.0).mode("manual").drive()
    assert sorted(stage.after(0.1)) == sorted([MANUAL, STOP])
    assert set(stage.stop().after(2.0)) == {STOP}


@pytest.mark.parametrize(
    ("force", "sent"), [((13,), [STOP]), ((10,), [NONE]), (("joystick",), PAIR)], ids=["13", "10", "both"]
)
def test_of_the_pair_only_what_the_robot_may_be_sent(force: tuple[str | int, ...], sent: list[bytes]) -> None:
    stage = in_3(options=Options(force=force))  # type: ignore[arg-type]
    stage.connect(NO_JOYSTICK)
    assert stage.stop(0.0).after(1.0) == sent


def test_a_robot_that_may_be_sent_neither_refuses_the_stop() -> None:
    stage = in_3()
    stage.connect(NO_JOYSTICK)
    with pytest.raises(Refused, match="does not announce joystick"):
        stage.stop()


# On whatever cause


async def in_mode_3(rig: Rig) -> None:
    rig.command("mode", {"mode": "autonomous"})
    await asyncio.sleep(0.1)
    assert rig.written() == [AUTONOMOUS]


async def stopped_by_command(rig: Rig) -> None:
    rig.driver.put("stop", {}, None)


async def stopped_by_deadman(rig: Rig) -> None:
    rig.command("drive", {"left": 1.0})
    await asyncio.sleep(1.9)
    assert set(rig.written()) == {MOVE_LEFT}
    await asyncio.sleep(0.1)


async def stopped_by_neutral(rig: Rig) -> None:
    rig.command("drive", {})


async def stopped_by_release(rig: Rig) -> None:
    assert rig.driver.release()["ok"]


async def stopped_by_takeover(rig: Rig) -> None:
    assert Program(rig, "other").acquire("takeover")["ok"]


async def stopped_by_expiry(rig: Rig) -> None:
    rig.freeze(1e7)
    assert not rig.driver.renew()["ok"]


async def stopped_by_reconnection(rig: Rig) -> None:
    rig.goes()
    await asyncio.sleep(2.0)
    rig._read = 0  # the new link's
    rig.sends(SETTINGS["1.3"])


@pytest.mark.parametrize(
    "stopped",
    [
        stopped_by_command,
        stopped_by_deadman,
        stopped_by_neutral,
        stopped_by_release,
        stopped_by_takeover,
        stopped_by_expiry,
        stopped_by_reconnection,
    ],
)
async def test_whatever_stops_a_robot_in_mode_3_sends_the_pair(stopped: Callable[[Rig], object]) -> None:
    async with established() as rig:
        await in_mode_3(rig)
        await stopped(rig)  # type: ignore[misc]
        await asyncio.sleep(0.95)
        sent = rig.written()
        start = sent.index(NONE)
        assert not {NONE, STOP} & set(sent[:start])
        assert pairs(sent[start:]) >= 4


# The silence after packet 4


WITH_UDP = server_settings(LISTED, "01010101010101" + SIZE_100_10, 2)
ANSWER = bytes.fromhex("03000000 01 06 01")
TRUE = bytes.fromhex("03000000 02 07 01")


@pytest.mark.parametrize("who", ["stop", "nobody"])
async def test_a_stop_in_the_silence_is_kept_and_is_the_first_packet_after_it(who: str) -> None:
    async with serving() as rig:
        await rig.settle()
        rig.sends(WITH_UDP + START)
        rig.conversations[-1].received_datagram(ANSWER)
        start = rig.loop.time()
        await asyncio.sleep(1.0)
        if who == "stop":
            rig.driver.put("stop", {}, None)
            rig.hold()
        await asyncio.sleep(1.45)
        rig.command("drive", {"left": 1.0})
        rig.command("mode", {"mode": "manual"})
        rig.command("lidar", {"on": True})
        assert [frame[5] for frame in rig.link.written] == [3, 7]
        assert rig.link.written[1] == TRUE
        await asyncio.sleep(1.5)
        assert rig.link.times[2] == pytest.approx(start + 2.5)
        assert set(rig.link.written[2:]) == {STOP}


async def test_commands_in_the_silence_are_refused_with_their_code_and_reason() -> None:
    async with serving() as rig:
        await rig.settle()
        rig.sends(WITH_UDP + START)
        await asyncio.sleep(2.4)
        for name, fields in (
            ("drive", {"left": 1.0}),
            ("drive", {}),
            ("mode", {"mode": "manual"}),
            ("lidar", {"on": True}),
        ):
            rig.command(name, fields)
        await asyncio.sleep(0.06)
        refusals = rig.last("control")["refusals"]
        assert {(refusal["code"], refusal["reason"]) for refusal in refusals} == {("not_ready", "handshaking")}
        assert sum(refusal["count"] for refusal in refusals) == 4
        assert rig.last("status")["state"] == "handshaking"
        (reply,) = rig.ask("pose").replies
        assert str(reply.error) == "handshaking"


@pytest.mark.parametrize("stopped_in_silence", [False, True])
async def test_after_a_reconnection_in_mode_3_the_pair_comes_first_after_the_silence(stopped_in_silence: bool) -> None:
    async with established() as rig:
        await in_mode_3(rig)
        rig.goes()
        await asyncio.sleep(2.0)
        rig.sends(WITH_UDP + START)
        await asyncio.sleep(1.0)
        if stopped_in_silence:
            rig.driver.put("stop", {}, None)
        await asyncio.sleep(2.0)
        assert [frame[5] for frame in rig.link.written[:2]] == [3, 7]
        assert pairs(rig.link.written[2:]) >= 4


def test_a_stop_in_a_silence_that_comes_late_is_kept_too() -> None:
    stage = Stage()
    stage.session.receive(START, stage.now)
    assert stage.session.busy == "handshaking"
    start = stage.now
    stage.after(0.1)
    stage.stop().until(start + 4.0)
    assert [(at >= start + 2.5, frame[5]) for at, frame in stage.sent][:2] == [(False, 7), (True, 13)]
    assert stage.session.state is State.ESTABLISHED


# What is sent once and matters is sent again to robots that misread a tenth


@misreading
@pytest.mark.parametrize(
    ("topic", "command", "frame"),
    [
        (topics.CMD_MODE, Mode("none"), NONE),
        (topics.CMD_MODE, Mode("manual"), MANUAL),
        (topics.CMD_MODE, Mode("autonomous"), AUTONOMOUS),
        (topics.CMD_LIDAR, Switch(True), LIDAR_ON),
        (topics.CMD_LIDAR, Switch(False), LIDAR_OFF),
    ],
)
def test_mode_and_lidar_are_sent_again_after_three_tenths_of_a_second(version, topic, command, frame) -> None:
    stage = Stage(version)
    start = stage.now
    stage.command(topic, command).after(5.0)
    assert stage.sent == [(start, frame), (pytest.approx(start + 0.3), frame)]


@pytest.mark.parametrize("version", ["1.3", "1.4"])
def test_robots_that_read_well_are_sent_them_once(version: str) -> None:
    assert Stage(version).mode("manual").lidar(True).after(5.0) == [MANUAL, LIDAR_ON]


@misreading
def test_a_newer_one_replaces_the_repetition_of_the_older(version: str) -> None:
    stage = Stage(version).mode("autonomous").lidar(True)
    stage.after(0.2)
    assert stage.mode("manual").lidar(False).after(5.0) == [MANUAL, LIDAR_OFF, MANUAL, LIDAR_OFF]


@misreading
@pytest.mark.parametrize("mode", ["none", "manual", "autonomous"])
def test_a_stop_drops_what_was_to_be_sent_again(version: str, mode: str) -> None:
    stage = Stage(version).mode(mode).lidar(True)
    stage.after(0.2)
    sent = stage.stop().after(5.0)
    if mode == "autonomous":
        assert pairs(sent) >= 9
    else:
        assert set(sent) == {STOP}


@misreading
def test_a_routine_stop_drops_no_repetition_but_that_of_a_3(version: str) -> None:
    """Else one in three would be lost to the stop that comes once a second."""
    stage = Stage(version).mode("manual").lidar(True)
    stage.after(0.2)
    assert stage.stop(0.0).after(0.5) == [STOP, MANUAL, LIDAR_ON]
    stage.mode("autonomous").after(0.2)
    assert stage.stop(0.0).after(5.0) == PAIR


@misreading
def test_a_neutral_lets_a_mode_be_sent_again_but_never_a_3(version: str) -> None:
    stage = Stage(version).mode("manual")
    stage.after(0.2)
    assert MANUAL in stage.drive().after(0.2)
    stage.mode("autonomous").after(0.2)
    assert pairs(stage.drive().after(5.0)) >= 4


@misreading
def test_a_robot_that_may_have_misread_another_mode_is_stopped_by_the_pair(version: str) -> None:
    stage = in_3(version, 1.0)
    stage.mode("manual").after(0.2)
    assert pairs(stage.stop().after(2.0)) >= 9
    stage.mode("manual").after(1.0)
    assert set(stage.stop().after(2.0)) == {STOP}


@misreading
def test_a_lidar_mode_that_still_waits_when_the_stop_comes_is_sent(version: str) -> None:
    stage = Stage(version).text()
    stage.after(0.0)
    assert stage.lidar(True).stop().after(5.0).count(LIDAR_ON) == 1


def test_what_was_to_be_sent_again_is_not_sent_on_the_next_connection() -> None:
    stage = Stage("1.1").mode("manual").lidar(True)
    stage.after(0.1)
    stage.connect(SETTINGS["1.1"])
    assert stage.after(5.0) == []
