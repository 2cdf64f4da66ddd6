"""Tells a robot's protocol when a lease begins and ends, so that motors can be on while somebody drives."""

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
        self._told: bool | None = None
        """What the protocol knows; None: it must be told whatever holds."""
        self._refused = self._left = False

    def __repr__(self) -> str:
        return f"<LeaseHook {self._context.keys.robot} {'leased' if self._told else 'free'}>"

    def forget(self) -> None:
        """Tell the protocol next time whatever holds: meanwhile another gateway serves the robot."""
        self._told = None

    def tell(self, *, anew: bool = False) -> None:
        """Tell whether somebody has the lease, if that has changed, or ``anew``; not before the session is there."""
        self._tell(self._authority.holders.current is not None and not self._left, anew=anew)

    def repeat(self) -> None:
        """Tell again what the robot side refused, or what it was not told. To be called once a second."""
        self.tell(anew=self._refused)

    def leave(self) -> None:
        """Tell that nobody has the lease any more, whoever has: the gateway leaves the robot."""
        self._left = True
        self._tell(False)

    def _tell(self, leased: bool, *, anew: bool = False) -> None:
        session = self._context.robot.driving
        if (leased is self._told and not anew) or session is None or session.state is not State.ESTABLISHED:
            return
        if session.outbox.muted:  # another gateway serves the robot
            return
        self._told, self._refused = leased, False
        try:
            self._context.robot.leased(leased, self._context.clock())
        except Refused as refusal:
            self._refused = True
            self._authority.refuse("leased", refusal)
        except Exception as error:  # of a protocol's own code: it must not affect who may drive
            self._context.faults.note("leased", error)
        self._context.pump()
