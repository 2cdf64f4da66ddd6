"""Commands from the bus to one robot, and its stops: the authority's decisions carried out in time."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable

from zbridge.bus import Sample
from zbridge.errors import EncodeError, PayloadError, Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Raw
from zbridge.fleet.topics import Delivery, KeySpace, Topic
from zbridge.metrics import Metrics
from zbridge.protocol import Outcome, Robot
from zbridge.session.control import Authority
from zbridge.session.session import State

log = logging.getLogger("zbridge.commands")

STOP_REPEAT_S = 1.0
"""Seconds for which a stop is repeated."""
_CONTROL_S = 0.05
"""Least time between two publications of ``control`` while refusals come in."""


class Commands:
    """Carries out, refuses and stops. ``publish`` shows a message on the bus, ``pump`` writes to the robot.

    ``clock``: seconds on the event loop's time line.
    """

    def __init__(
        self,
        robot: Robot,
        authority: Authority,
        keys: KeySpace,
        metrics: Metrics,
        *,
        publish: Callable[[Topic, FleetMessage], object],
        pump: Callable[[], None],
        clock: Callable[[], float],
    ) -> None:
        self._robot = robot
        self._authority = authority
        self._keys = keys
        self._publish = publish
        self._pump = pump
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._deadman: asyncio.TimerHandle | None = None
        self._control_due: asyncio.TimerHandle | None = None
        self._closing: str | None = None
        self._stands_at = -math.inf
        self._refused = metrics.count("refused")
        self._taken = metrics.count("commands")

    def __repr__(self) -> str:
        return f"<Commands {self._keys.robot} {self._authority!r}>"

    @property
    def moving(self) -> bool:
        """Whether the robot was told to move, or to move on its own, and not yet to stop."""
        return self._authority.moving or self._authority.on_its_own

    @property
    def stopping_s(self) -> float:
        """Seconds for which a stop or a neutral is still being repeated."""
        return max(0.0, self._stands_at - self._clock())

    def take_stop(self, sample: Sample) -> None:
        """Stop, whatever the payload says."""
        self._taken.value += 1
        self.halt("stop")

    def take(self, sample: Sample) -> None:
        """Carry out one command, or refuse it where everybody sees."""
        path = self._keys.path(sample.key)
        self._taken.value += 1
        try:
            self._carry_out(path, sample)
        except (Refused, PayloadError, EncodeError) as error:
            self._refuse(path.removeprefix("@cmd/"), str(error))

    def require_ready(self) -> None:
        """Raise Refused where the robot takes no commands now."""
        session = self._robot.driving
        if session is None or session.over:
            raise Refused("offline")
        if not self._robot.ready:
            raise Refused(session.busy or session.state.value)

    def halt(self, reason: str) -> None:
        """Stop the robot at once and for a second; motion needs a neutral drive afterwards."""
        self.forbid(reason)
        session = self._robot.driving
        if session is None or session.state is not State.ESTABLISHED:
            return
        log.info("%s: stop (%s)", self._keys.robot, reason)
        try:
            self.stand_still()
        except Refused as refusal:
            self._refuse("stop", str(refusal))

    def stand_still(self) -> None:
        """Send the robot its stop, for a second; raise Refused where it cannot be sent."""
        now = self._clock()
        self._robot.stop(now, now + STOP_REPEAT_S)
        self._stands_at = now + STOP_REPEAT_S
        self._pump()

    def refuse_all(self, reason: str) -> None:
        """Take nothing but stops from now on."""
        self._closing = reason

    def forbid(self, reason: str) -> None:
        """Allow no motion before a neutral drive: the robot stands, or is out of reach."""
        self._authority.stopped(reason)
        self._watch_deadman()
        self.report()

    def report(self) -> None:
        """Publish ``control`` now."""
        if self._control_due is not None:
            self._control_due.cancel()
            self._control_due = None
        self._publish(topics.CONTROL, self._authority.report())

    def close(self) -> None:
        """Let no timer fire any more."""
        for timer in (self._deadman, self._control_due):
            if timer is not None:
                timer.cancel()

    def _carry_out(self, path: str, sample: Sample) -> None:
        topic = topics.find(path)
        if topic is None or topic.delivery is not Delivery.COMMAND:
            raise Refused("no such command")
        if topic is topics.CMD_STOP:  # has a lane of its own, and came by it
            self._taken.value -= 1
            return
        if self._closing is not None:
            raise Refused(self._closing)
        now = self._clock()
        command = payloads.decode(topic.message, sample.payload)
        if isinstance(command, Drive):
            self._drive(topic, command, now)
        else:
            self.require_ready()
            on_its_own = _moves_by_itself(command)
            self._authority.admit(moving=on_its_own)
            self._show(topic, self._robot.command(topic, command, now))
            self._authority.on_its_own = self._authority.on_its_own or on_its_own
        self._pump()

    def _drive(self, topic: Topic, command: Drive, now: float) -> None:
        moving = command.moving
        try:
            self.require_ready()
        except Refused as refusal:
            if moving:
                self.forbid(str(refusal))
            raise
        self._authority.admit(moving=moving)
        outcome = self._robot.command(topic, command, now)
        self._authority.applied(moving=moving, now=now)
        if not moving:
            self._stands_at = now + STOP_REPEAT_S
        self._watch_deadman()
        self._show(topic, outcome)

    def _show(self, topic: Topic, outcome: Outcome) -> None:
        for shown, message in outcome.telemetry:
            self._publish(shown, message)
        if outcome.left_out:
            self._refuse(topic.path.removeprefix("@cmd/"), outcome.left_out)

    def _refuse(self, command: str, reason: str) -> None:
        self._refused.value += 1
        self._authority.refuse(command, reason)
        if self._control_due is None:
            self._control_due = self._loop.call_later(_CONTROL_S, self.report)

    def _watch_deadman(self) -> None:
        if self._deadman is not None:
            self._deadman.cancel()
            self._deadman = None
        deadline = self._authority.deadline()
        if deadline is not None:
            self._deadman = self._loop.call_at(deadline, self._on_deadman)

    def _on_deadman(self) -> None:
        self._deadman = None
        if self._authority.overdue(self._clock()):
            self.halt("deadman")
        else:
            self._watch_deadman()


def _moves_by_itself(command: FleetMessage) -> bool:
    """Tell a command after which a robot may move without being driven: what is opaque may do anything."""
    return isinstance(command, Raw) or (isinstance(command, Mode) and command.mode == "autonomous")
