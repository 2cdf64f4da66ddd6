"""What the state of a robot's links means: whether the robot is there, what ``status`` says, when motion must end."""

from __future__ import annotations

import contextlib
import socket
from itertools import product
from typing import Any

from msgspec import UNSET

from zbridge.control.context import RobotContext
from zbridge.control.enforcer import Enforcer
from zbridge.control.events import StopCause
from zbridge.control.faults import FaultCode
from zbridge.control.standstill import Standstill
from zbridge.errors import Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Status
from zbridge.log import Log
from zbridge.metrics import Count
from zbridge.protocol.session import Session, State
from zbridge.robot.commands import LINK_BLOCKED, Commands
from zbridge.robot.connection import Links
from zbridge.robot.observer import Observer
from zbridge.robot.queries import PendingQueries

log = Log("zbridge.robot.device")


class Presence:
    """Follows the sessions of one robot. protocol: the name that ``status`` shows."""

    def __init__(
        self,
        context: RobotContext,
        protocol: str,
        links: Links,
        enforcer: Enforcer,
        standstill: Standstill,
        commands: Commands,
        pending: PendingQueries,
        observer: Observer,
    ) -> None:
        self._context = context
        self._protocol = protocol
        self._links = links
        self._enforcer = enforcer
        self._standstill = standstill
        self._commands = commands
        self._pending = pending
        self._observer = observer
        self._greeted: Session[Any] | None = None
        self._busy: str | None = None
        self._doubtful: str | None = None
        self._shown_doubts: tuple[str, ...] = ()
        self._host = socket.gethostname() or None
        self._leaving = False
        self._lost = context.metrics.count("commands_lost")
        self._stalls = context.metrics.count("link_stalls")
        for link, outcome in product(context.robot.link_names, ("established", "failed", "lost")):
            self._connections(link, outcome)

    def __repr__(self) -> str:
        return f"<Presence {self._context.keys.robot} {self._links.first.state}>"

    def restore(self, session: Session[Any]) -> None:
        """Take a session for greeted: another process established it."""
        self._greeted, self._busy, self._doubtful = session, session.busy, session.doubtful

    def leave(self) -> None:
        """Note that the gateway takes leave of the robot: the end of its session holds nothing back."""
        self._leaving = True

    def session_changed(self, session: Session[Any]) -> None:
        """Act on a change of the session that drives: lost, established, busy, in doubt."""
        if session is not self._context.robot.driving:
            return
        busy, self._busy = self._busy, session.busy
        doubtful, self._doubtful = self._doubtful, session.doubtful
        if session.over:
            self._on_lost(session)
        elif session.state is State.ESTABLISHED and session is not self._greeted:
            self._on_established(session)
        elif busy != self._busy:
            self._enforcer.require_neutral(self._busy or "no longer busy", StopCause.ROBOT_BUSY, stops=True)
        if self._doubtful and not doubtful:
            self._enforcer.require_neutral(self._doubtful, StopCause.LINK_IN_DOUBT, stops=True)
        if session.doubts != self._shown_doubts and not session.over and self._links.first.state == "established":
            self.publish_status()

    def count_connection(self, link: str, outcome: str) -> None:
        """Count a connection that was established, failed before that, or was lost after it."""
        self._connections(link, outcome).value += 1

    def _connections(self, link: str, outcome: str) -> Count:
        return self._context.metrics.count("robot_connections", link=link, outcome=outcome)

    def stalled(self, name: str, stalled: bool) -> None:
        """Drive no robot whose first link is stalled: it would obey late, or lose its stop with the rest."""
        if name != self._links.first.name:
            return
        self._commands.blocked = stalled
        self._context.open_faults.set(FaultCode.LINK_STALLED, f"{LINK_BLOCKED}: it is not driven" if stalled else None)
        if stalled:
            self._stalls.value += 1
            log.warning("link_stalled", "{robot}: {reason}", robot=self._context.keys.robot, reason=LINK_BLOCKED)
        else:
            self._enforcer.require_neutral("the robot's link stalled", StopCause.LINK_STALLED, stops=True)

    def state_changed(self) -> None:
        """Show the new state of a link."""
        self.publish_status()
        self._observer.changed()

    def publish_status(self) -> None:
        """Publish ``status`` as it is now."""
        context, first = self._context, self._links.first
        session = context.robot.driving
        agreed = session if session is not None and first.state == "established" else None
        self._shown_doubts = agreed.doubts if agreed is not None else ()
        warnings = agreed.warnings if agreed is not None else ()
        reasons = (first.reason, *self._shown_doubts, *warnings, *context.open_faults.texts)
        context.publish(
            topics.STATUS,
            Status(
                stamp_ns=context.clock_ns(),
                state=first.state,
                reason="; ".join(filter(None, reasons)) or None,
                protocol=self._protocol,
                dialect=context.robot.dialect,
                version=(agreed.version or None) if agreed is not None else None,
                features=agreed.features if agreed is not None else (),
                links=tuple(connection.status() for connection in self._links),
                host=self._host,
                stalled=self._commands.blocked or UNSET,
                commands=("stop", *context.robot.accepts) if agreed is not None and agreed.busy is None else (),
                faults=context.open_faults.faults,
            ),
        )

    def _on_lost(self, session: Session[Any]) -> None:
        self._commands.blocked = False
        self._context.open_faults.set(FaultCode.LINK_STALLED, None)
        if session.version is not None:
            self._lost.value += len(session.outbox)
            if not self._leaving:
                self._context.open_faults.set(FaultCode.ROBOT_LOST, session.reason or "ended", quiet=True)
                self._enforcer.require_neutral("robot lost", StopCause.ROBOT_LOST, stops=False)
            self._pending.refuse_all("the robot was lost")

    def _on_established(self, session: Session[Any]) -> None:
        """Stop the robot, which something else may have driven before, and publish what it can show at once."""
        self._greeted = session
        self._context.open_faults.set(FaultCode.ROBOT_LOST, None, quiet=True)
        with contextlib.suppress(Refused):  # the condition says so on status
            self._standstill.stop(ordered=False)
        self._enforcer.lease_hook.notify(anew=True)
        for topic, message in self._context.robot.begun(self._context.clock_ns()):
            self._context.publish(topic, message)
