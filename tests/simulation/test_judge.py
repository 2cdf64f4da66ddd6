"""What every judge keeps."""

import pytest

from zbridge.simulation.judge import Ended, Judge, show


def test_a_judge_notes_what_is_wrong_and_what_happened_within_its_bound() -> None:
    noted: list[str] = []
    judge = Judge(keep=2, note=noted.append)
    for number in range(3):
        judge._violate(f"wrong {number}")
        judge._event(f"happened {number}")
    assert (judge.violations, judge.events) == (["wrong 0", "wrong 1"], ["happened 0", "happened 1"])
    assert noted == ["wrong 0", "wrong 1", "wrong 2"], "who listens hears of all"
    assert (judge.alive, judge.death) == (True, "")


def test_a_judge_that_dies_says_of_what_and_ends_what_it_was_doing() -> None:
    judge = Judge(keep=2, note=None)
    with pytest.raises(Ended, match="died: an unknown id"):
        judge._die("an unknown id")
    assert (judge.alive, judge.death, judge.violations) == (False, "an unknown id", ["an unknown id"])


def test_bytes_are_shown_in_hex_and_shortened() -> None:
    assert show(b"\x01\xff") == "01 ff"
    assert show(b"") == "(no bytes)"
    assert show(bytes(3), limit=2) == "00 00... (3 bytes)"
