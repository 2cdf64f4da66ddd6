"""One port for a host: what Prometheus reads of many gateways while they run, hang, die and hand over."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections import Counter
from urllib.error import HTTPError

from tests.e2e.conftest import Bench, device, until
from tests.e2e.rigs.robots import SETTINGS, Robot
from tests.e2e.rigs.supervised import Supervised
from tests.ports import free_port
from tests.scraped import Series, samples, scrape
from zbridge.app.endpoint import FRESH_MOST_S
from zbridge.host.metrics import ANSWER_S

ROBOTS = ("r0", "r1", "r2")


class Host:
    """A supervisor with an endpoint, and scripted robots."""

    def __init__(self, bench: Bench, options: str = "") -> None:
        self.port = free_port()
        folder = bench.folder / "robots"
        folder.mkdir()
        (folder / "host.toml").write_text(f'[metrics]\nlisten = "127.0.0.1:{self.port}"\n{options}')
        self.robots = {name: bench.stack.enter_context(contextlib.closing(Robot())) for name in ROBOTS}
        for name, robot in self.robots.items():
            bus = f'[bus]\nconnect = ["{bench.endpoint}"]\nmulticast = false\n'
            (folder / f"{name}.toml").write_text(f'[robot]\nname = "{name}"\n{device(robot.port)}{bus}')
        self.folder = folder
        self.supervisor = Supervised(bench.stack, folder)
        until(lambda: {bench.fleet.state(name) for name in ROBOTS} == {"established"}, 30, "all robots")

    def read(self) -> dict[Series, float]:
        return samples(scrape(self.port))

    def of(self, name: str, **given: str) -> Counter[str]:
        """Sum one metric of each robot, of series with these labels."""
        found = Counter[str]()
        for (own, labels), value in self.read().items():
            if own == name and labels >= given.items():
                found[dict(labels)["robot"]] += int(value)
        return found

    def readiness(self) -> tuple[int, str]:
        try:
            return 200, scrape(self.port, "/readyz")
        except HTTPError as error:
            return error.code, error.read().decode()


def test_a_gateway_that_hangs_or_has_died_has_no_series_and_all_others_are_served_in_time(bench: Bench) -> None:
    host = Host(bench)
    assert host.of("zbridge_gateway_up") == dict.fromkeys(ROBOTS, 1)
    until(lambda: host.readiness() == (200, "ok\n"), what="a host of use")
    assert set(host.of("zbridge_link_stalled")) == set(ROBOTS)
    frozen = host.supervisor.gateway("r1")
    os.kill(frozen, signal.SIGSTOP)
    time.sleep(FRESH_MOST_S)
    begun = time.monotonic()
    found = host.of("zbridge_link_stalled")
    assert ANSWER_S <= time.monotonic() - begun < ANSWER_S + 1.0
    assert set(found) == {"r0", "r2"}
    assert host.of("zbridge_gateway_up") == {"r0": 1, "r1": 0, "r2": 1}
    assert scrape(host.port, "/healthz") == "ok\n"
    os.kill(frozen, signal.SIGKILL)
    until(lambda: host.of("zbridge_gateway_restarts_total")["r1"] == 1, 20, "a restart")
    until(lambda: host.of("zbridge_gateway_up") == dict.fromkeys(ROBOTS, 1), 20, "its successor")
    os.kill(host.supervisor.gateway("r2"), signal.SIGKILL)
    until(lambda: host.of("zbridge_gateway_restarts_total")["r2"] == 1, 20, "a restart")
    host.robots["r0"].close()
    without = "503 r0: robot offline\n"
    until(lambda: "{} {}".format(*host.readiness()) == without, what="a host without a robot")
    offline = frozenset({("realm", "fleet"), ("robot", "r0"), ("state", "offline")})
    until(lambda: host.read()["zbridge_robot_state", offline] == 1, what="its state")


def test_only_a_scrape_in_the_moment_of_the_exchange_fails_when_the_supervisor_is_replaced(bench: Bench) -> None:
    host = Host(bench)
    handshake = host.of("zbridge_link_bytes_total", role="hq", direction="in")
    assert handshake == dict.fromkeys(ROBOTS, len(SETTINGS))
    supervisor = host.supervisor
    supervisor.process.send_signal(signal.SIGUSR2)
    with (host.folder / "r0.toml").open("a") as file:
        file.write("[control]\nlease_s = 2.0\n")
    supervisor.reload()
    counts, cut = [], 0

    def done() -> bool:
        nonlocal cut
        try:
            counts.append(host.of("zbridge_gateway_up"))
        except ConnectionError:  # its connection ended with the code that served it
            cut += 1
        return "has taken over in" in supervisor.log and "serves it now" in supervisor.log

    until(done, 30, "both")
    assert cut <= 1
    assert counts
    assert all(set(each) == set(ROBOTS) for each in counts)
    after = {**handshake, "r0": 0}
    until(lambda: host.of("zbridge_link_bytes_total", role="hq", direction="in") == after, what="counters of its own")
    (host.folder / "faulty.toml").write_text("colour = 1\n")
    supervisor.reload()
    until(lambda: ("zbridge_faulty_files", frozenset()) in host.read(), what="the number")
    until(lambda: host.read()["zbridge_faulty_files", frozenset()] == 1, what="the faulty file")
    assert "faulty.toml: faulty" in host.readiness()[1]


def test_gateways_of_one_process_are_shown_at_the_same_port(bench: Bench) -> None:
    host = Host(bench, "[host]\ntogether = true\n")
    assert set(host.of("zbridge_link_stalled")) == set(ROBOTS)
    until(lambda: host.readiness() == (200, "ok\n"), what="a host of use")
    started = [value for (name, _), value in host.read().items() if name == "process_start_time_seconds"]
    assert len(started) == 1
