"""How many different names a robot may publish under."""

from zbridge.robot.names import HOUR_S, NAMES, NameBudget


def test_as_many_names_as_there_may_be_are_admitted_again_and_again() -> None:
    names = NameBudget()
    for now in (10.0, 20.0):
        assert all(names.admit(f"n{number}", now) for number in range(NAMES))
    assert not names.over
    assert repr(names) == f"<NameBudget {NAMES} of {NAMES}>"


def test_one_more_is_not_admitted_until_the_hour_is_over() -> None:
    names = NameBudget()
    for number in range(NAMES):
        names.admit(f"n{number}", 10.0)
    assert not names.admit("more", 10.0)
    assert names.over
    assert names.admit("n0", 10.0)
    assert not names.admit("more", 10.0 + HOUR_S - 0.1)
    names.expire(10.0 + HOUR_S)
    assert not names.over
    assert names.admit("more", 10.0 + HOUR_S)
    assert repr(names) == f"<NameBudget 1 of {NAMES}>"


def test_the_hour_begins_with_its_first_name() -> None:
    names = NameBudget()
    names.expire(5.0)
    names.admit("first", HOUR_S)
    assert names.admit("second", 1.5 * HOUR_S)
    names.expire(1.9 * HOUR_S)
    assert repr(names) == f"<NameBudget 2 of {NAMES}>"
