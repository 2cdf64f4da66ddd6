"""Carries out ``zbridge replay``."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec

from zbridge.app import until_signal
from zbridge.app.tasks import together
from zbridge.bus import BusSettings
from zbridge.cli.bus import errors, joined
from zbridge.errors import ConfigError, LinkError
from zbridge.fleet.printable import shown
from zbridge.fleet.topics import KeySpace
from zbridge.metrics import Metrics
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Protocol, find_protocol
from zbridge.views.recording import amounts
from zbridge.views.recording.export import first_ns
from zbridge.views.recording.player import Player
from zbridge.views.recording.replay import Replay, ReplayPlan, plan_listeners, plan_names, survey
from zbridge.views.recording.selection import Selection
from zbridge.views.recording.wire_robot import WireLink


class ReplayOptions(msgspec.Struct, frozen=True, kw_only=True):
    """The options of ``zbridge replay`` as they were written."""

    path: Path
    realm: str
    robots: tuple[str, ...]
    speed: float
    loop: bool
    since: str
    until: str
    pause: bool
    hq: tuple[str, ...]


def _plan(options: ReplayOptions) -> ReplayPlan:
    seen, begin_ns = survey(options.path), first_ns(options.path)
    names = plan_names(seen.robots, options.robots)
    if options.hq and len(names) > 1:
        raise ConfigError(f"hq: serves one robot, and the replay has {', '.join(names)}: choose one by --robot")
    return ReplayPlan(
        path=options.path,
        realm=options.realm,
        names=names,
        selection=Selection(
            None,
            amounts.read_moment("from", options.since, begin_ns) if options.since else 0,
            amounts.read_moment("to", options.until, begin_ns) if options.until else 2**64,
        ),
        speed=options.speed,
        loop=options.loop,
        paused=options.pause,
        listeners=plan_listeners(options.hq),
        statuses=seen.statuses,
    )


async def run_replay(settings: BusSettings, options: ReplayOptions) -> None:
    """Replay onto the bus until the end of the file or a signal."""
    plan = _plan(options)
    async with joined(settings, options.realm) as bus:
        replay = Replay(bus, plan, lambda text: errors.print(shown(text)))
        with _keys(replay.player) if plan.paused else contextlib.nullcontext():
            errors.print(shown(", ".join(f"{recorded} as {name}" for recorded, name in plan.names.items())))
            await until_signal(replay.run())
    others = f", {replay.left_out} left out (other robots, commands, queries, raw frames, pictures)"
    errors.print(shown(f"{replay.played} messages played{others if replay.left_out else ''}"))
    if replay.fault is not None:
        errors.print(shown(f"the recording is not whole: {replay.fault}"))


@contextlib.contextmanager
def _keys(player: Player) -> Iterator[None]:
    """Let Enter pause the player, and go on."""
    loop, stdin = asyncio.get_running_loop(), sys.stdin.fileno()

    def pressed() -> None:
        if not os.read(stdin, 1024):
            loop.remove_reader(stdin)
            return
        if player.paused:
            player.resume()
        else:
            player.pause()
        errors.print("paused: Enter goes on" if player.paused else "playing: Enter pauses")

    try:
        loop.add_reader(stdin, pressed)
    except OSError as error:
        raise ConfigError(f"pause: stdin cannot be read: {error.strerror}") from error
    errors.print("paused: Enter goes on")
    try:
        yield
    finally:
        loop.remove_reader(stdin)


async def run_wire(path: Path, protocol: str, listen: list[str], robots: list[str], speed: float, realm: str) -> None:
    """Be the legacy robot until all was played, or a signal."""
    try:
        addresses = [Address.parse(text) for text in listen]
    except LinkError as error:
        raise ConfigError(f"listen = {error}") from error
    found = find_protocol(protocol)
    if len(addresses) > found.links:
        raise ConfigError(f"listen: a {found.name} robot has at most {found.links} links")
    seen = survey(path)
    known = seen.robots
    if len(robots) > 1 or (len(known) > 1 and not robots) or (robots and robots[0] not in known):
        raise ConfigError(f"robot: the recording has {', '.join(known)}: name one by --robot")
    keys = KeySpace(realm, robots[0] if robots else known[0])
    names = _links(found, len(addresses), seen.links.get(keys.robot, []))
    links = [WireLink(path, keys, name, speed, lambda text: errors.print(shown(text))) for name in names]
    ready = [lambda at, name=link.link: print(f"{name} listens at {at}", flush=True) for link in links]  # noqa: T201
    await until_signal(together(*(link.run(at, tell) for link, at, tell in zip(links, addresses, ready, strict=True))))
    for link in links:
        less = f"; in {link.unanswered} conversations the gateway said less than then" if link.unanswered else ""
        errors.print(shown(f"{link.link}: {link.frames} frames{less}"))


def _links(protocol: Protocol, count: int, recorded: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the links of a robot with so many; raise ConfigError if the recording has other ones."""
    names = {
        number: protocol.robot(protocol.options(), number, Metrics()).link_names
        for number in range(1, protocol.links + 1)
    }
    missing = set(names[count]) - set(recorded)
    if not missing:
        return names[count]
    there = ", ".join(recorded) or "none: record it with --wire"
    fitting = next((each for each in names.values() if set(each) <= set(recorded)), None)
    if fitting is not None:
        often = f"give {len(fitting)} --listen, in this order" if len(fitting) > 1 else "give one --listen"
        raise ConfigError(f"listen: the recorded robot has the links {', '.join(fitting)}: {often}")
    raise ConfigError(f"as-robot: no raw frames of link {', '.join(sorted(missing))}; the recording has {there}")
