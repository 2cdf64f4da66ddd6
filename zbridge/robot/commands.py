"""Commands from the bus to one robot: finds their topic, asks for leave, and tells the robot.

A command that is refused is counted and shown on ``control``; none is dropped silently.
"""

from __future__ import annotations

from functools import partial

import msgspec

from zbridge.bus import Sample
from zbridge.control.admission import OF_THE_HOLDER, is_stop
from zbridge.control.context import RobotContext
from zbridge.control.enforcer import Enforcer
from zbridge.control.events import CommandSender, StopCause
from zbridge.errors import Code, EncodeError, Malformed, NotReady, PayloadError, Refused, Unsupported, ZbridgeError
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Motor, Raw
from zbridge.fleet.topics import Delivery, Topic
from zbridge.lease.proof import Verifier
from zbridge.metrics import Count
from zbridge.protocol.plugin import Outcome
from zbridge.protocol.session import Session, State

LINK_BLOCKED = "the robot's link is stalled"
_MOTIONS = (Drive, Motor)
_ESTABLISHED = State.ESTABLISHED
WRITE_S = 0.4
"""Longest time that mode autonomous waits until it is written down, seconds."""


class _Awaiting(msgspec.Struct, frozen=True):
    """Mode autonomous on its way to the disk. verifier: of the lease then. since: seconds."""

    topic: Topic
    command: FleetMessage
    sender: CommandSender
    verifier: Verifier | None
    since: float


class Commands:
    """Carries out the commands for one robot, or refuses them. :meth:`take` is the handler of ``@cmd/**``."""

    def __init__(self, context: RobotContext, enforcer: Enforcer) -> None:
        self._context = context
        self._enforcer = enforcer
        self._robot = context.robot
        self._keys = context.keys
        self._clock = context.clock
        self._pump = context.pump
        self._box = context.box
        self._closing: str | None = None
        self._awaiting: _Awaiting | None = None
        """A mode that is carried out once it is written down."""
        self.blocked = False
        """Whether the robot's link is stalled: drives are not written, all other commands are refused."""
        self._topics = {context.keys.key(topics.CMD_DRIVE.path): topics.CMD_DRIVE}
        self._counts: dict[str, tuple[Count, Count]] = {}
        """Messages and bytes received, by kind."""
        self._unwritten = context.metrics.count("drives_unwritten")

    def __repr__(self) -> str:
        return f"<Commands {self._keys.robot}>"

    def take(self, sample: Sample) -> None:
        """Carry out one command, or refuse it and show the refusal on ``control``."""
        self._enforcer.keep_time()
        if self._box is not None:
            self._box.put(sample.key, sample.payload, sample.attachment)
        sender = topic = None
        try:
            topic = self._topics.get(sample.key)
            if topic is None:
                if is_stop(sample.key):  # of anybody, with any payload
                    self._count("stop", sample)
                    self._enforcer.stop_commanded(sample)
                    return
                topic = self._find(sample.key)
            self._count(topic.path.split("/", 2)[1], sample)
            now = self._clock()
            if topic.message in OF_THE_HOLDER:
                sender = self._enforcer.admit(sample, now)
            self._carry_out(topic, sample.payload, now, sender)
        except (Refused, PayloadError, EncodeError) as error:
            if topic is None:
                self._count("unknown", sample)
            self._refuse(sample.key.rpartition("@cmd/")[2], error, sender)
        self._enforcer.settle()

    def require_ready(self) -> Session[object]:
        """Return the session that takes commands; raise Refused if the robot takes none now."""
        session = self._robot.driving
        if session is None or (session.state is not _ESTABLISHED and session.over):
            raise NotReady("offline")
        if session.state is not _ESTABLISHED or session.busy is not None:
            raise NotReady(session.busy or session.state.value)
        return session

    def require_flowing(self) -> None:
        """Raise Refused if the robot's link is stalled: what waits for it would come after the stop."""
        if self.blocked:
            raise NotReady(LINK_BLOCKED)

    def refuse_all(self, reason: str | None) -> None:
        """Take nothing but stops from now on; None: take commands again."""
        self._closing, self._awaiting = reason, None

    def _count(self, kind: str, sample: Sample) -> None:
        counts = self._counts.get(kind)
        if counts is None:
            count = partial(self._context.metrics.count, direction="in", kind=kind)
            counts = self._counts[kind] = (count("bus_messages"), count("bus_bytes"))
        counts[0].value += 1
        counts[1].value += len(sample.payload)

    def _refuse(self, command: str, error: ZbridgeError, sender: CommandSender | None) -> None:
        refused = error if isinstance(error, Refused) else Malformed(str(error))
        self._enforcer.authority.refuse(command, refused, refused.who or (sender.who if sender is not None else None))

    def _find(self, key: str) -> Topic:
        if not topics.is_concrete(key):
            raise Malformed("its key has wildcards")
        topic = topics.find(self._keys.path(key))
        if topic is None or topic.delivery is not Delivery.COMMAND:
            raise Unsupported("no such command")
        return topic

    def _carry_out(self, topic: Topic, payload: bytes, now: float, sender: CommandSender | None) -> None:
        if self._closing is not None:
            raise NotReady(self._closing, Code.CLOSING)
        command = payloads.decode(topic.message, payload)
        if sender is not None and isinstance(command, _MOTIONS):
            self._move(topic, command, now, sender)
            return
        if sender is not None:
            self._awaiting = None
        self._require_allowed(command, sender)
        if sender is not None and _is_autonomous(command):
            writing = self._enforcer.write_autonomous()
            if writing is not None:
                waiting = self._awaiting = _Awaiting(topic, command, sender, self._enforcer.authority.verifier, now)
                writing.add_done_callback(lambda _: self._on_written(waiting))
                return
        self._command(topic, command, now, sender)

    def _on_written(self, waiting: _Awaiting) -> None:
        """Carry out a mode that is written down now, or could not be; unless a newer command or a stop came."""
        self._enforcer.keep_time()
        if waiting is not self._awaiting or waiting.verifier is not self._enforcer.authority.verifier:
            return
        self._awaiting, now = None, self._clock()
        try:
            if now - waiting.since > WRITE_S:
                raise NotReady(f"the disk took {now - waiting.since:.1f} s to write that the robot moves by itself")
            self._require_allowed(waiting.command, waiting.sender)
            self._command(waiting.topic, waiting.command, now, waiting.sender)
        except (Refused, PayloadError, EncodeError) as error:
            self._refuse(waiting.topic.path.removeprefix("@cmd/"), error, waiting.sender)
        self._enforcer.settle()

    def _require_allowed(self, command: FleetMessage, sender: CommandSender | None) -> None:
        """Raise Refused if a command that is no drive must not reach the robot now."""
        session = self.require_ready()
        self.require_flowing()
        if sender is not None and (isinstance(command, Raw) or _is_autonomous(command)):
            self._enforcer.require_fresh(sender)
            _require_sure(session)
            self._enforcer.authority.motion.check_motion()

    def _command(self, topic: Topic, command: FleetMessage, now: float, sender: CommandSender | None) -> None:
        self._show(topic, self._tell(topic, command, now), sender)
        self._enforcer.commanded(command)
        self._pump()

    def _move(self, topic: Topic, command: Drive | Motor, now: float, sender: CommandSender) -> None:
        """Tell the robot to move, or to stand: the robot is written to before anything is accounted for."""
        moving = command.moving
        if moving:
            self._enforcer.require_fresh(sender)
        else:
            self._awaiting = None
        try:
            session = self.require_ready()
            if moving and session.doubts:
                _require_sure(session)
        except Refused as refusal:
            if moving:
                self._enforcer.require_neutral(str(refusal), StopCause.NOT_READY, stops=False)
            raise
        if moving:
            permitted = self._enforcer.permit(command, now)
            if permitted is not command:
                command, moving = permitted, permitted.moving
        outcome = self._tell(topic, command, now)
        self._unwritten.value += self.blocked
        self._pump()
        self._enforcer.moved(topic.path, command, now, sender, moving=moving)
        if outcome.telemetry or outcome.left_out:
            self._show(topic, outcome, sender)

    def _tell(self, topic: Topic, command: FleetMessage, now: float) -> Outcome:
        """Tell the robot; refuse the command if the protocol's own code raises an exception."""
        try:
            outcome = self._robot.command(topic, command, now)
            if outcome is None:
                raise TypeError("RobotSide.command returned no Outcome")
        except (Refused, PayloadError, EncodeError):
            raise
        except Exception as error:
            raise self._context.faults.refusal(topic.path, error) from error
        return outcome

    def _show(self, topic: Topic, outcome: Outcome, sender: CommandSender | None) -> None:
        for shown, message in outcome.telemetry:
            self._context.publish(shown, message)
        if outcome.left_out:
            who = sender.who if sender is not None else None
            self._enforcer.authority.refuse(topic.path.removeprefix("@cmd/"), Unsupported(outcome.left_out), who)


def _is_autonomous(command: FleetMessage) -> bool:
    return isinstance(command, Mode) and command.mode == "autonomous"


def _require_sure(session: Session[object]) -> None:
    """Raise Refused if the robot is not to be set in motion: a later stop might not arrive."""
    doubt = session.doubtful
    if doubt is not None:
        raise NotReady(doubt)
