"""Marks by folder, and how hypothesis runs here: a machine that is busy with other tests is no failure."""

import asyncio
import itertools
from collections.abc import Callable
from fnmatch import fnmatch

import pytest
import uvloop
from hypothesis import HealthCheck, settings

from tests import STATE
from tests.clock import JumpingLoop

collect_ignore = ["vectors"]  # among them packages with tests of their own
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


@pytest.fixture(autouse=True)
def _state_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let no test find what another one's gateways kept."""
    monkeypatch.setenv("XDG_STATE_HOME", str(STATE / str(next(_numbers))))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        path = item.path.relative_to(item.config.rootpath).as_posix()
        if any(fnmatch(path, pattern) for pattern in REAL):
            item.add_marker("e2e")
    if hasattr(config, "workerinput"):
        items[:] = spread(items)


def spread(items: list[pytest.Item]) -> list[pytest.Item]:
    """Put the modules that mostly wait evenly among those that compute: each worker of xdist gets a run of the list."""
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
