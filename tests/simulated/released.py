"""What must become of leases that nobody uses: of HQ programs that are idle, gone, or whose listener was frozen.

Source: "The stick" in ``state-tables.md``. Programs are judged by their own notes.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from tests.simulated.accounts import Grant

if TYPE_CHECKING:
    from tests.simulated.checker import Checker
    from tests.simulated.hq_programs import HqProgram

UNUSED_S = 1.0
"""Longest time after ``lease_s`` of neutral until an HQ program's lease is given back."""
GONE_S = 0.8
"""Longest time until the lease of an HQ program that disconnected is given back."""
FROZEN_S = 0.9
"""A listener that did not run for so long asks its programs for a neutral: it looks every 0.1 s, for 0.6 s."""
SILENT_S = 1.8
"""A silence that is longer than the deadman of each HQ program."""
ORDER_S = 0.1
"""What a program says so long after something else arrives after it, by stream and by datagram."""
AWAY_S = 0.8
"""A robot whose gateways were all killed so long ago is away for listeners that the bus reaches."""
CLOSE = 0.0052
"""By how much motion may differ from what the program gave."""
AT_ONCE_S = 3.0
"""Longest time after a cut until all that waited has arrived."""
ALONE_S = 9.0
"""Longest time until the only gateway that runs serves the robot."""


class Released:
    """Follows the leases of HQ programs, and whether anybody serves the robot."""

    def __init__(self, checker: Checker) -> None:
        self._checker = checker
        self._world = checker.world
        self._simulation = checker.simulation
        programs = checker.simulation.programs
        self._only = programs[0].name if len(programs) == 1 else None
        """The program, where there is one: then each lease of a listener is its own."""
        self._spoke_at: dict[str, float] = {}
        """By program, when it last gave motion or a mode."""
        self._mode: dict[str, int] = {}
        self._paused: dict[str, float] = {}
        self.rested: dict[str, float] = {}
        """By listener, when it put neutral last."""
        self._noisy_at = -1.0
        """When a path was last cut, slow or lossy."""
        self._refused: set[str] = set()
        """Programs that pushed while no gateway served the robot, and have not said neutral since."""
        self._served_at = 0.0
        """When a gateway that serves the robot was last there."""
        self._cut_at: dict[str, float] = {}
        """By program, when what it sends to its listener was cut off."""
        self._silent: dict[str, float] = {}
        """By program, when its network was back after a silence in which it pushed."""
        self._gone_at: dict[str, float] = {}
        """By program, when its connection ended."""
        self._centred: dict[str, float] = {}
        """By program, when what it sends was cut off while its stick was centred."""
        self._waited: dict[str, tuple[float, float]] = {}
        """By program, such a cut's begin and end."""
        self._frozen: dict[str, float] = {}
        """By program, when its listener ran again after a freeze in which the program pushed."""

    def watch(self, who: str, what: str, fields: tuple[Any, ...]) -> None:
        """Follow the trace."""
        if what == "gives" and who == self._only:
            if fields[0]:
                self._spoke_at[who] = self._world.now
                self._on_pushed(who)
            else:
                self._refused.discard(who)
        elif what == "gives mode":
            self._mode[who], self._spoke_at[who] = fields[0], self._world.now
        elif what == "lost listener":
            self._gone_at[who] = self._world.now
            if who == self._only:
                self._on_gone(who)
        elif who == "paths":
            self._on_path(what, fields)
        elif what == "connected to listener":
            self._mode.pop(who, None)
            self._silent.pop(who, None)
            self._frozen.pop(who, None)
            self._refused.discard(who)
        elif what == "paused" and who in self._checker.gateways:
            self._paused[who] = self._world.now
        elif what == "resumed" and who in self._paused and self._world.now - self._paused.pop(who) > FROZEN_S:
            host = self._checker.gateways[who].host.name
            self._frozen |= {
                each.name: self._world.now for each in self._simulation.programs if each.address[0] == host
            }

    def _on_path(self, what: str, fields: tuple[Any, ...]) -> None:
        """A program that was cut off while it pushed, for longer than its deadman, says neutral then."""
        for program in self._simulation.programs:
            way, name = (program.host.name, program.address[0]), program.name
            if what == "cut" and (fields[:2] == way or (fields[2] and fields[:2] == way[::-1])):
                self._silent.pop(name, None)
                pushes = self._checker.said_last(name)
                (self._cut_at if pushes else self._centred).setdefault(name, self._world.now)
            elif what == "healed" and set(fields) == set(way) and name in self._centred:
                self._waited[name] = (self._centred.pop(name), self._world.now)
            elif what == "healed" and set(fields) == set(way) and name in self._cut_at:
                silent_s = self._world.now - self._cut_at.pop(name)
                if silent_s > SILENT_S and self._checker.said_last(name):
                    self._silent[name] = self._world.now

    def holds(self, program: HqProgram, motion: float, most_s: float) -> bool:
        """Whether a program that sets a velocity once set this one last, and its machine is connected (``hold``)."""
        cut_s = self._world.now - self._cut_at.get(program.name, self._world.now)
        close = abs(self._checker.said_last(program.name) - motion) < CLOSE
        gone_s = self._world.now - self._gone_at.get(program.name, -math.inf) if program.end is None else 0.0
        return close and gone_s < ORDER_S and cut_s < most_s

    def waited(self, motion: float, gives: Mapping[str, Iterable[tuple[float, float]]]) -> bool:
        """Whether a program gave this motion while a cut held it up that found its stick centred: translation.md."""
        for program, (cut_at, healed_at) in self._waited.items():
            if self._world.now - healed_at < AT_ONCE_S and any(
                cut_at < at < healed_at + ORDER_S and abs(value - motion) < CLOSE for at, value in gives[program]
            ):
                return True
        return False

    def granted(self, grant: Grant, taken_at: float | None, gives: Mapping[str, Iterable[tuple[float, float]]]) -> None:
        """An HQ program whose robot was taken says neutral before it drives again."""
        if taken_at is None or self._only is None or not grant.who.startswith("hq."):
            return
        if not any(value == 0.0 and at > taken_at - 0.2 for at, value in gives[self._only]):
            self._checker.violate("hq-neutral", f"{grant}: nothing neutral was said since the robot was taken")

    def put(self, program: str, gives: list[tuple[float, float]]) -> None:
        """Judge motion that a listener put for a program. gives: what that said, and when."""
        if program in self._refused:
            self._refused.discard(program)
            self._checker.violate("hq-neutral", f"{program} pushed while the robot was away, and moves it by that")
        healed_at = self._silent.get(program)
        if healed_at is not None and any(not value and at > healed_at for at, value in gives):
            del self._silent[program]
        elif healed_at is not None:
            self._checker.violate(
                "hq-neutral", f"{program} pushes since before it was heard again, and moves the robot"
            )
        since = self._frozen.get(program)
        if since is None:
            return
        if any(not value and at > since - 0.5 for at, value in gives):
            del self._frozen[program]
        else:
            self._checker.violate("hq-neutral", f"a listener that was frozen put motion of {program}, without neutral")

    def put_late(self, listener: str, program: str, given_at: float, gives: list[tuple[float, float]]) -> None:
        """Judge motion that a listener put though its program said neutral since: that neutral comes at once."""
        put_at, grant = self._world.now, self._of_program()
        said_at = max((at for at, value in gives if not value), default=0.0)
        late = said_at > given_at + ORDER_S and put_at > said_at + ORDER_S
        if self._only != program or not late or grant is None or self._noisy_at > given_at - 1.0:
            return

        def look() -> None:
            holds = grant.ended_at is None and self._simulation.members[listener].running
            if holds and self.rested.get(listener, 0.0) < put_at and self._noisy_at < given_at:
                self._checker.violate("hq-order", f"{listener} put motion of {program} after its newer neutral")

        self._world.after(ORDER_S, look)

    def _on_pushed(self, program: str) -> None:
        """Motion that an HQ program says while no gateway is there is refused: it must say neutral then."""
        begun, calm = self._world.now, self._checker.obligations.calm_since
        if begun - self._served_at < AWAY_S or not calm(begun - AWAY_S / 2):
            return

        def look() -> None:
            away = self._served_at < begun and self._simulation.members[self._listener(program)].running
            if away and calm(begun - AWAY_S / 2) and self._checker.said_last(program):
                self._refused.add(program)

        self._world.after(AWAY_S / 2, look)

    def _listener(self, program: str) -> str:
        host = next(each.address[0] for each in self._simulation.programs if each.name == program)
        return next(each.name for each in self._checker.gateways.values() if each.host.name == host)

    def tick(self) -> None:
        """Look for leases that nobody uses, and for a robot that nobody serves."""
        paths = self._simulation.paths
        if paths.cuts or paths.slow or paths.loss or paths.duplicates:
            self._noisy_at = self._world.now
        if any(each.alive for each in self._checker.gateways.values() if each.serves):
            self._served_at = self._world.now
        self._look_for_unused()
        self._look_for_served()

    def _of_program(self) -> Grant | None:
        """The lease that the only program holds."""
        for grant in self._checker.current.values():
            if grant.ended_at is None and grant.who.startswith("hq."):
                return grant
        return None

    def _on_gone(self, program: str) -> None:
        grant, begun = self._of_program(), self._world.now
        if grant is None:
            return

        def look() -> None:
            if grant.ended_at is None and self._judges(grant, begun - 1.0):
                self._checker.violate("hq-release", f"{program} disconnected, and keeps {grant}")

        self._world.after(GONE_S, look)
        self._checker.counts["an HQ program disconnected with a lease"] += 1

    def _look_for_unused(self) -> None:
        grant, now = self._of_program(), self._world.now
        if grant is None or self._only is None or self._mode.get(self._only) == 3:
            return
        if self._simulation.programs[0].options.get("once") and self._checker.said_last(self._only):
            return
        used_at = max(self._spoke_at.get(self._only, 0.0), grant.at)
        if now - used_at > grant.lease_s + UNUSED_S and self._judges(grant, used_at):
            self._checker.violate("hq-release", f"{self._only} keeps {grant}, unused for {now - used_at:.1f} s")
            self._spoke_at[self._only] = now

    def _judges(self, grant: Grant, since: float) -> bool:
        """Whether nothing was disturbed since then that a release needs."""
        listener, gateway = self._simulation.members[grant.asker], self._simulation.members[grant.gateway]
        works = listener.alive and gateway.alive and self._simulation.fabric.works(listener.session, gateway.session)
        return works and self._checker.obligations.calm_since(since)

    def _look_for_served(self) -> None:
        """A gateway that runs alone, with a bus, serves the robot."""
        serving = [each for each in self._checker.gateways.values() if each.serves]
        alive = [each for each in serving if each.alive]
        if len(serving) < 2 or len(alive) != 1:
            return
        (gateway,), now = alive, self._world.now
        obligations = self._checker.obligations
        if gateway.running and gateway.session.link.whole and obligations.calm_since(now - ALONE_S):
            self._checker.counts["a gateway was left alone"] += 1
            if not obligations.serves(gateway.name):
                self._checker.violate("served", f"{gateway.name} runs alone, and does not serve the robot")
                obligations.disturb()
