"""A small world around the real machines: one robot, its gateway, two programs, and a network that does what it likes.

Theory of operation. A world is copied, one move is made in the copy, and :meth:`World.key` names the state. Two states
of one name behave alike from then on: times count from now; the ids of leases, the numbers of commands, the counts of
refusals and the names of tokens only by their order, for the machines only compare them. What no machine can notice any
more is left out: ended leases of which nothing is on its way, refusals on which no program acts, the drift of a clock.

Real are the authority with its latches and proofs, the admission filters of commands and questions, and the lease
clients with :class:`LeaseHolder` around them. :class:`World` plays what asyncio and Zenoh do between them, as the
enforcer, the lease server and ``Commands`` do it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import msgspec

from zbridge.bus import Answer, PriorityClass
from zbridge.control.admission import CommandFilter, QueryFilter
from zbridge.control.authority import Authority
from zbridge.control.events import AuthorityEvent, CommandSender, EventKind, StopCause
from zbridge.control.latch import Latches, read_stop
from zbridge.errors import Code, NotReady, Refused, Stale
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import Acquire, Lease
from zbridge.fleet.messages import Control, Drive, Mode, Motor, Refusal, Stop
from zbridge.fleet.topics import KeySpace
from zbridge.lease.lease_client import LeaseClient, Question
from zbridge.lease.lease_events import LeaseEvent
from zbridge.lease.lease_holder import LeaseHolder
from zbridge.lease.proof import read

KEYS = KeySpace("fleet", "r1")
DRIVE, MODE = KEYS.key(topics.CMD_DRIVE.path), KEYS.key(topics.CMD_MODE.path)
MOTOR = KEYS.key("@cmd/motor/arm")
STOP, FLEET_STOP = KEYS.key(topics.CMD_STOP.path), "fleet/*/@cmd/stop"
RENEW, RELEASE = KEYS.key(topics.RPC_RENEW.path), KEYS.key(topics.RPC_RELEASE.path)
STEP_S, LEASE_S, DEADMAN_S, MAX_AGE_S, WAIT_S = 0.5, 1.0, 0.5, 0.4, 0.5
"""A step of time, and settings that are few steps long."""
PAYLOADS = {
    "motion": (DRIVE, payloads.encode(Drive(forward=1.0))),
    "neutral": (DRIVE, payloads.encode(Drive())),
    "motor": (MOTOR, payloads.encode(Motor(value=1.0))),
    "motor neutral": (MOTOR, payloads.encode(Motor(value=0.0))),
    "autonomous": (MODE, payloads.encode(Mode(mode="autonomous"))),
    "manual": (MODE, payloads.encode(Mode(mode="manual"))),
}
MOVES = ("motion", "motor", "autonomous")
"""Commands that set the robot in motion."""
LATCH_IDS = {"robot": b"L" * 16, "fleet": b"F" * 16}


class Program(NamedTuple):
    """One program of a world. waits: asks again for a while, as the Python client does; else as a listener.

    drives: whether it gives commands.
    """

    name: str
    takeover: bool = False
    priority: int = 0
    waits: bool = True
    drives: bool = True


class Command(NamedTuple):
    """A command on its way. given_ms: when it was given. lease, seq: as its proof says."""

    program: int
    what: str
    attachment: bytes
    given_ms: float
    lease: bytes
    seq: int


class Query(NamedTuple):
    """A question about the lease on its way. given_ms: when it was asked.

    lease, seq: of a question with a proof. alive: the token that a question for the lease names.
    """

    program: int
    question: Question
    given_ms: float
    lease: bytes | None
    seq: int
    alive: str


class Reply(NamedTuple):
    """An answer on its way. lease: that it grants."""

    program: int
    question: Question
    answer: Answer
    lease: bytes | None
    said: tuple[bool, str, int]
    """Whether it says yes, its code, and how long the lease lasts in hundredths of a second."""
    given_ms: float


class TokenGone(NamedTuple):
    """News for the gateway that a program's token is gone."""

    alive: str


Message = Command | Query | Reply | TokenGone


class Token:
    """A liveliness token. Its end is on its way to the gateway of the world that moves now."""

    def __init__(self, key: str) -> None:
        self.alive = key.removeprefix(KEYS.alive(""))

    def close(self) -> None:
        World.moves.net.append(TokenGone(self.alive))


class _Bus:
    def announce(self, key: str) -> Token:
        return Token(key)


class Holder(LeaseHolder):
    """A lease holder whose questions go onto the network of the world that moves now."""

    program: int

    def _ask(self, question: Question) -> Any:
        world = World.moves
        if len(world.net) < world.channel:  # else it is lost
            proven = question.key in (RENEW, RELEASE)
            shown = read(question.payload) if proven else None
            alive = "" if proven else self.client.request.alive or ""
            lease, seq = (shown.lease, shown.seq) if shown is not None else (None, 0)
            world.net.append(Query(self.program, question, world.now * 1000, lease, seq, alive))


class Robot:
    """What the robot was told last. parts: those that were told to move."""

    def __init__(self) -> None:
        self.parts: frozenset[str] = frozenset()
        self.autonomous = False
        self.moved_at = 0.0
        """When the motion was given that the robot carries out."""

    @property
    def moving(self) -> bool:
        return bool(self.parts)

    @property
    def in_motion(self) -> bool:
        return self.moving or self.autonomous

    def rest(self) -> None:
        """Take a stop."""
        self.parts, self.autonomous = frozenset(), False


class World:
    """One state. See the module."""

    moves: World
    """The world in which a move is made now."""

    def __init__(self, programs: tuple[Program, ...], channel: int, delay: int = 1, *, overtaken: bool = False) -> None:
        World.moves = self
        self.now = 1000.0
        self.delay_ms = delay * STEP_S * 1000
        """Longest time that a message is on its way."""
        self.channel = channel
        """Messages that may be on their way; a question that finds no room is lost."""
        self.programs = programs
        self.ready = True
        """Whether the gateway grants leases; else it says *ask later*."""
        self.overtaken = overtaken
        """Whether other input may come between the admission of a command and its record."""
        self.hand: list[tuple[Command, CommandSender]] = []
        """The command that was admitted and is not yet recorded."""
        self.net: list[Message] = []
        self.inbox: list[tuple[PriorityClass, Command]] = []
        self.news: list[Control | None] = [None for _ in programs]
        self.told: list[tuple[int, LeaseEvent]] = []
        """Events of the programs in the last move."""
        self.robot = Robot()
        self._ids = 0
        self.authority = Authority(LEASE_S, DEADMAN_S, _random, MAX_AGE_S, Latches())
        self.admission = CommandFilter(self.authority, KEYS, _clock)
        self.filters = {RENEW: QueryFilter(self.authority, _clock), RELEASE: QueryFilter(self.authority, _clock)}
        for each in (self.admission, *self.filters.values()):
            each.refusals._allowance = _Always()  # type: ignore[assignment]
        self.holders = [self._holder(number, program) for number, program in enumerate(programs)]
        self.decisions: list[tuple[str, Any]] = []
        """What the gateway decided in the last move: for the rules."""

    def _holder(self, number: int, program: Program) -> Holder:
        request = Acquire(
            who=program.name, priority=program.priority, alive=f"operator.{program.name}.1", deadman_s=DEADMAN_S
        )
        client = LeaseClient(
            KEYS, request, program.name, concerns=_Concerns(program.name), clock_ms=_clock_ms,
            takeover=program.takeover, wait_s=WAIT_S if program.waits else None,
        )  # fmt: skip
        holder = Holder(_Bus(), client, spawn=_spawn, on_event=_on_event, clock=_clock)  # type: ignore[arg-type]
        holder.program = number
        return holder

    # The programs

    def give(self, number: int, what: str) -> None:
        """Let a program give a command."""
        key, payload = PAYLOADS[what]
        client = self.holders[number].client
        attachment, signer = client.prove(key, payload), client._signer
        assert signer is not None
        self.net.append(Command(number, what, attachment, self.now * 1000, signer.lease, signer._commands))

    # The network

    def deliver(self, message: Message) -> None:
        """Take a message out of the network and deliver it."""
        self.net.remove(message)
        if isinstance(message, Reply):
            holder = self.holders[message.program]
            holder.client.answered(message.question, [message.answer], self.now)
            holder._settle()
        elif isinstance(message, TokenGone):
            self.authority.vanished(message.alive)
            self.settle()
        elif isinstance(message, Query):
            self._serve(message)
        else:
            self.arrive(message)
            self.attend()

    def arrive(self, command: Command) -> None:
        """Let a command pass its admission filter, on the bus's thread, into the inbox."""
        key, payload = PAYLOADS[command.what]
        priority = self.admission(key, command.attachment, len(payload) + len(command.attachment), lambda: payload)
        if priority is not None:
            self.inbox.append((priority, command))

    def attend(self) -> None:
        """Carry out what waits in the inbox, on the event loop."""
        waiting, self.inbox = sorted(self.inbox, key=lambda item: item[0] is not PriorityClass.COMMAND), []
        for _, command in waiting:
            self._take(command)

    def hear(self, number: int) -> None:
        """Deliver the news of ``control`` to a program."""
        control, self.news[number] = self.news[number], None
        if control is not None:
            self.holders[number].read_control(control)

    # The gateway, as the enforcer, the lease server and Commands

    def keep_time(self) -> None:
        due = self.authority.deadline()
        if due is not None and self.now >= due:
            self.authority.expire(self.now)
            self.settle()

    def _serve(self, query: Query) -> None:
        self.keep_time()
        question, now_ms = query.question, self.now * 1000
        admission = self.filters.get(question.key)
        try:
            if admission is None and not self.ready:
                self._put_off(query)
                return
            if admission is None:
                request = payloads.decode(Acquire, question.payload)
                take = self.authority.takeover if "/takeover/" in question.key else self.authority.acquire
                reply = take(request, self.now, now_ms)
                self.decisions.append(("acquire", (query, reply)))
            elif admission(question.key, question.payload, len(question.payload), lambda: b"") is None:
                return
            elif question.key == RENEW:
                reply = self.authority.renew(read(question.payload), question.key, self.now, now_ms)
                self.decisions.append(("renew", (query.program, read(question.payload), reply)))
            else:
                reply = self.authority.release(read(question.payload), question.key, self.now)
                self.decisions.append(("release", (query.program, read(question.payload), reply)))
        except Refused as refusal:
            reply = Lease(ok=False, code=refusal.code, reason=str(refusal))
        said = (reply.ok, str(reply.code or ""), round((reply.expires_in_s or 0) * 100))
        answer = Answer("", payloads.encode(reply))
        self.net.append(Reply(query.program, question, answer, reply.lease, said, self.now * 1000))
        self.settle()

    def _put_off(self, query: Query) -> None:
        """Answer as a gateway that does not know the fleet's latched stops yet."""
        answer, said = Answer("", b"", NotReady("not yet")), (False, "later", 0)
        self.net.append(Reply(query.program, query.question, answer, None, said, self.now * 1000))

    def _take(self, command: Command) -> None:
        self.keep_time()
        key, payload = PAYLOADS[command.what]
        sender = None
        try:
            sender = self.authority.admit(command.attachment, key, payload, self.now, self.now * 1000)
            self.decisions.append(("admitted", (command, sender)))
            if self.overtaken:
                self._require(command, sender)
                self.hand = [(command, sender)]
            else:
                self._carry_out(command, sender)
        except Refused as refusal:
            self.authority.refuse(command.what, refusal, refusal.who or (sender.who if sender else None))
        self.settle()

    def record(self) -> None:
        """Carry out the command that was admitted, whatever came meanwhile."""
        (command, sender), self.hand = self.hand[0], []
        self.decisions.append(("recorded", (command, sender)))
        self._tell(command, sender)
        self.settle()

    def _carry_out(self, command: Command, sender: CommandSender) -> None:
        self._require(command, sender)
        self.decisions.append(("told", (command, sender)))
        self._tell(command, sender)

    def _require(self, command: Command, sender: CommandSender) -> None:
        if command.what in MOVES:
            if sender.stale:
                raise Stale("given too long ago")
            self.authority.motion.check_motion()

    def _tell(self, command: Command, sender: CommandSender) -> None:
        what = command.what
        if what in ("motion", "neutral", "motor", "motor neutral"):
            part, moving = PAYLOADS[what][0], what in MOVES
            self.robot.parts = self.robot.parts | {part} if moving else self.robot.parts - {part}
            self.robot.autonomous = False if what == "neutral" else self.robot.autonomous
            self.robot.moved_at = sender.given_at if moving else self.robot.moved_at
            whole = part == DRIVE
            self.authority.applied(part, sender.given_at, moving=moving, stale=sender.stale, whole=whole)
        else:
            self.robot.autonomous = what == "autonomous"
            self.authority.motion.mode_chosen(autonomous=what == "autonomous")

    def stop(self, latch: str | None = None) -> None:
        """Let somebody stop the robot, or latch it."""
        stop = Stop(id=LATCH_IDS[latch], latch=True, who="eve", reason="cable") if latch else Stop()
        payload = payloads.encode(stop) if latch else b""
        if self.admission(STOP, None, len(payload), lambda: payload) is None:
            self.decisions.append(("folded", None))
            return
        self.decisions.append(("stop", latch))
        self.authority.take_stop(read_stop(payload), fleet=latch == "fleet")
        self.settle()
        self.admission.stopped()

    def unlatch(self, latch: str) -> None:
        try:
            self.authority.unlatch(LATCH_IDS[latch], "eve", fleet=latch == "fleet")
        except Refused:
            return
        self.decisions.append(("unlatched", latch))
        self.settle()

    def require_neutral(self, *, stops: bool) -> None:
        """Let the robot's link stall, or be lost: then the robot is stopped by itself."""
        if not stops:
            self.robot.rest()
        self.decisions.append(("neutral required", None))
        self.authority.require_neutral("link", StopCause.LINK_STALLED, stops=stops)
        self.settle()

    def settle(self) -> None:
        """Carry out the authority's events: stops to the robot, news to the programs."""
        changed = False
        for event in self.authority.events():
            self._carry_out_event(event)
            changed = changed or event.what is not EventKind.REFUSED or event.code == Code.LEASE_ENDED
        if changed:
            self.beat()

    def _carry_out_event(self, event: AuthorityEvent) -> None:
        if event.stops:
            self.robot.rest()
        if event.what is not EventKind.REFUSED:
            self.decisions.append(("event", event))

    def beat(self) -> None:
        """Publish ``control``; what a program has not heard yet is replaced."""
        self.news = [self.authority.report(self.now) for _ in self.programs]

    # Time

    def step(self, *, frozen: bool = False) -> None:
        """Let a step of time pass. frozen: the gateway does not turn meanwhile, and is late with what is due."""
        self.now += STEP_S
        oldest = self.now * 1000 - self.delay_ms
        self.net = [each for each in self.net if isinstance(each, TokenGone) or each.given_ms >= oldest]
        if not frozen:
            self.keep_time()
        for holder in self.holders:
            waiting = holder.client._waiting
            if waiting is not None and self.now >= waiting.asked_at + waiting.timeout_s:
                holder.client.answered(waiting, [], self.now)
                holder._settle()
            holder.expire()

    # Copies and names

    def copy(self) -> World:
        """Copy everything that a move may change."""
        new = _bare(self)
        new.net, new.inbox, new.news, new.told, new.decisions = self.net[:], self.inbox[:], self.news[:], [], []
        new.hand = self.hand[:]
        new.robot = _bare(self.robot)
        new.authority = _authority(self.authority, self)
        new.admission = _bare(self.admission)
        new.admission._authority = new.authority
        new.admission._prover = _bare(self.admission._prover)
        new.admission._prover._authority = new.authority
        new.filters = {}
        for key, admission in self.filters.items():
            new.filters[key] = other = _bare(admission)
            other._authority = new.authority
        new.holders = [_holder_copy(holder) for holder in self.holders]
        return new

    def forget(self) -> None:
        """Take out of the network what can end nothing any more."""
        self.net = [each for each in self.net if not isinstance(each, TokenGone) or self._matters(each.alive)]

    def _matters(self, alive: str) -> bool:
        """Tell whether anything can still be ended by the end of a token."""
        holder = self.authority.holders.current
        return (holder is not None and holder.alive == alive) or any(
            isinstance(each, Query) and alive == each.alive for each in self.net
        )

    def leases_in_use(self) -> set[bytes]:
        """Return the ids of leases that somebody may still use."""
        used = {holder.client._signer.lease for holder in self.holders if holder.client._signer is not None}
        used |= {each.lease for each in self.net if not isinstance(each, TokenGone) and each.lease is not None}
        used |= {command.lease for _, command in self.inbox} | {command.lease for command, _ in self.hand}
        return used

    def key(self) -> Any:
        """Name the state; see the module."""
        from tests.search.naming import name

        return name(self)


class _Always:
    """Lets everything through that a filter refuses: rates of filters are in no world, and would couple them."""

    def take(self, now: float) -> bool:
        return True


class _Concerns:
    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, refusal: Refusal) -> bool:
        return refusal.who == self.name


def _random(size: int) -> bytes:
    world = World.moves
    world._ids += 1
    return world._ids.to_bytes(4, "big") + bytes(size - 4)


def _clock() -> float:
    return World.moves.now


def _clock_ms() -> float:
    return World.moves.now * 1000


def _spawn(nothing: Any) -> None:
    pass


def _on_event(event: LeaseEvent) -> None:
    World.moves.told.append((-1, event))


def _bare(old: Any) -> Any:
    new = object.__new__(type(old))
    new.__dict__.update(old.__dict__)
    return new


def _authority(old: Authority, world: World) -> Authority:
    new: Authority = _bare(old)
    new.machine = machine = _bare(old.machine)
    new.motion = machine.motion = motion = _bare(old.motion)
    motion.parts, motion.moved, machine.events = set(motion.parts), set(motion.moved), []
    new.latches = machine._latches = latches = _bare(old.latches)
    latches._stops, latches._unsaved = latches._stops.copy(), set(latches._unsaved)
    latches._in_force = dict(latches._in_force)
    latches._released, latches._released_fleet = latches._released.copy(), latches._released_fleet.copy()
    new._refusals = _bare(old._refusals)
    new._refusals._counts = type(old._refusals._counts)(
        (key, count) for key, count in old._refusals._counts.items() if key[2] == Code.LEASE_ENDED and key[0]
    )
    new.holders = machine.holders = holders = _bare(old.holders)
    if holders.current is not None:
        holders.current = _lease_copy(holders.current)
    used = world.leases_in_use()
    holders._ended = type(old.holders._ended)(
        (lease, _lease_copy(holder)) for lease, holder in old.holders._ended.items() if lease in used
    )
    return new


def _lease_copy(old: Any) -> Any:
    new = _bare(old) if hasattr(old, "__dict__") else msgspec.structs.replace(old)
    new.numbers = dict(old.numbers)
    new.age = _bare(old.age)
    new.verifier = _bare(old.verifier)
    new.verifier._notes = dict(old.verifier._notes)
    return new


def _holder_copy(old: Holder) -> Holder:
    new: Holder = _bare(old)
    new.client = client = _bare(old.client)
    client._events = []
    client.news = _bare(old.client.news)
    if client._signer is not None:
        client._signer = _bare(client._signer)
    return new
