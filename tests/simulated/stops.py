"""Rules about stops: those that are reported, those that are repeated, and those that have to wait.

Source: "Latched stops" in ``lease.md``, "When the robot's program or its link stalls" and the silence after
packet 4 in ``failures.md``.
"""

from __future__ import annotations

import math
from collections import defaultdict
from typing import TYPE_CHECKING, Any

from tests.simulated.accounts import Command, Grant, read
from tests.simulated.written import stops

if TYPE_CHECKING:
    from tests.simulated.checker import Checker

IDLE_STOP_S = 1.0
"""Seconds between two stops to a robot that nobody drives."""
LATE_S = 1.2
"""How much later a stop may be: stops that follow a neutral, and those that a link or a full buffer holds up."""
ASKED_S = 5.0
"""Longest time that a program takes to confirm a stop."""
DEADMAN_LATE_S = 0.12
"""How much later than its deadman a robot is stopped: what a dated command was late by counts."""
GONE_S = 1.0
"""Longest time until a lease ends whose process was killed: its token disappears with its connection."""
SILENCE_S = 2.5
"""Seconds after packet 4 in which a TCP/UDP robot gets nothing but a packet 7."""
SHOWN_S = 1.0
"""Seconds after which a program that asks for ``status`` has what the gateway shows."""
ON_ITS_WAY_S = 0.15
"""Seconds for which what was written before the gateway had the packet 4 is excused."""


class StopRules:
    """Follows the stops on the bus, and those that a gateway writes to the robot."""

    def __init__(self, checker: Checker) -> None:
        self._checker = checker
        self._world = checker.world
        self._put: defaultdict[str, dict[bytes, float]] = defaultdict(dict)
        """By program, the ids of the stops that it sent this robot, and when first."""
        self._received: set[bytes] = set()
        self.told: set[bytes] = set()
        """The ids of those whose programs were told that they are done."""
        self._stopped_at: dict[str, float] = {}
        """By gateway, when it wrote a stop last."""
        self._moved: dict[str, Command] = {}
        """By gateway, the motion that it received last."""
        self._works: tuple[str | None, float] = (None, 0.0)
        self._starts: dict[str, float] = {}
        """By gateway, when the robot asked it for datagrams."""
        self._apart_since: dict[str, float] = {}
        """By gateway, since when its ``status`` has not shown a robot that takes commands."""

    def watch(self, who: str, what: str, fields: tuple[Any, ...]) -> None:
        """Follow the trace."""
        if what in ("puts", "receives") and fields[0].endswith("@cmd/stop"):
            stop_id = read(fields[1]).get("id")
            if isinstance(stop_id, bytes) and what == "puts":
                self._put[who].setdefault(stop_id, self._world.now)
            elif isinstance(stop_id, bytes) and who.rstrip("+-") in self._checker.gateways:
                self._received.add(stop_id)
        elif what == "receives" and who in self._checker.gateways:
            self._on_command(who)
        elif what == "killed":
            self._on_killed(who)
        elif what == "done" and fields[0] in ("stop", "latch"):
            self._on_done(who, fields[0])
        elif what == "puts" and who in self._checker.gateways and fields[0].endswith("/status"):
            self._on_status(who, read(fields[1]))
        elif (who, what) == ("robot", "connected"):
            self._starts.pop(self._checker.by_host.get(fields[0][0], ""), None)
        elif (who, what) == ("robot", "starts datagrams"):
            self._starts[self._checker.by_host.get(fields[0][0], "")] = self._world.now
        elif what == "writes" and fields[0][0] == "robot" and who in self._starts:
            self._look_at_silence(who, bytes.fromhex(fields[1]))

    def _on_done(self, who: str, what: str) -> None:
        """What a program is told to be done, was done: a gateway of the robot received the stop."""
        sent = {stop_id for stop_id, at in self._put[who].items() if self._world.now - at < ASKED_S}
        self._checker.counts[f"{what} confirmed"] += 1
        self.told |= sent
        if sent and not sent & self._received:
            self._checker.violate("confirmed", f"{who} was told that its {what} was done, which no gateway received")
        if max(self._apart_since.values(), default=math.inf) < self._world.now - SHOWN_S:
            self._checker.violate("confirmed", f"{who} was told that its {what} was done, and the robot was away")

    def _look_at_silence(self, gateway: str, data: bytes) -> None:
        begun, now = self._starts[gateway], self._world.now
        silent = begun + ON_ITS_WAY_S < now < begun + SILENCE_S - ON_ITS_WAY_S
        if silent and len(data) >= 6 and data[5] != 7 and self._checker.obligations.calm_since(begun - 1.0):
            self._checker.violate("silence", f"{gateway} wrote packet {data[5]}, {now - begun:.2f} s after packet 4")

    def written(self, gateway: str, data: bytes) -> None:
        """Take what a gateway wrote."""
        if stops(self._checker.protocol, data):
            self._stopped_at[gateway] = self._world.now

    def _on_status(self, gateway: str, status: dict[str, Any]) -> None:
        if status.get("state") == "established" and not status.get("stalled"):
            self._apart_since[gateway] = math.inf
        elif self._apart_since.get(gateway, math.inf) == math.inf:
            self._apart_since[gateway] = self._world.now

    def _on_killed(self, who: str) -> None:
        """The lease of a process that was killed ends with its liveliness token."""
        begun = self._world.now

        def look(grant: Grant) -> None:
            calm = self._checker.obligations.calm_since(begun + 0.01) and self._world.now - grant.renewed_at < 2.5
            if grant.ended_at is None and calm:
                self._checker.violate("silent-loss", f"{grant} stands {GONE_S:g} s after {who} was killed")

        for grant in self._checker.current.values():
            if grant.asker == who and grant.alive and grant.ended_at is None:
                self._world.after(GONE_S, lambda grant=grant: look(grant))

    def _on_command(self, gateway: str) -> None:
        grant = self._checker.current.get(gateway)
        if grant is not None and grant.last_motion is not None:
            self._moved[gateway] = grant.last_motion

    def _look_for_the_deadman(self) -> None:
        """A robot whose driver says nothing more is stopped after its deadman, which counts from when it spoke."""
        for gateway, command in tuple(self._moved.items()):
            grant, received = self._checker.current.get(gateway), command.received[gateway]
            if grant is None or grant.last_motion is not command or grant.ended_at is not None:
                del self._moved[gateway]
                continue
            given_at = command.given_at + grant.base_s if command.dated else received
            late_s = self._world.now - given_at - grant.deadman_s
            if late_s < DEADMAN_LATE_S:
                continue
            del self._moved[gateway]
            steady = self._works[0] == gateway == self._checker.obligations.works() and self._works[1] < received - 1.0
            ran = self._checker.obligations.undisturbed(gateway, received - 1.0)
            moves = self._checker.wrote_motion_at(gateway) >= received
            self._checker.counts["deadman judged"] += steady and ran and moves
            if steady and ran and moves and self._stopped_at.get(gateway, 0.0) < received:
                self._checker.violate("deadman", f"{gateway} did not stop the robot {late_s:.2f} s after the deadman")

    def tick(self) -> None:
        """Look for a robot that nobody drives, and that is sent no stop."""
        self._look_for_the_deadman()
        now, checker = self._world.now, self._checker
        gateway = checker.obligations.works()
        if gateway != self._works[0]:
            self._works = (gateway, now)
        if gateway is None or not self._owes_stops(gateway):
            return
        grant = checker.current.get(gateway)
        ended_at = grant.ended_at or 0.0 if grant is not None else 0.0
        idle_since = max([ended_at, *checker.latches[gateway].values()])
        since = max(self._stopped_at.get(gateway, 0.0), self._works[1], idle_since)
        if now - since > IDLE_STOP_S + LATE_S and checker.obligations.calm_since(since - 1.0):
            latched = "a latched robot" if checker.latches[gateway] else "a robot that nobody drives"
            checker.violate("idle-stop", f"{gateway} sent {latched} no stop for {now - since:.1f} s")
            self._stopped_at[gateway] = now

    def _owes_stops(self, gateway: str) -> bool:
        """Whether the robot must be sent stops now: it is latched, or nobody has its lease."""
        if self._checker.latches[gateway]:
            return True
        grant, control = self._checker.current.get(gateway), self._checker.simulation.scenario.get("control", {})
        return (grant is None or grant.ended_at is not None) and control.get("idle_stop_s") != 0
