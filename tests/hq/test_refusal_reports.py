"""What a listener refused, told to the robot's gateway: folded, a few times a second, and never without end."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any

import msgpack
import pytest

from tests.fake_bus import FakeBus
from zbridge.bus import IncomingQuery
from zbridge.errors import Code, NotReady, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import TOLD
from zbridge.fleet.topics import KeySpace
from zbridge.hq.refusal_reports import EVERY_S, RefusalReports
from zbridge.metrics import Metrics
from zbridge.tasks import Tasks

pytestmark = pytest.mark.jumping

OFFLINE = NotReady("offline")


class Scene:
    """A gateway that hears, and a listener that tells."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.bus = FakeBus()
        self.heard_at: list[float] = []
        self.told: list[list[dict[str, Any]]] = []
        self.tasks = Tasks()
        self.untold = Metrics().count("untold")
        self.reports = RefusalReports(self.bus.join("hq"), KeySpace("fleet", "r1"), "hq.desk", self.tasks, self.untold)

    def serve(self, refusal: Refused | None = None) -> None:
        def hear(question: IncomingQuery) -> None:
            self.heard_at.append(self.loop.time())
            self.told.append(msgpack.unpackb(question.payload)["refusals"])
            if refusal is not None:
                question.refuse(refusal)
            else:
                question.answer(b"\x80")

        self.bus.answer("fleet/r1/@rpc/control/refused/*", hear)

    def refuse(self, client: int = 3, command: str = "drive", refusal: Refused = OFFLINE) -> None:
        self.reports.note(f"hq.desk.{client}", command, refusal)


@pytest.fixture
async def scene() -> Scene:
    return Scene()


async def test_what_repeats_itself_is_folded_and_told_a_few_times_a_second(scene: Scene) -> None:
    scene.serve()
    for _ in range(100):  # two seconds of a stick that is held down
        scene.refuse(3)
        scene.refuse(4)
        await asyncio.sleep(0.02)
    await asyncio.sleep(2 * EVERY_S)
    assert len(scene.told) <= 6
    assert all(later - earlier >= EVERY_S - 1e-6 for earlier, later in itertools.pairwise(scene.heard_at))
    assert all(len({entry["who"] for entry in told}) == len(told) for told in scene.told)
    for who in ("hq.desk.3", "hq.desk.4"):
        assert sum(entry["count"] for told in scene.told for entry in told if entry["who"] == who) == 100


async def test_refusals_of_another_command_code_or_reason_are_told_apart(scene: Scene) -> None:
    scene.serve()
    scene.refuse()
    for command, refusal in (
        ("drive", NotReady("busy: map")),
        ("drive", NotReady("offline", Code.BUSY)),
        ("mode", OFFLINE),
        ("mode", OFFLINE),
    ):
        scene.refuse(command=command, refusal=refusal)
    await asyncio.sleep(2 * EVERY_S)
    told = [(entry["command"], entry["code"], entry["count"]) for entry in scene.told[-1]]
    assert told == [("drive", "not_ready", 1), ("drive", "busy", 1), ("mode", "not_ready", 2)]


async def test_so_many_different_ones_are_told_at_a_time_and_the_others_counted(scene: Scene) -> None:
    scene.serve()
    for number in range(200):
        scene.refuse(number)
    await asyncio.sleep(2 * EVERY_S)
    assert [len(told) for told in scene.told] == [1, TOLD]
    assert scene.untold.value == 200 - 1 - TOLD


async def test_a_gateway_that_is_not_there_or_will_not_hear_is_not_bothered_again(scene: Scene) -> None:
    scene.refuse()
    await asyncio.sleep(2 * EVERY_S)
    scene.serve(NotReady("later"))
    scene.refuse()
    await asyncio.sleep(5 * EVERY_S)
    assert [[entry["count"] for entry in told] for told in scene.told] == [[1]]
    assert not scene.tasks.running


async def test_a_teller_that_is_closed_tells_nothing_more(scene: Scene) -> None:
    scene.serve()
    scene.refuse()
    scene.refuse()
    scene.reports.close()
    await asyncio.sleep(5 * EVERY_S)
    assert len(scene.told) == 1


async def test_the_largest_report_keeps_within_the_bound_of_its_key(scene: Scene) -> None:
    sizes: list[int] = []
    scene.bus.answer("fleet/r1/@rpc/control/refused/*", lambda question: sizes.append(len(question.payload)))
    scene.refuse()
    for number in range(TOLD + 1):
        scene.refuse(60_000 + number, "motor/" + 1000 * "m", NotReady(1000 * "\u20ac"))
    await asyncio.sleep(2 * EVERY_S)
    assert 8192 < max(sizes) <= topics.SETTING_BYTES
