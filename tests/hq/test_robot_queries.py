"""What clients ask the robot."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from tests.hq.scene import COMMANDS, KEYS, MAP, Scene, soon
from zbridge.bus.interface import IncomingQuery
from zbridge.errors import BusError, NotReady
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Query

pytestmark = pytest.mark.jumping


async def test_a_question_of_many_is_asked_once_and_answered_to_each_that_is_still_there(scene: Scene) -> None:
    asked: list[IncomingQuery] = []
    scene.gateway.bus.answer(KEYS.key("@rpc/map"), asked.append)
    scene.gateway.bus.answer(KEYS.key("@rpc/map"), lambda question: question.answer(payloads.encode(MAP)))
    first, second, gone, idle = programs = scene.greeted(4)
    for program in (first, second, gone):
        program.say(b"map?", b"map?")
    second.say(b"pose?")
    gone.leave()
    await soon()
    assert len(asked) == 1
    assert first.heard() == [b"@rpc/map: Map"]
    assert sorted(second.heard()) == [b"@rpc/map: Map", b"@rpc/pose: NoneType"], "they do not wait for each other"
    assert [program.heard() for program in programs] == [[]] * 4
    assert await idle.said(b"map?") == [b"@rpc/map: Map"]
    assert len(asked) == 2, "what is asked later is asked anew"


async def bus_fails(*args: Any, **kwargs: Any) -> Any:
    raise BusError("the bus is closed")


@pytest.mark.parametrize(
    "answer",
    [
        lambda question: None,
        lambda question: question.refuse(NotReady("robot: busy")),
        lambda question: question.answer(b"\xc1"),
        lambda question: question.answer(payloads.pack({"rows": 7})),
        None,
    ],
    ids=["none", "refused", "nonsense", "another message", "the bus fails"],
)
async def test_a_question_without_an_answer_is_answered_with_what_is_known(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, answer: Callable[[IncomingQuery], None] | None
) -> None:
    if answer is None:
        monkeypatch.setattr(scene.bus, "ask", bus_fails)
    else:
        scene.gateway.bus.answer(KEYS.key("@rpc/pose"), answer)
    (program,) = scene.greeted(1)
    for _ in range(2):
        assert await program.said(b"pose?") == [b"@rpc/pose: NoneType"]


async def test_a_question_that_no_robot_is_asked_is_refused(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(COMMANDS, b"sessions?", (topics.RPC_SESSIONS("x"), Query()))
    (program,) = scene.greeted(1)
    assert await program.said(b"sessions?") == [b"! @rpc/sessions/x cannot be queried"]
