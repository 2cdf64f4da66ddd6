"""The keyboard: motion only while a key repeats, whatever is typed and however the terminal delivers it."""

import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.cli.keyboard import ARROWS, DRIVES, FIRST_REPEAT_S, NEXT_REPEAT_S, STEP, Keyboard, split_keys
from zbridge.fleet.messages import Drive

STANDS = Drive()
RATE_S = 1 / 30
"""Between two repetitions of a held key."""
OTHERS = [" ", "x", "\r", "[", "A", "D", "W", "ä", "\x00", ""]
AT_03 = {"w": Drive(0.3), "s": Drive(-0.3), "q": Drive(left=0.3), "e": Drive(left=-0.3)} | {
    "a": Drive(turn=0.3),
    "d": Drive(turn=-0.3),
}


def held(keyboard: Keyboard, key: str, seconds: float) -> float:
    """Press a key and hold it as terminals report it; give the time of the last repetition."""
    keyboard.press(key, 0.0)
    now = 0.5
    while now <= seconds:
        keyboard.press(key, now)
        now += RATE_S
    return now - RATE_S


@pytest.mark.parametrize("key", [*AT_03, *OTHERS, "+", "-"])
def test_a_held_key_moves_in_its_direction_at_the_speed_that_is_set_until_it_is_let_go(key: str) -> None:
    keyboard = Keyboard(0.3)
    last = held(keyboard, key, 1.0)
    assert keyboard.drive(last) == keyboard.drive(last + 0.14) == AT_03.get(key, STANDS)
    assert keyboard.drive(last + 0.15) == STANDS


def test_plus_and_minus_change_the_speed_between_a_tenth_and_one_and_the_motion_goes_on() -> None:
    keyboard = Keyboard(0.3)
    last = held(keyboard, "s", 1.0)
    for key, presses, speed in (("+", 1, 0.4), ("+", 20, 1.0), ("-", 20, 0.1), ("-", 1, 0.1)):
        for _ in range(presses):
            keyboard.press(key, last)
        assert keyboard.speed == speed
        assert keyboard.drive(last) == Drive(forward=-speed)
    keyboard.press("s", last + RATE_S)
    assert keyboard.drive(last + RATE_S).moving


def meant(history: list[tuple[float, str]], now: float) -> str | None:
    """Say in other words what is meant: the direction of the last key, if it repeated, and just now."""
    keys = [(at, key) for at, key in history if key not in ("+", "-")]
    if len(keys) < 2:
        return None
    (first_at, first), (last_at, last) = keys[-2:]
    repeated = first == last and last in DRIVES and last_at - first_at <= FIRST_REPEAT_S
    return last if repeated and now < last_at + NEXT_REPEAT_S else None


PAUSES = st.one_of(
    st.sampled_from([0.0, RATE_S, NEXT_REPEAT_S, FIRST_REPEAT_S, FIRST_REPEAT_S + 0.001]), st.floats(0.0, 2.0)
)
HOLDS = st.tuples(st.sampled_from([*DRIVES, "+", "-", *OTHERS]), st.lists(PAUSES, min_size=1, max_size=4))


@given(st.lists(HOLDS, max_size=15), PAUSES, st.floats(0.1, 1.0))
def test_motion_only_while_the_same_key_repeats(holds: list[tuple[str, list[float]]], rest: float, speed) -> None:
    keyboard, history, now = Keyboard(speed), list[tuple[float, str]](), 0.0
    for pause, key in [*((pause, key) for key, pauses in holds for pause in pauses), (rest, "")]:
        for looked_at in (now, now + pause):
            full = DRIVES.get(meant(history, looked_at) or "", STANDS)
            wanted = [value * keyboard.speed for value in (full.forward, full.left, full.turn)]
            drive = keyboard.drive(looked_at)
            assert [drive.forward, drive.left, drive.turn] == wanted
        assert STEP <= keyboard.speed <= 1.0
        now += pause
        keyboard.press(key, now)
        history.append((now, key))
    assert keyboard.drive(now) == keyboard.drive(now + 100.0) == STANDS


# What a terminal sends


@pytest.mark.parametrize(
    ("text", "keys"),
    [("", ""), ("www", "www"), ("\x1b[A\x1b[B\x1b[C\x1b[D", "wsda"), ("w\x1b[A \x1b[Aw", "ww ww"), ("\x1b", "")]
    + [("\x1b\x1b[A", "w"), ("x\r\n +-", "x\r\n +-")],
)
def test_text_is_cut_into_keys(text: str, keys: str) -> None:
    assert split_keys(text) == list(keys)


@given(st.text(alphabet=string.ascii_letters + " +-\r\n[]0123456789;~ä\x00"))
def test_what_has_no_escape_is_cut_into_characters(text: str) -> None:
    assert split_keys(text) == list(text)


@given(st.lists(st.sampled_from([*ARROWS, *DRIVES, " ", "x"])))
def test_arrows_and_letters_are_told_apart_in_any_mixture(parts: list[str]) -> None:
    assert split_keys("".join(parts)) == [ARROWS.get(part, part) for part in parts]


@given(st.text(alphabet="\x1b[ABCDwsadqe x"))
def test_no_key_is_longer_than_a_character_and_none_is_an_escape(text: str) -> None:
    keys = split_keys(text)
    assert all(len(key) == 1 and key != "\x1b" for key in keys)
    assert keys.count(" ") == text.count(" "), "a stop is never swallowed"


ALWAYS_CUT = st.tuples(st.sampled_from(sorted(ARROWS)), st.sampled_from([1, 2])).map(lambda cut: [cut] * 30)


@given(st.one_of(st.lists(st.tuples(st.sampled_from(sorted(ARROWS)), st.integers(0, 3)), max_size=30), ALWAYS_CUT))
def test_arrows_however_they_are_split_move_nowhere_but_where_they_point(arrows: list[tuple[str, int]]) -> None:
    keyboard, pointed = Keyboard(1.0), {STANDS}
    for number, (arrow, cut) in enumerate(arrows):
        if cut in (0, 3):
            pointed.add(DRIVES[ARROWS[arrow]])
        for part in (arrow[:cut], arrow[cut:]):
            for key in split_keys(part):
                keyboard.press(key, number * RATE_S)
            assert keyboard.drive(number * RATE_S) in pointed


@pytest.mark.parametrize("sequence", ["\x1b[3~", "\x1b[H", "\x1bOP", "\x1b[15~", "\x1b[1;5A", "\x1b[Z"])
def test_other_keys_with_an_escape_move_nothing_however_long_they_are_held(sequence: str) -> None:
    assert split_keys(sequence * 30) == []
