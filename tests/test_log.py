"""Events of the log: cheap while nobody wants them, whole for whoever reads ``logging``, and named once in the code."""

from __future__ import annotations

import ast
import logging
import re
from collections import defaultdict
from pathlib import Path
from string import Formatter

import pytest

from docs.generate.events import LogCall, calls_of, log_calls
from zbridge.log import Log, current_robot

ROOT = Path(__file__).parents[1]
WITH_LOGGERS = {"gateways/alf/simulator.py", "gateways/tcpudp/simulator.py", "gateways/wc2ec/simulator.py"}
"""The base of simulators takes a logger of ``logging``: authors of protocols need no other."""
SILENCED = {"zbridge/views/foxglove/server.py"}
"""Makes the logger of a library, to silence it."""

log = Log("test.log")


class Unreadable:
    def __str__(self) -> str:
        raise AssertionError("nobody reads this")


def test_a_record_is_a_sentence_with_a_code_and_fields(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO):
        log.info("next_process", "{robot}: next process in {delay_s:.1f} s", robot="r1", delay_s=0.52, pid=7)
        log.log(logging.WARNING, "torn", "a {{brace}} and 100 %")
    first, second = caplog.records
    assert first.getMessage() == "r1: next process in 0.5 s"
    assert first.__dict__["event"] == "next_process"
    assert first.__dict__["fields"] == {"robot": "r1", "delay_s": 0.52, "pid": 7}
    assert (first.name, first.levelname, second.levelname) == ("test.log", "INFO", "WARNING")
    assert second.getMessage() == "a {brace} and 100 %"
    assert logging.Formatter("%(levelname)s %(message)s").format(first) == "INFO r1: next process in 0.5 s"


def test_nothing_is_formatted_below_the_level(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)
    log.debug("unread", "{what}", what=Unreadable())
    log.info("unread", "{what}", what=Unreadable())
    log.log(logging.INFO, "unread", "{what}", what=Unreadable())
    caplog.set_level(logging.CRITICAL)
    log.warning("unread", "{what}", what=Unreadable())
    log.error("unread", "{what}", what=Unreadable())
    log.exception("unread", "{what}", what=Unreadable())
    assert caplog.records == []
    assert not log.enabled(logging.ERROR)


def test_an_exception_comes_with_its_traceback(caplog: pytest.LogCaptureFixture) -> None:
    fault = ValueError("no number")
    try:
        raise fault
    except ValueError:
        log.exception("failed", "it failed")
    log.error("failed", "it failed", exc_info=fault)
    assert [record.exc_info[1] for record in caplog.records if record.exc_info] == [fault, fault]
    assert caplog.text.count("ValueError: no number") == 2


def test_the_robot_of_the_running_code_is_its_contexts() -> None:
    assert current_robot.get() == ""


# The calls in the source


def test_every_call_names_its_event_and_gives_the_fields_of_its_sentence() -> None:
    calls = log_calls()
    assert len(calls) > 100
    wrong = [call for call in calls if (fault := fault_of(call)) is not None and print(call.place, fault) is None]
    assert wrong == []


def fault_of(call: LogCall) -> str | None:
    """Tell what is wrong with a call; None if nothing is."""
    if call.event is None or not re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", call.event):
        return f"no event in snake_case: {call.event!r}"
    if call.template is None:
        return "no literal sentence"
    names = {name for _, name, _, _ in Formatter().parse(call.template) if name is not None}
    return None if names <= call.fields and "**" not in call.fields else f"without {names - call.fields}"


def test_an_event_means_one_thing() -> None:
    meanings = defaultdict(set)
    for call in log_calls():
        meanings[call.event].add((call.logger, call.template, call.level))
    assert {event: found for event, found in meanings.items() if len(found) > 1} == {}


@pytest.mark.parametrize(
    "source",
    [
        'log.info("Not snake", "sentence")',
        'log.info(f"x_{y}", "sentence")',
        'log.info("event", f"sentence {x}")',
        'log.info("event", "{robot}: sentence")',
        'log.info("event", "{robot}: sentence", **fields)',
        'self._log.error("%s", error)',
        "log.log(logging.INFO, event, template)",
    ],
)
def test_a_wrong_call_is_found(source: str) -> None:
    (call,) = calls_of("zbridge/made_up.py", f'log = Log("zbridge.x")\ndef f():\n    {source}\n')
    assert fault_of(call) is not None


def test_the_source_logs_by_events_only() -> None:
    """A plain logger has neither event nor fields."""
    found = {
        path.relative_to(ROOT).as_posix()
        for top in ("zbridge", "gateways")
        for path in (ROOT / top).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "logging.getLogger" and node.args
    }
    assert found - WITH_LOGGERS - SILENCED == {"zbridge/log.py"}
