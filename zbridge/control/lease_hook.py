"""Notifies a robot's protocol when a lease begins and ends, so that motors can be on while somebody drives."""

from __future__ import annotations

from zbridge.control.authority import Authority
from zbridge.control.context import RobotContext
from zbridge.errors import Refused
from zbridge.protocol.session import State


class LeaseHook:
    """Calls :meth:`RobotSide.leased` of one robot."""

    def __init__(self, context: RobotContext, authority: Authority) -> None:
        self._context = context
        self._authority = authority
        self._notified: bool | None = None
        """What the protocol knows; None: nothing."""
        self._refused = self._left = False

    def __repr__(self) -> str:
        return f"<LeaseHook {self._context.keys.robot} {'leased' if self._notified else 'free'}>"

    def forget(self) -> None:
        """Notify the protocol of the current state next time: until then another gateway serves the robot."""
        self._notified = None

    def notify(self, *, anew: bool = False) -> None:
        """Notify whether somebody has the lease, if that changed or ``anew``; not before the session is established."""
        self._notify(self._authority.holders.current is not None and not self._left, anew=anew)

    def repeat(self) -> None:
        """Notify again where the robot side refused, or was not notified. To be called once a second."""
        self.notify(anew=self._refused)

    def leave(self) -> None:
        """Report that no client has the lease: the gateway is shutting down."""
        self._left = True
        self._notify(False)

    def _notify(self, leased: bool, *, anew: bool = False) -> None:
        session = self._context.robot.driving
        if (leased is self._notified and not anew) or session is None or session.state is not State.ESTABLISHED:
            return
        if session.outbox.muted:  # another gateway serves the robot
            return
        self._notified, self._refused = leased, False
        try:
            self._context.robot.leased(leased, self._context.clock())
        except Refused as refusal:
            self._refused = True
            self._authority.refuse("leased", refusal)
        except Exception as error:  # of a protocol's own code: it must not affect who may drive
            self._context.faults.note("leased", error)
        self._context.pump()
