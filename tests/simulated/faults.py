"""The steps of a scenario: what people and programs do, and faults, at a time or when a state is reached.

A step with ``when`` waits for a state from its ``t`` on, and happens ``after`` seconds after it was reached, once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgpack

if TYPE_CHECKING:
    from tests.simulated.scenario import Simulation

REACHED: dict[str, Callable[[str, str, tuple[Any, ...]], bool]] = {
    "moving": lambda who, what, fields: what == "moving" and bool(fields[0]),
    "stopping": lambda who, what, fields: what == "moving" and not fields[0],
    "mode read": lambda who, what, fields: what == "reads" and fields[0] == "mode",
    "asking": lambda who, what, fields: what == "asks" and "@rpc/control/" in fields[0],
    "granted, not replied": lambda who, what, fields: what == "answers" and "@rpc/control/acquire" in fields[0],
    "granted": lambda who, what, fields: what == "granted",
    "mode unwritten": lambda who, what, fields: what == "receives" and fields[0].endswith("@cmd/mode"),
    "stop unwritten": lambda who, what, fields: what == "receives" and fields[0].endswith("@cmd/stop"),
    "drive received": lambda who, what, fields: what == "receives" and fields[0].endswith("@cmd/drive"),
    "claim asked": lambda who, what, fields: what == "asks" and "@rpc/claim" in fields[0],
    "connected": lambda who, what, fields: who == "robot" and what == "connected",
    "released": lambda who, what, fields: what == "released",
}
"""The states that a fault can wait for."""
_SAID = ("Hello", "HandoverState", "Up", "Go")
HANDOVER: dict[str, Callable[[str, str, tuple[Any, ...]], bool]] = {
    f"{said} {what}": lambda who, noted, fields, what=what, said=said: (  # type: ignore[misc]
        noted == f"handover {what}" and fields[0] == said
    )
    for said in _SAID
    for what in ("unsent", "sent", "got")
}
"""The steps of a restart: before a message is sent, after, and when it was received."""
HANDOVER["restarting"] = lambda who, what, fields: what == "told to restart"


class Faults:
    """Carries the steps out."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self.world = simulation.world
        self._waiting: dict[str, list[dict[str, Any]]] = {}
        self.reached: dict[str, int] = {}
        self._over = False
        self._overheard: tuple[str, str, bytes, bytes] | None = None
        self.world.watchers.append(self._watch)

    def plan(self, steps: list[dict[str, Any]]) -> None:
        """Set the steps up."""
        for step in steps:
            if "when" in step:
                self.world.at(step["t"], lambda step=step: self._waiting.setdefault(step["when"], []).append(step))
            else:
                self.world.at(step["t"], lambda step=step: self.do(step))

    def _watch(self, who: str, what: str, fields: tuple[Any, ...]) -> None:
        if what == "puts" and fields[0].endswith("@cmd/drive") and fields[2]:
            grant = self._simulation.checker.grants.get(msgpack.unpackb(fields[2])["lease"])
            if grant is not None and grant.asker == who:
                self._overheard = (who, *fields)
        if not self._waiting:
            return
        for state in [state for state in self._waiting if (REACHED.get(state) or HANDOVER[state])(who, what, fields)]:
            steps = self._waiting.pop(state)
            for step in steps:
                self.reached[state] = self.reached.get(state, 0) + 1
                self.world.after(step.get("after", 0.0), lambda step=step: self.do(step))

    def do(self, step: dict[str, Any]) -> None:
        """Do one step now."""
        if self._over:
            return
        if step.get("target") == "owner":
            step = {**step, "target": self._simulation.checker.obligations.serving or "gw1"}
        if "fault" in step:
            self._simulation.checker.counts[f"fault {step['fault']}"] += 1
            for role in self._roles(step):
                self._simulation.checker.counts[f"{role}: {step['fault']}"] += 1
            getattr(self, f"_{step['fault']}")(step)
            return
        name = step["who"]
        if step["do"] == "leave":
            self._simulation.checker.counts["HQ program: leave"] += 1
        for who in (*self._simulation.drivers, *self._simulation.programs):
            if who.name == name:
                who.do(step)

    def _roles(self, step: dict[str, Any]) -> set[str]:
        """Return whose fault it is: of processes by name, of links by the hosts of both ends but routers."""
        simulation = self._simulation
        hit = {step.get("target"), *step.get("between", ())}
        roles = {"robot"} & hit
        roles |= {"client" for each in simulation.drivers if hit & {each.name, each.host.name}}
        roles |= {"HQ program" for each in simulation.programs if hit & {each.name, each.host.name}}
        for each in simulation.gateways:
            if hit & {each.name, each.host.name} and not roles:
                roles |= {"gateway"} if each.serves else {"listener"}
                roles |= {"listener"} if each.configuration["hq"] else set()
        return roles

    def _later(self, step: dict[str, Any], undo: Callable[[], None]) -> None:
        self.world.after(step.get("for", 1.0), undo)

    def _process(self, name: str) -> Any:
        simulation = self._simulation
        if name == "robot":
            return simulation.robot
        if name[-1] in "+-":  # of a restart
            life = simulation.members[name[:-1]].part(name[-1])
            return life.process if life is not None else None
        if name in simulation.members:
            member = simulation.members[name]
            return member.process if member.alive else None
        return next((each for each in simulation.programs if each.name == name), None)

    @property
    def paused(self) -> bool:
        """Whether a process is paused now."""
        simulation = self._simulation
        processes = [simulation.robot, *simulation.programs]
        processes += [member.process for member in simulation.members.values() if member.alive]
        return any(process.paused for process in processes)

    # Faults

    def _pause(self, step: dict[str, Any]) -> None:
        process = self._process(step["target"])
        if process is not None and process.alive and not process.paused:
            process.pause()
            self._later(step, process.resume)

    def _kill(self, step: dict[str, Any]) -> None:
        if step["target"][-1] in "+-":
            if (process := self._process(step["target"])) is not None:
                process.kill()
            return
        member = self._simulation.members[step["target"]]
        member.kill()
        self._later(step, member.start)

    def _restart(self, step: dict[str, Any]) -> None:
        """Let a gateway hand everything over to another process."""
        self._simulation.members[step["target"]].restart()  # type: ignore[attr-defined]

    def _end(self, step: dict[str, Any]) -> None:
        member = self._simulation.members[step["target"]]
        member.stop()
        self.world.after(max(5.0, step.get("for", 1.0)), member.start)

    def _cut(self, step: dict[str, Any]) -> None:
        here, there = step["between"]
        self._simulation.paths.cut(here, there, both=step.get("both", True))
        self._simulation.fabric.follow()
        self._later(step, lambda: self._simulation.paths.heal(here, there))

    def _mute(self, step: dict[str, Any]) -> None:
        """Let the robot send a gateway nothing more."""
        robot, host = self._simulation.robot, self._simulation.members[step["target"]].host.name
        robot.mute_to.add(host)
        self._later(step, lambda: robot.mute_to.discard(host))

    def _reset(self, step: dict[str, Any]) -> None:
        """Reset the connections between two hosts."""
        pair = set(step["between"])
        for end in tuple(self._simulation.network.ends):
            if {end.address[0], end.peer.address[0]} == pair and not end.closed:
                end.ended(ConnectionResetError("reset by peer"))
                end.peer.ended(ConnectionResetError("reset by peer"))

    def _unlink(self, step: dict[str, Any]) -> None:
        """Drop a member's link to its router, or that of the routers; it returns soon."""
        fabric = self._simulation.fabric
        name = step["target"]
        member = self._simulation.members.get(name)
        link = member.session.link if member is not None and member.alive else fabric.between
        link.drop(stays=True)
        self._later(step, link.restore)

    def _lock(self, step: dict[str, Any]) -> None:
        """Let a member's session lose its connection, and never make one again."""
        member = self._simulation.members[step["target"]]
        if member.alive:
            member.session.link.lock()

    def _router(self, step: dict[str, Any]) -> None:
        """Restart a router: all of its links end."""
        fabric = self._simulation.fabric
        fabric.kill_router(step["target"])
        self._later(step, lambda: fabric.start_router(step["target"]))

    def _slow(self, step: dict[str, Any]) -> None:
        slow, pair = self._simulation.paths.slow, frozenset(step["between"])
        slow[pair] = step.get("by", 0.1)
        self._later(step, lambda: slow.pop(pair, None))

    def _news(self, step: dict[str, Any]) -> None:
        """Liveliness news come late, or never."""
        fabric = self._simulation.fabric
        fabric.news_late_s, fabric.news_lost = step.get("late", 2.0), step.get("lost", 0.0)

        def undo() -> None:
            fabric.news_late_s, fabric.news_lost = 0.0, 0.0

        self._later(step, undo)

    def _duplicate(self, step: dict[str, Any]) -> None:
        fabric, paths = self._simulation.fabric, self._simulation.paths
        fabric.duplicates = paths.duplicates = 0.3

        def undo() -> None:
            fabric.duplicates = paths.duplicates = 0.0

        self._later(step, undo)

    def _threads(self, step: dict[str, Any]) -> None:
        """Slow the threads of a machine down: a busy disk, a bus that is written to late."""
        host = self._simulation.members[step["target"]].host
        host.thread_s, usual_s = step["by"], host.thread_s

        def undo() -> None:
            host.thread_s = usual_s

        self._later(step, undo)

    def _lose(self, step: dict[str, Any]) -> None:
        """Lose a part of all datagrams."""
        paths = self._simulation.paths
        paths.loss = step.get("part", 0.2)

        def undo() -> None:
            paths.loss = 0.0

        self._later(step, undo)

    def _forge(self, step: dict[str, Any]) -> None:
        """Somebody who overheard a drive alters it, repeats it late, and asks for the end of the lease."""
        overheard = self._overheard
        driver = next((each for each in self._simulation.drivers if overheard and each.name != overheard[0]), None)
        if overheard is None or driver is None or not driver.running or driver.bus is None:
            return
        _, key, payload, attachment = overheard
        bus, shown = driver.bus, msgpack.unpackb(attachment)
        altered = msgpack.packb({**msgpack.unpackb(payload), "forward": 0.98765})
        later = msgpack.packb({**shown, "seq": shown["seq"] + 1000})
        bus.put(key, altered, attachment, droppable=False)
        bus.put(key, altered, later, droppable=False)
        bus.put(key, payload, attachment, droppable=False)
        for after_s in (0.7, 1.3):
            driver.process.after(after_s, lambda: bus.put(key, payload, attachment, droppable=False))
        ask = bus.ask("fleet/r1/@rpc/control/release", later)
        driver.process.loop.create_task(ask)

    def _jump(self, step: dict[str, Any]) -> None:
        """Let the wall clock jump."""
        self._simulation.host(step["target"]).wall_offset_s += step.get("by", 3600.0)

    def _suspend(self, step: dict[str, Any]) -> None:
        """Suspend a gateway's machine: its processes are paused, and its monotonic clock stands."""
        simulation = self._simulation
        member = simulation.members[step["target"]]
        if not member.running:
            return
        process, begun = member.process, self.world.now
        process.pause()

        def wake() -> None:
            if process.alive and process.paused:
                member.host.suspended_s += self.world.now - begun
                self.world.note(member.name, "was suspended", self.world.now - begun)
                process.resume()

        self._later(step, wake)

    def heal_all(self) -> None:
        """End all faults."""
        self._over = True
        simulation, paths, fabric = self._simulation, self._simulation.paths, self._simulation.fabric
        self._waiting.clear()
        for here, there in paths.cuts:
            paths.heal(here, there)
        paths.loss = paths.duplicates = fabric.duplicates = fabric.news_late_s = fabric.news_lost = 0.0
        paths.slow.clear()
        simulation.robot.mute_to.clear()
        processes = [simulation.robot, *simulation.programs]
        processes += [member.process for member in simulation.members.values() if member.alive]
        parts = [gateway.part(which) for gateway in simulation.gateways for which in "+-"]
        processes += [part.process for part in parts if part is not None]
        for process in processes:
            process.resume()
        for member in simulation.members.values():
            if not member.alive:
                member.start()
        for router in fabric.routers:
            fabric.start_router(router)
        fabric.follow()
        fabric.between.restore()
        for session in fabric.sessions:
            session.link.restore()
