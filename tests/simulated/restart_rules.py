"""Rules about restarts with handover, from what is written, published and seen by the robot and the HQ programs.

A process that is not the member's own (its name ends with ``+`` or ``-``) may neither write, nor publish, nor grant; a
successor only confirms stops on ``control``. What a healthy restart must keep is judged only where nothing else went
wrong in its time.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import msgpack

from tests.simulated.accounts import motions, read
from tests.simulated.net import End

if TYPE_CHECKING:
    from tests.simulated.scenario import Simulation

SOON_S = 1.5
"""Seconds after *go* until which the robot, its HQ programs and ``control`` are as they must be."""
SETTLED_S = 3.5
"""A connection that is so old has ended its handshake."""
GONE_S = 0.05
"""Seconds after *go* for which what the process before published may still leave."""
TROUBLE_S = 6.0
"""A fault that is over for so long disturbs no restart."""
UNDONE_S = 7.0
"""Seconds after a restart that failed: two looks for other gateways."""
_FAULTS = ("killed", "paused", "resumed", "cut", "healed", "link lost", "was suspended", "told to end", "crashed")
_TOLD = {
    "pose": lambda fields: fields["x"] * 100,
    "motion": lambda fields: fields["temperature"],
    "sensor/ds0": lambda fields: fields["value"],
}
"""Where the number of a robot's telemetry stands on the bus."""


class RestartRules:
    """Judges the restarts of one simulation."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.checker = simulation.checker
        self.world = simulation.world
        self._trouble_at = -math.inf
        self._restarted_at = -math.inf
        self._moves: dict[str, bool] = {}
        """By gateway, whether the last thing that it wrote to the robot was motion."""
        self._given: dict[str, bool] = {}
        """By gateway, whether everything was given to a successor that may have the robot."""
        self._went_at: dict[str, float] = {}
        self._last_told = 0.0
        self._hello: dict[str, tuple[list[End], dict[str, Any]]] = {}
        """By gateway, the connections when its successor said hello: the robot's, and the HQ programs'."""
        self._connected: dict[End, float] = {}
        self._left_at: dict[str, float] = {}
        """By HQ program, when it left its listener by itself."""
        self.world.watchers.append(self._watch)
        simulation.fabric.on_put.append(self._on_put)

    def _watch(self, who: str, what: str, fields: tuple[Any, ...]) -> None:
        name, part = (who[:-1], who[-1]) if who[-1:] in ("+", "-") else (who, "")
        if what in _FAULTS:
            self._on_fault(name, part, what)
        elif what == "connected" and who == "robot":
            self._connected[self.simulation.robot.ends[-1]] = self.world.now
            self._moves.clear()
        elif what == "leaves listener":
            self._left_at[who] = self.world.now
        elif (who, what) == ("udp", "sends"):
            self._on_datagram(*fields)
        elif name not in self.checker.gateways:
            return
        elif what == "writes":
            self._on_writes(name, part, *fields)
        elif what == "answers" and part:
            self._on_answers(name, part, *fields)
        elif what.startswith("handover"):
            self._on_handover(name, part, what.partition(" ")[2], fields[0])
        elif what == "took over":
            self._on_took_over(name, fields[0])
        elif what == "leaves":
            self.checker.violate("leak", f"{who} leaves {fields[0]}")
        elif what in ("started", "took nothing over"):
            self._trouble_at = self.world.now if what != "started" or not part else self._trouble_at
            self._given[name] = False

    def _on_fault(self, name: str, part: str, what: str) -> None:
        if what == "killed" and part == "+":
            self._on_undone(name)
        self._trouble_at = self.world.now

    def _on_handover(self, name: str, part: str, what: str, said: str) -> None:
        self.checker.counts[f"restart: {said} {what}"] += 1
        if part == "" and (what, said) == ("got", "Hello"):
            self.checker.end(name, "gateway restarted")
            robot, host = self.simulation.robot, self.checker.gateways[name].host.name
            programs = {
                each.name: each.end
                for each in self.simulation.programs
                if each.address[0] == host and each.ready and each.end is not None
            }
            ends = [end for end in robot.ends if end.peer.address[0] == host and self._is_settled(end)]
            self._hello[name] = (ends, programs)
        elif part == "" and (what, said) == ("unsent", "HandoverState"):
            self._given[name] = True
            host = self.checker.gateways[name].host.name
            if self._moves.get(name) and any(end.peer.address[0] == host for end in self.simulation.robot.ends):
                self.checker.violate("restart-stop", f"{name} hands over a robot that it has not stopped")

    def _is_settled(self, end: End) -> bool:
        return self.world.now - self._connected.get(end, self.world.now) > SETTLED_S

    # Two processes

    def _on_writes(self, name: str, part: str, peer: tuple[str, int], data: str) -> None:
        to_robot = peer[0] == "robot"
        if part:
            old = "before" if part == "-" else "after"
            if part == "+" or self._given.get(name) or name in self._went_at:
                self.checker.violate("two-writers", f"the process {old} {name} writes to {peer}: {data}")
        elif self._has_successor(name):
            self.checker.violate("two-writers", f"{name} writes to {peer} while its successor has everything: {data}")
        elif to_robot and (found := _motion(self.checker.protocol, bytes.fromhex(data))) is not None:
            self._moves[name] = found

    def _on_datagram(self, source: tuple[str, int], target: tuple[str, int], data: str) -> None:
        name, found = self.checker.by_host.get(source[0]), _motion(self.checker.protocol, bytes.fromhex(data))
        if target[0] == "robot" and name is not None and found is not None:
            self._moves[name] = found

    def _has_successor(self, name: str) -> bool:
        member = self.checker.gateways[name]
        successor = member.part("+")
        return self._given.get(name, False) and successor is not None and successor.process.alive

    def _on_answers(self, name: str, part: str, key: str, payload: bytes, error: str, asker: str, _: bytes) -> None:
        if "@rpc/control/" in key and error == "None" and read(payload).get("ok"):
            when = "has not the robot yet" if part == "+" else "has handed over"
            self.checker.violate("restart-grant", f"{asker} got {key} of a process of {name} that {when}")

    def _on_put(self, who: str, key: str, payload: bytes) -> None:
        name, part = (who[:-1], who[-1]) if who[-1] in "+-" else (who, "")
        if name not in self.checker.gateways or "@" in key:
            return
        topic = key.partition("/r1/")[2]
        confirms_stop = part == "+" and topic == "control" and read(payload).get("lease") is None
        if (part == "+" and not confirms_stop) or (
            part == "-" and self.world.now - self._went_at.get(name, self.world.now) > GONE_S
        ):
            self.checker.violate("restart-publishes", f"{who} publishes {key}")
        if topic in _TOLD:
            self._on_telemetry(name, round(_TOLD[topic](msgpack.unpackb(payload))))

    def _on_telemetry(self, name: str, number: int) -> None:
        """What the robot says is published once, in order, and nothing is lost by a restart."""
        last, self._last_told = self._last_told, max(number, self._last_told)
        if sum(each.serves for each in self.simulation.gateways) > 1:
            return
        if number <= last:
            self.checker.violate("telemetry", f"{name} published what the robot said as {number:g} again, or late")
            return
        restarted = self.world.now - self._restarted_at < 2 * SOON_S
        if number > last + 1 and last and restarted and self._untroubled(SOON_S + TROUBLE_S):
            self.checker.violate("telemetry", f"the messages after {last:g}, before {number:g}, were lost")

    # A healthy restart

    def _untroubled(self, seconds: float) -> bool:
        """Whether nothing went wrong for so long, and nothing is wrong now."""
        simulation, paths = self.simulation, self.simulation.paths
        processes = [simulation.robot, *(member.process for member in simulation.members.values() if member.alive)]
        calm = not (paths.cuts or paths.slow or paths.loss or any(each.paused for each in processes))
        return calm and self.world.now - self._trouble_at > seconds

    def _on_took_over(self, name: str, why: str) -> None:
        self.checker.counts[f"restart: took over, {why}"] += 1
        self._went_at[name] = self._restarted_at = self.world.now
        self._given[name] = False
        ends, programs = self._hello.pop(name, ([], {}))
        if why != "go":
            return
        ended, since = [end for end in ends if end.closed or end.broken], self.world.now - 1.0
        calm = self._untroubled(TROUBLE_S)

        def look() -> None:
            if calm and self._trouble_at < since and self._went_at[name] <= since + 1.0:
                self._judge(name, [end for end in ends if end not in ended], programs)

        self.world.after(SOON_S, look)

    def _on_undone(self, name: str) -> None:
        """A gateway whose successor died keeps the robot, and its connection."""
        ends, _ = self._hello.pop(name, ([], {}))
        ends, begun, calm = [end for end in ends if not end.closed], self.world.now, self._untroubled(TROUBLE_S)
        leaves = self.checker.gateways[name].session.link.locked  # it joins the bus anew, and connects again
        if not ends or not calm or leaves:
            return

        def look() -> None:
            if self._trouble_at <= begun + 0.5:  # its link to the router ends with it
                self.checker.counts["restart: undone"] += 1
                if any(end.closed or end.broken for end in ends):
                    self.checker.violate("restart-connection", f"{name} did not restart, and the robot lost it")

        self.world.after(UNDONE_S, look)

    def _judge(self, name: str, ends: list[End], programs: dict[str, Any]) -> None:
        self.checker.counts["restart: healthy"] += 1
        robot, checker = self.simulation.robot, self.checker
        for end in ends:
            if end.closed or end.broken or end not in robot.ends or end.peer.closed:
                checker.violate("restart-connection", f"{name} restarted, and the robot lost its connection")
        host = checker.gateways[name].host.name
        if ends and sum(end.peer.address[0] == host for end in robot.ends) > len(ends):
            checker.violate("restart-connection", f"{name} restarted, and the robot has another connection")
        for program in self.simulation.programs:
            stays = self.world.now - self._left_at.get(program.name, -math.inf) > 2 * SOON_S
            if stays and program.name in programs and program.end is not programs[program.name]:
                checker.violate("restart-hq", f"{name} restarted, and {program.name} lost its connection")

    def ended(self) -> None:
        """Judge what holds at the end: HQ programs are connected again."""
        owners = tuple(self.simulation.network.listeners.values())
        for program in self.simulation.programs:
            waits = (
                any(program.end.peer in getattr(owner, "waiting", ()) for owner, _ in owners) if program.end else True
            )
            if waits:
                self.checker.violate("restart-hq", f"nobody serves {program.name} long after all faults are over")


AUTONOMOUS = 3.0


def _motion(protocol: str, data: bytes) -> bool | None:
    """Tell whether a frame moves the robot (True), or stops it (False); None: neither."""
    if any(kind == "motion" or value == AUTONOMOUS for kind, value in motions(protocol, data)):
        return True
    if protocol == "tcpudp" and len(data) >= 6:
        return False if data[5] in (11, 12, 13) else None
    if protocol == "alf":
        return False if data[:1] == b"\x03" or data[:2] == b"3|" else None
    if protocol == "wc2ec":
        return False if any(data[at] == 130 for at in range(0, len(data) - 10, 11)) else None
    return None
