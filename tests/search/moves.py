"""The moves that a world allows: everything that may happen next in one of its states."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from tests.search.world import Command, Program, Query, Reply, World

Move = tuple[str, Callable[[World], None]]
"""What happens, and how."""


@dataclass(frozen=True)
class Bounds:
    """One bounded world: what may happen in it.

    channel: messages on their way at a time; a program whose commands find no room waits, and its questions are lost.
    delay: steps of time for which a message is on its way at most. loses, repeats: what the network does. drops:
    whether programs give the lease back, or stop asking. freezes: whether the gateway may be late with what is due.
    beats: whether ``control`` comes unchanged, too. hears: whether programs hear of ``control`` before the network
    works. overtaken: whether other input may come between the admission of a command and its record, as the filters and
    the event loop never let it: what the authority makes of that by itself.
    """

    name: str
    programs: tuple[Program, ...]
    commands: tuple[str, ...] = ()
    channel: int = 2
    delay: int = 1
    loses: bool = True
    drops: bool = True
    repeats: bool = False
    freezes: bool = False
    beats: bool = True
    hears: bool = True
    overtaken: bool = False
    faults: frozenset[str] = field(default_factory=frozenset)
    """Of ``stop``, ``robot latch``, ``fleet latch``, ``link``, ``offline``, ``bus``, ``token``, ``gateway``,
    ``later``."""
    states: int = 200_000
    """More states than this are a fault of the bounds: the search has to be complete."""


def moves(world: World, bounds: Bounds) -> Iterator[Move]:
    """Yield every move of a state."""
    yield "time", lambda world: world.step()
    if bounds.freezes:
        yield "time, gateway frozen", lambda world: world.step(frozen=True)
    yield from _of_programs(world, bounds)
    yield from _of_network(world, bounds)
    yield from _of_others(world, bounds)


def _of_programs(world: World, bounds: Bounds) -> Iterator[Move]:
    room = len(world.net) < bounds.channel
    for number, holder in enumerate(world.holders):
        state = holder.client.state.value
        if room and state in ("free", "dropped", "returning"):
            yield f"{number} wants", lambda world, number=number: world.holders[number].want()
        if bounds.drops and state not in ("free", "dropped", "returning") and (room or not holder.held):
            yield f"{number} drops", lambda world, number=number: world.holders[number].drop()
        if room and holder.held and not world.hand and bounds.programs[number].drives:
            for what in bounds.commands:
                yield f"{number} {what}", lambda world, number=number, what=what: world.give(number, what)
        if world.news[number] is not None:
            yield f"{number} hears", lambda world, number=number: world.hear(number)
        if "gateway" in bounds.faults and state != "free":
            yield f"{number} hears that the gateway is gone", lambda w, n=number: w.holders[n].gateway_lost()
    if bounds.beats:
        yield "beat", lambda world: world.beat()


def _of_network(world: World, bounds: Bounds) -> Iterator[Move]:
    for index, message in enumerate(world.net):
        what = _described(message)
        yield f"deliver {what}", lambda world, index=index: world.deliver(world.net[index])
        if bounds.loses:
            yield f"lose {what}", lambda world, index=index: world.net.pop(index)
        if bounds.repeats and isinstance(message, Command | Query):
            yield f"repeat {what}", lambda world, index=index: _repeat(world, index)
    if bounds.loses:
        for number, news in enumerate(world.news):
            if news is not None:
                yield f"lose news of {number}", lambda world, number=number: _lose_news(world, number)


def _of_others(world: World, bounds: Bounds) -> Iterator[Move]:
    faults = bounds.faults
    if "stop" in faults:
        yield "stop", lambda world: world.stop()
    for latch in ("robot", "fleet"):
        if f"{latch} latch" in faults:
            yield f"latch {latch}", lambda world, latch=latch: world.stop(latch)
            yield f"unlatch {latch}", lambda world, latch=latch: world.unlatch(latch)
    if "link" in faults:
        yield "link stalls", lambda world: world.require_neutral(stops=True)
    if "offline" in faults:
        yield "robot lost", lambda world: world.require_neutral(stops=False)
    if "bus" in faults:
        yield "bus lost", _lose_bus
    if "later" in faults:
        yield "the gateway cannot say" if world.ready else "it can say again", _toggle_ready
    if world.hand:
        yield "record", lambda world: world.record()
    holder = world.authority.holders.current
    if "token" in faults and holder is not None and holder.alive is not None:
        yield "token lost", lambda world: _lose_token(world)


def _described(message: Any) -> str:
    if isinstance(message, Command):
        return f"{message.what} of {message.program}"
    if isinstance(message, Reply):
        return f"reply {message.question.key.rpartition('control/')[2]} to {message.program}"
    if isinstance(message, Query):
        return f"query {message.question.key.rpartition('control/')[2]} of {message.program}"
    return "end of a token"


def _repeat(world: World, index: int) -> None:
    message = world.net[index]
    kept = world.net[:]
    world.deliver(message)
    if not isinstance(message, Command):
        world.net = [each for each in world.net if not (isinstance(each, Reply) and each not in kept)]
    world.net.append(message)


def _lose_news(world: World, number: int) -> None:
    world.news[number] = None


def _toggle_ready(world: World) -> None:
    world.ready = not world.ready


def _lose_bus(world: World) -> None:
    world.authority.bus_lost()
    world.settle()


def _lose_token(world: World) -> None:
    holder = world.authority.holders.current
    assert holder is not None
    assert holder.alive is not None
    world.authority.vanished(holder.alive)
    world.settle()
