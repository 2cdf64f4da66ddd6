"""What is repeated, and what a stop is: packet 13, after a mode 3 a pair; what it drops, what keeps it."""

from __future__ import annotations

import asyncio
import re

import pytest

from gateways.tcpudp.options import TcpUdpOptions
from tests.gateways.tcpudp.frames import LISTED, LISTED_14, START, Stage, server_settings
from tests.robot.test_device import Program, Rig, established, serving
from zbridge.errors import Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, Mode, Switch, Text

pytestmark = pytest.mark.jumping

NONE, AUTONOMOUS = bytes.fromhex("06000000 02 0a 01000000"), bytes.fromhex("06000000 02 0a 03000000")
MANUAL = bytes.fromhex("06000000 02 0a 02000000")
STOP = bytes.fromhex("02000000 02 0d")
PAIR = [NONE, STOP]
SETTINGS = {
    "1.1": server_settings(b"1.1", "0001010101", 2),
    "1.2": server_settings(b"1.2", "000101010101", 2),
    "1.3": server_settings(LISTED, "00010101010101", 2),
    "1.4": server_settings(LISTED_14, "00010101010101", 2),
}
NO_JOYSTICK = server_settings(LISTED, "00010001010101", 2)
ACTS = {
    "none": (topics.CMD_MODE, Mode("none")),
    "manual": (topics.CMD_MODE, Mode("manual")),
    "auto": (topics.CMD_MODE, Mode("autonomous")),
    "left": (topics.CMD_DRIVE, Drive(left=1.0)),
    "right": (topics.CMD_DRIVE, Drive(left=-1.0)),
    "left_and_turn": (topics.CMD_DRIVE, Drive(left=1.0, turn=0.5)),
    "neutral": (topics.CMD_DRIVE, Drive()),
    "on": (topics.CMD_LIDAR, Switch(True)),
    "off": (topics.CMD_LIDAR, Switch(False)),
    "hi": (topics.CMD_TEXT, Text("hi")),
}
LETTERS = {
    "N": "06000000 02 0a 01000000",
    "M": "06000000 02 0a 02000000",
    "A": "06000000 02 0a 03000000",
    "S": "02000000 02 0d",
    "L": "0e000000 02 0b 000080bf 00000000 0000803f",
    "R": "0e000000 02 0b 0000803f 00000000 0000803f",
    "T": "06000000 02 0c 000000bf",
    "I": "06000000 02 32 01000000",
    "O": "06000000 02 32 02000000",
    "H": "08000000 02 01 02000000 6869",
    "7": "03000000 02 07 00",
}
"""Mode none, manual, autonomous; stop; left, right; turn; lidar on, off; "hi"; the 7 after a 4."""


def left(version: str, script: str, **options: object) -> str:
    """What leaves a robot, a letter for each packet; ``script``: acts, and seconds to wait ("+0.1") after them."""
    stage, letters = Stage(SETTINGS[version], TcpUdpOptions(**options)), ""  # type: ignore[arg-type]
    names = {bytes.fromhex(frame): letter for letter, frame in LETTERS.items()}
    for word in script.split():
        if word.startswith("+"):
            letters += "".join(names[frame] for frame in stage.after(float(word)))
        elif word in ("stop", "once"):  # a routine stop is sent once
            stage.robot.stop(stage.now, stage.now + (word == "stop"))
        elif word == "start":
            stage.timed.stream(START, stage.now)
        elif word == "reconnect":
            stage.connect(SETTINGS[version])
        elif word == "hand_over":
            stage.hand_over()
        else:
            stage.command(*ACTS[word])
    return letters


ALL, WELL, BADLY = tuple(SETTINGS), ("1.3", "1.4"), ("1.1", "1.2")
"""Robots of 1.1 and 1.2 misread a tenth: what is sent once and matters is sent to them again after 0.3 s."""

_TWICE = " neutral +0.01 neutral +0.19"
"""As a program of two wheels says it. A robot that reads every 0.1 s loses what comes 0.01 s apart."""

ROWS = {
    "motion is repeated every quarter of a second without end": (ALL, "left +2", "L{9}"),
    "neutral is 13 repeated for a second": (ALL, "left +0.01 neutral +4", "LS{5}"),
    "a neutral that is said all the time leaves evenly": (ALL, "left +0.01" + _TWICE * 10 + " +4", "LS{11,13}"),
    "and so does the pair of one": (BADLY, "auto +1 neutral" + _TWICE * 10 + " +4", "A+ NS (NS){6,10}"),
    "a stop goes before what waits and ends motion": (ALL, "left hi stop +3", "SHS{9,10}"),
    "a stop leaves before newer motion": (ALL, "left +0.001 stop +0.001 neutral +0.001 right +0.02", "LSR"),
    "a routine stop is sent exactly once and ends motion": (ALL, "left +0.1 once +3 once +3", "LSS"),
    "a late 4 is followed by silence": (("1.3",), "start +0.1 stop +2.39", "7"),
    "a stop in that silence is kept": (("1.3",), "start +0.1 stop +4", "7S+"),
    # once a 3 was written every stop is a pair: 2, 13 if mode manual was commanded last, else 1, 13
    "never in mode 3, never a 1": (ALL, "stop +2 neutral +2 manual +2 stop +2 left +2 stop +2", "[SML]*"),
    "the 1 of a stop is no other mode": (ALL, "auto +1 stop +3 stop +0.35 stop +3", "A+ pairs (NS){4} pairs"),
    "a routine stop is one pair": (ALL, "auto +1 once +1 once +1", "A+ NSNS"),
    "after mode 2": (WELL, "auto +0.1 stop +2 manual +0.1 stop +2 auto +0.1 stop +2", "A pairs M manuals A pairs"),
    "after mode 1": (WELL, "auto +0.1 stop +2 none +1 stop +2 auto +0.1 none +1 stop +2", "A pairs N pairs AN pairs"),
    "a routine stop long after mode 2": (WELL, "auto +0.1 manual +3600 once +1 once +1", "AM MSMS"),
    "a routine stop long after mode 1": (WELL, "auto +0.1 none +3600 once +1 once +1", "AN NSNS"),
    "a neutral in mode 2": (WELL, "auto +0.1 manual left +0.1 neutral +3 left +0.1", "A(ML|LM) (MS){4,5} L"),
    "never a 3 after a reconnection": (ALL, "auto +0.1 reconnect stop +3 reconnect stop +3", "A pairs pairs"),
    "after mode 2 and a reconnection": (WELL, "auto +0.1 manual +0.1 reconnect stop +3", "AM manuals"),
    "after mode 2 and a handover": (WELL, "auto +0.1 manual +0.1 hand_over stop +3 once +1", "AM manuals MS"),
    "after a handover and a reconnection": (WELL, "auto +0.1 hand_over reconnect stop +3", "A pairs"),
    "another mode did not leave before the connection ended": (ALL, "auto +0.1 none reconnect stop +3", "A pairs"),
    "a 3 that still waits never leaves and no 1 either": (ALL, "hi +0 auto stop +3", "H stops"),
    "another mode that still waits leaves behind the pair": (WELL, "auto +0 manual stop +0.05", "AMSM"),
    "the next holder's mode is not undone": (WELL, "auto +0.1 stop +0.05 manual +3", "A NS M?(MS){7,9}"),
    "a stop ends where the next holder lets the robot be": (WELL, "auto +0.1 stop +0.05 auto +3", "ANSA"),
    "the mode of a holder does not end its drive": (WELL, "stop +0.05 left +0.05 manual +1 auto +1", "SL ML{4} AL{4}"),
    "neutral in mode 3 is a stop": (WELL, "auto +0.1 neutral +0.02 +3 neutral left +0.05", "A NS (NS){3,4} NSL"),
    "neutral after another mode that waits": (WELL, "auto +0 manual neutral +0.1 stop +2", "A(MS)+M manuals"),
    # 1.1 and 1.2 ignore the first stop that they read alone after a stall, and some join what comes within 0.2 s
    "a routine stop to them is one packet": (BADLY, "left +0.1 once +3 once +3", "LSS"),
    "the next one continues where the one before was": (BADLY, "auto +1 once +0.12 once +1", "AA NS"),
    "its packets are an eighth of a second apart": (BADLY, "auto +1 once +0.13", "AA NS"),
    # what is sent again to robots that misread
    "robots that read well are sent it once": (WELL, "manual on +5", "MI"),
    "a newer one replaces the repetition": (BADLY, "auto on +0.2 manual off +5", "AI MO MO"),
    "a stop drops what was to be sent again": (BADLY, "manual on +0.2 stop +5", "MI stops"),
    "a stop drops a 3 that was to be sent again": (BADLY, "auto on +0.2 stop +5", "AI pairs"),
    # else one in three would be lost to the stop that comes once a second
    "a routine stop drops the repetition of a 3": (BADLY, "manual on +0.2 once +0.5 auto +0.2 once +5", "MI S MI A NS"),
    "neutral lets no 3 be sent again": (BADLY, "manual +0.2 neutral +2 auto +0.2 neutral +5", "MS MS{4} A(NS){4,5}"),
    "the pair where a mode may be misread": (
        BADLY,
        "auto +1 manual +0.2 stop +2 manual +1 stop +2",
        "AAM manuals MM manuals",
    ),
    "a lidar mode that still waits is sent": (BADLY, "hi +0 on stop +5", "H S?I S{9,10}"),
    "nothing is sent again on the next connection": (BADLY, "manual on +0.1 reconnect +5", "MI"),
}


@pytest.mark.parametrize(("versions", "script", "expected"), ROWS.values(), ids=ROWS)
def test_what_leaves_a_robot(versions: tuple[str, ...], script: str, expected: str) -> None:
    pairs = "{4,6}" if versions == BADLY else "{4,11}" if versions == ALL else "{9,11}"
    a_second = {"pairs": f"(NS){pairs}", "manuals": f"(MS){pairs}", "stops": "S{9,11}", " ": ""}
    for name, pattern in a_second.items():
        expected = expected.replace(name, pattern)
    for version in versions:
        assert re.fullmatch(expected, sent := left(version, script)), (version, sent)


@pytest.mark.parametrize("version", BADLY)
def test_mode_and_lidar_are_sent_again_after_three_tenths_of_a_second(version: str) -> None:
    for word, letter in {"none": "N", "manual": "M", "auto": "A", "on": "I", "off": "O"}.items():
        assert left(version, f"{word} +0.29") == letter
        assert left(version, f"{word} +0.31") == left(version, f"{word} +5") == letter * 2


def test_both_sends_translation_and_turn_in_turns_although_every_command_replaces_the_one_before() -> None:
    assert left("1.3", "left_and_turn +0.015625 " * 20, combine="both", gap_s=1 / 64) == "LT" * 10 + "L"


@pytest.mark.parametrize(
    ("force", "sent"),
    [((13,), [STOP]), ((10,), [NONE]), (("joystick",), PAIR), ((), None)],
    ids=["13", "10", "both", "neither"],
)
def test_of_the_pair_only_what_the_robot_may_be_sent(force: tuple[str | int, ...], sent: list[bytes] | None) -> None:
    stage = Stage(SETTINGS["1.3"], TcpUdpOptions(force=force))  # type: ignore[arg-type]
    stage.command(*ACTS["auto"])
    stage.after(0.1)
    stage.connect(NO_JOYSTICK)
    if sent is None:
        with pytest.raises(Refused, match="does not announce joystick"):
            stage.robot.stop(stage.now, stage.now)
    else:
        stage.robot.stop(stage.now, stage.now)
    assert stage.after(1.0) == (sent or [])


# On whatever cause


def pairs(frames: list[bytes]) -> int:
    """Count the pairs that frames are; nothing else may be among them."""
    assert frames == PAIR * (len(frames) // 2)
    return len(frames) // 2


async def in_mode_3(rig: Rig) -> None:
    rig.command("mode", {"mode": "autonomous"})
    await asyncio.sleep(0.1)
    assert rig.written() == [AUTONOMOUS]


async def stop_by(cause: str, rig: Rig) -> None:
    match cause:
        case "command":
            rig.driver.put("stop", {}, None)
        case "deadman":
            rig.command("drive", {"left": 1.0})
            await asyncio.sleep(2.0)
        case "neutral":
            rig.command("drive", {})
        case "release":
            assert rig.driver.release()["ok"]
        case "takeover":
            assert Program(rig, "other").acquire("takeover")["ok"]
        case "expiry":
            rig.freeze(1e7)
            assert not rig.driver.renew()["ok"]
        case "reconnection":
            rig.goes()
            await asyncio.sleep(2.0)
            rig.read_to = 0  # the new link's
            rig.sends(SETTINGS["1.3"])


@pytest.mark.parametrize("cause", ["command", "deadman", "neutral", "release", "takeover", "expiry", "reconnection"])
async def test_whatever_stops_a_robot_in_mode_3_sends_the_pair(cause: str) -> None:
    async with established() as rig:
        await in_mode_3(rig)
        await stop_by(cause, rig)
        await asyncio.sleep(0.95)
        sent = rig.written()
        start = sent.index(NONE)
        assert STOP not in sent[:start]
        assert pairs(sent[start:]) >= 4


# The silence after packet 4

WITH_UDP = server_settings(LISTED, "01010101010101", 2)


@pytest.mark.parametrize("who", ["stop", "nobody"])
async def test_a_stop_in_the_silence_is_the_first_packet_after_it_and_commands_are_refused(who: str) -> None:
    async with serving() as rig:
        await rig.settle()
        rig.sends(WITH_UDP + START)
        rig.conversations[-1].received_datagram(bytes.fromhex("03000000 01 06 01"))
        start = rig.loop.time()
        await asyncio.sleep(1.0)
        if who == "stop":
            rig.driver.put("stop", {}, None)
            rig.hold()
        await asyncio.sleep(1.39)
        for name, fields in {"drive": {"left": 1.0}, "mode": {"mode": "manual"}, "lidar": {"on": True}}.items():
            rig.command(name, fields)
        rig.command("drive", {})
        assert [reason for _, reason, _ in await rig.refusals()] == ["handshaking"] * 3
        assert {refusal["code"] for refusal in rig.last("control")["refusals"]} == {"not_ready"}
        assert rig.last("status")["state"] == "handshaking"
        assert [str(reply.error) for reply in rig.ask("pose").replies] == ["handshaking"]
        assert [frame[5] for frame in rig.link.written] == [3, 7]
        assert rig.link.written[1] == bytes.fromhex("03000000 02 07 01")
        await asyncio.sleep(1.5)
        assert rig.link.times[2] == pytest.approx(start + 2.5)
        assert set(rig.link.written[2:]) == {STOP}


async def test_after_a_reconnection_in_mode_3_the_pair_comes_first_after_the_silence() -> None:
    async with established() as rig:
        await in_mode_3(rig)
        rig.goes()
        await asyncio.sleep(2.0)
        rig.sends(WITH_UDP + START)
        await asyncio.sleep(3.0)
        assert [frame[5] for frame in rig.link.written[:2]] == [3, 7]
        assert pairs(rig.link.written[2:]) >= 4


@pytest.mark.parametrize(
    ("acts", "frames"),
    [
        ((), [STOP]),
        (("left",), [STOP]),
        (("manual",), [STOP]),
        (("auto",), PAIR),  # also before it is written
        (("auto", "manual"), [STOP]),  # neither is written
        (("auto", "+", "manual"), [MANUAL, STOP]),
        (("auto", "+", "none"), PAIR),
    ],
)
def test_the_frames_of_a_stop_are_told_and_change_nothing(acts: tuple[str, ...], frames: list[bytes]) -> None:
    stage, other = Stage(SETTINGS["1.3"]), Stage(SETTINGS["1.3"])
    for act in acts:
        for each in (stage, other):
            if act == "+":
                each.after(0.1)
            else:
                each.command(*ACTS[act])
    assert list(stage.robot.stop_frames()) == frames
    assert stage.after(2.0) == other.after(2.0)


def test_a_robot_that_may_not_be_sent_a_stop_has_no_frames_of_one() -> None:
    with pytest.raises(Refused):
        Stage(NO_JOYSTICK).robot.stop_frames()
