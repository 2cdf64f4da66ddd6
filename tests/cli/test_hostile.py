"""Every command, fed with what somebody hostile may put on the bus: no terminal is told anything, no markup is read."""

from __future__ import annotations

import io
import itertools
import json
import logging
import os
import pty
import sys
import unicodedata
from functools import reduce
from typing import Any

import msgpack
import pytest
from rich.console import Console

from tests.fake_bus import FakeBus
from zbridge import cli
from zbridge.bus import Answer, Bus, Sample
from zbridge.cli.demo import LiveTable
from zbridge.cli.drive import DriveRun
from zbridge.cli.log_lines import LineFormatter
from zbridge.errors import LeaseLost
from zbridge.fleet import topics

ESC, CSI, OSC, BELL, DELETE, OVERRIDE = "\x1b", "\x9b", "\x9d", "\x07", "\x7f", "\u202e"
EVIL = f"[/x] [bold red] :warning: {ESC}[31m{ESC}]0;owned{BELL} {CSI}2J{OSC}0;t\x9c {DELETE}{OVERRIDE}\r\n\x00\x08end"
NAME = f"r1[red]{ESC}[2J{CSI}31m{OVERRIDE}{DELETE}"
KEYS = (f"fleet/{NAME}/status", f"fleet/{NAME}/{NAME}", NAME, f"fleet/r1/sensor/{NAME}")

LINK = {"name": EVIL, "state": "established", "peer": "tcp://127.0.0.1:1", "reason": EVIL}
STATUS = dict.fromkeys(("reason", "protocol", "dialect"), EVIL) | {
    "state": "established",
    "version": "[/x]",
    "features": [EVIL, "[/bold]"],
    "links": [LINK],
}
SESSION = dict.fromkeys(("name", "peer", "role", "state", "reason", "transport"), EVIL) | {
    "version": "[/x]",
    "features": [EVIL],
    "counters": {EVIL: 1, "frames_in": 2},
    "left_out": {EVIL: 3},
}
REFUSAL = {"who": EVIL, "command": "stop", "code": EVIL, "reason": EVIL, "count": 1}
FREE = {"state": "free", "holder": None, "priority": None, "expires_in_s": None, "refusals": []}
DENIED = {"ok": False, "holder": EVIL, "reason": EVIL, "expires_in_s": 1.0}
PAYLOADS = [
    msgpack.packb(STATUS),
    msgpack.packb({EVIL: EVIL, "key": "fleet/other/status", "b": b"\x1b", "n": {EVIL: [EVIL, 1.5]}}),
    msgpack.packb({b"\x1b[31m": 1, "ext": msgpack.ExtType(5, b"\x1b"), "when": msgpack.Timestamp(1, 2)}),
    msgpack.packb({"deep": reduce(lambda inner, _: [inner], range(200), EVIL)}),
    msgpack.packb({"long": "x" * 10**6, f"{ESC}" * 10**5: 1}),
    b"\xc1" + EVIL.encode(),
    EVIL.encode(),
    b"",
]


class Hostile(FakeBus):
    """A bus on which whatever is asked about a lease is denied by somebody hostile."""

    async def ask(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Answer]:
        if "/@rpc/control/" in key_expr:
            return [Answer(key_expr, msgpack.packb(DENIED))]
        return await super().ask(key_expr, payload, timeout_s=timeout_s)

    def join(self, zid: str) -> Hostile:
        return Hostile(zid, self.network)


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> FakeBus:
    """A bus on which every command finds itself, and on which hostile gateways are."""
    bus, joined = Hostile("evil"), itertools.count()

    async def open_bus(*_: object, **__: object) -> Bus:
        return bus.join(f"program {next(joined)}")

    monkeypatch.setattr("zbridge.client.open_bus", open_bus)
    sessions = msgpack.packb({"sessions": [SESSION]})
    for robot in ("r1", NAME):
        bus.announce(f"fleet/{robot}/@alive/gateway")
        bus.publisher(f"fleet/{robot}/status", topics.STATUS).put(msgpack.packb(STATUS))
        bus.answer(f"fleet/{robot}/@rpc/sessions/{NAME}", lambda question: question.answer(sessions))
    return bus


def assert_harmless(text: str) -> None:
    wrong = {ascii(c) for c in text if c != "\n" and unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")}
    assert not wrong, text


@pytest.fixture
def zbridge(bus: FakeBus, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Any:
    """Run a command as its user does, and see that nothing of it could harm a terminal; give how it ended."""

    def run(*arguments: str) -> tuple[object, str, str]:
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
        return code, out, err

    return run


def test_ls(zbridge: Any) -> None:
    code, out, _ = zbridge("ls")
    assert (code, out.count("established")) == (0, 1), "what can be nobody's robot is left out"
    for shown_as_it_is in ("[/x]", r"\x1b[31m", ":warning:"):
        assert shown_as_it_is in out
    assert out.count("\n") == 2, "a line for each robot, whatever it says"
    code, out, _ = zbridge("ls", "--sessions")
    assert code == 0
    assert "[/x]" in out


@pytest.mark.parametrize(("more", "robots"), [((), {"r1"}), (("--sessions",), {"r1", NAME})])
def test_ls_as_json_means_what_was_published(zbridge: Any, more: tuple[str, ...], robots: set[str]) -> None:
    entries = [json.loads(line) for line in zbridge("ls", "--json", *more)[1].splitlines()]
    assert {(entry["robot"], entry["reason"]) for entry in entries} == {(robot, EVIL) for robot in robots}


@pytest.mark.parametrize("payload", PAYLOADS, ids=range(len(PAYLOADS)))
@pytest.mark.parametrize("more", [(), ("--json",)])
@pytest.mark.parametrize("key", KEYS)
def test_echo(zbridge: Any, bus: FakeBus, key: str, more: tuple[str, ...], payload: bytes) -> None:
    bus.publisher(key, topics.STATUS).put(payload)
    code, out, err = zbridge("echo", key, "--count", "1", *more)
    assert (code, out.count("\n"), err) == (0, 1, "")
    if more:
        assert json.loads(out)["key"] == key
    else:
        assert len(out) <= 20_001


def test_stop(zbridge: Any, bus: FakeBus) -> None:
    control, stops = bus.publisher("fleet/r1/control", topics.CONTROL), itertools.count(1)
    control.put(msgpack.packb(FREE))

    def refuse(sample: Sample) -> None:
        refusals, shown = [{**REFUSAL, "count": next(stops)}], [msgpack.unpackb(sample.payload)["id"]]
        control.put(msgpack.packb({**FREE, "state": "stopped", "refusals": refusals, "stops": shown}))

    bus.subscribe("fleet/r1/@cmd/stop", refuse)
    code, _, err = zbridge("stop", "--all")
    assert code == 1
    assert err.startswith("r1: cannot be stopped: [/x]")
    assert err.count("\n") == 1, "and what can be nobody's robot keeps nobody from stopping the others"
    assert zbridge("stop", "r1")[0] == 1


def test_probe(zbridge: Any) -> None:
    code, out, _ = zbridge("probe", "tcpudp", "tcp://127.0.0.1:1")
    assert code == 0
    assert "version: [/x]" in out
    assert "is served by the gateway of r1" in out


def test_drive_of_a_robot_that_somebody_hostile_holds(zbridge: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    near, far = pty.openpty()  # a terminal with nobody at the keyboard
    with os.fdopen(near), os.fdopen(far) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        code, _, err = zbridge("drive", "r1")
    assert code == 1
    assert "r1: [/x]" in err


def test_what_drive_says_while_it_drives_and_errors_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    sitting = DriveRun.__new__(DriveRun)
    sitting._line = ""
    sitting._say(str(LeaseLost(EVIL)))
    start, _, said = capsys.readouterr().out.partition("\x1b[K")
    assert (start, said[-1], said.count("\n")) == ("\r", "\n", 1)
    with pytest.raises(SystemExit, match="1"):
        cli.give_up(1, LeaseLost(EVIL))
    err = capsys.readouterr().err
    assert err.startswith("zbridge: [/x]")
    assert err.count("\n") == 1
    assert_harmless(said + err)


def test_the_table_of_the_demo() -> None:
    watch = LiveTable([NAME])
    control = {**FREE, "state": "held", "holder": EVIL}
    pose = {"x": float("nan"), "y": float("inf"), "heading": 1e308}
    for path, fields in (("status", STATUS), ("control", control), ("pose", pose)):
        watch.take(Sample(f"fleet/{NAME}/{path}", msgpack.packb(fields)))
    paper = io.StringIO()
    Console(file=paper, width=500).print(watch.table(1.0, 500))
    assert_harmless(paper.getvalue())
    assert "[/x]" in paper.getvalue()


def logged(message: str, *values: object, error: BaseException | None = None) -> str:
    failed = (type(error), error, None) if error is not None else None
    record = logging.LogRecord(EVIL, logging.WARNING, __file__, 1, message, values, failed)  # type: ignore[arg-type]
    return LineFormatter().format(record)


def test_a_line_of_the_log_stays_one_line_a_traceback_keeps_its_lines_and_both_harm_nobody() -> None:
    line = logged("%s: %s", EVIL, "x" * 10**6)
    assert " WARNING [/x]" in line
    assert line.count("\n") == 0
    assert len(line) <= 2000
    text = logged("a handler failed", error=ExceptionGroup(EVIL, [ValueError(EVIL)]))
    assert text.count("\n") > 3
    assert_harmless(line + text)
