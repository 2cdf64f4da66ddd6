"""What must happen in time: the robot stops, ``control`` shows the truth, holders learn of their loss."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tests.simulated.accounts import Grant, read

if TYPE_CHECKING:
    from tests.simulated.checker import Checker

LEFT = "left the robot to another gateway"
DISTURBS = frozenset(
    (
        "paused",
        "resumed",
        "started",
        "told to end",
        "was suspended",
        "cut",
        "healed",
        "link lost",
        "link back",
        "crashed",
    )
)
"""What the trace says of faults."""
TICK_S = 0.1
REST_S = 1.5
"""Longest time to rest, once the robot and its link work; docs/explanation/failures.md."""
TOLD_S = 0.25
"""Longest time until ``control`` shows news."""
HEARTBEAT_S = 2.5
"""Seconds without ``status`` that are too many."""
STATUS_S = 1.4
"""A gateway that serves its robot publishes ``status`` so often."""


class Obligations:
    """Judges what ought to have happened by now."""

    def __init__(self, checker: Checker) -> None:
        self.checker = checker
        self.simulation = checker.simulation
        self.world = checker.world
        self._status_at: dict[str, float] = {}
        self._tokens: dict[str, float] = {}
        """By gateway, since when its token says that it serves the robot."""
        self._control: dict[str, dict[str, Any]] = {}
        self._disturbed: dict[str, float] = {}
        """By process, when it was last paused, resumed or started."""
        self._moving_since: float | None = None
        self._works_since: float | None = None
        self._said = False
        self._connected_at = 0.0
        self._ended_for: dict[str, float] = {}
        self._granted_to: dict[str, float] = {}
        self._probe: dict[str, float] = {}
        self._dropped_at = -1.0
        self._calm_from = 0.0
        """When anything was last disturbed."""
        self.serving: str | None = None
        """The gateway that reached the robot last."""
        self.reachable_long = False
        self.world.after(TICK_S, self._tick)

    def watch(self, who: str, what: str, fields: tuple[Any, ...]) -> None:
        """Follow the trace."""
        if what == "puts" and who in self.checker.gateways:
            if fields[0].endswith("/status"):
                self._status_at[who] = self.world.now
            elif fields[0].endswith("/control"):
                self._on_control(who, read(fields[1]))
        elif what == "killed" and who in self.checker.gateways:
            self._tokens.pop(who, None)
            self._disturbed[who] = self._calm_from = self.world.now
        elif what in DISTURBS:
            self._disturbed[who] = self._calm_from = self.world.now
        elif what == "killed":  # one of the two processes of a restart
            self._tokens.pop(who, None)
        elif what == "took over":
            has_token = self._tokens.pop(f"{who}+", float("inf")) <= self.world.now
            self._tokens[who] = self.world.now if has_token else float("inf")
        elif what in ("announces", "withdraws") and fields[0].endswith("/r1/@alive/gateway"):
            self._tokens[who] = self.world.now if what == "announces" else float("inf")
        elif who == "robot":
            self._on_robot(what, fields)
        elif what == "granted":
            self._granted_to[who] = self.world.now
        elif what in ("lost", "released", "failed"):
            self._ended_for[who] = self.world.now

    def _on_robot(self, what: str, fields: tuple[Any, ...]) -> None:
        if what in ("connected", "starts datagrams"):
            self._connected_at = self.world.now
        if what == "connected":
            grant = self.checker.current.get(self.checker.by_host.get(fields[0][0], ""))
            if grant is not None:  # a robot that was lost is stopped when it comes back: state-tables.md
                grant.autonomous = False
        elif what in ("drops", "ignores"):
            self._dropped_at = self.world.now
            self.checker.counts[f"robot {what}"] += 1
        elif what == "moving":
            self.checker.counts[f"robot {'moves' if fields[0] else f'rests: {fields[1]}'}"] += 1
        elif what == "reads" and fields[0] == "motion":
            self._probe.setdefault("read", self.world.now)

    # control

    def _on_control(self, gateway: str, control: dict[str, Any]) -> None:
        self._control[gateway] = control
        last = self.checker.current.get(gateway)
        if last is not None and last.shown and control.get("lease") != last.lease:
            if not control.get("latches"):  # one that it learnt from others ends a lease, too
                self._ended_unexplained(last)
            self.checker.end(gateway, "as control says")
        grant = self.checker.grants.get(control.get("lease") or b"")
        if grant is None:
            return
        grant.shown = True
        if grant.over(self.world.now, TOLD_S) and self.undisturbed(gateway, grant.ended_at or 0.0):
            self.checker.violate("control", f"{gateway} shows {grant}, which has ended: {grant.why}")

    def _ended_unexplained(self, grant: Grant) -> None:
        """A lease whose holder drives does not end for no reason: one gateway, and nothing that ended it."""
        alone = sum(each.serves for each in self.simulation.gateways) == 1
        locked = self.checker.gateways[grant.gateway].session.link.locked  # it leaves the bus, and joins it anew
        driven = grant.last_motion is not None and self.world.now - grant.last_motion.put_at < 0.5
        if grant.ended_at is None and alone and driven and not locked and self.undisturbed(grant.gateway, grant.at):
            self.checker.violate("lost-lease", f"{grant} ended for no reason while it was used")

    def undisturbed(self, who: str, since: float) -> bool:
        """Whether a process ran all the time since then."""
        member = self.simulation.members.get(who)
        return member is not None and member.running and self._disturbed.get(who, -1.0) < since - 0.1

    def calm_since(self, since: float) -> bool:
        """Whether no path, link or process was disturbed since then, and none is."""
        paths, fabric = self.simulation.paths, self.simulation.fabric
        noisy = paths.cuts or paths.slow or fabric.news_lost or fabric.news_late_s or fabric.duplicates
        return self._calm_from < since and not noisy and not self.simulation.faults.paused

    def disturb(self) -> None:
        """Judge what needs calm anew: a violation was noted."""
        self._calm_from = self.world.now

    def serves(self, gateway: str) -> bool:
        return self.world.now - self._status_at.get(gateway, -9.0) < STATUS_S

    def granted(self, grant: Grant) -> None:
        """``control`` shows a lease that was granted."""

        def look() -> None:
            if not grant.shown and self.undisturbed(grant.gateway, grant.at):
                self.checker.violate("control", f"{grant.gateway} does not show {grant}")

        self.world.after(TOLD_S, look)

    def lease_ended(self, grant: Grant) -> None:
        """``control`` shows that a lease ended, and its holder learns of it."""

        def look() -> None:
            shown = self._control.get(grant.gateway, {}).get("lease")
            running = self.undisturbed(grant.gateway, grant.ended_at or 0.0) and self.serves(grant.gateway)
            if shown == grant.lease and running and grant.why != LEFT:  # who leaves publishes nothing more
                self.checker.violate("control", f"{grant.gateway} still shows {grant}: {grant.why}")

        self.world.after(TOLD_S, look)
        asker = grant.asker
        member = self.simulation.members.get(asker)
        if member is None or not getattr(member, "watches", False) or grant.why == "released":
            return
        begun = self.world.now

        def learnt() -> None:
            gateway = self.checker.gateways[grant.gateway]
            if not (self.undisturbed(asker, begun) and self.undisturbed(grant.gateway, begun)):
                return
            if not self.simulation.fabric.works(member.session, gateway.session):
                return
            if self._granted_to.get(asker, -1.0) < grant.at:
                return  # its grant was lost on the way
            if self._ended_for.get(asker, -1.0) < grant.at and not any(
                other.asker == asker and other.at >= grant.at and other is not grant
                for other in self.checker.grants.values()
            ):
                self.checker.violate("silent-loss", f"{asker} was not told that {grant} ended: {grant.why}")

        self.world.after(grant.lease_s + 2.5, learnt)

    def latched(self, gateway: str) -> None:
        """``control`` shows a latched stop."""
        at = self.world.now

        def look() -> None:
            shown = self._control.get(gateway, {}).get("state")
            in_force = self.checker.latches[gateway] and min(self.checker.latches[gateway].values()) <= at
            if in_force and shown != "latched" and self.undisturbed(gateway, at) and self.serves(gateway):
                self.checker.violate("latched", f"{gateway} shows {shown} while latched")

        self.world.after(TOLD_S, look)

    # The robot

    def _tick(self) -> None:
        self.checker.expire()
        self.checker.meet()
        for rules in self.checker.rules:
            rules.tick()
        self._look_at_robot()
        self._look_for_heartbeats()
        self.world.after(TICK_S, self._tick)

    def _look_for_heartbeats(self) -> None:
        """A gateway that serves its robot publishes ``status`` once a second."""
        now = self.world.now
        for gateway, since in self._tokens.items():
            said = max(self._status_at.get(gateway, 0.0), since)
            if now - said > HEARTBEAT_S and self.undisturbed(gateway, now - HEARTBEAT_S - 1.0):
                self.checker.violate("heartbeat", f"{gateway} published no status for {now - said:.1f} s")
                self._status_at[gateway] = now

    def works(self) -> str | None:
        """Return the gateway that serves the robot and reaches it now, by a connection that is established."""
        simulation, robot = self.simulation, self.simulation.robot
        if robot.paused or robot.crashed or not robot.alive:
            return None
        settles_s = 2.8 if getattr(robot, "udp", False) else 0.3
        for end in robot.ends:
            host = end.peer.address[0]
            gateway = simulation.checker.by_host.get(host)
            up = simulation.paths.up("robot", host) and simulation.paths.up(host, "robot")
            slow = frozenset(("robot", host)) in simulation.paths.slow
            if gateway is None or not up or slow or end.peer.broken or end.peer.closed:
                continue
            member = simulation.members[gateway]
            if member.running and self.serves(gateway) and self.world.now - self._connected_at > settles_s:
                return gateway
        return None

    def _deserved(self) -> bool:
        """Whether somebody may be driving: a motion command of a standing lease, within its deadman."""
        now = self.world.now
        for grant in self.checker.current.values():
            if grant.ended_at is not None:
                continue
            if grant.autonomous:
                return True
            last = grant.last_motion
            if last is not None and now - last.received[grant.gateway] <= grant.deadman_s + grant.base_s + 0.1:
                return True
        return False

    def _look_at_robot(self) -> None:
        now, robot, gateway = self.world.now, self.simulation.robot, self.works()
        self.serving = gateway or self.serving
        self._works_since = (self._works_since or now) if gateway is not None else None
        self.reachable_long = gateway is not None and self._works_since is not None and now - self._works_since > 3.0
        if not robot.moving or self._deserved():
            self._moving_since, self._said = None, False
            return
        self._moving_since = self._moving_since or now
        if self._works_since is None or self._said:
            return
        since = max(self._moving_since, self._works_since, self.excused_until())
        if now - since > REST_S + 2 * TICK_S + 0.15:
            self._said = True
            why = "by itself" if robot.by_itself else "by the last command"
            self.checker.violate("moves-on", f"nobody drives the robot for {now - since:.1f} s: it moves {why}")

    def excused_until(self) -> float:
        """Datagrams that are lost, and robots that lose the stops of the first second, where no more are sent."""
        if self.simulation.robot.by_itself and self.serving not in self.checker.know_mode:
            self.checker.counts["excused: the gateway never met one that knew of the mode"] += 1
            return float("inf")  # docs/explanation/failures.md: it was cut off since before the mode was chosen
        if self.simulation.scenario.get("control", {}).get("idle_stop_s") == 0:
            return float("inf") if self._dropped_at >= 0 else 0.0
        return 0.0

    # The last test

    def probe(self) -> None:
        """Release what is latched, and drive."""
        driver = self.simulation.drivers[0]
        for latches in self.checker.latches.values():
            self.checker.uncertain |= latches.keys()  # they are released one after the other
            latches.clear()
        driver.do({"do": "unlatch"})
        driver.do({"do": "unlatch", "fleet": True})
        self._probe.clear()
        self.world.after(2.5, lambda: self._probe.pop("read", None))
        self.world.after(2.6, lambda: driver.do({"do": "drive", "for": 1.5, "hz": 4.0, "takeover": True}))

    def probed(self) -> None:
        """The robot was driven, and rests."""
        robot = self.simulation.robot
        if robot.crashed or robot.single or robot.used_up:
            return
        if "read" not in self._probe:
            self.checker.violate("drivable", "nobody can drive the robot long after all faults are over")
        elif robot.moving and not self.excused_until():
            self.checker.violate("moves-on", "the robot moves after the last test")
        self.checker.counts["probed"] += 1
