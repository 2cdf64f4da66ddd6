"""The metrics of a host: those of all its gateways and of the supervisor, at one address.

Theory of operation. Whoever reads the metrics makes the supervisor ask every gateway over its channel. A gateway
answers with the lines of its own metrics; the supervisor puts them together, each metric once. Nothing is kept: the
series of a gateway that has died, or does not answer within :data:`ANSWER_S`, are missing, and ``gateway_up`` is 0.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator

from zbridge.app.process_usage import ProcessUsage
from zbridge.host.runner import Runner
from zbridge.host.runners import Runners
from zbridge.metrics import Metrics, Reading
from zbridge.metrics.exposition import FamilyLines, text, written

ANSWER_S = 0.4
"""Longest wait for the answers of all gateways."""


class HostMetrics:
    """Collects the metrics of a host. runners: of the gateways."""

    def __init__(self, runners: Runners) -> None:
        self._runners = runners
        self._own = Metrics()
        self._own.add_source(ProcessUsage(threads=False).readings)
        self._own.add_source(self._readings)
        self._up: frozenset[Runner] = frozenset()
        """The gateways that answered last."""

    def __repr__(self) -> str:
        return f"<HostMetrics of {len(self._runners.by_path)} robots>"

    async def read(self) -> str:
        """Ask all gateways, and write what has come within :data:`ANSWER_S`."""
        asked: dict[Runner, asyncio.Future[list[FamilyLines]]] = {
            runner: runner.process.ask_metrics()
            for runner in self._runners.by_path.values()
            if runner.process is not None and not runner.process.is_over
        }
        if asked:
            await asyncio.wait(asked.values(), timeout=ANSWER_S)
        answers = {runner: answer.result() for runner, answer in asked.items() if answer.done()}
        self._up = frozenset(answers)
        return text([written(self._own.read()), *answers.values()])

    def missing(self) -> tuple[str, ...]:
        """Return why the host is of no use now: what its gateways lack, and which files are faulty."""
        reasons = [f"{path.name}: faulty" for path in self._runners.faults]
        for runner in self._runners.by_path.values():
            of_robot = runner.process.missing if runner.process is not None else ("no process",)
            reasons += [f"{runner.file.robot}: {reason}" for reason in of_robot]
        return tuple(reasons)

    def _readings(self) -> Iterator[Reading]:
        for runner in self._runners.by_path.values():
            realm, robot = runner.file.identity or ("", runner.file.robot)
            labels = {"realm": realm, "robot": robot}
            yield "gateway_up", labels, int(runner in self._up)
            yield "gateway_restarts", labels, runner.restarts
        yield "faulty_files", {}, len(self._runners.faults)
