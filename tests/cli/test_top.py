"""``zbridge top``: the table that is printed once, and what is wrong with a command line."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.fake_bus import FakeBus
from tests.views.top import serve, stats
from zbridge import cli
from zbridge.bus import Bus, BusSettings
from zbridge.cli.top import print_once

NOWHERE = BusSettings(connect=("tcp/127.0.0.1:1",), multicast=False)


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> FakeBus:
    bus = FakeBus("robot")

    async def open_bus(*_: object, **__: object) -> Bus:
        return bus.join("program")

    monkeypatch.setattr("zbridge.client.open_bus", open_bus)
    return bus


async def printed(
    capsys: pytest.CaptureFixture[str], *, sort: str = "robot", text: str = "", as_json: bool = False
) -> list[str]:
    await print_once(NOWHERE, "fleet", sort, text, as_json=as_json)
    captured = capsys.readouterr()
    return (captured.out + captured.err).splitlines()


@pytest.mark.jumping
async def test_one_table_is_printed_in_the_order_that_is_asked_for(
    bus: FakeBus, capsys: pytest.CaptureFixture[str]
) -> None:
    for number in range(3):
        serve(bus, f"r{number}", stats(cpu=number / 100))
    heading, *rows, summary = await printed(capsys, sort="cpu")
    titles = ["robot", "state", "driver", "msg/s", "refused", "gaps", "cpu%↓", "mem", "host", "protocol", "reason"]
    assert heading.split() == titles
    assert [row.split()[0] for row in rows] == ["r2", "r1", "r0"]
    assert summary == "3 robots: 3 established"


@pytest.mark.jumping
async def test_each_robot_is_one_line_of_json(bus: FakeBus, capsys: pytest.CaptureFixture[str]) -> None:
    for number in range(3):
        serve(bus, f"r{number}")
    lines = await printed(capsys, as_json=True, text="R2")
    assert [json.loads(line)["robot"] for line in lines] == ["r2"]


@pytest.mark.jumping
async def test_no_robots_are_no_error(bus: FakeBus, capsys: pytest.CaptureFixture[str]) -> None:
    assert await printed(capsys) == ["no robots on fleet/"]
    assert await printed(capsys, as_json=True) == []
    serve(bus, "r1")
    assert await printed(capsys, text="x") == ["none of 1 robots matches the filter"]


def fails(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: str) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["zbridge", "top", *words])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert isinstance(ended.value.code, int)
    return ended.value.code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("--json",), "--json: only with --once"),
        (("--sort", "speed"), "--sort 'speed': expected one of robot, state, driver, rate, "),
        (("--once", "--sort", "speed"), "--sort 'speed': expected one of robot, state, driver, rate, "),
        ((), "top needs a terminal; --once prints the table"),
    ],
)
def test_what_is_typed_wrongly_is_one_line_and_exit_code_two(
    words: tuple[str, ...],
    error: str,
    bus: FakeBus,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    code, said = fails(capsys, monkeypatch, *words)
    assert (code, said.count("\n")) == (2, 1)
    assert said.startswith(f"zbridge: {error}")


def test_without_the_extra_its_name_is_in_the_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "zbridge.views.top.app", None)
    code, said = fails(capsys, monkeypatch)
    assert (code, said.count("\n")) == (2, 1)
    assert "install the extra: pip install 'zbridge[top]'" in said


def test_nothing_but_the_screen_loads_textual_and_top_loads_no_numpy() -> None:
    code = "import sys, zbridge.cli.app, zbridge.cli.top; sys.exit('textual' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
