"""One HQ program at a listener: its session and conversation, its operator, and the accounts that may end it.

What one client sends or fails to take costs the others nothing.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Iterable
from typing import Any

from zbridge.errors import EncodeError, ProtocolError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Delivery, Topic
from zbridge.hq.context import ListenerContext
from zbridge.hq.freeze import FROZEN
from zbridge.hq.intent import Intent
from zbridge.hq.operator import Operator
from zbridge.hq.refusal_reports import RefusalReports
from zbridge.hq.robot_queries import RobotQueries
from zbridge.log import Log
from zbridge.protocol.kept import Exported
from zbridge.protocol.plugin import Send, Telemetry
from zbridge.protocol.session import Session, State
from zbridge.transport import ClientConversation, Conversation, ConversationHooks, Parcel

log = Log("zbridge.hq")

STALL_S = 5.0
"""Seconds without taking what is written after which a client is closed; seconds of taking it count against them."""
MALFORMED = 20
"""Malformed messages between two sweeps, with no other among them, after which a client is closed."""
SWEEP_S = 0.5
"""Seconds between two calls of :meth:`Client.sweep`."""
TELL_S = 5.0
"""Seconds within which a client is not told the same text again."""
_NOT_TAKEN = "cannot decode a client's message"


class Client:
    """One HQ program. ``spoke`` is called after its messages were carried out.

    Made with a session that has not begun; the listener attaches ``conversation`` to the link.
    """

    def __init__(
        self,
        context: ListenerContext,
        number: int,
        host: str,
        session: Session[Any],
        *,
        queries: RobotQueries,
        refusals: RefusalReports,
        spoke: Callable[[Client], None],
    ) -> None:
        self.number = number
        self.host = host
        self.session = session
        self.begun = False
        """Whether its handshake is done; it is shown nothing before."""
        self._context = context
        self._queries = queries
        self._refusals = refusals
        self._spoke = spoke
        self._loop = asyncio.get_running_loop()
        self._told: dict[str, float] = {}
        self._due_at = math.inf
        """When the side translates what it keeps of this client until more comes."""
        self._timer: asyncio.TimerHandle | None = None
        self._bytes_in = 0
        self._silent_s = 0.0
        self._stalled_s = 0.0
        self._frames = (0, 0)
        """Messages that were malformed, and all, at the last sweep."""
        self.operator = self._make_operator()
        self.conversation = self._make_conversation()

    def __repr__(self) -> str:
        return f"<Client {self.number} {self.session!r}>"

    # The robot and the listener to the program

    def send(self, send: Send) -> None:
        """Put something into the client's outbox; what finds no place is dropped and counted."""
        try:
            send(self.session, self._context.clock())
        except Refused:
            self.session.traffic.dropped += 1
            self._context.counts.dropped.value += 1
        except Exception as error:
            self._context.failures.note("cannot send to a client", error)
        self.conversation.pump()

    def tell(self, text: str, *, again: bool = False, drives: bool = True) -> None:
        """Tell the people at the client a text, the same one at most once in TELL_S unless ``again`` is set.

        drives: False if the text says why the client does not drive; its program is shown that each time.
        """
        now = self._context.clock()
        if again:
            self._told.pop(text, None)
        if self.begun and now - self._told.get(text, -TELL_S) >= TELL_S:
            self._told = {old: at for old, at in self._told.items() if now - at < TELL_S} | {text: now}
            self.send(lambda session, now: self._context.side.tell(session, text, now))
        if self.begun and not drives:
            self.send(self._context.side.not_driving)

    def tick(self) -> None:
        """Let the side and the operator repeat and renew; called every ``ATTEND_S`` while the operator is active."""
        if self.operator.intent.held:
            self._context.side.attend(self)
        self.operator.tick()

    @property
    def silent_s(self) -> float:
        """Seconds for which the program's machine has owed an acknowledgement."""
        return self.conversation.link.silent_s if self.conversation.link is not None else 0.0

    def repeat(self) -> None:
        """Send the robot again what the program has in motion."""
        self.operator.repeat()

    def let_go(self, why: str) -> None:
        """Give the robot back; the program must send neutral before it drives again."""
        if self.operator.intent.held:
            self.send(self._context.side.not_driving)
        self.operator.let_go(why)

    # A restart

    @property
    def blocker(self) -> str | None:
        """Why the program's connection cannot be handed to another process now; None if it can."""
        return self.conversation.blocker

    def export(self, parcel: Parcel) -> Exported:
        """Put the connection of a suspended conversation into a parcel; describe the client."""
        return {
            "number": self.number,
            "host": self.host,
            "begun": self.begun,
            "operator": self.operator.export(),
            **self.conversation.export(parcel),
        }

    def restore(self, state: Exported, why: str) -> None:
        """Be the client that another process served: its session is restored. It owes neutral."""
        self.begun = bool(state["begun"])
        self.operator.restore(state["operator"], why)
        self.conversation.reading.suspended = True

    def resume(self) -> None:
        """Read and write; carry out what the side keeps of this client in its time."""
        self.conversation.resume()
        self._set_timer(self._context.side.deadline(self.session))

    def detach(self) -> None:
        """Forget the client, which another process serves now: its program notices nothing."""
        self.conversation.detach()
        self.close()

    def sweep(self) -> None:
        """End a client that is stalled, is silent for too long, or sends only malformed messages."""
        traffic, idle_s, link = self.session.traffic, self._context.settings.idle_s, self.conversation.link
        self._stalled_s = max(0.0, self._stalled_s + (SWEEP_S if self.conversation.stalled else -SWEEP_S))
        self._silent_s = self._silent_s + SWEEP_S if traffic.bytes_in == self._bytes_in else 0.0
        self._bytes_in = traffic.bytes_in
        before, self._frames = self._frames, (traffic.malformed, traffic.frames_in)
        malformed, frames = (now - then for now, then in zip(self._frames, before, strict=True))
        if malformed >= MALFORMED and malformed >= frames:
            self.conversation.close("only malformed messages")
        elif self._stalled_s >= STALL_S:
            self.conversation.cut(f"read nothing for {STALL_S:g} s")
        elif idle_s is not None and self._silent_s >= idle_s and (link is None or not link.speaks_first):
            self.conversation.close(f"silent for {idle_s:g} s")

    def close(self) -> None:
        """Give the robot back and carry out nothing any more; idempotent."""
        self.operator.close()
        self._set_timer(math.inf)

    # The program to the robot

    def _on_messages(self, messages: list[Any]) -> None:
        """Translate and carry out what the program sent."""
        context, operator = self._context, self.operator
        operator.intent.heard(context.clock())
        stale = context.freeze.stale(context.clock())
        for message in messages:
            try:
                self._carry_out(context.side.take(self.session, message), stale=stale)
            except (ProtocolError, EncodeError) as error:
                self.session.malformed(str(error))
            except Exception as error:
                self.session.malformed(repr(error))
                context.failures.note(_NOT_TAKEN, error)
        if stale:
            operator.intent.refused(FROZEN)
        self._set_timer(context.side.deadline(self.session))
        self._spoke(self)

    def _on_due(self) -> None:
        """Carry out what the side has kept until now."""
        context, now = self._context, self._context.clock()
        self._due_at, self._timer = math.inf, None
        try:
            self._carry_out(context.side.expire(self.session, now), stale=context.freeze.stale(now))
        except Exception as error:
            context.failures.note(_NOT_TAKEN, error)
        self._set_timer(context.side.deadline(self.session))
        self._spoke(self)

    def _set_timer(self, due_at: float) -> None:
        if due_at == self._due_at:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._due_at = due_at
        self._timer = self._loop.call_at(due_at, self._on_due) if due_at < math.inf else None

    def _carry_out(self, commands: Iterable[Telemetry], *, stale: bool = False) -> None:
        """Carry out commands and queries; report each that is refused."""
        for topic, command in commands:
            if stale:  # a neutral that was queued as well does not count either
                self.operator.intent.refused(FROZEN)
            self._context.counts.commands.value += 1
            try:
                if topic.delivery is Delivery.QUERY:
                    self._queries.ask(topic, self, self._answer)
                else:
                    self.operator.command(topic, command)
            except Refused as refusal:
                self._refuse(topic, refusal)

    def _answer(self, topic: Topic, message: FleetMessage | None) -> None:
        if not self.session.over:
            self.send(lambda session, now: self._context.side.answer(session, topic, message, now))

    def _refuse(self, topic: Topic, refusal: Refused) -> None:
        """Count a refused command, tell the people at the client, and show it on ``control``."""
        context = self._context
        self.session.traffic.refused += 1
        context.counts.refused.value += 1
        self.tell(str(refusal), drives=topic is not topics.CMD_DRIVE)
        if context.robot.view.alive:
            self._refusals.note(self.operator.who, topic.path.partition("/")[2], refusal)

    # The session

    def _on_session(self) -> None:
        """Begin with a client whose handshake is done; give the robot back for a client whose session is over."""
        context = self._context
        if self.session.state is State.ESTABLISHED and not self.begun:
            self.begun = True
            agreed = f", version {self.session.version}" if self.session.version else ""
            log.log(
                self.level("established"),
                "hq_established",
                "{listener}: client {client} established{agreed}",
                listener=context.name,
                client=self.number,
                agreed=agreed,
                peer=self.session.peer,
            )
            self.send(context.side.begin)
            missing = context.robot.view.missing
            if missing is not None:
                self.tell(missing)
        elif self.session.over:
            self.operator.close()

    def level(self, kind: str) -> int:
        """Return the level of an event of this client: INFO for the first of its kind and address in a second."""
        first = self._context.connections.first(self.host, kind, self._context.clock())
        return logging.INFO if first else logging.DEBUG

    def _make_operator(self) -> Operator:
        side = self._context.side
        operator = Operator(
            Intent(side.deadman_s),
            self._context.bridge,
            who=f"hq.{self._context.name}.{self.number}",
            protocol=side.name,
            is_motion=side.is_motion,
            tell=lambda text, drives: self.tell(text, drives=drives),
            clock=self._context.clock,
            clock_ms=self._context.clock_ms,
        )
        for topic, command in side.initial_commands():
            operator.command(topic, command)
        return operator

    def _make_conversation(self) -> Conversation:
        context = self._context
        hooks = ConversationHooks(
            deliver=self._on_messages,
            changed=self._on_session,
            malformed=context.counts.malformed_frames,
            foreign=context.counts.foreign_datagrams,
            rivals=context.counts.rival_sources,
            refused=lambda refusal: self._refuse(topics.CMD_DRIVE, refusal),
            may_warn=lambda kind: context.connections.first(self.host, kind, context.clock()),
            clock=context.clock,
        )
        return ClientConversation(self.session, self._loop, hooks)
