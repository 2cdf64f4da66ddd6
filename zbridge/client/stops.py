"""Stops, latches and releases robots; reports only what their gateways confirmed.

Each stop has its own id, and is repeated until ``control`` shows that id: whatever the network loses or delays, the
robot's gateway has carried out a confirmed stop. A robot's latched stop is released by its id; a stop of the whole
fleet has one id for all robots.
Source: "Latched stops" in ``lease.md``.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping
from itertools import islice
from typing import TypeVar

import msgspec

from zbridge.bus import Bus, Sample
from zbridge.bus.tls.membership import Right, no_answer, require_right
from zbridge.errors import BusError, NotReady, PayloadError, Refused, refusal
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Unlatch
from zbridge.fleet.messages import Control, Latch, Refusal, Status, Stop
from zbridge.fleet.topics import KeySpace, Topic, split_key

REPEAT_S = 0.25
"""Seconds between two repetitions of a stop that is not confirmed."""
CONFIRM_S = 3.0
"""Longest wait for the confirmation of a stop."""
ANSWER_S = 2.0
"""Longest wait for the answer to a release, and for the last value of a state."""
AT_ONCE = 64
"""Most robots whose confirmations are awaited at a time."""
_APART_S = 0.1
"""Seconds after which a gateway does not treat a repeated stop as a repetition."""
NAMED = 20
"""Most robots that a finding names."""
_WHO, _REASON = 64, 100
"""Characters that fit into a stop, with room for non-ASCII ones."""

T = TypeVar("T")


class StopWaits(NotReady):
    """The gateway has the stop, and the robot gets it when its link works again."""


Outcome = Refused | BusError | None
"""The outcome for a robot: None if it was confirmed."""


def new_stop(who: str, reason: str | None, *, latch: bool, secret: Callable[[int], bytes] = os.urandom) -> Stop:
    """Make a stop with its own id. who, reason: for people, truncated to what a stop can carry.

    secret: returns the given number of random bytes.
    """
    stop = Stop(id=secret(16), who=_cut(who, _WHO))
    if latch:
        stop = msgspec.structs.replace(stop, latch=True)
    return msgspec.structs.replace(stop, reason=_cut(reason, _REASON)) if reason else stop


async def put_stop(bus: Bus, keys: KeySpace, stop: Stop) -> None:
    """Send a stop once. keys: of a robot, or of all (``*``)."""
    with contextlib.closing(bus.publisher(keys.key(topics.CMD_STOP.path), topics.CMD_STOP)) as publisher:
        publisher.put(payloads.encode(stop))
        with contextlib.suppress(BusError):
            await bus.flush()


async def stop_robot(bus: Bus, keys: KeySpace, stop: Stop) -> None:
    """Stop a robot and return when its gateway has confirmed it.

    Raises BusError if no gateway does within CONFIRM_S, Refused if the robot cannot be stopped, NotReady if its gateway
    has no connection to it, or a stalled one, or has left meanwhile.
    """
    await put_stop(bus, keys, stop)  # before anything that may take time
    control = await _shown(bus, keys, stop, lambda control: stop.id in control.stops, CONFIRM_S)
    if control is None:
        raise _unconfirmed(keys.robot)
    if count := _stops_refused(control):  # of this stop, or of an earlier one: the next report shows which
        await asyncio.sleep(_APART_S)
        control = await _shown(bus, keys, stop, lambda control: _stops_refused(control) > count, REPEAT_S)
    if control is not None and count:
        refused = _refused_stops(control)[-1]
        raise refusal(refused.code, f"{keys.robot}: cannot be stopped: {refused.reason}")
    try:
        status = await _last(bus, keys, topics.STATUS, Status, broken=True)
    except PayloadError as error:
        raise NotReady(f"{keys.robot}: stop accepted, but the robot's status cannot be read: {error}") from error
    if status is None:
        raise NotReady(f"{keys.robot}: stop accepted, but its gateway has left: nobody knows whether the robot got it")
    if isinstance(status, Status) and status.state != "established":
        why = status.reason or "no reason known"
        raise NotReady(f"{keys.robot}: stop accepted, but the robot is {status.state}: {why}")
    if isinstance(status, Status) and status.stalled is True:
        raise StopWaits(f"{keys.robot}: stop accepted, but it waits: the robot's link is stalled")


async def stop_robots(
    bus: Bus, realm: str, robots: Iterable[str], stop: Stop, *, absent: Iterable[str] = ()
) -> dict[str, Outcome]:
    """Stop robots, a limited number at a time; return the outcome for each.

    absent: robots that have no gateway now. They share one wait, so that none of the others waits for them.
    """
    stopped, missed = await asyncio.gather(
        _each(robots, lambda robot: stop_robot(bus, KeySpace(realm, robot), stop)),
        _stop_absent(bus, realm, absent, stop),
    )
    return dict(sorted((missed | stopped).items()))


async def _stop_absent(bus: Bus, realm: str, robots: Iterable[str], stop: Stop) -> dict[str, Outcome]:
    """Stop those of these robots that get a gateway within CONFIRM_S."""
    outcomes: dict[str, Outcome] = {robot: _unconfirmed(robot) for robot in robots}
    begun: dict[str, asyncio.Task[dict[str, Outcome]]] = {}

    def begin(sample: Sample) -> None:
        split = split_key(sample.key)
        if split is not None and split[1] in outcomes and split[1] not in begun:
            begun[split[1]] = asyncio.create_task(stop_robots(bus, realm, [split[1]], stop))

    try:
        if outcomes:
            with contextlib.closing(bus.subscribe(KeySpace(realm, "*").key(topics.CONTROL.path), begin, history=True)):
                await asyncio.sleep(CONFIRM_S)
        for stopped in await asyncio.gather(*begun.values()):
            outcomes |= stopped
    finally:
        for task in begun.values():
            task.cancel()
    return outcomes


async def unlatch_robot(bus: Bus, keys: KeySpace, name: str) -> tuple[Latch, ...]:
    """Release the latched stops of one robot alone, as ``name``; return those that were released.

    Raises BusError if no gateway answers, Refused as the gateway did; if only stops of the whole fleet are in force,
    its refusal says so.
    """
    latches = await _latches(bus, keys)
    own = tuple(latch for latch in latches if not latch.fleet) or latches
    for latch in own:
        await _release(bus, keys, name, latch.id, fleet=False)
    return own


async def unlatch_fleet(bus: Bus, realm: str, robots: Iterable[str], who: str) -> dict[str, Outcome]:
    """Release the latched stops of the whole fleet at these robots, as ``who``; return the outcome for each.

    If ``stop --all`` reached a robot only by its own key, the robot holds the id as its own latch: that is released
    too. Robots that do not know a released id are sent it, because they may learn of the stop later.
    """
    latches = await _each(robots, lambda robot: _latches(bus, KeySpace(realm, robot)))
    known = {robot: answer for robot, answer in latches.items() if isinstance(answer, tuple)}
    fleet_ids = sorted({latch.id for held in known.values() for latch in held if latch.fleet})

    async def release(robot: str) -> None:
        own_ids = {latch.id for latch in known[robot] if not latch.fleet}
        for stop_id in fleet_ids:
            await _release(bus, KeySpace(realm, robot), who, stop_id, fleet=stop_id not in own_ids)

    errors = {robot: answer for robot, answer in latches.items() if not isinstance(answer, tuple)}
    return errors | await _each(known, release)


def summarize(outcomes: Mapping[str, Outcome], done: str) -> str:
    """Sum up in one line: ``38 of 40 stopped; r7 offline; r9 did not confirm``."""
    findings = {name: finding(error) for name, error in outcomes.items() if error is not None}
    parts = [f"{len(outcomes) - len(findings)} of {len(outcomes)} {done}"]
    for word in dict.fromkeys(findings.values()):
        names = [name for name, found in findings.items() if found == word]
        parts.append(f"{listed(names)} {word}")
    return "; ".join(parts)


def listed(names: Collection[str]) -> str:
    """Name some robots, and say how many more there are."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(islice(names, NAMED)) + more


def finding(error: Exception) -> str:
    """Return a fixed word for why a stop was not confirmed."""
    if isinstance(error, NotReady):
        return "not reached" if isinstance(error, StopWaits) else "offline"
    return "refused" if isinstance(error, Refused) else "did not confirm"


async def _each(robots: Iterable[str], ask: Callable[[str], Awaitable[T]]) -> dict[str, T | Refused | BusError]:
    """Do it for each robot, a limited number at a time; return the result or the error for each."""
    room = asyncio.Semaphore(AT_ONCE)

    async def one(robot: str) -> T | Refused | BusError:
        async with room:
            try:
                return await ask(robot)
            except (Refused, BusError) as error:
                return error

    names = sorted(set(robots))
    return dict(zip(names, await asyncio.gather(*map(one, names)), strict=True))


async def _latches(bus: Bus, keys: KeySpace) -> tuple[Latch, ...]:
    control = await _last(bus, keys, topics.CONTROL, Control)
    if not isinstance(control, Control):
        raise BusError(f"{keys.robot}: no gateway answered within {ANSWER_S:g} s")
    return control.latches


async def _release(bus: Bus, keys: KeySpace, name: str, stop_id: bytes, *, fleet: bool) -> None:
    topic = (topics.RPC_UNLATCH_FLEET if fleet else topics.RPC_UNLATCH)(name)
    question = payloads.encode(Unlatch(id=stop_id))
    for answer in await bus.ask(keys.key(topic.path), question, timeout_s=ANSWER_S):
        if isinstance(answer.error, Refused):
            raise refusal(answer.error.code, f"{keys.robot}: {answer.error}")
        if answer.error is None:
            return
    right = Right.UNLATCH_FLEET if fleet else Right.UNLATCH
    await require_right(bus.ask, keys.realm, name, right, keys.robot)
    raise BusError(f"{keys.robot}: {no_answer(name, ANSWER_S)}")


async def _shown(
    bus: Bus, keys: KeySpace, stop: Stop, shows: Callable[[Control], bool], within_s: float
) -> Control | None:
    """Repeat a stop until ``control`` shows something; return that, None if it does not within this time."""
    loop = asyncio.get_running_loop()
    shown: asyncio.Future[Control] = loop.create_future()

    def read_control(sample: Sample) -> None:
        with contextlib.suppress(PayloadError):
            control = payloads.decode(Control, sample.payload)
            if shows(control) and not shown.done():
                shown.set_result(control)

    publisher = bus.publisher(keys.key(topics.CMD_STOP.path), topics.CMD_STOP)
    with (
        contextlib.closing(bus.subscribe(keys.key(topics.CONTROL.path), read_control, history=True)),
        contextlib.closing(publisher),
    ):
        ends_at = loop.time() + within_s
        while not shown.done() and loop.time() < ends_at:
            publisher.put(payloads.encode(stop))
            await asyncio.wait((shown,), timeout=REPEAT_S)
    return shown.result() if shown.done() else None


async def _last(
    bus: Bus,
    keys: KeySpace,
    topic: Topic,
    kind: type[Control] | type[Status],
    *,
    broken: bool = False,
) -> Control | Status | None:
    """Return the last value of a state; None if there is none. broken: raise PayloadError if it cannot be decoded."""
    with contextlib.suppress(BusError):
        for answer in await bus.ask(keys.key(topic.path), timeout_s=ANSWER_S):
            try:
                if answer.error is None:
                    return payloads.decode(kind, answer.payload)
            except PayloadError:
                if broken:
                    raise
    return None


def _unconfirmed(robot: str) -> BusError:
    return BusError(f"{robot}: stop sent, but no gateway confirmed it within {CONFIRM_S:g} s")


def _refused_stops(control: Control) -> list[Refusal]:
    """Return the refusals of stops by the robot's gateway."""
    return [refusal for refusal in control.refusals if refusal.command == "stop" and refusal.by is None]


def _stops_refused(control: Control) -> int:
    return sum(refusal.count for refusal in _refused_stops(control))


def _cut(text: str, most: int) -> str:
    """Truncate a text to a number of bytes of UTF-8."""
    return text.encode("utf-8", "replace")[:most].decode("utf-8", "ignore")
