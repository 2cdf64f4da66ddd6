"""Commands from the bus to one robot: who may give them, what becomes of them."""

from __future__ import annotations

from collections.abc import Callable

from zbridge.bus import Sample
from zbridge.control.gate import OF_THE_HOLDER, is_stop
from zbridge.control.lease_server import LeaseServer
from zbridge.errors import Code, EncodeError, Malformed, NotReady, PayloadError, Refused, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Motor, Raw
from zbridge.fleet.topics import Delivery, KeySpace, Topic
from zbridge.metrics import Metrics
from zbridge.protocol.plugin import Outcome, Robot

_MOVING = (Drive, Motor)


LINK_BLOCKED = "the robot's link takes nothing"


class Commands:
    """Carries out and refuses. ``publish`` shows a message on the bus, ``pump`` writes to the robot."""

    def __init__(
        self,
        robot: Robot,
        leases: LeaseServer,
        keys: KeySpace,
        metrics: Metrics,
        *,
        publish: Callable[[Topic, FleetMessage], object],
        pump: Callable[[], None],
        clock: Callable[[], float],
    ) -> None:
        self._robot = robot
        self._leases = leases
        self._authority = leases.authority
        self._limits = leases.limits
        self._keys = keys
        self._publish = publish
        self._pump = pump
        self._clock = clock
        self._closing: str | None = None
        self.blocked = False
        """Whether the robot's link takes nothing: drives wait in vain, and all else is refused."""
        self._topics = {keys.key(topics.CMD_DRIVE.path): topics.CMD_DRIVE}
        self._taken = metrics.count("commands")
        self._slowed = metrics.count("drives_slowed")
        self._unwritten = metrics.count("drives_unwritten")

    def __repr__(self) -> str:
        return f"<Commands {self._keys.robot}>"

    def take(self, sample: Sample) -> None:
        """Carry out one command, or refuse it where everybody sees."""
        self._taken.value += 1
        if is_stop(sample.key):  # whatever the payload says and whoever says it
            self._leases.stop("stop")
            self._leases.gate.stopped()
            return
        who = None
        try:
            topic = self._topics.get(sample.key) or self._find(sample.key)
            who = self._admit(topic, sample)
            self._carry_out(topic, sample.payload, who)
        except (Refused, PayloadError, EncodeError) as error:
            refused = error if isinstance(error, Refused) else Malformed(str(error))
            self._authority.refuse(sample.key.rpartition("@cmd/")[2], refused, refused.who or who)
        self._leases.settle()

    def require_ready(self) -> None:
        """Raise Refused where the robot takes no commands now."""
        session = self._robot.driving
        if session is None or session.over:
            raise NotReady("offline")
        if not self._robot.ready:
            raise NotReady(session.busy or session.state.value)

    def require_flowing(self) -> None:
        """Raise Refused where the robot's link takes nothing: what waits for it would come after the stop."""
        if self.blocked:
            raise NotReady(LINK_BLOCKED)

    def require_sure(self) -> None:
        """Raise Refused where the robot is not to be set in motion: what it is told later might not arrive."""
        session = self._robot.driving
        if session is not None and session.doubtful is not None:
            raise NotReady(session.doubtful)

    def refuse_all(self, reason: str) -> None:
        """Take nothing but stops from now on."""
        self._closing = reason

    def _find(self, key: str) -> Topic:
        if not topics.is_concrete(key):
            raise Malformed("its key has wildcards")
        topic = topics.find(self._keys.path(key))
        if topic is None or topic.delivery is not Delivery.COMMAND:
            raise Unsupported("no such command")
        return topic

    def _admit(self, topic: Topic, sample: Sample) -> str | None:
        """Give the holder whose command this is, None of one that needs no lease; raise Refused where it may not be."""
        if topic.message not in OF_THE_HOLDER:
            return None
        who = self._authority.admit(sample.attachment, sample.key, sample.payload, self._clock())
        self._leases.settle()
        return who

    def _carry_out(self, topic: Topic, payload: bytes, who: str | None) -> None:
        if self._closing is not None:
            raise NotReady(self._closing, Code.CLOSING)
        now = self._clock()
        command = payloads.decode(topic.message, payload)
        if isinstance(command, _MOVING):
            self._move(topic, command, now, who)
            return
        self.require_ready()
        self.require_flowing()
        autonomous = isinstance(command, Mode) and command.mode == "autonomous"
        if autonomous or isinstance(command, Raw):
            self.require_sure()
            self._authority.require_motion()
        self._show(topic, self._robot.command(topic, command, now), who)
        if isinstance(command, Mode):
            self._authority.mode_chosen(autonomous=autonomous)
        elif isinstance(command, Raw):
            self._authority.sent_opaque()
        self._pump()

    def _move(self, topic: Topic, command: Drive | Motor, now: float, who: str | None) -> None:
        try:
            self.require_ready()
            if command.moving:
                self.require_sure()
        except Refused as refusal:
            if command.moving:
                self._leases.hold_back(str(refusal), stops=False)
            raise
        if command.moving:
            self._authority.require_motion()
        if isinstance(command, Drive):
            wished, command = command, self._limits.limit(command, now)
            self._slowed.value += command is not wished and command != wished
        outcome = self._robot.command(topic, command, now)
        self._unwritten.value += self.blocked
        self._pump()  # the robot first, the accounts after it
        if command.moving:
            self._authority.require_motion()  # the link may just have begun to take again: a stop went instead
        if isinstance(command, Drive):
            self._limits.sent(command, now)
        self._authority.applied(topic.path, now, moving=command.moving)
        if isinstance(command, Drive) and not self._authority.driven:
            self._leases.standstill.neutral(now)
        self._show(topic, outcome, who)

    def _show(self, topic: Topic, outcome: Outcome, who: str | None) -> None:
        for shown, message in outcome.telemetry:
            self._publish(shown, message)
        if outcome.left_out:
            self._authority.refuse(topic.path.removeprefix("@cmd/"), Unsupported(outcome.left_out), who)
