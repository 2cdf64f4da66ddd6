"""Two drivers fight for one robot: it obeys one at a time, and everybody tells the same story."""

from __future__ import annotations

import pytest

from tests.e2e.measured.fight import faults, fight, holder_of


@pytest.mark.long
def test_two_drivers_never_move_a_robot_at_the_same_time_and_the_audit_log_tells_all() -> None:
    story = fight(6.0)
    assert not faults(story), story
    holders = {holder_of(frame).split(".")[0] for frame in story.frames if frame.moves}
    assert holders == {"anna", "bert"}
    events = {line["event"] for line in story.audit}
    assert events == {"acquired", "taken over", "released", "ended", "stopped", "refused"}
