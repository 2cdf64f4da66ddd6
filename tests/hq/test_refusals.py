"""What a listener refused, told to the robot's gateway: folded, a few times a second, and never without end."""

from __future__ import annotations

import asyncio
import itertools
from typing import Any

import msgpack
import pytest

from zbridge.bus import IncomingQuery
from zbridge.bus.fake import FakeBus
from zbridge.errors import Code, LeaseLost, NeutralFirst, NotReady, Refused
from zbridge.fleet.messages import TOLD
from zbridge.fleet.topics import KeySpace
from zbridge.hq.refusals import EVERY_S, RefusalReports
from zbridge.hq.tasks import Tasks
from zbridge.metrics import Metrics

pytestmark = pytest.mark.jumping

KEY = "fleet/r1/@rpc/control/refused/hq.desk"
OFFLINE = NotReady("offline")


class Scene:
    """A gateway that hears, and a listener that tells."""

    def __init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.bus = FakeBus()
        self.told: list[tuple[float, list[dict[str, Any]]]] = []
        self.tasks = Tasks()
        self.metrics = Metrics()
        untold = self.metrics.count("untold")
        self.reports = RefusalReports(self.bus.join("hq"), KeySpace("fleet", "r1"), "hq.desk", self.tasks, untold)

    def serve(self, refusal: Refused | None = None) -> None:
        def hear(question: IncomingQuery) -> None:
            self.told.append((self.loop.time(), msgpack.unpackb(question.payload)["refusals"]))
            if refusal is not None:
                question.refuse(refusal)
            else:
                question.answer(b"\x80")

        self.bus.answer("fleet/r1/@rpc/control/refused/*", hear)


@pytest.fixture
async def scene() -> Scene:
    return Scene()


async def test_the_first_refusal_is_told_at_once_with_who_command_code_and_reason(scene: Scene) -> None:
    scene.serve()
    scene.reports.note("hq.desk.3", "drive", NeutralFirst("connected: release the stick first"))
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    ((_, told),) = scene.told
    reason = "connected: release the stick first"
    first = {"who": "hq.desk.3", "command": "drive", "code": "neutral_first", "reason": reason, "count": 1, "by": None}
    assert told == [first]


async def test_what_repeats_itself_is_folded_and_told_a_few_times_a_second(scene: Scene) -> None:
    scene.serve()
    began = scene.loop.time()
    for _ in range(100):  # two seconds of a stick that is held down
        scene.reports.note("hq.desk.3", "drive", OFFLINE)
        scene.reports.note("hq.desk.4", "drive", OFFLINE)
        await asyncio.sleep(0.02)
    await asyncio.sleep(2 * EVERY_S)
    assert scene.loop.time() - began < 3.1
    assert len(scene.told) <= 6
    assert all(later[0] - earlier[0] >= EVERY_S - 1e-6 for earlier, later in itertools.pairwise(scene.told))
    counts = {"hq.desk.3": 0, "hq.desk.4": 0}
    for _, told in scene.told:
        assert len({entry["who"] for entry in told}) == len(told)
        for entry in told:
            counts[entry["who"]] += entry["count"]
    assert counts == {"hq.desk.3": 100, "hq.desk.4": 100}


async def test_refusals_of_another_command_code_or_reason_are_told_apart(scene: Scene) -> None:
    scene.reports.note("hq.desk.3", "drive", OFFLINE)
    scene.serve()
    for command, refusal in (
        ("drive", NotReady("busy: map")),
        ("drive", NotReady("offline", Code.BUSY)),
        ("mode", OFFLINE),
        ("drive", LeaseLost("offline")),
        ("mode", OFFLINE),
    ):
        scene.reports.note("hq.desk.3", command, refusal)
    await asyncio.sleep(2 * EVERY_S)
    (*_, (_, told)) = scene.told
    assert [(entry["command"], entry["code"], entry["count"]) for entry in told] == [
        ("drive", "not_ready", 1),
        ("drive", "busy", 1),
        ("mode", "not_ready", 2),
        ("drive", "lease_ended", 1),
    ]


async def test_so_many_different_ones_are_told_at_a_time_and_the_others_counted(scene: Scene) -> None:
    scene.serve()
    for number in range(200):
        scene.reports.note(f"hq.desk.{number}", "drive", OFFLINE)
    await asyncio.sleep(2 * EVERY_S)
    assert [len(told) for _, told in scene.told] == [1, TOLD]
    assert scene.metrics.total("untold") == 200 - 1 - TOLD


async def test_a_gateway_that_is_not_there_or_will_not_hear_is_not_bothered_again(scene: Scene) -> None:
    scene.reports.note("hq.desk.3", "drive", OFFLINE)
    await asyncio.sleep(2 * EVERY_S)
    scene.serve(NotReady("later"))
    scene.reports.note("hq.desk.3", "drive", OFFLINE)
    await asyncio.sleep(5 * EVERY_S)
    assert [[entry["count"] for entry in told] for _, told in scene.told] == [[1]]
    assert not scene.tasks.running


async def test_a_teller_that_is_closed_tells_nothing_more(scene: Scene) -> None:
    scene.serve()
    scene.reports.note("hq.desk.3", "drive", OFFLINE)
    scene.reports.note("hq.desk.3", "drive", OFFLINE)
    scene.reports.close()
    scene.reports.close()
    await asyncio.sleep(5 * EVERY_S)
    assert len(scene.told) == 1
    assert repr(scene.reports) == f"<RefusalReports at {KEY}, 0 wait>"
