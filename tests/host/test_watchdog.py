"""When a process counts as hung, and when one that died is started again: times are arguments."""

import pytest

from zbridge.host.watchdog import DRIVEN_S, EXTENSION_S, FIRST_S, IDLE_S, RestartDelay, Watchdog

DELAYS_S = [0.25, 0.5, 1.0, 2.0, 4.0]


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
    watchdog = Watchdog(100.0)
    for at, driven in beats:
        watchdog.heartbeat(at, driven=driven)
    assert watchdog.deadline == pytest.approx(deadline)


def test_a_driven_robot_can_be_stopped_within_a_second_and_a_half() -> None:
    stop_s = 0.2  # gaps of the protocols, and the end of the process
    assert DRIVEN_S + EXTENSION_S + stop_s <= 1.5


def test_a_supervisor_that_was_held_up_waits_a_little_longer_and_not_for_ever() -> None:
    watchdog = Watchdog(0.0)
    watchdog.heartbeat(1.0, driven=True)
    for _ in range(5):
        watchdog.extend()
    assert watchdog.deadline == pytest.approx(1.0 + DRIVEN_S + EXTENSION_S)
    watchdog.heartbeat(2.0, driven=True)
    assert watchdog.deadline == pytest.approx(2.0 + DRIVEN_S)


def test_five_failures_are_answered_soon_and_further_ones_once_a_minute() -> None:
    back_off = RestartDelay(lambda: 0.5)
    assert [back_off.failed(1.0) for _ in range(8)] == [*DELAYS_S, 60.0, 60.0, 60.0]


def test_a_process_that_lived_for_a_minute_begins_anew() -> None:
    back_off = RestartDelay(lambda: 0.5)
    for _ in range(7):
        back_off.failed(1.0)
    assert back_off.failed(59.9) == 60.0
    assert [back_off.failed(60.0), back_off.failed(1.0)] == DELAYS_S[:2]


def test_a_changed_file_begins_anew() -> None:
    back_off = RestartDelay(lambda: 0.5)
    for _ in range(7):
        back_off.failed(1.0)
    back_off.reset()
    assert back_off.failed(1.0) == DELAYS_S[0]


@pytest.mark.parametrize(("chance", "part"), [(0.0, 0.8), (1.0, 1.2)])
def test_chance_shifts_a_start_by_a_fifth(chance: float, part: float) -> None:
    assert RestartDelay(lambda: chance).failed(1.0) == pytest.approx(part * DELAYS_S[0])
