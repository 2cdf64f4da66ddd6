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
DIRECTIONS = sorted(DRIVES)
OTHERS = [" ", "x", "\r", "[", "A", "D", "W", "ä", "\x00", ""]


def held(keyboard: Keyboard, key: str, start: float, seconds: float, *, wait_s: float = 0.5) -> float:
    """Press a key and hold it as terminals report it; give the time of the last repetition."""
    keyboard.press(key, start)
    now = start + wait_s
    while now <= start + seconds:
        keyboard.press(key, now)
        now += RATE_S
    return now - RATE_S


# What a key means


@pytest.mark.parametrize(
    ("key", "drive"),
    [
        ("w", Drive(forward=0.3)),
        ("s", Drive(forward=-0.3)),
        ("a", Drive(turn=0.3)),
        ("d", Drive(turn=-0.3)),
        ("q", Drive(left=0.3)),
        ("e", Drive(left=-0.3)),
    ],
)
def test_a_held_key_moves_in_its_direction_at_the_speed_that_is_set(key: str, drive: Drive) -> None:
    keyboard = Keyboard(0.3)
    last = held(keyboard, key, 0.0, 1.0)
    assert keyboard.drive(last) == drive
    assert keyboard.drive(last + 0.14) == drive


@pytest.mark.parametrize("key", DIRECTIONS)
def test_nothing_moves_before_the_key_repeats(key: str) -> None:
    keyboard = Keyboard(0.3)
    keyboard.press(key, 10.0)
    for tenth in range(100):
        assert keyboard.drive(10.0 + tenth / 10) == STANDS


def test_nothing_moves_before_any_key() -> None:
    assert Keyboard(1.0).drive(0.0) == STANDS


def test_motion_ends_soon_after_the_last_repetition() -> None:
    keyboard = Keyboard(0.3)
    last = held(keyboard, "w", 0.0, 2.0)
    assert keyboard.drive(last + NEXT_REPEAT_S - 0.001).moving
    assert not keyboard.drive(last + NEXT_REPEAT_S).moving
    assert NEXT_REPEAT_S <= 0.15


def test_a_second_press_long_after_the_first_is_no_repetition() -> None:
    keyboard = Keyboard(0.3)
    keyboard.press("w", 0.0)
    keyboard.press("w", FIRST_REPEAT_S + 0.001)
    assert not keyboard.drive(FIRST_REPEAT_S + 0.001).moving


def test_a_slow_first_repetition_is_one() -> None:
    keyboard = Keyboard(0.3)
    keyboard.press("w", 0.0)
    keyboard.press("w", FIRST_REPEAT_S)
    assert keyboard.drive(FIRST_REPEAT_S).moving


@pytest.mark.parametrize("other", [*(key for key in DIRECTIONS if key != "w"), *OTHERS])
def test_another_key_ends_the_motion_at_once(other: str) -> None:
    keyboard = Keyboard(0.3)
    last = held(keyboard, "w", 0.0, 1.0)
    assert keyboard.drive(last).moving
    keyboard.press(other, last)
    assert keyboard.drive(last) == STANDS
    keyboard.press("w", last + 0.01)
    assert keyboard.drive(last + 0.01) == STANDS, "w has to repeat anew"


def test_two_keys_in_turn_move_nothing() -> None:
    keyboard = Keyboard(0.3)
    for number in range(60):
        now = number * RATE_S
        keyboard.press("wd"[number % 2], now)
        assert keyboard.drive(now) == STANDS


@pytest.mark.parametrize("key", OTHERS)
def test_a_held_key_without_a_direction_moves_nothing(key: str) -> None:
    keyboard = Keyboard(0.3)
    assert keyboard.drive(held(keyboard, key, 0.0, 2.0)) == STANDS


# Speed


def test_plus_and_minus_change_the_speed_between_a_tenth_and_one() -> None:
    keyboard = Keyboard(0.3)
    keyboard.press("+", 0.0)
    assert keyboard.speed == 0.4
    for _ in range(20):
        keyboard.press("+", 0.0)
    assert keyboard.speed == 1.0
    for _ in range(20):
        keyboard.press("-", 0.0)
    assert keyboard.speed == STEP


def test_the_speed_changes_under_way_and_the_motion_goes_on() -> None:
    keyboard = Keyboard(0.3)
    last = held(keyboard, "s", 0.0, 1.0)
    keyboard.press("+", last)
    assert keyboard.drive(last) == Drive(forward=-0.4)
    keyboard.press("s", last + RATE_S)
    assert keyboard.drive(last + RATE_S) == Drive(forward=-0.4)


def test_holding_plus_moves_nothing() -> None:
    keyboard = Keyboard(0.3)
    assert keyboard.drive(held(keyboard, "+", 0.0, 2.0)) == STANDS


# Any keys at any times

presses = st.lists(st.tuples(st.floats(0.0, 2.0), st.sampled_from([*DIRECTIONS, "+", "-", *OTHERS])), max_size=40)


def meant(history: list[tuple[float, str]], now: float) -> str | None:
    """Say in other words what is meant: the direction of the last key, if it repeated, and just now."""
    keys = [(at, key) for at, key in history if key not in ("+", "-")]
    if len(keys) < 2:
        return None
    (first_at, first), (last_at, last) = keys[-2:]
    repeated = first == last and last in DRIVES and last_at - first_at <= FIRST_REPEAT_S
    return last if repeated and now < last_at + NEXT_REPEAT_S else None


@given(presses, st.floats(0.0, 1.0), st.floats(0.1, 1.0))
def test_motion_only_while_the_same_key_repeats(steps: list[tuple[float, str]], rest: float, speed: float) -> None:
    keyboard, history, now = Keyboard(speed), list[tuple[float, str]](), 100.0
    for pause, key in steps:
        for looked_at in (now, now + pause):
            assert keyboard.drive(looked_at).moving == (meant(history, looked_at) is not None)
        now += pause
        keyboard.press(key, now)
        history.append((now, key))
    drive, key = keyboard.drive(now + rest), meant(history, now + rest)
    full = DRIVES[key] if key else STANDS
    assert drive == Drive(
        forward=full.forward * keyboard.speed, left=full.left * keyboard.speed, turn=full.turn * keyboard.speed
    )


@given(presses, st.floats(NEXT_REPEAT_S, 100.0))
def test_a_keyboard_at_rest_never_moves(steps: list[tuple[float, str]], rest: float) -> None:
    keyboard, now = Keyboard(1.0), 100.0
    for pause, key in steps:
        now += pause
        keyboard.press(key, now)
    assert keyboard.drive(now + rest + 1e-9) == STANDS


@given(st.permutations(DIRECTIONS), st.lists(st.floats(0.0, 1.0), min_size=6, max_size=6))
def test_single_presses_never_move(keys: list[str], pauses: list[float]) -> None:
    keyboard, now = Keyboard(1.0), 0.0
    for key, pause in zip(keys, pauses, strict=True):
        keyboard.press(key, now)
        assert keyboard.drive(now) == keyboard.drive(now + pause / 2) == STANDS
        now += pause


@given(presses)
def test_no_command_is_out_of_range(steps: list[tuple[float, str]]) -> None:
    keyboard, now = Keyboard(1.0), 0.0
    for pause, key in steps:
        now += pause
        keyboard.press(key, now)
        drive = keyboard.drive(now)
        assert all(-1.0 <= value <= 1.0 for value in (drive.forward, drive.left, drive.turn))
        assert sum(value != 0 for value in (drive.forward, drive.left, drive.turn)) <= 1
        assert STEP <= keyboard.speed <= 1.0


# What a terminal sends


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        ("", []),
        ("w", ["w"]),
        ("www", ["w", "w", "w"]),
        ("\x1b[A", ["w"]),
        ("\x1b[B\x1b[C\x1b[D", ["s", "d", "a"]),
        ("w\x1b[Aw", ["w", "w", "w"]),
        ("\x1b[A\x1b[A \x1b[A", ["w", "w", " ", "w"]),
        ("\x1b", []),
        ("\x1b\x1b[A", ["w"]),
        ("x\r\n +-", ["x", "\r", "\n", " ", "+", "-"]),
    ],
)
def test_text_is_cut_into_keys(text: str, keys: list[str]) -> None:
    assert split_keys(text) == keys


@given(st.text(alphabet=string.ascii_letters + " +-\r\n[]0123456789;~ä\x00"))
def test_what_has_no_escape_is_cut_into_characters(text: str) -> None:
    assert split_keys(text) == list(text)


@given(st.lists(st.sampled_from([*ARROWS, *DIRECTIONS, " ", "x"])))
def test_arrows_and_letters_are_told_apart_in_any_mixture(parts: list[str]) -> None:
    assert split_keys("".join(parts)) == [ARROWS.get(part, part) for part in parts]


@given(st.text(alphabet="\x1b[ABCDwsadqe x"))
def test_no_key_is_longer_than_a_character_and_none_is_an_escape(text: str) -> None:
    keys = split_keys(text)
    assert all(len(key) == 1 and key != "\x1b" for key in keys)
    assert keys.count(" ") == text.count(" "), "a stop is never swallowed"


def test_a_held_arrow_moves() -> None:
    keyboard = Keyboard(0.5)
    for number in range(10):
        for key in split_keys("\x1b[D"):
            keyboard.press(key, number * RATE_S)
    assert keyboard.drive(9 * RATE_S) == Drive(turn=0.5)


@pytest.mark.parametrize("cut", [1, 2])
@pytest.mark.parametrize("arrow", ARROWS)
def test_an_arrow_split_over_two_reads_moves_nothing(arrow: str, cut: int) -> None:
    keyboard = Keyboard(1.0)
    for number in range(30):
        for part in (arrow[:cut], arrow[cut:]):
            for key in split_keys(part):
                keyboard.press(key, number * RATE_S)
            assert keyboard.drive(number * RATE_S) == STANDS


@given(st.lists(st.tuples(st.sampled_from(sorted(ARROWS)), st.integers(0, 3)), max_size=30))
def test_arrows_however_they_are_split_move_nowhere_but_where_they_point(arrows: list[tuple[str, int]]) -> None:
    keyboard = Keyboard(1.0)
    pointed = set()
    for number, (arrow, cut) in enumerate(arrows):
        pointed.add(ARROWS[arrow])
        for part in (arrow[:cut], arrow[cut:]):
            for key in split_keys(part):
                keyboard.press(key, number * RATE_S)
            drive = keyboard.drive(number * RATE_S)
            assert drive == STANDS or drive in [DRIVES[key] for key in pointed]


@pytest.mark.parametrize("sequence", ["\x1b[3~", "\x1b[H", "\x1bOP", "\x1b[15~", "\x1b[1;5A", "\x1b[Z"])
def test_other_keys_with_an_escape_move_nothing_however_long_they_are_held(sequence: str) -> None:
    keyboard = Keyboard(1.0)
    for number in range(30):
        for key in split_keys(sequence):
            keyboard.press(key, number * RATE_S)
        assert keyboard.drive(number * RATE_S) == STANDS
