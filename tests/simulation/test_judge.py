"""What every judge keeps."""

import pytest

from zbridge.simulation.judge import Chances, Ended, Judge, show


class Strict(Judge):
    """A judge that a test tells what to record."""

    def violate(self, text: str) -> None:
        self._violate(text)

    def happen(self, text: str) -> None:
        self._event(text)

    def die(self, text: str) -> None:
        self._die(text)

    def report(self, problem: str, raw: str, *, deadly: bool = False) -> bool:
        return self._report(problem, raw, deadly=deadly)


class Forgetful(Strict):
    KEEP = 2


def test_a_judge_notes_what_is_wrong_and_what_happened_within_its_bound_and_says_of_what_it_dies() -> None:
    noted: list[str] = []
    judge = Forgetful()
    judge.note = noted.append
    judge.violate("wrong")
    assert (judge.alive, judge.death) == (True, "")
    with pytest.raises(Ended, match="died: an unknown id"):
        judge.die("an unknown id")
    judge.violate("wrong again")
    for number in range(3):
        judge.happen(f"happened {number}")
    assert (judge.violations, judge.events) == (["wrong", "an unknown id"], ["happened 0", "happened 1"])
    assert noted == ["wrong", "an unknown id", "wrong again"], "who listens hears of all"
    assert (judge.alive, judge.death) == (False, "an unknown id")


def test_a_fault_in_a_message_is_recorded_with_its_bytes_and_a_deadly_one_ends_the_judge() -> None:
    judge = Forgetful()
    assert not judge.report("", "01 02")
    assert judge.report("a wrong length", "01 02")
    with pytest.raises(Ended):
        judge.report("an unknown id", "03", deadly=True)
    assert judge.violations == ["a wrong length: 01 02", "an unknown id: 03"]
    assert judge.death == "an unknown id: 03"
    for number in range(3):
        judge.received.append(number)
    assert list(judge.received) == [1, 2], "the newest are kept"


def test_what_is_left_to_one_chance_does_not_depend_on_another() -> None:
    one, other = Chances(5), Chances(5)
    other["sleep"].random()
    assert one["answer"].random() == other["answer"].random()
    assert one["answer"].random() != one["sleep"].random() != Chances(6)["sleep"].random()


def test_bytes_are_shown_in_hex_and_shortened() -> None:
    assert show(b"\x01\xff") == "01 ff"
    assert show(b"") == "(no bytes)"
    assert show(bytes(3), limit=2) == "00 00... (3 bytes)"
