"""Floods on a real bus: the robot obeys its holder and every stop, others are answered, nothing grows."""

import pytest

from tests.benchmarks.flooder import KINDS
from tests.benchmarks.floods import ENDING, measure

RATES_HZ = {"drives": 10_000, "express": 5000, "forged": 5000, "scans": 100, "raws": 100, "stops": 20_000}
USUAL_HZ = 2000
SECONDS, QUIET_S = 2.0, 0.5
ANSWER_S = 2.0
"""Longest wait for an answer, and of commands, on a busy machine; without filters it is four seconds, or for ever."""
OBEYED = 0.5
"""Least share of the holder's drives that arrive, on a busy machine: what waits longer than 0.3 s is dropped."""
GROWN_MB = 20.0


RUNS = [*((kind, "router") for kind in KINDS), ("drives", "peer"), ("stops", "peer"), ("takeovers", "peer")]


@pytest.mark.parametrize(("kind", "way"), RUNS)
def test_a_flood_moves_no_robot_keeps_nobody_waiting_and_costs_no_memory(kind: str, way: str) -> None:
    row = measure(way, kind, RATES_HZ.get(kind, USUAL_HZ), SECONDS, QUIET_S)
    print(row)
    assert row.flooded.applied == 0, "nothing of the flood's was carried out"
    if kind in ENDING:
        assert row.stopped_s is not None
        assert row.stopped_s < 0.5
        assert row.last_motion_s is None or row.last_motion_s < row.stopped_s, "at rest, and it stays so"
    else:
        assert row.flooded.arrived > OBEYED, "the holder is obeyed"
        assert row.flooded.median_us < ANSWER_S * 1e6
    assert row.answer_s < ANSWER_S
    assert row.after_mb - row.before_mb < GROWN_MB
    if kind in ("scans", "raws"):
        assert "refused" not in row.counted, "too large: nobody here has heard of them"
    else:
        assert sum(row.counted.get(name, 0) for name in ("refused", "stops_folded", "bus_in_folded")) > 1000
