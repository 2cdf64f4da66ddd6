"""Stops the whole fleet, and says what came of it: what gateways confirmed, and what robots show of themselves since.

A confirmed stop is a stop that the robot's gateway has sent. Whether the robot obeys is another matter: its own pose
and speed are watched for a second after it.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Collection, Iterable, Mapping

import msgspec

from zbridge.bus import Bus, Sample
from zbridge.client.fleet import Fleet
from zbridge.client.stops import Outcome, StopWaits, listed
from zbridge.errors import NotReady, PayloadError, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Motion, Pose, Stop
from zbridge.fleet.topics import is_name, split_key

ROLL_OUT_S = 0.5
"""Seconds for which a robot that was stopped may roll out."""
WATCH_S = 1.0
"""Seconds for which robots are watched then."""
STILL = 0.02
"""Speed, as a fraction of full scale, and metres, up to which a robot is at rest."""
STILL_RAD = 0.05
ROBOTS = 10_000
"""Most robots that are watched."""


class StopReport(msgspec.Struct, frozen=True):
    """What came of a stop of the fleet. text: one sentence, for people. good: whether nothing is left to be done."""

    text: str
    good: bool


async def stop_fleet(
    fleet: Fleet, bus: Bus, stop: Stop, roster: Iterable[str], is_alive: Callable[[str], bool]
) -> StopReport:
    """Send a latching stop to the whole fleet; report what was confirmed, and who moves nevertheless.

    roster: robots that must be among those on the bus. is_alive: whether a robot has a gateway now.
    """
    stopping = asyncio.create_task(fleet.send_stop(stop, also=roster))
    await asyncio.sleep(0)  # the stop goes first
    try:
        with contextlib.closing(MovementWatch(bus, fleet.realm)) as watch:
            outcomes = await stopping
            await asyncio.sleep(ROLL_OUT_S)
            watch.begin()
            await asyncio.sleep(WATCH_S)
            return judge(outcomes, watch.moving(), is_alive)
    finally:
        stopping.cancel()


def judge(outcomes: Mapping[str, Outcome], moving: Collection[str], is_alive: Callable[[str], bool]) -> StopReport:
    """Say what came of a stop: ``38 of 40 stopped (their gateways sent it); r7 away; r9 not confirmed``."""
    if not outcomes:
        return StopReport("No robot is known: the stop was sent to all, and nobody confirmed it", good=False)
    failed: dict[str, list[str]] = {}
    for name, error in outcomes.items():
        if error is not None:
            failed.setdefault(_finding(name, error, is_alive), []).append(name)
    confirmed = sum(error is None for error in outcomes.values())
    parts = [f"{confirmed} of {len(outcomes)} stopped (their gateways sent it)"]
    parts += [f"{listed(names)} {finding}" for finding, names in failed.items()]
    if moving:
        how = "move by their" if len(moving) > 1 else "moves by its"
        parts.append(f"{listed(sorted(moving))} still {how} own pose or speed")
    return StopReport("; ".join(parts), good=not failed and not moving)


def _finding(name: str, error: Exception, is_alive: Callable[[str], bool]) -> str:
    if isinstance(error, StopWaits):
        return "not reached yet: its link is stalled"
    if not is_alive(name):
        return "without a gateway, which nothing can stop from here"
    if isinstance(error, NotReady):
        return "away"
    return "refused it" if isinstance(error, Refused) else "not confirmed"


class MovementWatch:
    """Which robots move, by their own pose or speed. Keeps two samples of each key, and reads them in the end only."""

    def __init__(self, bus: Bus, realm: str) -> None:
        self._samples: dict[str, tuple[Sample, Sample]] = {}
        self._handles = [
            bus.subscribe(f"{realm}/*/{path}", self._take) for path in (topics.POSE.path, topics.MOTION.path)
        ]

    def __repr__(self) -> str:
        return f"<MovementWatch {len(self._samples)} keys>"

    def close(self) -> None:
        """Watch nothing any more; idempotent."""
        while self._handles:
            self._handles.pop().close()

    def begin(self) -> None:
        """Forget what was seen so far."""
        self._samples.clear()

    def moving(self) -> set[str]:
        """Return the robots that move, by the first and the last sample since :meth:`begin`."""
        found = set()
        for key, (first, last) in self._samples.items():
            split = split_key(key)
            with contextlib.suppress(PayloadError):
                if split is not None and is_name(split[1]) and _moves(split[2], first, last):
                    found.add(split[1])
        return found

    def _take(self, sample: Sample) -> None:
        known = self._samples.get(sample.key)
        if known is not None or len(self._samples) < 2 * ROBOTS:
            self._samples[sample.key] = (known[0] if known is not None else sample, sample)


def _moves(path: str, first: Sample, last: Sample) -> bool:
    if path == topics.MOTION.path:
        speed = payloads.decode(Motion, last.payload).speed
        return speed is not None and abs(speed) > STILL
    begin, end = payloads.decode(Pose, first.payload), payloads.decode(Pose, last.payload)
    if not all(map(math.isfinite, (begin.heading, end.heading))):
        return True  # nobody knows
    turned = math.remainder(end.heading - begin.heading, math.tau)
    return math.hypot(end.x - begin.x, end.y - begin.y) > STILL or abs(turned) > STILL_RAD
