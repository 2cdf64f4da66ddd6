"""Enforces what the authority of one robot decides: stops in time, ``control``, the audit log, counters.

Theory of operation. The authority decides and has no clock; the enforcer carries out. A command of the holder's passes
three times: :meth:`Enforcer.admit` before it is read, :meth:`Enforcer.permit` before the robot is sent it,
:meth:`Enforcer.moved` afterwards. Every caller of the authority calls :meth:`Enforcer.settle` afterwards: it
sends the robot its stop where an event asks for it, writes every event down, publishes ``control``, and arms the timer
for the authority's deadline. The timer is re-armed only for an earlier deadline: commands mostly postpone it, and an
early wake-up is harmless. Before anything is written to the robot, or read from it or from the bus,
:meth:`Enforcer.keep_time` does what is due, since the process may have been frozen past its deadline, or the machine
suspended: then no clock of the event loop shows how long.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Iterable

from zbridge.bus import Sample
from zbridge.control.admission import CommandFilter, RefusalLimit
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.context import RobotContext
from zbridge.control.event_counts import EventCounts
from zbridge.control.events import ORDERED, CommandSender, EventKind, StopCause
from zbridge.control.faults import EventFaults
from zbridge.control.latch import Latches, LatchRecord, read_stop
from zbridge.control.lease_hook import LeaseHook
from zbridge.control.motion_limits import MotionLimits
from zbridge.control.standstill import Standstill
from zbridge.errors import Refused, Stale
from zbridge.fleet import topics
from zbridge.fleet.lease_messages import FleetLatches
from zbridge.fleet.messages import Drive, FleetMessage, Mode, Motor, Raw
from zbridge.fleet.topics import KeySpace
from zbridge.protocol.session import State

Save = Callable[[Latches], "asyncio.Future[None] | None"]

SUSPENDED_S = 0.1
"""A machine that was suspended for longer stops its robots, and ends their leases."""
_CONTROL_S = 0.05
"""Least time between two publications of ``control`` while refusals come in."""


class Enforcer:
    """Carries out the decisions of one robot's authority.

    limits: None where drives are not limited. save: writes the latched stops down, so that they survive this process;
    returns what ends when that is done, None if it is.
    """

    def __init__(
        self,
        context: RobotContext,
        authority: Authority,
        standstill: Standstill,
        audit: Audit,
        limits: MotionLimits | None = None,
        save: Save = lambda latches: None,
    ) -> None:
        self.authority = authority
        self._save = save
        self._saving = 0
        """Writings of latched stops that have not ended."""
        self.admission = CommandFilter(authority, context.keys, context.clock)
        """Sorts commands on the bus's threads."""
        self.lease_hook = LeaseHook(context, authority)
        self._context = context
        self._clock = context.clock
        self._suspended_s = context.suspended_s()
        self._standstill = standstill
        self._audit = audit
        self._limits = limits
        self.settled: Callable[..., object] | None = None
        """Called after :meth:`settle`: whether the robot is driven, or (``at_once``) how it is stopped, may be new."""
        self._stops_anew = False
        """Whether a command has just changed how the robot is stopped."""
        self.refusal_limits: dict[str, RefusalLimit] = {"commands": self.admission.refusals}
        """What admission filters drop, by command: :meth:`beat` shows it."""
        self._fleet_stop = KeySpace(context.keys.realm, "*").key(topics.CMD_STOP.path)
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at = math.inf
        self._control_due: asyncio.TimerHandle | None = None
        self._closed = False
        self._counts = EventCounts(context.metrics)
        self._faults = EventFaults(context.open_faults, context.clock)
        self._faults.latched(authority.latches.in_force, anew=False)
        self._same_stops = context.metrics.count("stops_folded")
        self._slowed = context.metrics.count("drives_slowed")
        self._remind()

    def __repr__(self) -> str:
        return f"<Enforcer {self._context.keys.robot} {self.authority!r}>"

    # A command of the holder's

    def admit(self, sample: Sample, now: float) -> CommandSender:
        """Return who of the holders sent a command, and renew the lease; raise Refused for other senders."""
        sender = self.authority.admit(sample.attachment, sample.key, sample.payload, now, self._context.raw_ms())
        if self.authority.machine.events:  # what was due by then
            self.settle()
        return sender

    def require_fresh(self, sender: CommandSender) -> None:
        """Raise Refused for a command that is too old to set the robot in motion."""
        if sender.stale:
            raise Stale("the command is too old: the network delayed it")

    def permit(self, command: Drive | Motor, now: float) -> Drive | Motor:
        """Return the motion that the robot may be sent, within the limits; raise Refused where it may not move."""
        self.authority.motion.check_motion()
        if self._limits is None or not isinstance(command, Drive):
            return command
        limited = self._limits.limit(command, now)
        self._slowed.value += limited is not command and limited != command
        return limited

    def moved(self, path: str, command: Drive | Motor, now: float, sender: CommandSender, *, moving: bool) -> None:
        """Record that the robot was sent motion, or neutral.

        Raises Refused if the link has just recovered from a stall: then a stop went instead of the motion.
        """
        authority = self.authority
        if moving:
            authority.motion.check_motion()
            self._faults.moved()
        whole = isinstance(command, Drive)
        authority.applied(path, sender.given_at, moving=moving, stale=sender.stale, whole=whole)
        if isinstance(command, Drive):
            if self._limits is not None:
                self._limits.sent(command, now)
            if not moving and not authority.motion.driven:
                self._standstill.neutral(now)

    def commanded(self, command: FleetMessage) -> None:
        """Record that the robot was sent something that may move it: a mode, or a raw message."""
        self._stops_anew = isinstance(command, Mode | Raw)
        if isinstance(command, Mode):
            self.authority.motion.mode_chosen(autonomous=command.mode == "autonomous")
        elif isinstance(command, Raw):
            self.authority.motion.sent_opaque()

    # Stops

    def stop(self, reason: str, cause: StopCause) -> None:
        """Stop the robot at once and for a second, and end the lease."""
        self.authority.stop(reason, cause)
        self.settle()

    def stop_commanded(self, sample: Sample) -> None:
        """Obey a stop from the bus, which anybody may send; the admission filter folds those that follow at once."""
        self.authority.take_stop(read_stop(sample.payload), fleet=sample.key == self._fleet_stop)
        self.settle()
        self.admission.stopped()

    def adopt(self, answers: Iterable[FleetLatches]) -> None:
        """Take over the fleet's latched stops that other gateways know."""
        self.authority.latch(*self.authority.latches.adopt(answers))
        self.settle()

    def merge(self, record: LatchRecord) -> None:
        """Add the latches and releases that another gateway of this robot has recorded.

        If this gateway learns only now that the robot was ever ordered to move by itself, it stops the robot, unless a
        program drives it.
        """
        was_known = self.authority.latches.autonomous
        self.authority.merge(record)
        self.settle()
        if self.authority.latches.autonomous and not was_known:
            self._remind()
            self._save_latches()
            if not self.authority.motion.driven:
                self._send_stop(ordered=False)

    def restore(self, latches: Latches) -> None:
        """Take over what was written down, before the robot is served; raise ProtocolError."""
        self.authority.restore_latches(latches.export())
        self._faults.latched(self.authority.latches.in_force, anew=False)
        self._remind()

    def write_autonomous(self) -> asyncio.Future[None] | None:
        """Store that the robot was ordered to move by itself; return what ends when that is done, None if it is."""
        self.authority.latches.autonomous = True
        return self._save(self.authority.latches)

    def require_neutral(self, reason: str, cause: StopCause, *, stops: bool) -> None:
        """Allow no motion before a neutral drive; with ``stops`` the robot is sent its stop."""
        self.authority.require_neutral(reason, cause, stops=stops)
        self.settle()

    # What follows from a decision, and from time going by

    def settle(self) -> None:
        """Carry out what the authority decided, and arm the timer for its next deadline."""
        if self.authority.machine.events:
            self._settle_events()
        deadline = self.authority.deadline()
        if deadline is not None and deadline < self._timer_at:
            if self._timer is not None:
                self._timer.cancel()
            self._timer_at, self._timer = deadline, self._loop.call_at(deadline, self._on_time)
        stops_anew, self._stops_anew = self._stops_anew, False
        if self.settled is not None:
            self.settled(at_once=stops_anew)

    def keep_time(self) -> None:
        """Do what is due, before anything is read or written: the process may have been frozen, the machine asleep."""
        suspended_s = self._context.suspended_s()
        if suspended_s > self._suspended_s + SUSPENDED_S:
            asleep_s, self._suspended_s = suspended_s - self._suspended_s, suspended_s
            self.stop(f"the gateway's machine was suspended for {asleep_s:.1f} s", StopCause.SUSPENDED)
        if self._clock() >= self._timer_at:
            self._on_time()

    def beat(self) -> None:
        """Publish ``control`` with what admission filters dropped, and write down what was folded, once a second."""
        for command, limit in self.refusal_limits.items():
            for refusal, count in limit.dropped():
                self.authority.refuse(command, refusal, count=count)
                self._counts.refused(refusal.code, count - 1)  # settling counts one
        self._same_stops.value = self.admission.same_stops
        self.lease_hook.repeat()
        self.settle()
        self._save_latches()
        self.report()
        self._audit.flush()

    def report(self) -> None:
        """Publish ``control`` now."""
        if self._control_due is not None:
            self._control_due.cancel()
            self._control_due = None
        self._context.publish(topics.CONTROL, self.authority.report(self._clock()))

    def close(self) -> None:
        """Let no timer fire any more, nor be set by what still arrives."""
        self._closed = True
        for timer in (self._timer, self._control_due):
            if timer is not None:
                timer.cancel()

    def _settle_events(self) -> None:
        changed = False
        while events := self.authority.events():
            for event in events:
                self._counts.note(event)
                if event.what is not EventKind.REFUSED:
                    changed = True
                    if event.what is not EventKind.ACQUIRED and self._limits is not None:
                        self._limits.stopped()
                if event.stops:
                    self._send_stop(ordered=event.cause in ORDERED)
                if event.what in (EventKind.LATCHED, EventKind.UNLATCHED):
                    self._save_latches()
                    self._faults.latched(self.authority.latches.in_force)
                self._audit.write(event)
                self._faults.note(event)
            self.lease_hook.notify()
            if self._control_due is None and not self._closed:
                self._control_due = self._loop.call_later(_CONTROL_S, self.report)
        if changed:
            self.report()

    def _save_latches(self) -> None:
        """Write the latched stops down; ``control`` confirms a new one when that has ended."""
        writing = self._save(self.authority.latches)
        if writing is not None:
            self._saving += 1
            writing.add_done_callback(self._on_saved)
        elif not self._saving:
            self.authority.latches.saved()

    def _on_saved(self, _: object) -> None:
        self._saving -= 1
        if not self._saving:
            self.authority.latches.saved()
            self.report()

    def _remind(self) -> None:
        """Let the robot's stops end its own motion too, where a gateway before may have chosen that."""
        if self.authority.latches.autonomous:
            try:
                self._context.robot.was_autonomous()
            except Exception as error:
                self._context.faults.note("was_autonomous", error)

    def _send_stop(self, *, ordered: bool) -> None:
        session = self._context.robot.driving
        if session is None or session.state is not State.ESTABLISHED:
            return
        try:
            self._standstill.stop(ordered=ordered)
        except Refused as refusal:
            self.authority.refuse("stop", refusal)

    def _on_time(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer, self._timer_at = None, math.inf
        self.authority.expire(self._clock())
        self.settle()
