"""When a process that died is started again."""

import pytest

from zbridge.host.back_off import BackOff

SOON_S = [0.25, 0.5, 1.0, 2.0, 4.0]


def test_five_failures_are_answered_soon_and_further_ones_once_a_minute() -> None:
    back_off = BackOff(lambda: 0.5)
    assert [back_off.failed(1.0) for _ in range(8)] == [*SOON_S, 60.0, 60.0, 60.0]


def test_a_process_that_lived_for_a_minute_begins_anew() -> None:
    back_off = BackOff(lambda: 0.5)
    for _ in range(7):
        back_off.failed(1.0)
    assert back_off.failed(59.9) == 60.0
    assert [back_off.failed(60.0), back_off.failed(1.0)] == SOON_S[:2]


def test_a_changed_file_begins_anew() -> None:
    back_off = BackOff(lambda: 0.5)
    for _ in range(7):
        back_off.failed(1.0)
    back_off.forget()
    assert back_off.failed(1.0) == SOON_S[0]


@pytest.mark.parametrize(("chance", "part"), [(0.0, 0.8), (1.0, 1.2)])
def test_chance_shifts_a_start_by_a_fifth(chance: float, part: float) -> None:
    assert BackOff(lambda: chance).failed(1.0) == pytest.approx(part * SOON_S[0])
