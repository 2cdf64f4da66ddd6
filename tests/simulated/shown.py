"""Whether ``status`` and ``control`` say what is true, 0.2 s after the news at the latest."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tests.simulated.accounts import read

if TYPE_CHECKING:
    from tests.simulated.checker import Checker

NEWS_S = 0.2
SETTLED_S = 1.5
"""Longest time that a handshake takes once the connection is there and the robot takes commands."""
RIVAL_S = 5.0
"""Longest time until a gateway has found that another one is gone: it asks every 0.5 s, for 1 s, and looks thrice."""
STALLED = "the robot's link is stalled"
RECOVERED_S = 3.0
"""Longest time until a link that works again is shown to do so: TCP sends again within a second."""
RIVALS = ("another gateway serves", "a second connection is open")
UDP_S = 2.5
"""How much longer a handshake with datagrams takes."""


class Shown:
    """Compares what gateways publish with the simulated network, and with the leases and stops on the bus."""

    def __init__(self, checker: Checker) -> None:
        self._checker = checker
        self._world = checker.world
        self._state: dict[str, str] = {}
        """By gateway, the state of its last ``status``."""
        self._reason: dict[str, str] = {}
        """By gateway, the reason that its last ``status`` gives."""
        self._reason_at: dict[str, float] = {}
        """By gateway, when that reason was first given."""
        self._apart_since: dict[str, float] = {}
        self._works_since: tuple[str | None, float] = (None, 0.0)
        self._latched_at = 0.0
        """When a latched stop was last in force."""

    def watch(self, who: str, what: str, fields: tuple[Any, ...]) -> None:
        """Follow the trace."""
        if what == "puts" and who in self._checker.gateways:
            if fields[0].endswith("/status"):
                status = read(fields[1])
                if (STALLED in str(status.get("reason"))) is not bool(status.get("stalled")):
                    self._checker.violate("status", f"{who} shows stalled = {status.get('stalled')}: {status}")
                if str(status.get("reason")) != self._reason.get(who):
                    self._reason_at[who] = self._world.now
                self._state[who], self._reason[who] = str(status.get("state")), str(status.get("reason"))
            elif fields[0].endswith("/control"):
                self._on_control(who, read(fields[1]))
        elif what in ("killed", "ended"):
            self._state.pop(who, None)

    def tick(self) -> None:
        """Compare ``status`` with the connections."""
        now, checker = self._world.now, self._checker
        self._note_latches()
        self._look_for_rivals()
        works = checker.obligations.works()
        if works != self._works_since[0]:
            self._works_since = (works, now)
        self._look_for_stalled(works)
        for gateway, state in self._state.items():
            if self._connected(gateway) or state != "established":
                self._apart_since.pop(gateway, None)
            elif now - self._apart_since.setdefault(gateway, now) > NEWS_S + 0.1 and self._judges(gateway, NEWS_S):
                checker.violate("status", f"{gateway} shows established, and has no connection")
                self._apart_since.pop(gateway)
        robot = checker.simulation.robot  # a handshake may have waited while the robot was paused
        begun = max(self._works_since[1], robot.resumed_at + (UDP_S if getattr(robot, "udp", False) else 0.0))
        settled = works is not None and now - begun > SETTLED_S
        if works is not None and settled and self._state.get(works) != "established" and self._judges(works, SETTLED_S):
            checker.violate("status", f"{works} shows {self._state.get(works)}, and its robot is established")
            self._works_since = (works, now)

    def _look_for_stalled(self, works: str | None) -> None:
        """``status`` says that a link is stalled for as long as it is."""
        if works is None or self._world.now - max(self._works_since[1], self._reason_at.get(works, 0.0)) < RECOVERED_S:
            return
        if STALLED in self._reason.get(works, "") and self._judges(works, RECOVERED_S):
            self._checker.violate("status", f"{works} reaches its robot, and shows: {self._reason.pop(works)}")

    def _look_for_rivals(self) -> None:
        """``status`` names another gateway of the robot for as long as that one is there."""
        serving = [each for each in self._checker.gateways.values() if each.serves]
        alive = [each for each in serving if each.alive]
        if len(serving) < 2 or len(alive) != 1 or not alive[0].running or not alive[0].session.link.whole:
            return
        gateway, since = alive[0].name, self._world.now - RIVAL_S
        named = any(text in self._reason.get(gateway, "") for text in RIVALS)
        if named and self._checker.obligations.calm_since(since) and self._checker.obligations.serves(gateway):
            self._checker.violate("status", f"{gateway} runs alone, and shows: {self._reason.pop(gateway)}")

    def _note_latches(self) -> None:
        if any(self._checker.latches.values()):
            self._latched_at = self._world.now

    def _connected(self, gateway: str) -> bool:
        """Whether a gateway has a connection to the robot that has not ended."""
        return any(
            end.process.name == gateway and end.peer.process.name == "robot" and not end.closed and not end.finished
            for end in self._checker.simulation.network.ends
        )

    def _on_control(self, gateway: str, control: dict[str, Any]) -> None:
        lease, state, checker = control.get("lease"), control.get("state"), self._checker
        for refused in control.get("refusals", ()):
            checker.counts[f"refused {refused.get('code')}"] += 1
        self._note_latches()
        grant = checker.grants.get(lease or b"")
        if lease is not None and grant is None:
            checker.violate("control", f"{gateway} shows a lease that nobody was granted")
        elif grant is not None and control.get("holder") != grant.who:
            checker.violate("control", f"{gateway} shows {control.get('holder')} as the holder of {grant}")
        elif (lease is not None) is not (state == "held"):
            checker.violate("control", f"{gateway} shows {state}, {'with' if lease else 'without'} a lease")
        elif state == "latched" and self._world.now - self._latched_at > NEWS_S + 0.15:
            if {latch["id"] for latch in control["latches"]} <= checker.uncertain:
                return
            checker.violate("control", f"{gateway} shows latched, and nobody latched the robot")

    def _judges(self, gateway: str, seconds: float) -> bool:
        obligations = self._checker.obligations
        return obligations.serves(gateway) and obligations.undisturbed(gateway, self._world.now - seconds - 0.2)
