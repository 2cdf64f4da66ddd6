"""What every judge keeps."""

import pytest

from zbridge.simulation.judge import Ended, Judge, show


def test_a_judge_notes_what_is_wrong_and_what_happened_within_its_bound_and_says_of_what_it_dies() -> None:
    noted: list[str] = []
    judge = Judge(keep=2, note=noted.append)
    judge._violate("wrong")
    assert (judge.alive, judge.death) == (True, "")
    with pytest.raises(Ended, match="died: an unknown id"):
        judge._die("an unknown id")
    judge._violate("wrong again")
    for number in range(3):
        judge._event(f"happened {number}")
    assert (judge.violations, judge.events) == (["wrong", "an unknown id"], ["happened 0", "happened 1"])
    assert noted == ["wrong", "an unknown id", "wrong again"], "who listens hears of all"
    assert (judge.alive, judge.death) == (False, "an unknown id")


def test_bytes_are_shown_in_hex_and_shortened() -> None:
    assert show(b"\x01\xff") == "01 ff"
    assert show(b"") == "(no bytes)"
    assert show(bytes(3), limit=2) == "00 00... (3 bytes)"
