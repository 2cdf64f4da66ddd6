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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        path = item.path.relative_to(item.config.rootpath).as_posix()
        if any(fnmatch(path, pattern) for pattern in REAL):
            item.add_marker("e2e")


def pytest_asyncio_loop_factories(item: pytest.Item) -> dict[str, Callable[[], asyncio.AbstractEventLoop]]:
    if item.get_closest_marker("jumping"):
        return {"jumping": JumpingLoop}
    if item.get_closest_marker("both_loops"):
        return {"asyncio": asyncio.new_event_loop, "uvloop": uvloop.new_event_loop}
    return {"real": asyncio.new_event_loop}
