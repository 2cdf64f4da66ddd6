"""Runs a zbridge command that notes when each drive passes each stage between the bus's callback and the link.

``python -m tests.benchmarks.stages OUT run FILE``. The functions at the borders of the stages are wrapped from
outside, which costs well under a microsecond a stage. SIGUSR1 begins anew. A command is alone on its way: at rates at
which commands queue up the stages do not belong together.
"""

from __future__ import annotations

import json
import signal
import sys
import time
from pathlib import Path
from typing import Any

from gateways.tcpudp.translate import TcpUdpRobot
from tests.benchmarks.drives import number
from zbridge.bus.inbox import Inbox
from zbridge.cli import main as zbridge
from zbridge.control.admission import CommandFilter
from zbridge.control.authority import Authority
from zbridge.robot.commands import Commands
from zbridge.transport.tcp import TcpLink

STAGES = {
    "callback": "Zenoh called back",
    "proven": "proof checked, priority chosen",
    "woken": "event loop woken",
    "taken": "sample read",
    "admitted": "lease checked",
    "decoded": "drive decoded, checked and limited",
    "ordered": "translated to a frame",
    "written": "written to the socket",
    "done": "timers set, accounts kept (the robot has it already)",
}


class Stages:
    """The times of the command that is on its way, and of those before."""

    def __init__(self) -> None:
        self.passed: list[dict[str, int]] = []
        self._now: dict[str, int] = {}

    def wrap(self, owner: type, name: str, *, before: str = "", after: str = "") -> None:
        """Note the time before and after a method, and at the end which drive it was."""
        method = getattr(owner, name)

        def noted(*arguments: Any, **named: Any) -> Any:
            if before:
                self._pass(before)
            try:
                return method(*arguments, **named)
            finally:
                if after == "done":
                    self._now["number"] = number(arguments[1].payload)
                if after:
                    self._pass(after)

        setattr(owner, name, noted)

    def _pass(self, stage: str) -> None:
        if stage == "callback":
            self._now = {}
        self._now[stage] = time.perf_counter_ns()
        if stage == "done":
            if len(self._now) == len(STAGES) + 1:
                self.passed.append(self._now)
            self._now = {}


def main() -> None:
    """Run the command; write what was noted when it ends."""
    out = Path(sys.argv[1])
    sys.argv = ["zbridge", *sys.argv[2:]]
    stages = Stages()
    stages.wrap(CommandFilter, "__call__", before="callback", after="proven")
    stages.wrap(Inbox, "_drain", before="woken")
    stages.wrap(Commands, "take", before="taken", after="done")
    stages.wrap(Authority, "admit", after="admitted")
    stages.wrap(TcpUdpRobot, "command", before="decoded", after="ordered")
    stages.wrap(TcpLink, "write", after="written")
    signal.signal(signal.SIGUSR1, lambda *_: stages.passed.clear())
    try:
        zbridge()
    finally:
        out.write_text(json.dumps(stages.passed))


if __name__ == "__main__":
    main()
