"""Two drivers fight for one robot: it obeys one at a time, and everybody tells the same story."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy

import pytest

from tests.e2e.fight import GRANTS, Story, faults, fight, holder_of


@pytest.fixture(scope="module")
def story() -> Story:
    return fight(6.0)


def test_two_drivers_never_move_a_robot_at_the_same_time_and_the_audit_log_tells_all(story: Story) -> None:
    assert not faults(story), story
    holders = {holder_of(frame).split(".")[0] for frame in story.frames if frame.moves}
    assert holders == {"anna", "bert"}
    events = {line["event"] for line in story.audit}
    assert events == {"acquired", "taken over", "released", "ended", "stopped", "refused"}


def _without_a_grant(story: Story) -> None:
    grants = [line for line in story.audit if line["event"] in GRANTS]
    story.audit = [line for line in story.audit if line is not grants[len(grants) // 2]]


def _without_an_end(story: Story) -> None:
    ends = [line for line in story.audit if line["event"] == "ended"]
    story.audit = [line for line in story.audit if line is not ends[0]]


def _with_a_late_motion(story: Story) -> None:
    first = next(frame for frame in story.frames if frame.moves)
    last = max(index for index, frame in enumerate(story.frames) if frame.moves)
    story.frames = [*story.frames[: last + 1], first._replace(at=story.frames[last].at), *story.frames[last + 1 :]]


def _without_stops(story: Story) -> None:
    story.frames = [frame for frame in story.frames if frame.moves]


def _with_two_holders(story: Story) -> None:
    shown = [message for message in story.control if message.get("holder")]
    story.control = [*story.control, shown[0]]


@pytest.mark.parametrize(
    "spoil", [_without_a_grant, _without_an_end, _with_a_late_motion, _without_stops, _with_two_holders]
)
def test_a_story_that_contradicts_itself_is_found_out(story: Story, spoil: Callable[[Story], None]) -> None:
    spoiled = copy(story)
    spoil(spoiled)
    assert faults(spoiled)
