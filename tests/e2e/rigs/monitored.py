"""A fleet that Prometheus scrapes: three protocols, a driver, an HQ program, refusals and stops; and its answers."""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

import yaml

from tests.e2e.conftest import WAIT_S, Bench, device, end, listener, repeated, until
from tests.e2e.rigs.supervised import Supervised
from tests.ports import HOST, free_port

SHIPPED = Path(__file__).parents[3] / "deploy" / "prometheus"
PROMETHEUS = shutil.which("prometheus")
INTERVAL_S, RATE_INTERVAL = 1, "10s"
ROBOTS = {"r1": "tcpudp", "v1": "alf", "w1": "wc2ec"}

Answer = list[dict[str, Any]]
"""Series: ``metric``, with ``value`` or ``values``."""


class Prometheus:
    """A Prometheus with the configuration that is shipped, but for its target and intervals."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path, target: str) -> None:
        assert PROMETHEUS is not None
        configuration = yaml.safe_load((SHIPPED / "prometheus.yml").read_text())
        (job,) = configuration["scrape_configs"]
        job["static_configs"] = [{"targets": [target]}]
        job["scrape_timeout"] = f"{INTERVAL_S}s"
        configuration["global"] = {f"{what}_interval": f"{INTERVAL_S}s" for what in ("scrape", "evaluation")}
        configuration["rule_files"] = [str(SHIPPED / "alerts.yml")]
        file, port = folder / "prometheus.yml", free_port()
        file.write_text(yaml.safe_dump(configuration))
        command = [PROMETHEUS, f"--config.file={file}", f"--storage.tsdb.path={folder / 'tsdb'}"]
        with (folder / "prometheus.log").open("wb") as log:
            listen = f"--web.listen-address={HOST}:{port}"
            process = subprocess.Popen([*command, listen], stdout=log, stderr=log, text=True)
        stack.callback(end, process)
        self._at = f"http://{HOST}:{port}/api/v1"

    def ask(self, page: str, **parameters: object) -> Any:
        """Ask its HTTP interface; give the data."""
        with urllib.request.urlopen(f"{self._at}/{page}?{urllib.parse.urlencode(parameters)}", timeout=10) as answer:
            return json.load(answer)["data"]

    def query(self, expression: str) -> Answer:
        """Give the series of an expression, now; none while Prometheus starts."""
        try:
            return self.ask("query", query=expression)["result"]  # type: ignore[no-any-return]
        except urllib.error.URLError as error:
            if isinstance(error.reason, ConnectionRefusedError):
                return []
            raise

    def history(self, expression: str, seconds: float) -> Answer:
        """Give the series of an expression over the last seconds."""
        now = time.time()
        span = {"start": now - seconds, "end": now, "step": INTERVAL_S}
        return self.ask("query_range", query=expression, **span)["result"]  # type: ignore[no-any-return]

    def scraped(self, times: int) -> None:
        """Wait until all gateways have answered so many times."""
        expression = f"min(sum_over_time(zbridge_gateway_up[1h])) >= {times}"
        until(lambda: self.query(expression), times * INTERVAL_S + WAIT_S, f"{times} scrapes")


def dashboard() -> dict[str, Any]:
    """Read the dashboard that is shipped, for all realms and robots."""
    text = (SHIPPED / "dashboard.json").read_text()
    for variable, value in {"$__rate_interval": RATE_INTERVAL, "$realm": ".*", "$robot": ".*"}.items():
        text = text.replace(variable, value)
    return json.loads(text)  # type: ignore[no-any-return]


class MonitoredFleet:
    """The fleet of a supervisor, and its Prometheus. Motion is asked for while a robot is in ``driven``."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.driven: set[str] = set()
        folder, self._hq_port = bench.folder / "robots", free_port()
        folder.mkdir()
        target = f"{HOST}:{free_port()}"
        self.prometheus = Prometheus(bench.stack, bench.folder, target)
        (folder / "host.toml").write_text(f'[metrics]\nlisten = "{target}"\n')
        for robot, protocol in ROBOTS.items():
            parts = [f'[robot]\nname = "{robot}"\n', device(bench.simulator(protocol), protocol)]
            parts.append(f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n')
            parts.append(f'[control]\naudit = "{bench.folder}/{robot}.jsonl"\n')
            if robot == "r1":
                parts.append(listener("hq", "tcpudp", self._hq_port))
            (folder / f"{robot}.toml").write_text("".join(parts))
        self.supervisor = Supervised(bench.stack, folder)
        until(lambda: {bench.fleet.state(robot) for robot in ROBOTS} == {"established"}, 20, "all robots")
        bench.stack.enter_context(repeated(self._drive, 0.1))

    def _drive(self) -> None:
        for robot in tuple(self.driven):
            self.bench.fleet.put(f"{robot}/@cmd/drive", forward=0.4)

    def show_to_hq_program(self) -> None:
        """Connect an HQ program to the first robot."""
        self.bench.zbridge("simulate", "tcpudp", "--hq", f"tcp://{HOST}:{self._hq_port}")
