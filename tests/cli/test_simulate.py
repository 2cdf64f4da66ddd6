"""``zbridge simulate``: what it starts."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import Coroutine

import msgspec
import pytest
from typer.testing import CliRunner

from tests.e2e.other_package import toyrobot as toy
from zbridge import cli
from zbridge.cli import simulate as command
from zbridge.cli.app import app
from zbridge.cli.simulate import SimulateOptions, default_addresses, default_baud, read_drive, simulate_robot
from zbridge.errors import ConfigError
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Protocol, Simulation, find_protocol


async def test_a_simulated_robot_streams_pictures_too(capsys: pytest.CaptureFixture[str]) -> None:
    listening = asyncio.Event()
    simulation = Simulation((Address("127.0.0.1", 0),), ready=lambda addresses: listening.set())
    options = SimulateOptions(camera="127.0.0.1:0")
    work = asyncio.create_task(simulate_robot(find_protocol("tcpudp"), simulation, options))
    async with asyncio.timeout(20.0):
        while not (listening.is_set() and "camera at http://127.0.0.1:" in capsys.readouterr().out):
            assert not work.done(), work.exception()
            await asyncio.sleep(0.01)
    work.cancel()
    await asyncio.gather(work, return_exceptions=True)


@pytest.mark.parametrize(
    ("name", "addresses"),
    [
        ("tcpudp", ["tcp://127.0.0.1:11001"]),
        ("alf", ["tcp://127.0.0.1:6666"]),
        ("wc2ec", ["tcp://127.0.0.1:27015"]),
        ("ros2", ["tcp://127.0.0.1:7447"]),
    ],
)
def test_a_simulated_robot_listens_where_the_template_of_its_protocol_expects_it(
    name: str, addresses: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[Simulation] = []
    monkeypatch.setattr("zbridge.cli.app.set_up_log", lambda **_: None)
    monkeypatch.setattr("zbridge.cli.simulate.run_loop", lambda work: work.close())
    monkeypatch.setattr("zbridge.cli.simulate.until_signal", lambda work: work)

    async def nothing(simulated: Protocol, simulation: Simulation, options: SimulateOptions) -> None:
        """Never awaited."""

    def note(simulated: Protocol, simulation: Simulation, options: SimulateOptions) -> Coroutine[None, None, None]:
        started.append(simulation)
        return nothing(simulated, simulation, options)

    monkeypatch.setattr("zbridge.cli.simulate.simulate_robot", note)
    assert CliRunner().invoke(app, ["simulate", name]).exit_code == 0
    assert [list(map(str, simulation.addresses)) for simulation in started] == [addresses]


def test_a_template_without_an_address_to_listen_at_asks_for_one() -> None:
    serial = '[device]\nprotocol = "alf"\nconnect = ["serial:///dev/ttyUSB0?baud=57600"]\n'
    with pytest.raises(ConfigError, match="listen: missing, the template of alf names no address"):
        default_addresses(msgspec.structs.replace(find_protocol("alf"), template=serial))


def test_a_serial_line_has_the_baud_rate_of_the_template() -> None:
    serial = '[device]\nconnect = ["tcp://127.0.0.1:1", "serial:///dev/ttyUSB0?baud=57600"]\n'
    assert default_baud(msgspec.structs.replace(find_protocol("alf"), template=serial)) == 57600
    assert default_baud(find_protocol("alf")) == command.BAUD


PLUGIN = msgspec.structs.replace(toy.PROTOCOL, name="toy")
"""It has no simulated HQ program."""
NOBODY = "tcp://127.0.0.1:1"


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (f"tcpudp --serial --listen {NOBODY}", 2, "--serial: not with --listen"),
        (f"tcpudp --serial --hq {NOBODY}", 2, "--serial: not with --hq"),
        ("tcpudp --serial --udp", 2, "--serial: not with --udp"),
        ("tcpudp --serial --drive 0.1", 2, "--drive: only with --hq"),
        ("alf --serial", 2, "--serial: robots of alf have up to 2 links, a serial line is one"),
        ("ros2 --serial", 2, "--serial: robots of ros2 are connected by Zenoh"),
        (f"ros2 --hq {NOBODY}", 2, "there is no simulated HQ program of ros2"),
        ("tcpudp --hq serial:///dev/none?baud=9600", 2, "only a robot is connected by a serial line"),
        ("toy --hq hello", 2, "--hq 'hello': expected tcp://host:port or serial:///path?baud=N"),
        (f"toy --hq {NOBODY} --drive 2", 2, "drive = '2': expected FORWARD or FORWARD,TURN"),
        (f"toy --hq {NOBODY} --version 1", 2, "--version: not with --hq, as there is no simulated HQ program of toy"),
        (f"toy --hq {NOBODY} --dialect a", 2, "--dialect: not with --hq"),
        (f"toy --hq {NOBODY} --udp", 2, "--udp: not with --hq"),
        (f"toy --hq {NOBODY}", 1, f"{NOBODY}: Connection refused"),
        ("toy --hq serial:///dev/none?baud=9600", 1, "serial:///dev/none?baud=9600: No such file or directory"),
    ],
)
def test_what_cannot_be_simulated_is_one_line(
    words: str, code: int, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("zbridge.cli.app.set_up_log", lambda **_: None)
    monkeypatch.setattr("zbridge.cli.app.find_protocol", lambda name: PLUGIN if name == "toy" else find_protocol(name))
    monkeypatch.setattr(sys, "argv", ["zbridge", "simulate", *words.split()])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    out, err = capsys.readouterr()
    assert (ended.value.code, out) == (code, "")
    assert said in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "drive"), [("", None), ("0.3", (0.3, 0.0)), ("0.3,-0.2", (0.3, -0.2)), ("-1, 1", (-1.0, 1.0))]
)
def test_what_an_hq_program_is_to_drive_is_read(text: str, drive: tuple[float, float] | None) -> None:
    assert read_drive(text) == drive


@pytest.mark.parametrize("text", ["fast", "1.1", "0,2", "0.1,0.1,0.1", "nan", ","])
def test_what_no_robot_can_drive_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match=r"drive = .*: expected FORWARD or FORWARD,TURN, each -1 to 1"):
        read_drive(text)


@pytest.mark.parametrize(("result", "code"), [(None, 0), (True, 0), (0, 0), (False, 1), (1, 1), (2, 2)])
def test_a_command_ends_with_the_code_that_its_work_returns(
    result: bool | int | None, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli, "set_up_log", lambda **_: None)

    async def work() -> bool | int | None:
        return result

    with contextlib.nullcontext() if code == 0 else pytest.raises(SystemExit, match=str(code)):
        cli.run_command(work())
