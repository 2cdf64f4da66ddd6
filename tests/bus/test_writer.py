"""The thread that writes what may block: order, bounds, newest wins or back pressure."""

import threading
from collections.abc import Callable, Iterator

import pytest

from zbridge.bus.writer import BACKLOG, Writer
from zbridge.metrics import Metrics

SOON_S = 5.0


class Rig:
    """A writer whose thread can be held, as a full transmission queue holds it."""

    def __init__(self, *, lossless: bool) -> None:
        self.metrics = Metrics()
        self.relieved = threading.Event()
        self.relieved_on: list[int] = []
        self.writer = Writer("test", self.metrics, lossless=lossless, relieved=self._relieve)
        self.written: list[object] = []
        self._go = threading.Event()

    def _relieve(self) -> None:
        self.relieved_on.append(threading.get_ident())
        self.relieved.set()

    def hold(self) -> None:
        """Keep the thread busy until :meth:`go`."""
        held = threading.Event()

        def wait() -> None:
            held.set()
            self._go.wait(SOON_S)

        self.writer.put(wait, 0)
        assert held.wait(SOON_S)

    def release(self) -> None:
        """Let the thread go on."""
        self._go.set()

    def go(self) -> None:
        """Let the thread go on, and wait until it has written everything."""
        self.release()
        self.writer.stop(SOON_S)

    def call(self, what: object) -> Callable[[], None]:
        """A call that notes ``what``."""
        return lambda: self.written.append(what)

    def put(self, what: object, size: int = 1) -> bool:
        return self.writer.put(self.call(what), size)

    def replace(self, key: str, what: object) -> bool:
        return self.writer.replace(key, self.call(what))

    @property
    def dropped(self) -> int:
        return self.metrics.count("bus_out_dropped", writer="test").value

    @property
    def replaced(self) -> int:
        return self.metrics.count("bus_out_replaced", writer="test").value


def fail() -> None:
    raise OSError("closed")


@pytest.fixture(params=["newest", "lossless"])
def rig(request: pytest.FixtureRequest) -> Iterator[Rig]:
    """A writer for which the newest wins, or one that writes everything."""
    rig = Rig(lossless=request.param == "lossless")
    yield rig
    rig.go()


@pytest.fixture
def newest() -> Iterator[Rig]:
    rig = Rig(lossless=False)
    yield rig
    rig.go()


@pytest.fixture
def lossless() -> Iterator[Rig]:
    rig = Rig(lossless=True)
    yield rig
    rig.go()


def test_calls_are_carried_out_in_order_on_a_thread_of_their_own(rig: Rig) -> None:
    threads: list[str] = []
    rig.writer.put(lambda: threads.append(threading.current_thread().name))
    for number in range(100):
        assert rig.put(number)
    rig.writer.replace("status", lambda: threads.append(threading.current_thread().name))
    rig.go()
    assert rig.written == list(range(100))
    assert threads == ["zbridge-test", "zbridge-test"]
    assert (rig.dropped, rig.replaced) == (0, 0)


def test_the_caller_does_not_wait_for_a_call(rig: Rig) -> None:
    rig.hold()
    assert rig.put("late")
    assert rig.replace("status", "late too")
    assert rig.written == []


# The newest wins


def test_of_calls_that_wait_under_one_key_only_the_newest_is_carried_out(newest: Rig) -> None:
    newest.hold()
    for number in range(10):
        assert newest.replace("status", ("status", number))
    newest.replace("map", ("map", 0))
    newest.go()
    assert newest.written == [("status", 9), ("map", 0)]
    assert (newest.replaced, newest.dropped) == (9, 0)


def test_a_call_that_came_after_its_elder_was_carried_out_replaces_nothing(newest: Rig) -> None:
    newest.replace("status", 1)
    newest.hold()
    newest.replace("status", 2)
    newest.go()
    assert newest.written == [1, 2]
    assert newest.replaced == 0


def test_a_call_with_a_key_goes_before_what_waits_in_line_one_that_comes_meanwhile_too(newest: Rig) -> None:
    def first() -> None:
        newest.written.append("first")
        newest.replace("status", "status")

    newest.hold()
    newest.writer.put(first)
    newest.put("second")
    newest.replace("map", "map")
    newest.go()
    assert newest.written == ["map", "first", "status", "second"]


def test_beyond_the_backlog_the_oldest_are_forgotten_and_counted(newest: Rig) -> None:
    newest.hold()
    for number in range(BACKLOG + 3):
        assert newest.put(number), "the source is never paused"
    assert newest.dropped == 3
    newest.go()
    assert newest.written == list(range(3, BACKLOG + 3))
    assert newest.dropped == 3
    assert not newest.relieved.is_set()


@pytest.mark.parametrize(
    ("sizes", "written"),
    [({"old": 7, "middle": BACKLOG - 7, "new": 1}, ["middle", "new"]), ({"old": 7, "large": BACKLOG + 1}, ["large"])],
)
def test_what_is_forgotten_counts_by_its_size_and_a_large_call_stays_alone(newest: Rig, sizes, written) -> None:
    newest.hold()
    for what, size in sizes.items():
        assert newest.dropped == 0
        newest.put(what, size)
    assert newest.dropped == 7
    newest.go()
    assert newest.written == written


def test_what_was_written_or_forgotten_makes_room(newest: Rig) -> None:
    newest.put("old", BACKLOG)
    newest.hold()
    newest.put("next", BACKLOG)
    assert newest.dropped == 0
    newest.put("new", BACKLOG)
    newest.go()
    assert newest.written == ["old", "new"]
    assert newest.dropped == BACKLOG


# Everything is written


def test_a_lossless_writer_carries_out_every_call_of_a_key_in_order(lossless: Rig) -> None:
    lossless.hold()
    lossless.put("first")
    for number in range(10):
        assert lossless.replace("status", number)
    lossless.go()
    assert lossless.written == ["first", *range(10)]
    assert lossless.replaced == 0


def test_a_lossless_writer_asks_for_a_pause_beyond_the_backlog_and_loses_nothing(lossless: Rig) -> None:
    lossless.hold()
    assert lossless.put(1, BACKLOG)
    assert not lossless.put(2, 1)
    assert not lossless.put(3, 0), "full until it is relieved"
    assert not lossless.replace("status", 4)
    assert not lossless.relieved.is_set()
    lossless.go()
    assert lossless.written == [1, 2, 3, 4]
    assert lossless.dropped == 0


def test_the_relief_comes_once_when_less_than_half_the_backlog_waits(lossless: Rig) -> None:
    before: list[bool] = []
    lossless.hold()
    lossless.put("large", BACKLOG // 2 + 1)
    lossless.writer.put(lambda: before.append(lossless.relieved.is_set()), 1)  # half the backlog waits still
    lossless.writer.put(lambda: before.append(lossless.relieved.is_set()), BACKLOG // 2 - 1)
    assert not lossless.put("too much", 1)
    lossless.go()
    assert before == [False, False]
    assert len(lossless.relieved_on) == 1
    assert lossless.relieved_on != [threading.get_ident()], "on the writer's own thread"


def test_a_pause_lasts_until_the_relief(lossless: Rig) -> None:
    drained, go = threading.Event(), threading.Event()

    def second_hold() -> None:
        drained.set()
        go.wait(SOON_S)

    lossless.hold()
    lossless.put("a", 100)
    lossless.writer.put(second_hold, 0)
    assert not lossless.put("b", BACKLOG)
    lossless.release()
    assert drained.wait(SOON_S)
    assert not lossless.put("c", 0), "no more than the backlog waits, but more than half of it"
    assert not lossless.relieved.is_set()
    go.set()
    assert lossless.relieved.wait(SOON_S)
    assert lossless.put("d")


def test_without_a_pause_there_is_no_relief(lossless: Rig) -> None:
    assert lossless.put(1, BACKLOG)
    lossless.go()
    assert not lossless.relieved.is_set()


def test_after_the_relief_calls_are_taken_again_and_the_next_pause_is_relieved_too(lossless: Rig) -> None:
    lossless.hold()
    assert not lossless.put(1, BACKLOG + 1)
    lossless.release()
    assert lossless.relieved.wait(SOON_S)
    lossless.relieved.clear()
    assert lossless.put(2)
    lossless.put(3, 2 * BACKLOG)
    assert lossless.relieved.wait(SOON_S)


# Failure and end


def test_a_call_that_fails_counts_by_its_size_and_the_next_is_carried_out(rig: Rig) -> None:
    rig.writer.put(fail)
    rig.writer.put(fail, 3)
    rig.writer.replace("status", fail)
    rig.put("after")
    rig.go()
    assert rig.written == ["after"]
    assert rig.dropped == 5


def test_a_call_that_fails_does_not_stay_in_the_backlog(lossless: Rig) -> None:
    lossless.hold()
    assert not lossless.writer.put(fail, BACKLOG + 1)
    lossless.go()
    assert lossless.relieved.is_set()


def test_stopping_finishes_what_waits_and_stopping_twice_does_no_harm(rig: Rig) -> None:
    rig.hold()
    rig.put("first")
    rig.replace("status", "second")
    rig.go()
    rig.go()
    assert sorted(map(str, rig.written)) == ["first", "second"]


def test_calls_after_the_stop_are_counted_and_not_carried_out(rig: Rig) -> None:
    rig.go()
    assert rig.put("late", 2), "nobody is paused"
    assert rig.dropped == 2
    assert rig.replace("status", "late")
    assert rig.written == []


def test_a_call_with_a_key_after_the_stop_is_counted_by_a_lossless_writer(lossless: Rig) -> None:
    lossless.go()
    assert lossless.replace("status", "late")
    assert lossless.dropped == 1


def test_stopping_waits_for_a_thread_that_is_held_for_a_bounded_time_only(rig: Rig) -> None:
    rig.hold()
    rig.put("late")
    rig.writer.stop(0.01)
    assert rig.written == []
