"""Rules about latched stops of the whole fleet, which the gateways of other robots know too.

Source: "Latched stops" in ``lease.md``: who missed one learns of it from them before it grants a lease, and
nobody takes over what one of them knows to be released.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tests.simulated.accounts import read

if TYPE_CHECKING:
    from tests.simulated.checker import Checker

ADOPTED_S = 3.0
"""Longest time until a gateway that is on the bus again has asked the others, and shows what is in force."""


class FleetRules:
    """Follows what the gateways of other robots know, and what this robot's adopt of it."""

    def __init__(self, checker: Checker) -> None:
        self._checker = checker
        self._world = checker.world
        self._simulation = checker.simulation
        self._known: dict[str, dict[bytes, float]] = {each.name: {} for each in checker.simulation.others}
        """By gateway of another robot, the fleet's latched stops that are in force there, and since when."""
        self._released: dict[bytes, dict[str, float]] = {}
        """By latched stop, the gateways that released it, and when."""
        self._here_since: dict[str, float] = {}
        """By gateway of this robot, since when it is on the bus."""
        self._shown: dict[str, set[bytes]] = {name: set() for name in checker.gateways}
        """By gateway of this robot, the latched stops that it ever showed."""

    def watch(self, who: str, what: str, fields: tuple[Any, ...]) -> None:
        """Follow the trace."""
        if not self._known:
            return
        if what == "receives" and who in self._known and fields[0] == "fleet/*/@cmd/stop":
            self._on_stop(who, read(fields[1]))
        elif what == "answers" and fields[2] == "None":
            self._on_answers(who, *fields)
        elif what == "connected" and who in self._checker.gateways:
            self._here_since[who] = self._world.now if fields[0] else float("inf")
        elif what == "puts" and who in self._checker.gateways and fields[0].endswith("/control"):
            self._on_control(who, read(fields[1]))

    def _on_stop(self, who: str, stop: dict[str, Any]) -> None:
        stop_id = stop.get("id")
        if stop.get("latch") is True and isinstance(stop_id, bytes) and who not in self._released.get(stop_id, {}):
            self._known[who].setdefault(stop_id, self._world.now)

    def _on_answers(self, who: str, key: str, payload: bytes, error: str, asker: str, asked: bytes) -> None:
        verb = key.partition("@rpc/control/")[2].partition("/")[0]
        if verb == "unlatch_fleet":
            stop_id = read(asked).get("id", b"")
            self._released.setdefault(stop_id, {}).setdefault(who, self._world.now)
            self._known.get(who, {}).pop(stop_id, None)
            return
        granted = verb in ("acquire", "takeover") and who in self._checker.gateways and read(payload).get("ok")
        if granted and self._not_learnt(who):
            self._checker.violate("latched", f"{who} granted {asker} before it knew of the fleet's latched stop")

    def _not_learnt(self, gateway: str) -> set[bytes]:
        """The latched stops that others knew when a gateway came to the bus, and that it has not shown yet."""
        since = self._here_since.get(gateway, float("inf"))
        if since == float("inf") or not self._checker.obligations.calm_since(since):  # it does not know of its bus yet
            return set()
        return {
            stop_id
            for name in self._reached_by(gateway)
            for stop_id, at in self._known[name].items()
            if at < since and stop_id not in self._released and stop_id not in self._shown[gateway]
        }

    def _reached_by(self, gateway: str) -> list[str]:
        """The gateways of other robots that a gateway reaches."""
        here, fabric = self._simulation.members[gateway].session, self._simulation.fabric
        return [each.name for each in self._simulation.others if each.alive and fabric.works(here, each.session)]

    def _on_control(self, gateway: str, control: dict[str, Any]) -> None:
        """Take over what a gateway adopted, unless another one knows that it was released."""
        since, own = self._here_since.get(gateway, float("inf")), self._checker.latches[gateway]
        for latch in control.get("latches", ()):
            stop_id = latch["id"]
            self._shown[gateway].add(stop_id)
            released = self._released.get(stop_id, {})
            if stop_id in own or not latch.get("fleet") or gateway in released:
                continue
            told = [name for name in self._reached_by(gateway) if released.get(name, since) < since]
            if told and self._checker.obligations.calm_since(since):
                self._checker.violate(
                    "latched", f"{gateway} adopted a latched stop that {told[0]} knows to be released"
                )
            self._checker.counts["a fleet's latched stop was adopted"] += 1
            own[stop_id] = self._world.now

    def tick(self) -> None:
        """Look for latched stops that a gateway has not learnt."""
        for gateway, since in self._here_since.items():
            if self._world.now - since < ADOPTED_S or not self._checker.obligations.serves(gateway):
                continue
            if not_learnt := self._not_learnt(gateway):
                self._shown[gateway] |= not_learnt
                self._checker.violate("latched", f"{gateway} has not learnt of the fleet's latched stop")
