"""The checks that run the simulated robot in real time, several of them at once."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from functools import partial
from typing import Any

from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.protocol.plugin import Protocol
from zbridge.simulation.checks import bearings, journeys, motion
from zbridge.simulation.checks.finding import CheckFinding, raised
from zbridge.simulation.checks.stage import Stage, live
from zbridge.simulation.checks.values import check_values

Scene = Callable[[Protocol, Stage], Awaitable[list[CheckFinding]]]


def check_live(protocol: Protocol, establish_s: float) -> Iterator[CheckFinding]:
    """Drive one simulated robot in each scene; all scenes run at the same time."""
    shown: list[tuple[Topic, FleetMessage]] = []
    again = partial(journeys.check_reconnect, establish_s=establish_s)
    scenes: tuple[tuple[str, Scene, dict[str, Any]], ...] = (
        (motion.DRIVES, motion.check_motion, {}),
        (journeys.LONG, journeys.check_long, {}),
        (journeys.CONNECTED_AGAIN, again, {}),
        (journeys.WRAPS, journeys.check_wrap, {"at_wrap": True}),
        (bearings.LEFT, bearings.check_bearings, {"place": bearings.PLACE}),
    )

    async def play_all() -> list[list[CheckFinding]]:
        return await asyncio.gather(*(_play(protocol, establish_s, shown, *scene) for scene in scenes))

    for findings in asyncio.run(play_all()):
        yield from findings
    yield from check_values(protocol, shown)


async def _play(
    protocol: Protocol,
    establish_s: float,
    shown: list[tuple[Topic, FleetMessage]],
    claim: str,
    scene: Scene,
    options: dict[str, Any],
) -> list[CheckFinding]:
    try:
        async with live(protocol, **options) as stage:
            if not await stage.established(establish_s):
                return [CheckFinding(claim, "; ".join(stage.lacking(establish_s)))]
            try:
                return await scene(protocol, stage)
            finally:
                shown += stage.history
    except Exception as error:  # whatever the protocol's own code raises is a finding
        return [CheckFinding(claim, raised(error, "a robot that is driven"))]
