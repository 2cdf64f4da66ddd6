"""The independent checker: rules about who drives, from the robot's account, the bus and the programs' logs alone.

It reads the notes of the trace. What a gateway writes to the robot is compared with the commands that reached that
gateway and with the leases that it granted; :mod:`tests.simulated.obligations` adds what must happen in time.
Each violation begins with its time and the name of its rule.
"""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from typing import TYPE_CHECKING, Any

from tests.simulated.accounts import SLACK_S, TOLERANCE, Command, Grant, fault_of, motions, read
from tests.simulated.fleet import FleetRules
from tests.simulated.obligations import LEFT, Obligations
from tests.simulated.released import Released
from tests.simulated.served import ServedRules
from tests.simulated.shown import Shown
from tests.simulated.stops import StopRules
from tests.simulated.written import Written

if TYPE_CHECKING:
    from tests.simulated.hq_programs import HqProgram
    from tests.simulated.scenario import Simulation

NEW = "+"
"""Behind the name of a gateway's successor, until *go*."""
PARTS = "+-"
"""What the names of a successor, and of a process that has handed over, end with."""
WRITTEN_S = 0.02
"""Seconds that writing a latched stop takes."""
KNOWN_S = 1.5
"""Longest time until a gateway that has met the other one knows its latched stops: it asks every 0.5 s."""
MEET_S = 3.0
"""Two gateways that see each other for so long: exactly one grants."""
LOOK_S = 0.6
"""A gateway that waits asks the other one so often what it must write down."""
MOST = 20
"""Violations that are kept."""
HQ_DEADMAN_S = {"tcpudp": 1.3, "alf": 0.3, "wc2ec": 0.5}


class Checker:
    """Judges one simulation."""

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.world = simulation.world
        self.protocol = simulation.robot_protocol
        self.violations: list[str] = []
        self.counts: Counter[str] = Counter()
        self.grants: dict[bytes, Grant] = {}
        self.current: dict[str, Grant] = {}
        """By gateway, the lease that it granted last."""
        self.latches: dict[str, dict[bytes, float]] = {each.name: {} for each in simulation.gateways}
        self._released_at: dict[bytes, float] = {}
        """By latched stop, when a gateway released it."""
        self.uncertain: set[bytes] = set()
        """Latched stops of which a gateway may know and another one not: it was killed, or has not taken over."""
        self._unlatched: defaultdict[bytes, set[str]] = defaultdict(set)
        """By latched stop, the gateways at which it was released."""
        self._before_go: defaultdict[str, set[bytes]] = defaultdict(set)
        """By gateway, the latched stops that a successor received."""
        self.gateways = {each.name: each for each in simulation.gateways}
        self.by_host = {each.host.name: each.name for each in simulation.gateways if each.serves}
        self._requests: dict[tuple[str, str, bytes], dict[str, Any]] = {}
        """By program, key and payload: several may come at once, after a cut."""
        self._commands: dict[tuple[str, bytes, bytes], Command] = {}
        self._recent: dict[str, deque[Command]] = {name: deque(maxlen=600) for name in self.gateways}
        self._gives: dict[str, deque[tuple[float, float]]] = {
            each.name: deque(maxlen=200) for each in simulation.programs
        }
        self._given_at: dict[tuple[str, float], float] = {}
        """By driver and value, when it was given last."""
        self._taken_at: dict[str, float] = {}
        """By the name of a holder, when a stop or a takeover ended its lease."""
        self._wrote_motion: dict[str, float] = {}
        self._paused_at: dict[str, float] = {}
        self._met: dict[frozenset[str], float] = {}
        self._handlers = {
            "asks": self._on_asks,
            "answers": self._on_answers,
            "puts": self._on_puts,
            "receives": self._on_receives,
            "writes": self._on_writes,
            "sends": self._on_sends,
            "alive": self._on_alive,
            "withdraws": self._on_withdraws,
            "took over": self._on_took_over,
            "connected": self._on_connected,
            "started": self._on_started,
            "killed": self._on_ended,
            "ended": self._on_ended,
            "was suspended": self._on_suspended,
            "paused": self._on_paused,
            "resumed": self._on_resumed,
            "gives": self._on_gives,
            "crashed": lambda who, why: self.violate("fragile", f"{who} crashed: {why}"),
        }
        self.obligations = Obligations(self)
        self.written, self.released, self.stops = Written(self), Released(self), StopRules(self)
        self.rules = (self.written, self.released, self.stops, FleetRules(self), Shown(self), ServedRules(self))
        self.know_mode: set[str] = set()
        """The gateways that know that the robot was told to move by itself."""
        self._mode_at = 0.0
        """When another one began to know it."""
        self.world.watchers.append(self._watch)

    def violate(self, rule: str, text: str) -> None:
        """Note that a rule was broken."""
        self.counts[f"violation {rule}"] += 1
        if len(self.violations) < MOST:
            self.violations.append(f"{self.world.now:.3f} {rule}: {text}")
        self.world.note("checker", "violation", rule, text)

    def _watch(self, who: str, what: str, fields: tuple[Any, ...]) -> None:
        handler = self._handlers.get(what)
        if handler is not None:
            handler(who, *fields)
        self.obligations.watch(who, what, fields)
        for rules in self.rules:
            rules.watch(who, what, fields)

    # Leases

    def _on_asks(self, who: str, key: str, payload: bytes) -> None:
        if "@rpc/control/" in key:
            self._requests[who, key, payload] = {**read(payload), "asked at": self.world.now}

    def _on_answers(self, gateway: str, key: str, payload: bytes, error: str, asker: str, asked: bytes) -> None:
        verb = key.partition("@rpc/control/")[2].partition("/")[0]
        if not verb or error != "None" or gateway not in self.gateways:
            return
        name = asker.rstrip(PARTS)  # it may have handed over, or died, since it asked
        answer, requests = read(payload), self._requests
        request = requests.get((asker, key, asked)) or requests.get((name, key, asked), {})
        self.counts[f"{verb} {'ok' if answer.get('ok', True) else answer.get('code')}"] += 1
        if verb.startswith("unlatch"):
            stop_id = request.get("id", b"")
            self._unlatched[stop_id].add(gateway)
            self._released_at.setdefault(stop_id, self.world.now)
            for known in self.latches.values():
                known.pop(stop_id, None)
            if len(self.latches) > 1:
                self.uncertain.add(stop_id)  # another gateway may still have to learn of it
        elif answer.get("ok") and verb in ("acquire", "takeover"):
            grant, last = Grant(gateway, asker, answer, request, self.world.now), self.current.get(gateway)
            stands = last is not None and last.ended_at is None and last.shown and not last.expires_by(self.world.now)
            again = last is not None and last.asks_again(asker, request)
            if verb == "acquire" and stands and not again and not request.get("priority"):
                self.violate("held", f"{grant} granted while {last} stands")
            self._grant(grant, request, again=again)
        elif verb == "release" and gateway in self.current:
            if request.get("lease") == self.current[gateway].lease:
                self._released(self.current[gateway], answer, asker)
        elif answer.get("ok") and verb == "renew" and gateway in self.current:
            self.current[gateway].renewed_at, self.current[gateway].used = self.world.now, True

    def _released(self, grant: Grant, answer: dict[str, Any], asker: str) -> None:
        """Only the holder ends its lease, and may do so."""
        if answer.get("ok") and asker.rstrip(PARTS) != grant.asker.rstrip(PARTS) and grant.ended_at is None:
            self.violate("forged", f"{asker} released {grant}")
        elif not answer.get("ok") and answer.get("code") == "malformed" and asker == grant.asker:
            self.violate("forged", f"{asker} may not release {grant}: {answer.get('reason')}")
        if answer.get("ok"):
            self.end(grant.gateway, "released")

    def _grant(self, grant: Grant, request: dict[str, Any], *, again: bool) -> None:
        now = self.world.now
        most_s = self.simulation.scenario.get("control", {}).get("deadman_s", 2.0)
        grant.deadman_s = min(request.get("deadman_s") or most_s, most_s)
        grant.base_s = now - request.get("asked at", now)
        self.end(grant.gateway, "granted again" if again else "superseded")
        self.released.granted(grant, self._taken_at.pop(grant.who, None), self._gives)
        self.grants[grant.lease] = self.current[grant.gateway] = grant
        if any(now - at > SLACK_S for at in self.latches[grant.gateway].values()):
            self.violate("latched", f"{grant} granted while latched")
        for other, last in self.current.items():
            if other != grant.gateway and last.ended_at is None and self._met_for(other, grant.gateway) > MEET_S:
                self.violate("one-gateway", f"{grant} granted while {last} stands")
        self.obligations.granted(grant)

    def end(self, gateway: str, why: str) -> None:
        """Note the end of a gateway's lease."""
        grant = self.current.get(gateway)
        if grant is not None and grant.ended_at is None:
            grant.end(self.world.now, why)
            if why in ("stop", "superseded", "gateway restarted"):
                self._taken_at[grant.who] = self.world.now
            self.counts[f"lease ended: {why}"] += 1
            self.obligations.lease_ended(grant)

    def expire(self) -> None:
        """End leases that nobody renewed."""
        for gateway, grant in self.current.items():
            if self.world.now > grant.renewed_at + grant.lease_s + 0.1:
                self.end(gateway, "expired")

    def _on_alive(self, who: str, key: str, alive: bool) -> None:
        grant = self.current.get(who)
        if not alive and grant is not None and grant.alive and key.endswith(f"/@alive/{grant.alive}"):
            self.end(who, "holder lost")

    def _on_withdraws(self, who: str, key: str) -> None:
        if who in self.gateways and key.endswith("/@alive/gateway"):
            self.end(who, LEFT)

    def _on_took_over(self, who: str, why: str) -> None:
        """What a successor received before *go* holds from now on."""
        for stop_id in self._before_go.pop(who, ()):
            self.latches[who].setdefault(stop_id, self.world.now)

    def _on_connected(self, who: str, up: Any) -> None:
        if up is False and who in self.gateways:
            self.end(who, "bus lost")

    def _on_started(self, who: str) -> None:
        if who in self.gateways:
            self.end(who, "gateway started")

    def _on_ended(self, who: str) -> None:
        if who in self.gateways:
            written_s = WRITTEN_S + 2 * self.gateways[who].host.thread_s
            unwritten = [each for each, at in self.latches[who].items() if self.world.now - at < written_s]
            for stop_id in set(unwritten) - self.stops.told:  # nobody has confirmed it yet
                del self.latches[who][stop_id]
                self.uncertain.add(stop_id)
                self.counts["excused: killed before a latch was written"] += 1
            self.end(who, "gateway ended")

    def _on_paused(self, who: str) -> None:
        self._paused_at[who] = self.world.now
        grant = self.current.get(who)
        if grant is not None:
            grant.paused(self.world.now)

    def _on_resumed(self, who: str) -> None:
        """A restart that was asked for in a pause ends the lease after it."""
        grant, paused_at = self.current.get(who), self._paused_at.get(who, 0.0)
        if grant is not None and grant.why == "gateway restarted" and (grant.ended_at or 0.0) >= paused_at:
            grant.ended_at = self.world.now

    def _on_suspended(self, who: str, seconds: float) -> None:
        if seconds > 0.15:
            self.end(who, "suspended")

    def meet(self) -> None:
        """Note since when gateways reach each other; called regularly."""
        names = [name for name, each in self.gateways.items() if each.serves]
        for number, one in enumerate(names):
            for other in names[number + 1 :]:
                a, b = self.gateways[one], self.gateways[other]
                pair = frozenset((one, other))
                if a.running and b.running and self.simulation.fabric.works(a.session, b.session):
                    self._met.setdefault(pair, self.world.now)
                    self._share_latches(one, other)
                    asked = self._met_for(one, other) > MEET_S and self.world.now - self._mode_at > LOOK_S
                    if asked and self.know_mode & pair:
                        self.know_mode |= pair
                    if self._met_for(one, other) > MEET_S:
                        self._share_releases(pair)
                else:
                    self._met.pop(pair, None)

    def _share_latches(self, one: str, other: str) -> None:
        """Two gateways of one robot that met for long know of each other's latches."""
        now = self.world.now
        if self._met_for(one, other) < MEET_S:
            return
        for here, there in ((one, other), (other, one)):
            for stop_id, at in self.latches[here].items():
                if now - at > KNOWN_S:
                    self.latches[there].setdefault(stop_id, now)

    def _share_releases(self, pair: frozenset[str]) -> None:
        """A gateway that met the one that serves the robot, and has released a latched stop, knows that."""
        for stop_id, names in self._unlatched.items():
            if any(map(self.obligations.serves, names & pair)) and self.world.now - self._released_at[stop_id] > MEET_S:
                self.uncertain.discard(stop_id)

    def _met_for(self, one: str, other: str) -> float:
        return self.world.now - self._met.get(frozenset((one, other)), self.world.now)

    # Commands

    def _on_puts(self, who: str, key: str, payload: bytes, attachment: bytes | None) -> None:
        kind = key.partition("@cmd/")[2].partition("/")[0]
        if kind in ("drive", "motor", "mode") and attachment:
            command = Command(key, payload, read(attachment), who, self.world.now)
            if command.value and command.dated:
                command.given_at = self._given_at.get((who, command.value), command.given_at)
            self._commands.setdefault((key, payload, attachment), command)
            if who in self.gateways and kind != "mode":
                if command.value:
                    self._of_program(who, command)
                else:
                    self.released.rested[who] = self.world.now
        elif kind == "stop":
            self.counts["stops"] += 1

    def _of_program(self, listener: str, command: Command) -> None:
        """A listener's motion was said by an HQ program a moment ago."""
        programs = self.simulation.programs
        said = {each.name: at for each in programs if (at := self._said(each, command.value)) is not None}
        if not said and self.released.waited(command.value, self._gives):
            self.counts["excused: pushed during a cut, from the centre"] += 1
        elif not said:
            self.violate("hq-motion", f"{listener} put {command}, which no HQ program said lately")
        elif len(said) == 1:
            ((program, at),) = said.items()
            self.released.put(program, list(self._gives[program]))
            if any(each.name == program and each.protocol == "tcpudp" for each in programs):  # one value a command
                self.released.put_late(listener, program, at, list(self._gives[program]))

    def _said(self, program: HqProgram, motion: float) -> float | None:
        """Return when a program said this motion, within its deadman; None if it did not."""
        now, most_s = self.world.now, HQ_DEADMAN_S[program.protocol] + 0.35
        if program.options.get("once") and self.released.holds(program, motion, most_s):
            return now
        later: float | None = None  # of two wheels one may have the next value
        for at, value in reversed(self._gives[program.name]):
            if now - at > most_s:
                break
            other = later if later is not None and program.protocol == "wc2ec" else value
            later = value
            if min(value, other) - 0.0052 < motion < max(value, other) + 0.0052:
                return at
        return None

    def wrote_motion_at(self, gateway: str) -> float:
        """Return when a gateway wrote motion last."""
        return self._wrote_motion.get(gateway, -1.0)

    def said_last(self, program: str) -> float:
        """Return what a program said last, 0 for neutral."""
        said = self._gives.get(program)
        return said[-1][1] if said else 0.0

    def _on_gives(self, who: str, value: float) -> None:
        if who in self._gives:
            self._gives[who].append((self.world.now, value))
        else:
            self._given_at[who, value] = self.world.now

    def _on_receives(self, gateway: str, key: str, payload: bytes, attachment: bytes | None) -> None:
        now = self.world.now
        if key.endswith("@cmd/stop"):
            fields = read(payload)
            if gateway.endswith(NEW) and fields.get("latch") is True and fields.get("id"):
                self._before_go[gateway.removesuffix(NEW)].add(fields["id"])
                self.uncertain.add(fields["id"])
        if gateway not in self.gateways:
            return
        if key.endswith("@cmd/stop"):
            self.end(gateway, "stop")
            released_at = self._unlatched.get(fields.get("id", b""), set())
            if fields.get("latch") is True and fields.get("id") and gateway not in released_at:
                self.latches[gateway].setdefault(fields["id"], now)
                self.obligations.latched(gateway)
                self.uncertain |= {fields["id"]} if released_at else set()
            return
        command = self._commands.get((key, payload, attachment or b""))
        if command is None or gateway in command.received:
            return
        command.received[gateway] = now
        self._recent[gateway].append(command)
        grant = self.current.get(gateway)
        theirs = grant is not None and command.lease == grant.lease and command.who == grant.asker
        if grant is not None and theirs and grant.ended_at is None:
            grant.received(command, now)

    # What is written to the robot

    def _on_writes(self, who: str, peer: tuple[str, int], data: str) -> None:
        if peer[0] == "robot" and who in self.gateways:
            self._written(who, bytes.fromhex(data))

    def _on_sends(self, who: str, source: tuple[str, int], target: tuple[str, int], data: str) -> None:
        if target[0] == "robot" and source[0] in self.by_host:
            self._written(self.by_host[source[0]], bytes.fromhex(data))

    def _written(self, gateway: str, data: bytes) -> None:
        self.written.written(gateway, data)
        self.stops.written(gateway, data)
        for kind, value in motions(self.protocol, data):
            if kind == "mode" and value != 3.0:
                continue
            self.counts[f"{kind} written"] += 1
            if kind == "mode" and gateway not in self.know_mode:
                self.know_mode.add(gateway)
                self._mode_at = self.world.now
            reason = self._judge(gateway, kind, 1.0 if kind == "mode" else value)
            if reason is not None:
                self.violate(*reason)
            now = self.world.now
            for other, at in self._wrote_motion.items():
                if other != gateway and now - at < 1.0 and self._met_for(other, gateway) > MEET_S:
                    self.violate("one-gateway", f"{gateway} and {other} both move the robot")
            self._wrote_motion[gateway] = now

    def _judge(self, gateway: str, kind: str, value: float) -> tuple[str, str] | None:
        """Return the rule that this frame breaks; None where a command allows it."""
        now, tolerance = self.world.now, TOLERANCE[self.protocol]
        if any(now - at > SLACK_S for at in self.latches[gateway].values()):
            return "latched", f"{gateway} wrote {kind} {value:.5f} while latched"
        worst: tuple[str, str] | None = None
        for command in reversed(self._recent[gateway]):
            if now - command.received[gateway] > 15.0:
                break
            if (command.kind == "mode") is not (kind == "mode") or abs(command.value - value) > tolerance:
                continue
            reason = fault_of(command, self.grants.get(command.lease or b""), gateway, now)
            if reason is None:
                return None
            worst = worst or (reason[0], f"{gateway} wrote {command}: {reason[1]}")
        return worst or ("unknown-motion", f"{gateway} wrote {kind} {value:.5f}, which nobody commanded")

    # The end

    def probe(self) -> None:
        """Begin the last test: the robot can be driven again."""
        self.obligations.probe()

    def probed(self) -> None:
        """End it."""
        self.obligations.probed()

    def ended(self) -> None:
        """Look for what is left after all processes were told to end."""
        for error in self.world.errors:
            self.violate("exception", error)
        for member in self.simulation.members.values():
            if member.task is None or not member.process.alive:
                continue
            assert member.process.loop is not None
            tasks, timers = member.process.loop.left
            if not member.task.done():
                self.violate("leak", f"{member.name} does not end")
            elif tasks or timers:
                self.violate("leak", f"{member.name} leaves {len(tasks)} tasks and {timers} timers: {tasks[:2]}")
            elif member.process.descriptors:
                self.violate("leak", f"{member.name} leaves descriptors: {member.process.descriptors}")
        if self.simulation.robot.moving and self.obligations.reachable_long and not self.obligations.excused_until():
            self.violate("moves-on", "the robot moves after its gateways ended")
