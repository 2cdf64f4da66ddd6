"""What waits for a viewer: bounded, the newest wins, answers are never dropped."""

from zbridge.views.foxglove import outbox as module
from zbridge.views.foxglove.outbox import ViewerOutbox


def drained(outbox: ViewerOutbox) -> list[str | bytes]:
    messages = []
    while (message := outbox.next()) is not None:
        messages.append(message)
    return messages


def test_messages_go_in_the_order_in_which_they_came_and_answers_first() -> None:
    outbox = ViewerOutbox()
    outbox.show(1, b"a")
    outbox.show(2, b"b")
    outbox.say("answer")
    outbox.show(1, b"c")
    assert drained(outbox) == ["answer", b"a", b"b", b"c"]
    assert len(outbox) == 0


def test_a_full_queue_loses_its_oldest_message_and_no_other_queue_does() -> None:
    outbox = ViewerOutbox()
    outbox.show(2, b"other")
    for number in range(module.DEPTH + 5):
        outbox.show(1, b"%d" % number)
    assert outbox.dropped == 5
    assert drained(outbox) == [b"other", *(b"%d" % number for number in range(5, module.DEPTH + 5))]


def test_the_bytes_of_all_messages_together_are_bounded() -> None:
    outbox, large = ViewerOutbox(), bytes(module.MOST_BYTES // 4)
    for number in range(10):
        outbox.show(number, bytes([number]) + large)
    waiting = drained(outbox)
    assert [message[0] for message in waiting] == [7, 8, 9]
    assert outbox.dropped == 7


def test_a_message_that_is_too_large_by_itself_is_sent_alone() -> None:
    outbox, large = ViewerOutbox(), bytes(module.MOST_BYTES + 1)
    outbox.show(1, b"small")
    outbox.show(2, large)
    assert drained(outbox) == [large]


def test_what_waits_of_an_ended_subscription_is_forgotten() -> None:
    outbox = ViewerOutbox()
    for subscription in (1, 2, 1):
        outbox.show(subscription, b"%d" % subscription)
    outbox.forget(1)
    outbox.show(1, b"new")
    assert drained(outbox) == [b"2", b"new"]


def test_too_many_answers_or_too_long_ones_are_an_overrun() -> None:
    many, long = ViewerOutbox(), ViewerOutbox()
    for _ in range(module.CONTROLS):
        many.say("x")
    assert not many.overrun
    many.say("x")
    assert many.overrun
    long.say("x" * (module.CONTROL_BYTES + 1))
    assert long.overrun
