"""``zbridge simulate``: what it starts."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Coroutine

import msgspec
import pytest
from typer.testing import CliRunner

from zbridge import cli
from zbridge.cli.app import app, default_addresses, read_drive, simulate_robot
from zbridge.errors import ConfigError
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Protocol, Simulation, find_protocol


async def test_a_simulated_robot_streams_pictures_too(capsys: pytest.CaptureFixture[str]) -> None:
    listening = asyncio.Event()
    simulation = Simulation((Address("127.0.0.1", 0),), ready=lambda addresses: listening.set())
    work = asyncio.create_task(simulate_robot(find_protocol("tcpudp"), simulation, "127.0.0.1:0"))
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
    monkeypatch.setattr("zbridge.cli.app.run_loop", lambda work: work.close())
    monkeypatch.setattr("zbridge.cli.app.until_signal", lambda work: work)

    async def nothing(simulated: Protocol, simulation: Simulation, camera: str) -> None:
        """Never awaited."""

    def note(simulated: Protocol, simulation: Simulation, camera: str) -> Coroutine[None, None, None]:
        started.append(simulation)
        return nothing(simulated, simulation, camera)

    monkeypatch.setattr("zbridge.cli.app.simulate_robot", note)
    assert CliRunner().invoke(app, ["simulate", name]).exit_code == 0
    assert [list(map(str, simulation.addresses)) for simulation in started] == [addresses]


def test_a_template_without_an_address_to_listen_at_asks_for_one() -> None:
    serial = '[device]\nprotocol = "alf"\nconnect = ["serial:///dev/ttyUSB0?baud=57600"]\n'
    with pytest.raises(ConfigError, match="listen: missing, the template of alf names no address"):
        default_addresses(msgspec.structs.replace(find_protocol("alf"), template=serial))


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
