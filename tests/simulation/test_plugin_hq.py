"""The robot side of a protocol without a gateway: what it prints, that it drives, and that it stops what it drove."""

from __future__ import annotations

import asyncio
import contextlib
import math
import re
from collections.abc import AsyncIterator, Callable, Iterable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tests.e2e.other_package import toyrobot as toy
from zbridge.errors import LinkError, NotReady, ProtocolError
from zbridge.fleet import topics
from zbridge.fleet.messages import Battery, Device, Devices, Drive, FleetMessage, Image, Map, Motion, Pose, Reading
from zbridge.fleet.messages import Scan as FleetScan
from zbridge.fleet.topics import Topic
from zbridge.protocol.address import Address, SerialAddress
from zbridge.protocol.plugin import Outcome, Protocol, Simulation, Telemetry, Truth
from zbridge.protocol.session import Limits
from zbridge.simulation import plugin_hq
from zbridge.simulation.plugin_hq import LineReport, PluginHq, described
from zbridge.simulation.serial_line import simulate_on_serial_line

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "khepera"
NAN = math.nan


@pytest.fixture
def khepera(monkeypatch: pytest.MonkeyPatch) -> Protocol:
    monkeypatch.syspath_prepend(str(EXAMPLE))
    from khepera import PROTOCOL

    assert isinstance(PROTOCOL, Protocol)
    return PROTOCOL


def scan(*ranges_m: float) -> FleetScan:
    return FleetScan(
        angle_min=0.0, angle_increment=0.1, range_min=0.0, range_max=4.0, ranges=np.array(ranges_m, np.float32)
    )


@pytest.mark.parametrize(
    ("path", "message", "line"),
    [
        ("pose", Pose(x=0.123, y=-0.001, heading=1.5, stamp_ns=7), "pose x=0.12 y=0.00 heading=1.50"),
        ("scan", scan(NAN, 0.5, 0.312, NAN), "scan 4 points, 2 measured, nearest 0.31 m"),
        ("scan", scan(NAN, NAN), "scan 2 points, 0 measured"),
        ("battery", Battery(level=0.5, charging=False), "battery level=0.50 charging=False"),
        ("motion", Motion(gyro=(0.0, 0.25, -1.0)), "motion gyro=(0.00, 0.25, -1.00)"),
        ("sensor/bumper", Reading(value=1.0, kind="touch"), "sensor/bumper 1"),
        ("sensor/front", Reading(value=0.0625, fault=True), "sensor/front 0.0625 (fault)"),
        ("image", Image(format="jpeg", data=b"12345"), "image format='jpeg' data=5 bytes"),
        ("devices", Devices(devices=(Device("a", 1, "led"),)), "devices devices=1 items"),
        (
            "map",
            Map(rows=2, columns=1, cell=0.5, origin=(0.0, 1.0), cells=np.zeros((2, 1), np.uint8)),
            "map rows=2 columns=1 cell=0.50 origin=(0.00, 1.00) cells=uint8[2, 1]",
        ),
    ],
)
def test_a_message_is_one_line(path: str, message: FleetMessage, line: str) -> None:
    assert described(path, message) == line


def test_the_first_line_of_a_kind_is_printed_at_once_and_then_the_newest_of_each_kind() -> None:
    lines: list[str] = []
    report = LineReport(lines.append)
    for number in (1, 2, 3):
        report.note("pose", lambda number=number: f"pose {number}")
        report.note("battery", lambda number=number: f"battery {number}\x1b")
    assert lines == ["pose 1", "battery 1\\x1b"]
    report.flush()
    report.flush()
    assert lines[2:] == ["battery 3\\x1b", "pose 3"]


def test_kinds_without_number_print_no_lines_without_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugin_hq, "KINDS", 2)
    lines: list[str] = []
    report = LineReport(lines.append)
    for number in range(5):
        report.note(f"sensor/{number}", lambda number=number: f"{number}")
    report.flush()
    assert lines == ["0", "1"]


# With a simulated Khepera


@contextlib.asynccontextmanager
async def simulated(protocol: Protocol, truths: list[Truth], *, serial: bool) -> AsyncIterator[Address | SerialAddress]:
    """Run the simulated robot of a protocol; yield its address."""
    bound: asyncio.Future[Address | SerialAddress] = asyncio.get_running_loop().create_future()
    simulation = Simulation(
        (Address("127.0.0.1", 0),), report=truths.append, ready=lambda addresses: bound.set_result(addresses[0])
    )
    work = protocol.simulate(simulation)
    if serial:
        work.close()
        work = simulate_on_serial_line(protocol.simulate, simulation, 57600, bound.set_result)
    running = asyncio.ensure_future(work)
    try:
        yield await bound
    finally:
        running.cancel()
        await asyncio.wait((running,))


async def soon(condition: Callable[[], object], what: object = "") -> None:
    try:
        async with asyncio.timeout(10.0):
            while not condition():  # noqa: ASYNC110
                await asyncio.sleep(0.01)
    except TimeoutError:
        raise AssertionError(what) from None


async def interrupt(running: asyncio.Future[None]) -> None:
    """End it as a signal does."""
    running.cancel()
    await asyncio.wait((running,))
    assert running.cancelled()


def poses(lines: list[str]) -> list[tuple[float, ...]]:
    """Give x, y and heading of each pose that was printed."""
    return [tuple(map(float, re.findall(r"=(\S+)", line))) for line in lines if line.startswith("pose ")]


@pytest.mark.both_loops
@pytest.mark.parametrize("serial", [False, True], ids=["tcp", "serial"])
async def test_a_khepera_is_driven_and_stands_before_the_session_ends(
    khepera: Protocol, serial: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plugin_hq, "REPORT_S", 0.2)
    monkeypatch.setattr(plugin_hq, "STOP_S", 0.5)
    truths: list[Truth] = []
    lines: list[str] = []
    async with simulated(khepera, truths, serial=serial) as address:
        running = asyncio.ensure_future(PluginHq(khepera, address, (0.4, 0.2), lines.append).run())
        await soon(lambda: "drives: forward 0.4, turn 0.2" in lines, lines)
        assert lines[:2] == [f"connected to {address}", "established, version 5.1"]
        order = [lines.index(line) for line in ("sends neutral", "drives: forward 0.4, turn 0.2")]
        assert 1 < order[0] < order[1]
        await soon(lambda: "motion speed=0.40" in lines[order[1] :], lines)
        await soon(lambda: poses(lines)[-1][0] > 0.02 and poses(lines)[-1][2] > 0.02, lines)
        assert poses(lines)[0] == (0.0, 0.0, 0.0)
        assert truths[-1].wheels_m_s[1] > truths[-1].wheels_m_s[0] > 0.0
        running.cancel()
        await soon(lambda: truths[-1].neutral or running.done())
        assert not running.done(), "it was stopped while the session was open, not by its watchdog"
        await asyncio.wait((running,))
        assert running.cancelled()
        assert "stops the robot" in lines
        assert re.fullmatch(r"session ended: this program ends; \d+ frames in, \d+ out, 0 malformed", lines[-1])
        assert [line for line in lines if line.startswith("motion ")][-1] == "motion speed=0.00"


async def test_who_only_watches_a_khepera_sends_no_command(khepera: Protocol) -> None:
    lines: list[str] = []
    async with simulated(khepera, [], serial=False) as address:
        program = PluginHq(khepera, address, None, lines.append)
        sent: list[bytes] = []
        program.session.tap = lambda direction, frame: sent.append(frame[:1]) if direction == "out" else None
        running = asyncio.ensure_future(program.run())
        await soon(lambda: any(line.startswith("scan ") for line in lines), lines)
        await interrupt(running)
        assert set(sent) == {b"B", b"E", b"H", b"N"}
        assert "stops the robot" not in lines


# With a scripted robot


class MoodySession(toy.ToySession):
    """Its robot also says ``busy``, with a reason, and ``idle``. first: what is wrong with it from the beginning."""

    first: tuple[str | None, tuple[str, ...]] = (None, ())

    def opened(self, now: float) -> None:
        super().opened(now)
        self.busy, self.doubts = self.first

    def decode(self, frame: bytes) -> toy.At:
        word, _, reason = frame.decode().strip().partition(" ")
        if word in ("busy", "idle"):
            self.busy, self.doubts = reason or None, ()
            return toy.At(9.0, 0.0, 0.0)
        return super().decode(frame)


class MoodyRobot(toy.ToyRobot):
    """Notes what its hook is told. It takes no turns, and shows nothing but where it is."""

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        self.leases: list[bool] = []

    def session(self, link: str, peer: str) -> MoodySession:
        super().session(link, peer)
        self._session = MoodySession(Limits(frame_bytes=100, handshake_s=5.0))
        return self._session

    def begun(self, stamp_ns: int) -> tuple[Telemetry, ...]:
        return ((topics.BATTERY, Battery(level=1.0)),)

    def leased(self, on: bool, now: float) -> None:
        self.leases.append(on)

    def command(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        if isinstance(command, Drive) and command.forward == 1.0:
            raise NotReady("too fast")
        if isinstance(command, Drive) and command.forward == -1.0:
            raise KeyError("reverse")
        super().command(topic, command, now)
        return Outcome(left_out="turn: it goes straight" if isinstance(command, Drive) and command.turn else None)

    def pose(self, message: toy.At, stamp_ns: int) -> Iterable[Telemetry]:
        if message.x > 100.0:
            raise ProtocolError(f"{message.x:g} m is outside of the building")
        return super().pose(message, stamp_ns)


MOODY = msgspec.structs.replace(toy.PROTOCOL, name="moody", robot=MoodyRobot)


class Scene:
    """A robot that notes each line it gets, and a program that is connected to it."""

    def __init__(self, drive: tuple[float, float] | None) -> None:
        self.got: list[tuple[float, float]] = []
        self.lines: list[str] = []
        self._drive = drive

    @contextlib.asynccontextmanager
    async def playing(self) -> AsyncIterator[Scene]:
        connected = asyncio.Event()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            self.writer = writer
            connected.set()
            with contextlib.suppress(ConnectionError):
                while line := await reader.readline():
                    _, forward, turn = line.split()
                    self.got.append((float(forward), float(turn)))
            writer.close()

        async with await asyncio.start_server(serve, "127.0.0.1", 0) as server:
            address = Address(*server.sockets[0].getsockname()[:2])
            self.program = PluginHq(MOODY, address, self._drive, self.lines.append)
            self.running = asyncio.ensure_future(self.program.run())
            await connected.wait()
            try:
                yield self
            finally:
                self.running.cancel()
                await asyncio.wait((self.running,))

    @property
    def leases(self) -> list[bool]:
        robot = self.program.robot
        assert isinstance(robot, MoodyRobot)
        return robot.leases

    def say(self, *lines: str) -> None:
        self.writer.write("".join(f"{line}\n" for line in lines).encode())

    async def printed(self, start: str) -> None:
        await soon(lambda: any(line.startswith(start) for line in self.lines), (start, self.lines))


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in (("NEUTRAL_S", 0.15), ("DRIVE_S", 0.05), ("STOP_S", 0.2)):
        monkeypatch.setattr(plugin_hq, name, seconds)


async def test_neutral_comes_first_and_a_signal_stops_releases_and_closes_in_this_order() -> None:
    async with Scene((0.5, 0.25)).playing() as scene:
        await soon(lambda: (0.5, 0.25) in scene.got)
        assert scene.got[0] == (0.0, 0.0)
        assert scene.leases == [True]
        await interrupt(scene.running)
        assert scene.leases == [True, False]
        await soon(lambda: scene.got[-2:] == [(0.0, 0.0)] * 2, scene.got)
        assert scene.lines[:3] == [scene.lines[0], "established, version 7.0, features wheels", "battery level=1.00"]
        assert scene.lines[-2] == "stops the robot"
        assert "left out of the drive: turn: it goes straight" in scene.lines
        assert scene.lines[-1].startswith("session ended: this program ends; 0 frames in, ")


async def test_a_robot_that_becomes_busy_is_stopped_at_once_and_not_driven_again() -> None:
    async with Scene((0.5, 0.0)).playing() as scene:
        await soon(lambda: (0.5, 0.0) in scene.got)
        scene.say("busy charging")
        await soon(lambda: scene.got[-1] == (0.0, 0.0))
        assert scene.lines[-2:] == ["busy: charging", "stops the robot; start again to drive"]
        scene.say("idle")
        await scene.printed("no longer busy")
        count = len(scene.got)
        await asyncio.sleep(0.3)
        assert set(scene.got[count:]) <= {(0.0, 0.0)}
        assert not scene.running.done()


@pytest.mark.parametrize(
    ("first", "printed"),
    [(("booting", ()), "busy: booting"), ((None, ("echo", "loss")), "busy: connection in doubt: echo; loss")],
)
async def test_a_robot_that_is_busy_from_the_beginning_is_driven_once_it_is_not(
    first: tuple[str | None, tuple[str, ...]], printed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MoodySession, "first", first)
    async with Scene((0.5, 0.0)).playing() as scene:
        await scene.printed(printed)
        await asyncio.sleep(0.3)
        assert scene.got == []
        scene.say("idle")
        await soon(lambda: (0.5, 0.0) in scene.got, scene.lines)
        assert scene.got[0] == (0.0, 0.0)


async def test_who_only_watches_takes_no_lease_and_stops_nothing() -> None:
    async with Scene(None).playing() as scene:
        scene.say("at 1 2 0.5", "at 1.5 2 0.5")
        await scene.printed("pose x=1.00 y=2.00 heading=0.50")
        scene.say("busy charging")
        await scene.printed("busy: charging")
        await interrupt(scene.running)
        assert (scene.got, scene.leases) == ([], [])
        assert "pose x=9.00 y=0.00 heading=0.00" in scene.lines


async def test_refused_commands_malformed_lines_and_messages_without_meaning_are_printed() -> None:
    async with Scene((1.0, 0.0)).playing() as scene:
        await scene.printed("refused drive: too fast (not_ready)")
        scene.say("at nowhere", "at 101 0 0", "what")
        await scene.printed("malformed 2, last: b'what")
        await scene.printed("no meaning 1, last: 101 m is outside of the building")
        assert not scene.running.done()


async def test_a_fault_of_the_protocol_stops_the_robot_and_is_raised() -> None:
    async with Scene((-1.0, 0.0)).playing() as scene:
        await asyncio.wait((scene.running,), timeout=5.0)
        with pytest.raises(KeyError, match="reverse"):
            scene.running.result()
        assert scene.leases == [True, False]
        await soon(lambda: scene.got[-1] == (0.0, 0.0))


async def test_a_robot_that_hangs_up_ends_the_program_with_the_reason() -> None:
    async with Scene((0.5, 0.0)).playing() as scene:
        await soon(lambda: (0.5, 0.0) in scene.got)
        scene.writer.close()
        await asyncio.wait((scene.running,), timeout=5.0)
        scene.running.result()
        assert re.fullmatch(r"session ended: .*closed.*; 0 frames in, \d+ out, 0 malformed", scene.lines[-1])
        assert "stops the robot" not in scene.lines


async def test_nobody_at_the_address_is_an_error() -> None:
    with pytest.raises(LinkError, match=r"^tcp://127\.0\.0\.1:1: Connect"):
        await PluginHq(MOODY, Address("127.0.0.1", 1), None, print).run()
