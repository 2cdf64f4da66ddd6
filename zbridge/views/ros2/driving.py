"""Which publisher on a robot's cmd_vel drives it, and when it may begin. Sans-IO; time is an argument.

Theory of operation. Each publisher, known by its gid, has a :class:`~zbridge.lease.stick.Stick`. One publisher at a
time drives: it holds the robot, or asks for it. Who commands motion meanwhile needs neutral, and so does a publisher
that was there before us, or that was cut off and is back: its stick may be deflected already, and must not move the
robot by itself. A zero, or a second of silence, is neutral.
"""

from __future__ import annotations

from collections import OrderedDict

import msgspec

from zbridge.errors import Held, NeutralFirst, Unsupported
from zbridge.lease.stick import Stick, StickRules

DEADMAN_S = 0.5
"""A publisher that drives and is silent for so long is stopped."""
QUIET_S = 1.0
"""Silence that is as good as a zero; and zeros for so long give the robot back."""
PUBLISHERS = 32
"""Most publishers of one robot that are known; more are refused."""
REMEMBERED = 256
"""Publishers that are gone, and need neutral if they come back: they were cut off, and did not begin anew."""
RULES = StickRules(
    deadman_s=DEADMAN_S,
    keeps=False,
    idle_s=QUIET_S,
    quiet_s=QUIET_S,
    lapsed=f"silent for {DEADMAN_S:g} s while it drove",
    advice=": send a zero, or nothing for a second, then drive",
)
_EARLY = "it existed before"


class TwistPublisher(msgspec.Struct, frozen=True, eq=False):
    """What is known of one publisher. name: of its node, ``/teleop``."""

    name: str
    stick: Stick


class Driving:
    """The publishers of one robot's cmd_vel. robot: its name, for reasons."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self.publishers: dict[bytes, TwistPublisher] = {}
        self._driver: TwistPublisher | None = None
        """The last one that might drive."""
        self._gone: OrderedDict[bytes, None] = OrderedDict()

    def __repr__(self) -> str:
        return f"<Driving {self._robot} {list(self.publishers.values())}>"

    @property
    def driver(self) -> TwistPublisher | None:
        """The publisher that drives."""
        return self._driver if self._driver is not None and self._driver.stick.active else None

    def came(self, gid: bytes, name: str, now: float, *, early: bool) -> bool:
        """A publisher's token came; False if there is no place. early: the publisher was there before us."""
        known = self.publishers.get(gid)
        if known is not None:
            if early and not known.stick.active and known.stick.needs_neutral is None:
                known.stick.refused(_EARLY)
            return True
        if len(self.publishers) >= PUBLISHERS:
            return False
        why = "it was cut off, and is back" if gid in self._gone else _EARLY if early else None
        self._gone.pop(gid, None)
        stick = Stick(RULES, why)
        stick.heard_at = now  # it may have spoken until now: its silence begins here
        self.publishers[gid] = TwistPublisher(name, stick)
        return True

    def gone(self, gid: bytes) -> None:
        """A publisher's token is gone; the caller releases the robot if this one drove."""
        if self.publishers.pop(gid, None) is not None:
            self._gone[gid] = None
            if len(self._gone) > REMEMBERED:
                self._gone.popitem(last=False)

    def heard(self, gid: bytes, moving: bool, now: float, wrong: str = "") -> None:
        """A publisher commands motion or zero; wrong: or what the robot cannot do, and why.

        Raises Refused if its stick must not be asked: then the caller releases the robot if this one drove.
        """
        publisher = self.publishers.get(gid)
        if publisher is None:
            raise NeutralFirst("a publisher without a token")
        stick, driver = publisher.stick, self.driver
        stick.heard(now)
        if wrong:
            stick.refused(wrong)
            raise Unsupported(wrong)
        if moving and driver is not None and driver is not publisher:
            why = f"{self._robot} is driven by {driver.name}"
            stick.refused(why)
            raise Held(why)
        if moving:
            self._driver = publisher
