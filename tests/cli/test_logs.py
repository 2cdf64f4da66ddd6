"""What sets up the log of a process: settings, environment, and that faults of any kind come in the same form."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from zbridge import cli
from zbridge.app import plan
from zbridge.app.config import LogSettings
from zbridge.cli.logs import log_settings, set_up_log
from zbridge.errors import ConfigError

FAULTS = """
import logging, sys, threading, warnings
from zbridge.app.config import LogSettings
from zbridge.cli.logs import set_up_log
from zbridge.log import Log

class Torn:
    def __del__(self):
        raise ValueError("from a destructor")

def fail():
    raise ValueError("from a thread")

log = Log("test")
set_up_log()
log.info("first", "for people")
set_up_log(robot="r1", settings=LogSettings("json", "warning"))
log.info("unread", "below the level")
warnings.warn("from a library\\nof two lines", stacklevel=1)
thread = threading.Thread(target=fail)
thread.start()
thread.join()
Torn()
logging.getLogger("plain").error("from %s\\x1b", "a protocol")
for number in range(3):
    log.error("repeated", "number {number}", number=number)
raise ValueError("from the program")
"""


def test_every_fault_is_json_and_what_is_counted_is_written_at_the_end() -> None:
    ran = subprocess.run([sys.executable, "-c", FAULTS], capture_output=True, text=True, check=False, timeout=30)
    people, *programs = ran.stderr.splitlines()
    lines = list(map(json.loads, programs))
    assert ran.returncode == 1
    assert people.endswith(" INFO    test: for people")
    assert [(line.get("event"), line["level"], line["logger"]) for line in lines] == [
        (None, "warning", "py.warnings"),
        ("uncaught", "critical", "zbridge.cli"),
        ("unraisable", "error", "zbridge.cli"),
        (None, "error", "plain"),
        ("repeated", "error", "test"),
        ("uncaught", "critical", "zbridge.cli"),
        ("repeated", "error", "test"),
    ]
    assert {line["robot"] for line in lines} == {"r1"}
    assert "from a library" in lines[0]["message"]
    assert "ValueError: from a thread" in lines[1]["traceback"]
    assert lines[3]["message"] == "from a protocol\\x1b"
    assert (lines[6]["message"], lines[6]["repeated"]) == ("number 2", 2)


@pytest.mark.parametrize(
    ("form", "said"),
    [
        ("", "zbridge: r1.toml: "),
        ("json", "{"),
        ("xml", "zbridge: ZBRIDGE_LOG_FORMAT = 'xml': expected console or json"),
    ],
)
def test_the_variable_decides_where_no_file_can_be_read(form: str, said: str, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "zbridge", "run", "r1.toml"]
    environment = {**os.environ, "ZBRIDGE_LOG_FORMAT": form}
    ran = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=30
    )
    assert ran.returncode == 2
    assert ran.stderr.startswith(said)
    assert ran.stderr.count("\n") == 1


def test_a_robots_settings_win_one_by_one() -> None:
    host = LogSettings("json", "warning")
    assert LogSettings().over(host) == host
    assert LogSettings(level="debug").over(host) == LogSettings("json", "debug")
    assert LogSettings("console").over(host) == LogSettings("console", "warning")
    assert LogSettings("console").over(None) == LogSettings("console")


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"format": "xml"}, "log.format = 'xml'"),
        ({"level": "trace"}, "log.level = 'trace'"),
        ({"file": "r1.log"}, "log.file = 'r1.log': unknown key; expected one of format, level"),
    ],
)
def test_a_wrong_setting_is_an_error(table: dict[str, Any], said: str) -> None:
    hq = {"protocol": "tcpudp", "listen": "tcp://127.0.0.1:0"}
    with pytest.raises(ConfigError, match=said):
        plan({"robot": {"name": "r1"}, "hq": [hq], "log": table})


def test_words_of_another_version_are_as_if_not_said() -> None:
    assert log_settings("json", "debug") == LogSettings("json", "debug")
    assert log_settings("", "") == log_settings("xml", "trace") == LogSettings()


def test_a_program_that_runs_this_one_keeps_its_own_log(capsys: pytest.CaptureFixture[str]) -> None:
    hooks = (sys.excepthook, sys.unraisablehook)
    set_up_log(settings=LogSettings("json"))
    assert (sys.excepthook, sys.unraisablehook) == hooks
    with pytest.raises(SystemExit, match="2"):
        cli.give_up(2, "wrong")
    assert capsys.readouterr().err == "zbridge: wrong\n"
