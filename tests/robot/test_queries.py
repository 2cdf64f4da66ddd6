"""Queries that wait for the robot's answer."""

import asyncio

import pytest

from tests.fake_bus import FakeQuery
from zbridge.errors import Refused
from zbridge.fleet import topics
from zbridge.robot.queries import WAITING, PendingQueries

pytestmark = pytest.mark.jumping


def question() -> FakeQuery:
    return FakeQuery("fleet/r1/@rpc/map")


def replies(asked: FakeQuery) -> list[bytes | str]:
    return [str(reply.error) if reply.error else reply.payload for reply in asked.replies]


@pytest.fixture
async def waiting() -> PendingQueries:
    return PendingQueries(asyncio.get_running_loop())


async def test_the_robot_is_asked_once_for_a_topic_and_its_answer_goes_to_all_who_wait_for_it_once(waiting) -> None:
    first, second, other = question(), question(), question()
    assert waiting.add(topics.MAP, first)
    assert not waiting.add(topics.MAP, second)
    assert waiting.add(topics.POSE, other)
    for payload in (b"map", b"map again"):
        waiting.answer(topics.MAP, payload)
    assert (replies(first), replies(second), replies(other)) == ([b"map"], [b"map"], [])
    assert waiting.add(topics.MAP, question()), "the next one asks anew"
    await asyncio.sleep(5.0)
    assert len(first.replies) == 1, "who was answered is not refused later"


async def test_a_question_is_refused_when_its_own_time_is_over(waiting) -> None:
    first, second = question(), question()
    waiting.add(topics.MAP, first)
    await asyncio.sleep(1.0)
    waiting.add(topics.MAP, second)
    await asyncio.sleep(1.01)
    assert (replies(first), replies(second)) == (["the robot did not answer within 2 s"], [])
    await asyncio.sleep(1.0)
    assert len(second.replies) == 1
    assert not waiting.waiting


async def test_a_removed_question_gets_no_reply_and_all_others_can_be_refused_at_once(waiting) -> None:
    removed, first, second = question(), question(), question()
    for topic, asked in ((topics.MAP, removed), (topics.MAP, first), (topics.POSE, second)):
        waiting.add(topic, asked)
    waiting.remove(topics.MAP, removed)
    waiting.remove(topics.MAP, removed)
    waiting.refuse_all("the robot was lost")
    await asyncio.sleep(5.0)
    assert (replies(removed), replies(first), replies(second)) == ([], ["the robot was lost"], ["the robot was lost"])
    assert not waiting.waiting


async def test_one_question_too_many_is_refused_and_the_others_go_on_waiting(waiting) -> None:
    asked = [question() for _ in range(WAITING)]
    for each in asked:
        waiting.add(topics.MAP, each)
    with pytest.raises(Refused, match="64 queries wait"):
        waiting.add(topics.MAP, question())
    waiting.answer(topics.MAP, b"map")
    assert all(replies(each) == [b"map"] for each in asked)
