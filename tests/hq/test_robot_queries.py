"""What clients ask the robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.hq.scene import COMMANDS, KEYS, MAP, Scene, serving, soon
from zbridge.bus.interface import Answer, IncomingQuery
from zbridge.errors import BusError, NotReady
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Query
from zbridge.fleet.topics import Topic

pytestmark = pytest.mark.jumping


# Questions


def answering(scene: Scene, topic: Topic, answer: Callable[[IncomingQuery], None]) -> list[IncomingQuery]:
    asked: list[IncomingQuery] = []

    def take(question: IncomingQuery) -> None:
        asked.append(question)
        answer(question)

    scene.gateway.bus.answer(KEYS.key(topic.path), take)
    return asked


async def test_a_question_of_many_is_asked_once_and_answered_to_each(scene: Scene) -> None:
    asked = answering(scene, topics.RPC_MAP, lambda question: question.answer(payloads.encode(MAP)))
    programs = [scene.connect().greeted() for _ in range(5)]
    for program in programs[:4]:
        program.say(b"map?", b"map?")
    await soon()
    assert len(asked) == 1
    assert [program.heard() for program in programs] == [[b"@rpc/map: Map"]] * 4 + [[]]
    programs[0].say(b"map?")
    await soon()
    assert len(asked) == 2, "what is asked later is asked anew"
    assert programs[0].heard() == [b"@rpc/map: Map"]


@pytest.mark.parametrize(
    "answer",
    [
        lambda question: None,
        lambda question: question.refuse(NotReady("robot: busy")),
        lambda question: question.answer(b"\xc1"),
        lambda question: question.answer(payloads.pack({"rows": 7})),
    ],
)
async def test_a_question_without_an_answer_is_answered_with_what_is_known(scene: Scene, answer) -> None:
    answering(scene, topics.RPC_POSE, answer)
    program = scene.connect().greeted()
    for _ in range(2):
        program.say(b"pose?")
        await soon()
        assert program.heard() == [b"@rpc/pose: NoneType"]


async def test_a_bus_that_cannot_be_asked_leaves_no_question_open(scene, monkeypatch) -> None:

    async def fails(*args: Any, **kwargs: Any) -> list[Answer]:
        raise BusError("the bus is closed")

    monkeypatch.setattr(scene.bus, "ask", fails)
    program = scene.connect().greeted()
    for _ in range(2):
        program.say(b"map?")
        await soon()
        assert program.heard() == [b"@rpc/map: NoneType"]


async def test_a_client_that_asked_and_left_is_not_answered_and_the_others_are(scene: Scene) -> None:
    answering(scene, topics.RPC_MAP, lambda question: question.answer(payloads.encode(MAP)))
    first, second = scene.connect().greeted(), scene.connect().greeted()
    first.say(b"map?")
    second.say(b"map?")
    first.leave()
    await soon()
    assert (first.heard(), second.heard()) == ([], [b"@rpc/map: Map"])


async def test_different_questions_do_not_wait_for_each_other(scene: Scene) -> None:
    answering(scene, topics.RPC_MAP, lambda question: question.answer(payloads.encode(MAP)))
    program = scene.connect().greeted()
    program.say(b"map?", b"pose?")
    await soon()
    assert sorted(program.heard()) == [b"@rpc/map: Map", b"@rpc/pose: NoneType"]


async def test_a_question_that_no_robot_is_asked_is_refused() -> None:
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setitem(COMMANDS, b"sessions?", (topics.RPC_SESSIONS("x"), Query()))
        async with serving() as scene:
            program = scene.connect().greeted()
            program.say(b"sessions?")
            await soon()
            assert program.heard() == [b"! robots are not asked for @rpc/sessions/x"]
