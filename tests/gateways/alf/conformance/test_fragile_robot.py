"""The fragile vehicle against a small HQ written by hand: every byte here is read off the protocol page."""

import asyncio
import contextlib
import logging
import random
import socket
import time
from collections import Counter
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gateways.alf.conformance import parser
from gateways.alf.conformance.fragile_hq import FragileAlfHq
from gateways.alf.conformance.fragile_robot import FragileVehicle, fragile_vehicle
from gateways.alf.conformance.machine import JudgedVehicle
from gateways.alf.conformance.parser import AlfTimes, Dialect, Repeats
from tests.captures import payloads
from tests.conformance.scene import LONG_S, Peer, serving, until
from tests.gateways.alf.conformance.scene import DIALECTS, MESSAGES, AlfScene, conversations
from zbridge.protocol import Address, Simulation

QUICK = AlfTimes(
    cycle_s=0.005, scan_s=0.02, info_s=0.05, first_s=5, gap_s=5, window_commands=0, flight_s=0.05, answer_s=0.15,
    close_s=0.15, motor_s=0.1,
)  # fmt: skip
"""As quick as a test, and patient where the rhythm is not what it is about."""
LASER: dict[str, Any] = {"laser": True, "drive": False}


# Messages


STANDARD = "not written as std::to_string prints integers"
UNKNOWN = ", of which this server knows nothing"


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"3|100|1|-90|1;", ""),
        (b"3|101|0|0|0;", "speed 101 instead of 0..100"),
        (b"3|-1|0|0|0;", "speed -1 instead of 0..100"),
        (b"3|0|0|-2147483648|0;", "steering angle -2147483648 instead of -90..90"),
        (b"3|0|2|0|0;", "direction 2 instead of 0..1"),
        (b"3|0|0|91|0;", "steering angle 91 instead of -90..90"),
        (b"3|0|0|0|2;", "light 2 instead of 0..1"),
        (b"3|0|0|0;", "3 fields instead of 4"),
        *((text, STANDARD) for text in (b"3|0.000000|0|0|0;", b"\n3|0|0|0|0;", b"\xff3|0|0|0|0;", b"3|+1|0|0|0;")),
        *((text, STANDARD) for text in (b"3|01|0|0|0;", b"3|0|0|-0|0;", b"3|0|0|0|true;", b"3|0||0|0;", b"3 0 0 0 0;")),
        (b"3|" + b"0" * 5000 + b"|0|0|0;", STANDARD),
        (b"hello;", "a message without a number"),
        *((b"%d|0|0;" % number, f"id {number}{UNKNOWN}") for number in (1, 2, 4, 0, -3)),
        (b"255|0;", "end 0 instead of 1"),
        (b"255|1|1;", "2 fields instead of 1"),
        (b"3|2147483648|0|0|0;", "deadly: an integer over 2^31-1, 2147483648"),
        (b"3|0|0|-2147483649|0;", "deadly: an integer over 2^31-1, -2147483649"),
        (b"3|0|0|0|" + b"9" * 5000 + b";", "deadly: an integer over 2^31-1, 99999999999999999999"),
        (b"3|.5|0|0|0;", "deadly: a number without leading digit, .5"),
        (b"3|0|0|-.5|0;", "deadly: a number without leading digit, -.5"),
        (b"3|" * 32769, "deadly: a message without end, 65538 bytes"),
        (b"\x03\x64\x01\xb4\x01", ""),
        (b"\x03\xff\x00\x5a\x00", ""),  # counts as 100
        (b"\x03\x00\x02\x5a\x00", "direction 2 instead of 0..1"),
        (b"\x03\x00\x00\xb5\x00", "steering angle 181 instead of 0..180"),
        (b"\x03\x00\x00\x5a\x02", "light 2 instead of 0..1"),
        (b"\xff\x00", "end 0 instead of 1"),
        *((bytes([number, 0]), f"deadly: id {number}{UNKNOWN}: the framing is lost") for number in (0, 1, 2, 4, 51)),
    ],
)
def test_what_is_wrong_in_a_message_is_told_and_whether_it_kills_a_vehicle(data: bytes, problem: str) -> None:
    (heard,) = parser.CommandReader("text" if data[-1:] in b";|" else "binary", {3, 255}).take(data)
    assert (heard.deadly, heard.problem) == (problem.startswith("deadly: "), problem.removeprefix("deadly: "))


def test_full_speed_is_a_hundred_and_a_laser_knows_no_commands() -> None:
    drive, laser = parser.CommandReader("text", {3, 255}), parser.CommandReader("text", {255})
    told = [one.problem for one in drive.take(b"3|100|0|0|0;3|101|0|0|0;") + laser.take(b"3|0|0|0|0;")]
    assert told == ["", "speed 101 instead of 0..100", f"id 3{UNKNOWN}"]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_the_cut_does_not_depend_on_the_reads_and_random_bytes_never_make_the_judge_raise(dialect: Dialect) -> None:
    messages = [MESSAGES[name][dialect] for name in ("GOOD", "FORWARD", "END")]
    data = b"".join(messages)
    for size in range(1, len(data)):
        reader = parser.CommandReader(dialect, {3, 255})
        heard = [one for at in range(0, len(data), size) for one in reader.take(data[at : at + size])]
        assert [one.raw for one in heard] == messages
        assert not any(one.problem for one in heard)
        assert reader.rest == b""
    rng = random.Random(5)
    for _ in range(300):
        reader = parser.CommandReader(dialect, {3, 255})
        assert all(one.raw for one in reader.take(bytes(rng.choices(b"0123459|;.-\xff\x03", k=60))))


# The rhythm of the commands


@pytest.mark.parametrize(
    ("times", "commands", "problems"),
    [
        (AlfTimes(), [1] * 500, {}),
        (AlfTimes(), [1, 0] * 250, {}),
        (AlfTimes(), [1] * 5 + [0] * 100 + [1] * 100, {10: "no drive command for 0.12 s"}),
        (AlfTimes(), [0] * 20, {12: "no drive command for 0.26 s"}),
        (AlfTimes(cycle_s=0.03125), [1, 0] * 32, dict.fromkeys((31, 63), "16 drive commands in 1.00 s")),
    ],
    ids=["every 20 ms", "every 40 ms", "a gap is noted once", "the first has more time", "every 62 ms"],
)
def test_a_rhythm_that_is_too_slow_is_noted(times: AlfTimes, commands: list[int], problems: dict[int, str]) -> None:
    repeats = Repeats(times)
    told = [repeats.cycle(times.cycle_s, count) for count in commands]
    assert {cycle: problem for cycle, problem in enumerate(told) if problem} == problems


def test_the_recorded_hq_is_not_reproached() -> None:
    reader, repeats = parser.CommandReader("text", {3, 255}), Repeats(AlfTimes())
    records = payloads("alf-drive.hex", destination=16668)
    heard = [(record.seconds, one.problem) for record in records for one in reader.take(record.payload)]
    assert [problem for _, problem in heard] == [""] * 115
    cycles = Counter(int(seconds / 0.02) for seconds, _ in heard)
    assert not any(repeats.cycle(0.02, cycles[number]) for number in range(116))


def test_any_number_of_points_has_its_valid_indices_inside_and_a_seed_gives_the_same_measurement() -> None:
    for points in (1, 10, 726, 1081):
        one, two = (JudgedVehicle(random.Random(5), points).measure() for _ in range(2))
        assert one == two
        assert len(one) == points + 2
        assert 0 <= one[-2] <= one[-1] < points


# Conversations


class Hq(AlfScene):
    """The few habits of an HQ that behaves."""

    async def repeat(self, words: str) -> None:
        """Send this for so many seconds every 20 ms."""
        text, _, seconds = words.rpartition(" ")
        end = time.monotonic() + float(seconds)
        while time.monotonic() < end:
            await self.send(text)
            await asyncio.sleep(0.02)

    async def send_until_noted(self, text: str) -> None:
        """Send it again and again: nobody knows how late the vehicle's own time is."""
        async with asyncio.timeout(LONG_S):
            while not self.judge.violations:
                await self.send(text)
                await asyncio.sleep(QUICK.cycle_s)

    async def read(self) -> list[str]:
        """Read the fields of a text message, the id first."""
        data = b""
        while not data.endswith(b";"):
            data += await self.peer.read(1)
        return data[:-1].decode("ascii").split("|")

    async def kind(self, kind: str) -> None:
        """Read until a text message of this id."""
        while (await self.read())[0] != kind:
            pass

    async def ended(self, _: str) -> None:
        with pytest.raises((EOFError, ConnectionError)):
            await self.kind("255")

    async def cut(self, _: str) -> None:
        await self.judge.cut()

    async def stall(self, seconds: str) -> None:
        """Keep the whole process from running."""
        time.sleep(float(seconds))  # noqa: ASYNC251


@contextlib.asynccontextmanager
async def connected(vehicle: FragileVehicle) -> AsyncIterator[Hq]:
    async with serving(vehicle, Peer, Hq) as hq:
        await hq.connect("")
        yield hq


def quick(dialect: Dialect = "text", **options: Any) -> FragileVehicle:
    return FragileVehicle(dialect, **{"laser": False, "drive": True, "times": QUICK, **options})


async def played(options: dict[str, Any], steps: list[str]) -> None:
    async with connected(quick(**options)) as hq:
        await hq.play(steps)


OPTIONS: dict[str, dict[str, Any]] = {
    "binary": {"dialect": "binary"},
    "laser": LASER,
    "both": {"laser": True},
    "deployed": {"times": AlfTimes()},
    "eager": {"times": AlfTimes(first_s=0.06)},
    "strict": {"times": AlfTimes(gap_s=0.05)},
    "patient": {"times": AlfTimes(cycle_s=0.005, scan_s=0.0, first_s=50, send_s=0.1), "points": 100_000},
    "hasty": {"times": AlfTimes(first_s=0.05, gap_s=0.05, window_s=0.1)},
}


@conversations(
    """
a wrong command, which is survived: > GOOD / say 3|101|0|0|0; / > GOOD / heard 3
    / !! speed 101 instead of 0..100: '3|101|0|0|0;'
a first command that drives: > FORWARD FORWARD / !! the first command has speed 80:
a bad END, which is an end: say 255|0; / kind 255 / !! end 0 instead of 1: '255|0;'
messages after END: > END GOOD / ! a message after END: '3|0|0|0|0;' / > END / ! a message after END: '255|1;' / noted 2
no close after END: > END / !! the HQ did not close within 0.15 s of its END
no answer to the vehicle's END: kind 4 / begin_end / end_ended / !! no END within 0.15 s of the vehicle's
a close instead of an answer: begin_end / kind 255 / close / end_ended / !! the HQ closed without answering END
an answer without a close: begin_end / kind 255 / > END / end_ended / !! the HQ did not close within 0.15 s of its END
commands long after the vehicle's END: begin_end / kind 255 / send_until_noted GOOD
    / ! s after the vehicle's END: '3|0|0|0|0;' / end_ended
a close within a message: say 3|0|0| / close / ! the connection ended within a message:
silence [eager]: ! no drive command for 0.
a repetition that stops [deployed]: repeat GOOD 0.1 / ! no drive command for 0. / noted 1
    / ? 2 s without a command: the motor stopped by itself, at rest
a gap, with the lateness of the process [strict]: > GOOD / heard 1 / stall 0.2 / ! s (this process woke
an integer over 2^31-1: > GOOD / say 99999999999|1; / died an integer over 2^31-1, 99999999999: / ended / refused
an unknown id in binary [binary]: > GOOD 00 / died id 0, of which this server knows nothing:
a command to a laser in binary [binary, laser]: > GOOD / died id 3,
""",
    **OPTIONS,
)
async def test_what_the_judge_says_of(options: dict[str, Any], steps: list[str]) -> None:
    await played(options, steps)


@conversations(
    """
say a speed above 100 in binary [binary]: > GOOD 0365005a00 0365005a00 / heard 3 / ok / ? speed 101 counts as 100
end a laser, which answers and closes its side [laser]: > END / kind 255 / ended / ok
close right after its END [both]: wait 0.05 / > GOOD END / close / ? closed the connection after END / ok
shut its side and be answered: > END / shut / kind 255 / ok
say END while driving: > GOOD FORWARD END / ? END while the last command had speed 80
answer the vehicle's END with a command in flight: > GOOD / heard 1 / begin_end / > GOOD / kind 255 / > END / close
    / end_ended / ok / begin_end / end_ended
close without END, and the motor stops: > GOOD FORWARD / close / ? the HQ closed the connection without END:
    / ? the motor stopped by itself, moving / ok
lose its connection [both]: > GOOD / reset / ? the HQ closed the connection without END: ConnectionResetError / ok
see the vehicle leave with END: kind 4 / cancel / kind 255 / ended
have its connection cut [both]: kind 1 / cut / ended / ok / ? the vehicle cut the connection
connect often: crowd 20
connect a second time, for nothing: kind 4 / again / > GOOD / ? second connection, from 127.0.0.1:
    / ? while connected / nothing / ok
connect again after the end, for nothing: kind 4 / close / ? the HQ closed / again / > GOOD / ? while over / nothing
read nothing [binary, laser, patient]: ? the HQ read nothing for 0.1 s / ok
send a laser nothing [laser, hasty]: wait 0.3 / kind 1 / quiet
""",
    **OPTIONS,
)
async def test_an_hq_may(options: dict[str, Any], steps: list[str]) -> None:
    await played(options, steps)


async def test_a_process_that_is_late_itself_reproaches_nobody() -> None:
    async with connected(quick(times=AlfTimes())) as hq:
        repeating = asyncio.create_task(hq.repeat(f"GOOD {LONG_S}"))
        await hq.play(["stall 0.25", "wait 0.08"] * 2)
        repeating.cancel()
        await hq.ok("")


async def test_the_motor_stops_two_seconds_after_the_last_command_as_the_deployed_one_does() -> None:
    """20 cycles of 20 ticks at 200 Hz ("Translation of commands")."""
    vehicle = quick(times=AlfTimes(first_s=5, gap_s=5, window_commands=0))
    async with connected(vehicle) as hq:
        await hq.play(["> GOOD FORWARD", "? 2 s without a command: the motor stopped by itself, moving"])
    assert time.monotonic() - vehicle.received[-1][0] > 1.9


async def test_the_motor_stops_by_itself_and_any_message_applies_the_stale_command() -> None:
    vehicle = quick()
    async with connected(vehicle) as hq:
        await hq.play(["> GOOD FORWARD", "? 0.1 s without a command: the motor stopped by itself, moving"])
        assert not vehicle.machine.moving
        await hq.say("7|1;")
        await until(lambda: vehicle.machine.moving, vehicle)
        await until(lambda: len(vehicle.events) == 2, vehicle.events)
    assert vehicle.violations == ["id 7, of which this server knows nothing: '7|1;'"]


@pytest.mark.parametrize(("steps", "ended"), [(["> END", "heard 1"], True), (["cancel"], False)])
async def test_an_end_goes_behind_a_measurement_that_is_being_sent_and_none_where_it_is_left_in_part(
    steps: list[str], ended: bool
) -> None:
    times = AlfTimes(cycle_s=0.005, scan_s=0.0, close_s=LONG_S)
    async with connected(quick("binary", **LASER, times=times, points=1_000_000)) as hq:
        await hq.play(["wait 0.3", *steps])
        said = await hq.peer.read_to_the_end()
    size = (1 + 6 * 4) + (1 + 8 + 8 * 1_000_000 + 8) + 2
    assert (len(said) == size, said.endswith(b"\xff\x01")) == (ended, ended)


async def test_what_is_kept_is_bounded_and_nothing_is_ended_before_anybody_came(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(FragileVehicle, "KEEP", 2)
    vehicle, noted = quick(), list[str]()
    vehicle.note = noted.append
    await vehicle.end()
    async with connected(vehicle) as hq:
        await hq.say("7;8;9;3|0|0|0|0;")
        await until(lambda: vehicle.received and vehicle.received[-1][1] == 3, vehicle.received)
        assert (len(vehicle.violations), len(vehicle.received), len(noted)) == (2, 2, 3)


# Both judges face each other


@pytest.mark.parametrize("dialect", DIALECTS)
async def test_neither_judge_finds_fault_with_the_other(dialect: Dialect) -> None:
    vehicle = FragileVehicle(dialect, laser=True, drive=True)
    straight, right, one_g = (0, 30, 1.0) if dialect == "text" else (90, 120, 1000)
    async with serving(vehicle, Peer, AlfScene) as scene, asyncio.timeout(4 * LONG_S):
        hq = FragileAlfHq(dialect=dialect, serves="both")
        task = asyncio.create_task(hq.run("127.0.0.1", scene.peer.port))
        await until(lambda: hq.scans >= 2, hq)
        hq.drive(80, 0, right, True)
        await until(lambda: hq.scans >= 12 and len(hq.infos) >= 2, hq)
        await (hq if dialect == "text" else vehicle).end()
        await task
    assert hq.violations == vehicle.violations == []
    assert hq.scanner == pytest.approx((-135.0, 119.882812, 0.351562, 100, 20, 5600), rel=1e-5)
    scans = [(seconds, fields) for seconds, kind, fields in hq.received if kind == 1]
    assert [fields[0] for _, fields in scans] == list(range(hq.scans))
    assert scans[10][0] - scans[0][0] > 0.7, "ten a second"
    assert scans[-1][1][2:] == (44, 725)
    assert all(0 <= point <= 5600 for point in hq.last_points)
    assert any(point >= 20 for point in hq.last_points[44:726])
    assert hq.infos[0][:7] == (0, 0, 0, one_g, 0, 0, 0)
    speed, _, to_the_right, _, _, _, turn, _ = hq.infos[1]
    assert (speed > 50, to_the_right > 0, turn < 0, vehicle.machine.light) == (True, True, True, True)
    heard = [(kind, fields) for _, kind, fields in vehicle.received]
    assert (heard[0], heard[-1]) == ((3, (0, 0, straight, 0)), (255, (1,)))
    assert heard.count((3, (80, 0, right, 1))) > 20


# As a process


async def simulating(servers: int, dialect: Dialect = "text") -> list[Hq]:
    bound: asyncio.Future[tuple[Address, ...]] = asyncio.get_running_loop().create_future()
    simulation = Simulation((Address("127.0.0.1", 0),) * servers, ready=bound.set_result)
    first, *others = fragile_vehicle(dialect, servers=servers, seed=3, times=QUICK)
    task = asyncio.create_task(first.simulate(simulation.addresses, simulation.ready, *others))
    scenes = [Hq(None, Peer(address.port), task) for address in await bound]
    for scene in scenes:
        await scene.connect("")
    return scenes


async def test_two_servers_share_the_work_and_are_one_vehicle(caplog: pytest.LogCaptureFixture) -> None:
    hq, eye = await simulating(2)
    async with asyncio.timeout(4 * LONG_S):
        assert (await eye.read())[0] == "2"
        before = after = (await eye.read())[3 + 44 : 3 + 726]
        await hq.play(["repeat GOOD 0.02", f"repeat {b'3|100|0|0|0;'.hex()} 0.3"])
        assert {(await hq.read())[0] for _ in range(4)} == {"4"}
        while sum(one != other for one, other in zip(before, after, strict=True)) < 300:
            after = (await eye.read())[3 + 44 : 3 + 726]
        assert not caplog.records
        await eye.send("GOOD")
        await until(lambda: len(caplog.records) == 1, "one violation")
        await hq.play(["cancel", "kind 255"])
        await eye.kind("255")
    await eye.aclose()
    await hq.aclose()
    assert caplog.records[0].getMessage().startswith("violation, laser: id 3, of which")


async def test_the_simulator_logs_violations_and_says_what_it_died_of(caplog, capsys) -> None:
    (hq,) = await simulating(1, "binary")
    await hq.play(["> 48", "over", "close"])
    assert capsys.readouterr().out.startswith("died: id 72, of which this server knows nothing")
    assert [record.levelno for record in caplog.records if "violation" in record.message] == [logging.ERROR]


async def test_a_port_in_use_is_an_error_and_a_server_that_cannot_be_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(OSError, match="in use"):
        await quick().serve("127.0.0.1", taken.getsockname()[1], print)
    for options in ({"dialect": "text", "laser": False}, {"dialect": "morse", "laser": True}):
        with pytest.raises(ValueError, match="no such server"):
            FragileVehicle(**options, drive=False)  # type: ignore[arg-type]
