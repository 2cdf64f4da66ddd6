"""Queries that wait for the robot's answer."""

import asyncio

import pytest

from zbridge.bus.fake import FakeQuery
from zbridge.errors import Refused
from zbridge.fleet import topics
from zbridge.robot.queries import WAITING, PendingQueries

pytestmark = pytest.mark.jumping


def questions() -> PendingQueries:
    return PendingQueries(asyncio.get_running_loop(), answer_s=2.0)


def question() -> FakeQuery:
    return FakeQuery("fleet/r1/@rpc/map")


async def test_the_first_question_of_a_topic_must_be_put_to_the_robot_and_the_others_not() -> None:
    waiting = questions()
    assert not waiting.waiting
    assert waiting.add(topics.MAP, question())
    assert not waiting.add(topics.MAP, question())
    assert waiting.add(topics.POSE, question())
    assert waiting


async def test_an_answer_goes_to_all_who_wait_for_its_topic_once() -> None:
    waiting = questions()
    first, second, other = question(), question(), question()
    waiting.add(topics.MAP, first)
    waiting.add(topics.MAP, second)
    waiting.add(topics.POSE, other)
    waiting.answer(topics.MAP, b"map")
    waiting.answer(topics.MAP, b"map again")
    assert [reply.payload for reply in first.replies] == [b"map"]
    assert [reply.payload for reply in second.replies] == [b"map"]
    assert other.replies == []
    assert waiting.add(topics.MAP, question()), "the next one asks anew"


async def test_an_answer_nobody_waits_for_is_no_error() -> None:
    questions().answer(topics.MAP, b"map")


async def test_a_question_is_refused_when_its_own_time_is_over() -> None:
    waiting = questions()
    first, second = question(), question()
    waiting.add(topics.MAP, first)
    await asyncio.sleep(1.0)
    waiting.add(topics.MAP, second)
    await asyncio.sleep(1.01)
    assert [str(reply.error) for reply in first.replies] == ["the robot did not answer within 2 s"]
    assert second.replies == []
    await asyncio.sleep(1.0)
    assert len(second.replies) == 1
    assert not waiting.waiting


async def test_an_answered_question_is_not_refused_later() -> None:
    waiting = questions()
    asked = question()
    waiting.add(topics.MAP, asked)
    waiting.answer(topics.MAP, b"map")
    await asyncio.sleep(5.0)
    assert len(asked.replies) == 1


async def test_a_removed_question_gets_no_reply() -> None:
    waiting = questions()
    asked = question()
    waiting.add(topics.MAP, asked)
    waiting.remove(topics.MAP, asked)
    waiting.remove(topics.MAP, asked)
    assert not waiting.waiting
    waiting.answer(topics.MAP, b"map")
    await asyncio.sleep(5.0)
    assert asked.replies == []


async def test_all_who_wait_can_be_refused_at_once() -> None:
    waiting = questions()
    first, second = question(), question()
    waiting.add(topics.MAP, first)
    waiting.add(topics.POSE, second)
    waiting.refuse_all("the robot was lost")
    await asyncio.sleep(5.0)
    assert [str(reply.error) for reply in (*first.replies, *second.replies)] == ["the robot was lost"] * 2
    assert not waiting.waiting


async def test_one_question_too_many_is_refused_and_the_others_go_on_waiting() -> None:
    waiting = questions()
    asked = [question() for _ in range(WAITING)]
    for each in asked:
        waiting.add(topics.MAP, each)
    with pytest.raises(Refused, match="64 queries wait"):
        waiting.add(topics.MAP, question())
    waiting.answer(topics.MAP, b"map")
    assert all(len(each.replies) == 1 for each in asked)


async def test_questions_print_what_they_wait_for() -> None:
    waiting = questions()
    waiting.add(topics.MAP, question())
    assert repr(waiting) == "<PendingQueries waiting for ['map']>"
