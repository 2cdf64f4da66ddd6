"""The simulated bus does what Zenoh does: the quick traces, on real sessions and a router between namespaces."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.e2e.rigs.processes import NotHereError, apart
from tests.simulated.bus_validation import played_model
from tests.simulated.bus_validation.trace import Trace
from tests.simulated.bus_validation.traces import TRACES


def test_what_zenoh_does_lies_within_what_the_simulated_bus_allows() -> None:
    try:
        apart()
    except NotHereError as why:
        pytest.skip(str(why))
    command = [sys.executable, "-m", "tests.simulated.bus_validation", "--quick", "--seeds", "10", "--at-once", "8"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("trace", [each for each in TRACES if each.lasts_s < 12], ids=lambda trace: trace.name)
def test_the_same_seed_plays_a_trace_the_same_way(trace: Trace) -> None:
    assert played_model.play(trace, 3) == played_model.play(trace, 3)
