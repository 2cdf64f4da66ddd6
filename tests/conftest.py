"""Marks by folder, and how hypothesis runs here: a machine that is busy with other tests is no failure."""

import asyncio
import contextlib
import importlib
import itertools
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

import pytest
import uvloop
from hypothesis import HealthCheck, settings

from tests import STATE
from tests.clock import JumpingLoop

collect_ignore = ["vectors"]  # among them packages with tests of their own
TESTS = Path(__file__).parent
_numbers = itertools.count()
REAL = ("tests/e2e/*", "tests/gateways/*/conformance/*")
"""Where tests take real sockets and real time: scenes on Zenoh, and the judges against plain sockets."""

PROFILES = {"zbridge": 100, "quick": 20}
for profile, examples in PROFILES.items():
    settings.register_profile(
        profile, deadline=None, max_examples=examples, suppress_health_check=[HealthCheck.too_slow]
    )


def pytest_configure(config: pytest.Config) -> None:
    settings.load_profile("quick" if config.getoption("markexpr") == "not e2e" else "zbridge")


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session: pytest.Session) -> None:
    """Let each worker of a whole run first import its share of the modules: what it compiles the others only read."""
    config, workerinput = session.config, getattr(session.config, "workerinput", None)
    if workerinput is None or config.args_source is not pytest.Config.ArgsSource.TESTPATHS:
        return
    paths = (path.relative_to(config.rootpath) for path in TESTS.rglob("test_*.py"))
    names = sorted(path for path in paths if not {*collect_ignore} & {*path.parts})
    first, workers = int(workerinput["workerid"].removeprefix("gw")), workerinput["workercount"]
    for name in names[first::workers]:
        with contextlib.suppress(Exception, pytest.skip.Exception):  # told when it is collected
            importlib.import_module(".".join(name.with_suffix("").parts))


@pytest.fixture(autouse=True)
def _state_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no test find what another one's gateways kept."""
    monkeypatch.setenv("XDG_STATE_HOME", str(STATE / str(next(_numbers))))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        path = item.path.relative_to(item.config.rootpath).as_posix()
        if any(fnmatch(path, pattern) for pattern in REAL):
            item.add_marker("e2e")
    workerinput = getattr(config, "workerinput", None)
    if workerinput is not None:
        items[:] = dealt(items, workerinput["workercount"])


def dealt(items: list[pytest.Item], workers: int) -> list[pytest.Item]:
    """Let each worker begin with its share of the longest: a worker of xdist gets a run of the list as long as others.

    A long test that is begun last is waited for by all; of a run that is finished late the other workers take the end.
    """
    longest = [item for item in items if item.get_closest_marker("long")]
    others = spread([item for item in items if not item.get_closest_marker("long")])
    runs: list[pytest.Item] = []
    for worker in range(workers):
        share = longest[worker::workers]
        rest = max(0, (len(items) - len(runs)) // (workers - worker) - len(share))
        runs += share + others[:rest]
        del others[:rest]
    return runs + others


def spread(items: list[pytest.Item]) -> list[pytest.Item]:
    """Put the modules that mostly wait evenly among those that compute."""
    placed = []
    for waits in (False, True):
        alike = [item for item in items if (item.get_closest_marker("e2e") is not None) is waits]
        modules = [list(module) for _, module in itertools.groupby(alike, key=lambda item: item.path)]
        before = itertools.accumulate((len(module) for module in modules), initial=0)
        placed += [(at / len(alike), module) for at, module in zip(before, modules, strict=False)]
    return [item for _, module in sorted(placed, key=lambda one: one[0]) for item in module]


def pytest_asyncio_loop_factories(item: pytest.Item) -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    if item.get_closest_marker("jumping"):
        return {"jumping": JumpingLoop}
    if item.get_closest_marker("both_loops"):
        return {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}
    return {"real": asyncio.new_event_loop}
