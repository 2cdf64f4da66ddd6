"""What every judge keeps."""

import pytest

from zbridge.simulation.judge import Judge


class _Dead(Exception):
    pass


class _Toy(Judge):
    _DEATH = _Dead


def test_a_judge_notes_what_is_wrong_and_what_happened_within_its_bound() -> None:
    noted: list[str] = []
    judge = _Toy(keep=2, note=noted.append)
    for number in range(3):
        judge._violate(f"wrong {number}")
        judge._event(f"happened {number}")
    assert (judge.violations, judge.events) == (["wrong 0", "wrong 1"], ["happened 0", "happened 1"])
    assert noted == ["wrong 0", "wrong 1", "wrong 2"], "who listens hears of all"
    assert (judge.alive, judge.death) == (True, "")


def test_a_judge_that_dies_says_of_what_and_ends_what_it_was_doing() -> None:
    judge = _Toy(keep=2, note=None)
    with pytest.raises(_Dead, match="died: an unknown id"):
        judge._die("an unknown id")
    assert (judge.alive, judge.death, judge.violations) == (False, "an unknown id", ["an unknown id"])
