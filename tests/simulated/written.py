"""What must come before motion in what a gateway writes to the robot: a stop, on a connection and after a stall.

Each rule cites ``failures.md``. Links are judged by the simulated network, never by what a gateway says.
"""

from __future__ import annotations

import re
import struct
from typing import TYPE_CHECKING, Any

from tests.simulated.accounts import motions, read

if TYPE_CHECKING:
    from tests.simulated.checker import Checker
    from tests.simulated.net import End

STALLED_S = 0.45
"""A link that acknowledges nothing for so long is stalled for the gateway too, which looks after 0.3 s."""
DOUBTED_S = 11.0
"""Longest time until a gateway doubts a connection: a handshake with UDP, and 5 s."""
ASIDE_S = 1.3
"""Longest time until a gateway that leaves its robot to another one has stopped it."""
BACK_S = 0.5
"""Longest time until a gateway that serves its robot again has stopped it."""
REPLACED_S = 0.02
"""A stop of a new connection that was not yet written is replaced by the motion of a holder: the newest wins."""
BUS_NOTICED_S = 0.3
"""Seconds after which a gateway knows that its bus is gone."""
STOPPED_ONCE_S = 0.5
"""A gateway that left its robot to another one so long ago has written the one stop, and writes no more."""


def stops(protocol: str, data: bytes) -> bool:
    """Whether what was written to a robot stops it, or a part of it."""
    if protocol == "tcpudp":
        return len(data) >= 6 and (data[5] == 13 or (data[5] == 11 and data[14:18] == bytes(4)))
    if protocol == "alf":
        return data[:2] == b"\x03\x00" or re.search(rb"(?:^|;)3\|0\|", data) is not None
    frames = [data[start : start + 11] for start in range(0, len(data) - 10, 11)]
    return any(frame[0] == 130 and struct.unpack("<d", frame[3:]) == (0.0,) for frame in frames)


class Written:
    """Follows what each gateway writes to the robot."""

    def __init__(self, checker: Checker) -> None:
        self._checker = checker
        self._world = checker.world
        self._owes: dict[str, str] = {}
        """By gateway, why a stop must come before motion."""
        self._moves: set[str] = set()
        """Gateways whose last frame of the kind was motion."""
        self._aside: set[str] = set()
        """Gateways that left a moving robot to another one."""
        self._left_at: dict[str, float] = {}
        """By gateway, when it left the robot to another one."""
        self._bus_lost_at: dict[str, float] = {}
        """By host, when its link to the router was lost, until it is back."""
        self._back: set[str] = set()
        """Gateways that serve the robot again, and have not stopped it."""
        self._connected_at = 0.0
        self._established_at: dict[str, float] = {}
        """By gateway, when its ``status`` showed the robot's connection last as new."""
        self._open: dict[str, tuple[End, float]] = {}
        """By gateway, its connection to the robot once a stop was written to it, and when it was open last."""

    def watch(self, who: str, what: str, fields: tuple[Any, ...]) -> None:
        """Follow the trace."""
        if who == "robot" and what == "connected":
            self._connected_at = self._world.now
            gateway = self._checker.by_host.get(fields[0][0])
            if gateway is not None:
                self._owes[gateway] = "since the robot was connected"
                self._moves.discard(gateway)
                self._require_neutral(gateway)
        elif what == "withdraws" and who in self._checker.gateways and fields[0].endswith("/@alive/gateway"):
            self._on_aside(who)
        elif what == "announces" and fields[0].endswith("/@alive/gateway"):
            if self._left_at.pop(who, None) is not None:
                self._on_back(who)
                self._look_for_a_bus(who)
            if who in self._aside:
                self._aside.discard(who)
                self._owes[who] = "since it serves the robot again"
        elif what == "puts" and who in self._checker.gateways and fields[0].endswith("/status"):
            if read(fields[1]).get("state") == "established":
                self._established_at.setdefault(who, self._world.now)
            else:
                self._established_at.pop(who, None)
        elif what in ("killed", "ended", "started", "took over"):
            self._left_at.pop(who, None)
        elif (who, what) == ("bus", "link lost") and fields[2] == 0:
            self._bus_lost_at[fields[0]] = self._world.now
        elif (who, what) == ("bus", "link back"):
            self._bus_lost_at.pop(fields[0], None)

    def written(self, gateway: str, data: bytes) -> None:
        """Take what a gateway wrote."""
        protocol = self._checker.protocol
        self._look_aside(gateway, data)
        if stops(protocol, data):
            self._back.discard(gateway)
            if self._owes.pop(gateway, "").endswith("connected"):
                self._note_open(gateway)
            self._moves.discard(gateway)
        elif any(kind != "mode" or value == 3.0 for kind, value in motions(protocol, data)):
            self._moves.add(gateway)
            if self._checker.simulation.robot.used_up and self._world.now - self._connected_at > DOUBTED_S:
                self._checker.violate("in-doubt", f"{gateway} wrote motion on a connection that is not the usable one")
            why = self._owes.pop(gateway, None)
            replaced = self._world.now - self._established_at.get(gateway, 0.0) < REPLACED_S
            if why is not None and not (replaced and why.endswith("connected")):
                self._checker.violate("stop-first", f"{gateway} wrote motion, and no stop {why}")

    def tick(self) -> None:
        """Note the links that are open, and those that are stalled."""
        for gateway, (end, _) in self._open.items():
            if not (end.closed or end.broken or end.finished):
                self._open[gateway] = (end, self._world.now)
        for end in self._links():
            gateway = end.process.name
            reachable = self._up(end)
            waited_s = self._world.now - max(end.heard_at, end._oldest[0]) if end._oldest else 0.0
            if not reachable and end.unacknowledged and waited_s > STALLED_S and self._ran(gateway, STALLED_S):
                self._owes[gateway] = "since its link was stalled"
                self._checker.counts["a link was stalled"] += 1

    def _note_open(self, gateway: str) -> None:
        """Note the connection that a gateway established: it writes a stop at once."""
        for end in self._links():
            if end.process.name == gateway:
                self._open[gateway] = (end, self._world.now)

    def _require_neutral(self, gateway: str) -> None:
        """Whoever held a robot that was lost must say neutral: state-tables.md, "require neutral"."""
        _, open_at = self._open.pop(gateway, (None, 0.0))
        grant = self._checker.current.get(gateway)
        if grant is not None and grant.ended_at is None and grant.at < open_at:
            grant.needs_neutral = True
            self._checker.counts["a held robot was lost, and is back"] += 1

    def _look_aside(self, gateway: str, data: bytes) -> None:
        """Judge what a gateway writes that left the robot to another one: one stop, and then no more."""
        left_at, protocol = self._left_at.get(gateway), self._checker.protocol
        if left_at is None or self._world.now - left_at < STOPPED_ONCE_S:
            return
        if (stops(protocol, data) or motions(protocol, data)) and self._checker.obligations.calm_since(left_at):
            self._left_at.pop(gateway)
            self._checker.violate("aside", f"{gateway} left the robot to another gateway, and writes {data.hex()}")

    def _on_aside(self, gateway: str) -> None:
        """A gateway that leaves its robot to another one stops it, over the connection that it keeps."""
        member = self._checker.gateways[gateway]
        if member.ending or member.part("+") is not None:  # a process that hands over withdraws its token too
            return
        self._left_at[gateway] = self._world.now
        if gateway not in self._moves:
            return
        self._aside.add(gateway)
        begun = self._world.now
        self._checker.counts["a gateway left a moving robot to another one"] += 1

        def look() -> None:
            kept = any(end.process.name == gateway and self._up(end) for end in self._links())
            calm = self._ran(gateway, ASIDE_S + 1.0) and self._checker.obligations.calm_since(begun)
            if kept and calm and gateway in self._moves and gateway in self._aside:
                self._checker.violate("stop-aside", f"{gateway} left the robot to another gateway, and moving")

        self._world.after(ASIDE_S, look)

    def _look_for_a_bus(self, gateway: str) -> None:
        """Whoever left the robot to another gateway cannot know that it is gone, while its own bus is."""
        member = self._checker.gateways[gateway]
        lost_at = self._bus_lost_at.get(member.host.name, self._world.now)
        if not member.session.link.up and self._world.now - lost_at > BUS_NOTICED_S:
            self._checker.violate("aside", f"{gateway} serves the robot again, and has no bus")

    def _on_back(self, gateway: str) -> None:
        """A gateway that serves its robot again begins with a stop."""
        begun = self._world.now
        self._back.add(gateway)

        def look() -> None:
            owes, obligations = gateway in self._back, self._checker.obligations
            self._back.discard(gateway)
            calm = self._ran(gateway, BACK_S + 1.0) and obligations.calm_since(begun)
            if owes and calm and obligations.works() == gateway:
                self._checker.violate("stop-first", f"{gateway} serves the robot again, and does not stop it")

        self._world.after(BACK_S, look)

    def _links(self) -> list[End]:
        """The connections of gateways to the robot that are open."""
        gateways = self._checker.gateways
        return [
            end
            for end in self._checker.simulation.network.ends
            if end.peer.process.name == "robot" and end.process.name in gateways and not end.closed and not end.broken
        ]

    def _up(self, end: End) -> bool:
        paths, here, there = self._checker.simulation.paths, end.address[0], end.peer.address[0]
        return paths.up(here, there) and paths.up(there, here)

    def _ran(self, gateway: str, seconds: float) -> bool:
        return self._checker.obligations.undisturbed(gateway, self._world.now - seconds)
