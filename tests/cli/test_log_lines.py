"""A line of the log: the same event for people and for programs, whatever it holds."""

from __future__ import annotations

import json
import logging
import math
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.cli.log_lines import LINE_BYTES, MESSAGE_BYTES, JsonFormatter, LineFormatter, cut
from zbridge.log import Log

EVIL = "\x1b[2Jline\nbreak\r\0 \u2028 \x85 \x9b31m \x7f \u202e \ud800 \udcff"
"""Controls of terminals (C0, DEL, C1), line breaks, text that turns, and halves of characters."""
log = Log("zbridge.host")


def refuse(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")


def parsed(line: str) -> dict[str, Any]:
    """Read a line as a strict reader does, and check what holds for all lines."""
    assert line.isascii()
    assert line.isprintable()
    assert len(line.encode()) < LINE_BYTES
    found: dict[str, Any] = json.loads(line, parse_constant=refuse)
    texts = [text for text in (*found.values(), *found.get("fields", {}).values()) if isinstance(text, str)]
    assert all(part.isprintable() for text in texts for part in text.split("\n"))
    return found


def as_json(
    level: int, event: str, template: str, error: BaseException | None = None, **fields: object
) -> dict[str, Any]:
    record = log.record(level, event, template, **fields)
    if error is not None:
        record.exc_info = (type(error), error, error.__traceback__)
    return parsed(JsonFormatter().format(record))


def test_a_line_of_json_has_code_names_sentence_and_fields() -> None:
    template = "{robot}: {peer} waits {delay_s:.1f} s"
    line = as_json(logging.WARNING, "waits", template, robot="r1", peer="10.0.0.7:5", session="hq.desk.1", delay_s=0.25)
    assert line.pop("time").endswith("Z")
    assert line == {
        "level": "warning",
        "logger": "zbridge.host",
        "robot": "r1",
        "peer": "10.0.0.7:5",
        "session": "hq.desk.1",
        "event": "waits",
        "message": "r1: 10.0.0.7:5 waits 0.2 s",
        "fields": {"delay_s": 0.25},
    }


def test_its_time_is_utc_to_the_microsecond() -> None:
    record = log.record(logging.INFO, "event", "text")
    record.created = 1_800_000_000.000_25
    assert parsed(JsonFormatter().format(record))["time"] == "2027-01-15T08:00:00.000250Z"


def test_plain_records_of_others_have_no_event() -> None:
    record = logging.LogRecord("asyncio", logging.ERROR, __file__, 1, "%s of %d", (EVIL, 7), None)
    line = parsed(JsonFormatter().format(record))
    assert (line["logger"], line["message"].endswith("of 7"), "event" in line, "fields" in line) == (
        "asyncio",
        True,
        False,
        False,
    )


def test_numbers_stay_numbers_and_all_else_is_text() -> None:
    values: dict[str, object] = {
        "small": 1,
        "real": 0.5,
        "yes": True,
        "raw": b"\x01\xff",
        "path": Path("/etc/r1.toml"),
        "nan": math.nan,
        "inf": -math.inf,
        "huge": 10**5000,
        "missing": None,
        "list": [1, "\x1b"],
    }
    fields = as_json(logging.INFO, "event", "text", **values)["fields"]
    assert fields.pop("huge").startswith("0x")
    assert fields == {
        "small": 1,
        "real": 0.5,
        "yes": True,
        "raw": "01ff",
        "path": "/etc/r1.toml",
        "nan": "nan",
        "inf": "-inf",
        "list": "[1, '\\x1b']",
    }


def test_controls_and_halves_of_characters_are_escaped_in_every_text() -> None:
    line = as_json(logging.INFO, EVIL, "{what}", ValueError(EVIL), robot=EVIL, peer=EVIL, session=EVIL, what=EVIL)
    escaped = r"\x1b[2Jline\nbreak\r\x00"
    for text in (line["event"], line["robot"], line["peer"], line["session"], line["message"], line["fields"]["what"]):
        assert text.startswith(escaped)
    assert r"\ud800" in line["message"]
    assert "ValueError" in line["traceback"]


def test_a_line_is_never_too_long_and_gives_up_the_traceback_first() -> None:
    error = KeyError("torn")
    for number in range(40):
        error.add_note(f"note {number} {'x' * 200}")
    line = as_json(logging.ERROR, "event", "{text}", error, text="short", number=7)
    assert line["traceback"].startswith("...")
    assert line["traceback"].splitlines()[-1].startswith("note 39 ")
    assert line["fields"] == {"text": "short", "number": 7}
    line = as_json(
        logging.ERROR, "event", "{text}", error, first="\U0001f600" * 1500, text="y" * 5000, robot="\u00e9" * 999
    )
    assert len(json.dumps(line["message"])) <= MESSAGE_BYTES
    assert set(line["fields"]) == {"first", "text"}
    assert all(text.endswith("...") for text in line["fields"].values())
    assert "traceback" not in line


@given(st.text(), st.dictionaries(st.from_regex("[a-z_]{1,9}", fullmatch=True), st.text() | st.binary() | st.floats()))
def test_any_fields_make_one_line(message: str, fields: dict[str, Any]) -> None:
    fields.pop("self", None)
    as_json(logging.INFO, "event", "{message}", **{**fields, "message": message})


@given(st.text(), st.integers(8, 60), st.booleans())
def test_what_is_cut_fits(text: str, most: int, end: bool) -> None:
    assert len(json.dumps(cut(text, most, end=end))) <= most


def test_people_read_the_same_events() -> None:
    """The same records in both forms: the sentence of the one stands in the other."""
    records = [
        log.record(logging.INFO, "ready", "ready: {status}", status="3 robots"),
        log.record(logging.ERROR, "died", "{robot}: process {pid} {how}", robot="r1", pid=7, how=EVIL),
        logging.LogRecord("asyncio", logging.WARNING, __file__, 1, "slow: %r", ("x",), None),
    ]
    records[1].__dict__.update(repeated=12, repeated_s=10.0)
    try:
        raise ValueError(EVIL)
    except ValueError:
        records.append(log.record(logging.ERROR, "failed", "it failed"))
        records[-1].exc_info = sys.exc_info()
    for record in records:
        line, people = parsed(JsonFormatter().format(record)), LineFormatter("r1: ").format(record)
        head = f" {record.levelname:<7} r1: {record.name}: {line['message']}"
        assert head in people.split("\n")[0]
        assert people.isprintable() or record.exc_info
        assert all(part in people for part in line.get("traceback", "").split("\n"))
    assert LineFormatter().format(records[1]).endswith(" (12 times more in 10 s)")
    assert parsed(JsonFormatter().format(records[1]))["repeated"] == 12


@pytest.mark.parametrize("count", [1, 2])
def test_the_count_of_one_is_once(count: int) -> None:
    record = log.record(logging.ERROR, "event", "text")
    record.__dict__.update(repeated=count, repeated_s=9.9)
    assert LineFormatter().format(record).endswith(("(once more in 10 s)", "(2 times more in 10 s)")[count - 1])
