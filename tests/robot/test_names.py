"""How many different names a robot may publish under."""

from zbridge.robot.names import HOUR_S, NAMES, NameBudget


def test_so_many_names_are_admitted_again_and_again_and_one_more_when_the_hour_of_the_first_is_over() -> None:
    names = NameBudget()
    names.expire(5.0)
    assert names.admit("n0", 10.0)
    for now in (20.0, 30.0):
        assert all(names.admit(f"n{number}", now) for number in range(NAMES))
    assert not names.over
    assert not names.admit("more", HOUR_S + 9.9)
    assert names.over
    assert names.admit("n0", HOUR_S + 9.9)
    names.expire(HOUR_S + 10.0)
    assert not names.over
    assert names.admit("more", HOUR_S + 10.0)
