"""Every command, fed with what somebody hostile may put on the bus: no terminal is told anything, no markup is read."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import logging
import os
import pty
import sys
import unicodedata
from collections.abc import Iterator
from typing import Any

import msgpack
import pytest
from rich.console import Console

from zbridge import cli
from zbridge.bus import Answer, Bus, Sample
from zbridge.bus.fake import FakeBus
from zbridge.cli import LineFormatter
from zbridge.cli.demo import Watch
from zbridge.cli.drive import Session
from zbridge.errors import LeaseLost, Refused, refusal
from zbridge.fleet import topics

ESC, CSI, OSC, BELL, DELETE, OVERRIDE = "\x1b", "\x9b", "\x9d", "\x07", "\x7f", "\u202e"
EVIL = f"[/x] [bold red] :warning: {ESC}[31m{ESC}]0;owned{BELL} {CSI}2J{OSC}0;t\x9c {DELETE}{OVERRIDE}\r\n\x00\x08end"
NAME = f"r1[red]{ESC}[2J{CSI}31m{OVERRIDE}{DELETE}"
ROBOT = "r1"
HARMLESS = "\n"

STATUS = {
    "state": "established",
    "reason": EVIL,
    "protocol": EVIL,
    "dialect": EVIL,
    "version": "[/x]",
    "features": [EVIL, "[/bold]"],
    "links": [{"name": EVIL, "state": "established", "peer": "tcp://127.0.0.1:1", "reason": EVIL}],
}
SESSION = {
    "name": EVIL,
    "peer": EVIL,
    "role": EVIL,
    "state": EVIL,
    "reason": EVIL,
    "version": "[/x]",
    "features": [EVIL],
    "transport": EVIL,
    "counters": {EVIL: 1, "frames_in": 2},
    "left_out": {EVIL: 3},
}
REFUSAL = {"who": EVIL, "command": "stop", "code": EVIL, "reason": EVIL, "count": 1}
FREE = {"state": "free", "holder": None, "priority": None, "expires_in_s": None, "refusals": []}


def nested(depth: int) -> Any:
    return [nested(depth - 1)] if depth else EVIL


PAYLOADS = [
    msgpack.packb(STATUS),
    msgpack.packb({EVIL: EVIL, "key": "fleet/other/status", "b": b"\x1b", "n": {EVIL: [EVIL, 1.5]}}),
    msgpack.packb({b"\x1b[31m": 1, "ext": msgpack.ExtType(5, b"\x1b"), "when": msgpack.Timestamp(1, 2)}),
    msgpack.packb({"deep": nested(200)}),
    msgpack.packb({"long": "x" * 10**6, f"{ESC}" * 10**5: 1}),
    b"\xc1" + EVIL.encode(),
    EVIL.encode(),
    b"",
]


DENIED = {"ok": False, "holder": EVIL, "reason": EVIL, "expires_in_s": 1.0}


class Hostile(FakeBus):
    """A bus on which whatever is asked about a lease is denied by somebody hostile."""

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        if "/@rpc/control/" in key_expr:
            return [Answer(key_expr, msgpack.packb(DENIED))]
        return await super().ask(key_expr, payload, timeout_s=timeout_s)

    def join(self, zid: str) -> Hostile:
        return Hostile(zid, self._shared)


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> FakeBus:
    """A bus on which every command finds itself, and on which hostile gateways are."""
    monkeypatch.setattr("zbridge.cli.bus.console._width", 2000)
    bus = Hostile("evil")
    joined = iter(range(100))

    async def open_bus(*_: object, **__: object) -> Bus:
        return bus.join(f"program {next(joined)}")

    monkeypatch.setattr("zbridge.client.open_bus", open_bus)
    monkeypatch.setattr("zbridge.cli.bus.open_bus", open_bus)
    sessions = msgpack.packb({"sessions": [SESSION]})
    for robot in (ROBOT, NAME):
        bus.announce(f"fleet/{robot}/@alive/gateway")
        bus.publisher(f"fleet/{robot}/status", topics.STATUS).put(msgpack.packb(STATUS))
        bus.answer(f"fleet/{robot}/@rpc/sessions/{NAME}", lambda question: question.answer(sessions))
    return bus


class Run:
    """What a command printed, and how it ended."""

    def __init__(self, code: object, out: str, err: str) -> None:
        self.code = code
        self.out = out
        self.err = err


@pytest.fixture
def zbridge(bus: FakeBus, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Any:
    """Run a command as its user does, and see that nothing of it could harm a terminal."""

    def run(*arguments: str) -> Run:
        monkeypatch.setattr(sys, "argv", ["zbridge", *arguments])
        capfd.readouterr()
        code: object = 0
        try:
            cli.main()
        except SystemExit as end:
            code = end.code
        out, err = capfd.readouterr()
        assert_harmless(out + err)
        assert "Traceback" not in err
        assert "MarkupError" not in err
        return Run(code, out, err)

    return run


def assert_harmless(text: str) -> None:
    wrong = {ascii(c) for c in text if c != HARMLESS and unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")}
    assert not wrong, text


def test_ls(zbridge: Any) -> None:
    shown = zbridge("ls")
    assert shown.code == 0
    assert shown.out.count("established") == 2
    assert "[/x]" in shown.out
    assert r"\x1b[31m" in shown.out
    assert ":warning:" in shown.out, "shown as it is, not as a picture"
    assert shown.out.count("\n") == 3, "a line for each robot, whatever it says"


def test_ls_of_sessions(zbridge: Any) -> None:
    shown = zbridge("ls", "--sessions")
    assert shown.code == 0
    assert "[/x]" in shown.out


@pytest.mark.parametrize("more", [(), ("--sessions",)])
def test_ls_as_json_means_what_was_published(zbridge: Any, more: tuple[str, ...]) -> None:
    shown = zbridge("ls", "--json", *more)
    entries = [json.loads(line) for line in shown.out.splitlines()]
    assert {entry["robot"] for entry in entries} == {ROBOT, NAME}
    assert {entry["reason"] for entry in entries} == {EVIL}


@pytest.mark.parametrize("payload", PAYLOADS, ids=range(len(PAYLOADS)))
@pytest.mark.parametrize("more", [(), ("--json",)])
@pytest.mark.parametrize("key", [f"fleet/{NAME}/status", f"fleet/{NAME}/{NAME}", NAME, f"fleet/r1/sensor/{NAME}"])
def test_echo(zbridge: Any, bus: FakeBus, key: str, more: tuple[str, ...], payload: bytes) -> None:
    bus.publisher(key, topics.STATUS).put(payload)
    shown = zbridge("echo", key, "--count", "1", *more)
    assert shown.code == 0
    assert shown.out.count("\n") == 1
    assert shown.err == ""
    if more:
        assert json.loads(shown.out)["key"] == key
    else:
        assert len(shown.out) <= 20_001


def test_stop(zbridge: Any, bus: FakeBus) -> None:
    control = bus.publisher(f"fleet/{ROBOT}/control", topics.CONTROL)
    control.put(msgpack.packb(FREE))
    stops = itertools.count(1)

    def refuse(_: Sample) -> None:
        refusals = [{**REFUSAL, "count": next(stops)}]
        control.put(msgpack.packb({**FREE, "state": "stopped", "refusals": refusals}))

    bus.subscribe(f"fleet/{ROBOT}/@cmd/stop", refuse)
    shown = zbridge("stop", "--all")
    assert shown.code == 1
    assert shown.err.startswith("r1: cannot be stopped: [/x]")
    assert shown.err.count("\n") == 1, "and what can be nobody's robot keeps nobody from stopping the others"
    assert zbridge("stop", ROBOT).code == 1


def test_probe(zbridge: Any) -> None:
    shown = zbridge("probe", "tcpudp", "tcp://127.0.0.1:1")
    assert shown.code == 0
    assert "version: [/x]" in shown.out
    assert "is served by the gateway of r1" in shown.out


class Terminal:
    """A terminal with nobody at the keyboard."""

    def __init__(self) -> None:
        self._near, far = pty.openpty()
        self.stdin = os.fdopen(far)

    def close(self) -> None:
        self.stdin.close()
        os.close(self._near)


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    with contextlib.closing(Terminal()) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal.stdin)
        yield terminal


def test_drive_of_a_robot_that_somebody_hostile_holds(zbridge: Any, terminal: Terminal) -> None:
    shown = zbridge("drive", ROBOT)
    assert shown.code == 1
    assert "r1: [/x]" in shown.err


@pytest.mark.parametrize("said", [LeaseLost(EVIL), refusal("busy", EVIL), refusal(EVIL, EVIL)])
async def test_what_drive_says_while_it_drives(capsys: pytest.CaptureFixture[str], said: Refused) -> None:
    sitting = Session.__new__(Session)
    sitting._line = ""
    sitting._say(str(said))
    start, end = "\r\x1b[K", "\n"
    out = capsys.readouterr().out
    assert out.startswith(start)
    assert out.endswith(end)
    assert_harmless(out.removeprefix(start))
    assert out.count("\n") == 1


def test_the_table_of_the_demo() -> None:
    watch = Watch([NAME])
    control = {**FREE, "state": "held", "holder": EVIL}
    pose = {"x": float("nan"), "y": float("inf"), "heading": 1e308}
    for path, fields in (("status", STATUS), ("control", control), ("pose", pose)):
        watch.take(Sample(f"fleet/{NAME}/{path}", msgpack.packb(fields)))
    paper = io.StringIO()
    Console(file=paper, width=500).print(watch.table(1.0))
    assert_harmless(paper.getvalue())
    assert "[/x]" in paper.getvalue()


def test_errors_are_one_line_that_harms_nobody(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.give_up(1, LeaseLost(EVIL))
    assert ended.value.code == 1
    err = capsys.readouterr().err
    assert err.startswith("zbridge: [/x]")
    assert err.count("\n") == 1
    assert_harmless(err)


def logged(message: str, *values: object, error: BaseException | None = None) -> str:
    failed = (type(error), error, None) if error is not None else None
    record = logging.LogRecord(EVIL, logging.WARNING, __file__, 1, message, values, failed)  # type: ignore[arg-type]
    return LineFormatter("%(levelname)s %(name)s: %(message)s").format(record)


def test_a_line_of_the_log_stays_one_line_that_harms_nobody() -> None:
    line = logged("%s: %s", EVIL, "x" * 10**6)
    assert line.startswith("WARNING [/x]")
    assert line.count("\n") == 0
    assert len(line) <= 2000
    assert_harmless(line)


def test_a_traceback_in_the_log_keeps_its_lines_and_harms_nobody() -> None:
    text = logged("a handler failed", error=ExceptionGroup(EVIL, [ValueError(EVIL)]))
    assert text.count("\n") > 3
    assert_harmless(text)
