"""The thread that writes what may block: order, bounds, newest wins or back pressure."""

import threading
from collections.abc import Iterator

import pytest

from zbridge.bus.writer import AT_ONCE, BACKLOG, SLOW_S, WARY_S, Writer
from zbridge.metrics import Metrics

SOON_S = 5.0
NEWEST, LOSSLESS = [False], [True]
BOTH = NEWEST + LOSSLESS


class Rig:
    """A writer whose thread can be held, as a full transmission queue holds it."""

    def __init__(self, lossless: bool) -> None:
        self.metrics = Metrics()
        self.relieved = threading.Event()
        self.relieved_on: list[int] = []
        self.writer = Writer("test", self.metrics, lossless=lossless, relieved=self._relieve)
        self.written: list[str] = []
        self._go = threading.Event()

    def _relieve(self) -> None:
        self.relieved_on.append(threading.get_ident())
        self.relieved.set()

    def hold(self) -> None:
        """Keep the thread busy until :meth:`release`."""
        held, self._go = threading.Event(), threading.Event()
        go = self._go
        self.writer.put(lambda: (held.set(), go.wait(SOON_S)), 0)
        assert held.wait(SOON_S)

    def release(self) -> None:
        self._go.set()

    def end(self) -> None:
        """Let the thread continue, and wait until it has written everything."""
        self.release()
        self.writer.stop(SOON_S)

    def play(self, steps: str) -> str:
        """Put calls: ``a:7`` a call of size 7, ``status=on`` one under a key; ``fail`` raises. Tell which ask to pause.

        In capitals, the newest of a key. ``hold`` keeps the thread busy until the end, ``end`` ends it.
        """
        paused = []
        for step in steps.split():
            if step in ("hold", "end"):
                getattr(self, step)()
                continue
            name, _, size = step.partition(":")
            key, by_key, _ = name.partition("=")
            call = _fail if "fail" in name else lambda name=name: self.written.append(name)
            by = self.writer.newest if name.isupper() else self.writer.replace
            goes_on = by(key, call) if by_key else self.writer.put(call, int(size or 1))
            paused += [] if goes_on else [name]
        return " ".join(paused)


def _fail() -> None:
    raise OSError("closed")


@pytest.fixture
def lossless() -> Iterator[Rig]:
    rig = Rig(lossless=True)
    yield rig
    rig.end()


FULL = BACKLOG
MANY = "a " * FULL
COURSES = {
    # for which writers; steps; what asks to pause; what is written; dropped, replaced, relieved
    "calls are carried out in order": (BOTH, "a b c d", "", "a b c d", 0, 0, 0),
    "a call that fails counts by its size": (BOTH, "fail fail:3 status=fail after", "", "after", 5, 0, 0),
    "calls after the end are counted": (BOTH, "a end late:2 status=late", "", "a", 3, 0, 0),
    "of a key the newest wins": (NEWEST, "hold s=1 s=2 s=3 map=1", "", "s=3 map=1", 0, 2, 0),
    "but not over what was written": (NEWEST, "s=1 hold s=2", "", "s=1 s=2", 0, 0, 0),
    "a key goes before what waits in line": (NEWEST, "hold a b map=1", "", "map=1 a b", 0, 0, 0),
    "the oldest are forgotten": (NEWEST, f"hold a b c {MANY}", "", MANY.strip(), 3, 0, 0),
    "by their size": (NEWEST, f"hold a:7 b:{FULL - 7} c", "", "b c", 7, 0, 0),
    "a large call stays alone": (NEWEST, f"hold a:7 b:{FULL + 1}", "", "b", 7, 0, 0),
    "what was written or forgotten makes room": (NEWEST, f"a:{FULL} hold b:{FULL} c:{FULL}", "", "a c", FULL, 0, 0),
    "lossless, all of a key is written in order": (LOSSLESS, "hold a s=1 s=2 s=3", "", "a s=1 s=2 s=3", 0, 0, 0),
    "lossless, of an image the newest wins": (LOSSLESS, "hold a I=1 I=2 I=3", "", "I=3 a", 0, 2, 0),
    "beyond the backlog a pause is asked for": (LOSSLESS, f"hold a:{FULL} b c:0 s=1", "b c s=1", "a b c s=1", 0, 0, 1),
    "without a pause there is no relief": (LOSSLESS, f"hold a:{FULL}", "", "a", 0, 0, 0),
    "what failed does not stay in the backlog": (LOSSLESS, f"hold fail:{FULL + 1}", "fail", "", FULL + 1, 0, 1),
}


@pytest.mark.parametrize(
    ("lossless", "steps", "paused", "written", "dropped", "replaced", "relieved"),
    [(each, *row[1:]) for row in COURSES.values() for each in row[0]],
    ids=[f"{name}-{'lossless' if each else 'newest'}" for name, row in COURSES.items() for each in row[0]],
)
def test_every_call_is_written_replaced_or_counted(
    lossless, steps, paused, written, dropped, replaced, relieved
) -> None:
    rig = Rig(lossless)
    assert rig.play(steps) == paused
    assert not rig.relieved_on
    rig.end()
    assert " ".join(rig.written) == written
    assert (rig.metrics.total("bus_dropped"), rig.metrics.total("bus_replaced")) == (dropped, replaced)
    assert len(rig.relieved_on) == relieved


@pytest.mark.parametrize("lossless", BOTH)
def test_calls_are_carried_out_on_a_thread_of_their_own_which_nobody_waits_for(lossless: bool) -> None:
    rig, threads = Rig(lossless), list[str]()
    rig.writer.put(lambda: threads.append(threading.current_thread().name))
    rig.hold()
    rig.play("late status=late")
    rig.writer.stop(0.01)
    assert rig.written == [], "not even at the end"
    assert threads == ["zbridge-test"]
    rig.end()
    rig.end()
    assert sorted(rig.written) == ["late", "status=late"]


def test_a_call_with_a_key_that_comes_meanwhile_goes_before_what_waits_in_line() -> None:
    newest = Rig(lossless=False)
    newest.hold()
    newest.writer.put(lambda: newest.play("status=on"))
    newest.play("second")
    newest.end()
    assert newest.written == ["status=on", "second"]


def test_the_relief_comes_once_when_less_than_half_the_backlog_waits(lossless: Rig) -> None:
    before: list[bool] = []
    lossless.hold()
    lossless.play(f"large:{BACKLOG // 2 + 1}")
    for size in (1, BACKLOG // 2 - 1):  # after the large call half the backlog waits still
        lossless.writer.put(lambda: before.append(lossless.relieved.is_set()), size)
    assert lossless.play("more") == "more"
    lossless.end()
    assert before == [False, False]
    assert len(lossless.relieved_on) == 1
    assert lossless.relieved_on != [threading.get_ident()], "on the writer's own thread"


def test_a_pause_lasts_until_the_relief_and_the_next_one_is_relieved_too(lossless: Rig) -> None:
    drained, go = threading.Event(), threading.Event()
    lossless.hold()
    lossless.play("a:100")
    lossless.writer.put(lambda: (drained.set(), go.wait(SOON_S)), 0)
    assert lossless.play(f"b:{BACKLOG}") == "b"
    lossless.release()
    assert drained.wait(SOON_S)
    assert lossless.play("c:0") == "c", "no more than the backlog waits, but more than half of it"
    assert not lossless.relieved.is_set()
    go.set()
    assert lossless.relieved.wait(SOON_S)
    lossless.relieved.clear()
    lossless.hold()
    assert lossless.play(f"d e:{2 * BACKLOG}") == "e"
    lossless.release()
    assert lossless.relieved.wait(SOON_S)


# Calls on the caller's thread


class Clock:
    """The writer's own clock; a call may take time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr("zbridge.bus.writer.time.monotonic", lambda: self.now)

    def take(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def lossy() -> Iterator[Rig]:
    rig = Rig(lossless=False)
    yield rig
    rig.end()


def made_here(rig: Rig, size: int = 1) -> bool:
    """Put a call; tell whether it was made before this returned, on this thread."""
    threads: list[int] = []
    rig.writer.put_at_once(lambda: threads.append(threading.get_ident()), size)
    return threads == [threading.get_ident()]


def test_a_small_call_is_made_at_once_where_nothing_waits(lossy: Rig) -> None:
    assert made_here(lossy, AT_ONCE)
    assert not made_here(lossy, AT_ONCE + 1)


def test_a_call_behind_others_waits_for_its_turn(lossy: Rig) -> None:
    lossy.hold()
    lossy.play("a b")
    lossy.writer.put_at_once(lambda: lossy.written.append("c"), 1)
    assert lossy.written == []
    lossy.end()
    assert lossy.written == ["a", "b", "c"]


def test_a_lossless_writer_makes_no_call_here_for_it_may_block(lossless: Rig) -> None:
    assert not made_here(lossless)


def test_after_a_slow_call_none_is_made_here_for_a_while(lossy: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    lossy.writer.put_at_once(lambda: clock.take(2 * SLOW_S), 1)
    clock.take(WARY_S / 2)
    lossy.hold()
    assert not made_here(lossy)
    clock.take(WARY_S)
    assert not made_here(lossy), "one waits"
    lossy.end()
    assert not made_here(lossy), "nothing is made here after the end"


def test_some_time_after_a_slow_call_small_ones_are_made_here_again(
    lossy: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock(monkeypatch)
    lossy.writer.put_at_once(lambda: clock.take(2 * SLOW_S), 1)
    clock.take(WARY_S)
    assert made_here(lossy)


def test_a_call_that_fails_here_is_counted(lossy: Rig) -> None:
    lossy.writer.put_at_once(_fail, 3)
    assert lossy.metrics.total("bus_dropped") == 3
