"""When a gateway process counts as hung."""

import pytest

from zbridge.host.watchdog import DRIVEN_S, EXCUSED_S, FIRST_S, IDLE_S, Heart


@pytest.mark.parametrize(
    ("beats", "deadline"),
    [
        ([], 100.0 + FIRST_S),
        ([(101.0, False)], 101.0 + IDLE_S),
        ([(101.0, True)], 101.0 + DRIVEN_S),
        ([(101.0, True), (101.2, True)], 101.2 + DRIVEN_S),
        ([(101.0, True), (101.2, False)], 101.2 + IDLE_S),
    ],
)
def test_a_process_is_given_time_from_its_last_beat(beats: list[tuple[float, bool]], deadline: float) -> None:
    heart = Heart(100.0)
    for at, driven in beats:
        heart.beat(at, driven=driven)
    assert heart.deadline == pytest.approx(deadline)


def test_a_driven_robot_can_be_stopped_within_a_second_and_a_half() -> None:
    stop_s = 0.2  # gaps of the protocols, and the end of the process
    assert DRIVEN_S + EXCUSED_S + stop_s <= 1.5


def test_a_supervisor_that_was_held_up_waits_a_little_longer_and_not_for_ever() -> None:
    heart = Heart(0.0)
    heart.beat(1.0, driven=True)
    for _ in range(5):
        heart.excuse()
    assert heart.deadline == pytest.approx(1.0 + DRIVEN_S + EXCUSED_S)
    heart.beat(2.0, driven=True)
    assert heart.deadline == pytest.approx(2.0 + DRIVEN_S)
