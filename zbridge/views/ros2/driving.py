"""Which publisher on a robot's cmd_vel drives it, and when it may begin. Sans-IO; time is an argument.

Theory of operation. One machine for each robot. Each publisher, known by its gid, has a standing, and :data:`TABLE`
says what an event does to it:

- FREE: may begin with motion. It has just come, was silent for :data:`QUIET_S`, or sent a zero.
- DRIVES: holds the robot, or asks for it. One publisher at a time.
- OWES: a zero or a second of silence. Its stick is pushed already, and must not move the robot anew by itself.

The caller carries out the :class:`Decision`, tells :meth:`Driving.lost` when the lease is refused or lost, and calls
:meth:`Driving.expire` at :meth:`Driving.deadline`.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Mapping
from enum import Enum, auto

import msgspec

DEADMAN_S = 0.5
"""A publisher that drives and is silent for so long is stopped."""
QUIET_S = 1.0
"""Silence that pays; and zeros for so long give the robot back."""
PUBLISHERS = 32
"""Most publishers of one robot that are known; more are refused."""
REMEMBERED = 256
"""Publishers that are gone, and owe if they come back: they were cut off, and did not begin anew."""


_EARLY = "it was there before"


class Standing(Enum):
    """What a publisher may do."""

    FREE = auto()
    DRIVES = auto()
    OWES = auto()


class Event(Enum):
    """What happens to a publisher."""

    MOTION = auto()
    """It commands motion, and nobody else drives."""
    TAKEN = auto()
    """It commands motion while another publisher drives."""
    NEUTRAL = auto()
    """It commands zero."""
    WRONG = auto()
    """It commands what the robot cannot do."""
    QUIET = auto()
    """It was silent for QUIET_S."""
    SILENT = auto()
    """It was silent for DEADMAN_S after motion, while it drives."""
    IDLE = auto()
    """It sent zeros only, or nothing after a zero, for QUIET_S, while it drives."""
    LOST = auto()
    """The lease was refused or lost; the robot was stopped."""
    GONE = auto()
    """Its token is gone."""


class Action(Enum):
    """What the caller has to do."""

    NOTHING = auto()
    ACQUIRE = auto()
    SEND = auto()
    REFUSE = auto()
    RELEASE = auto()


class Decision(msgspec.Struct, frozen=True):
    """What to do. publisher: its name; why: of a refusal or release, for people."""

    action: Action
    publisher: str = ""
    why: str = ""


class Publisher:
    """What is known of one publisher. name: of its node, ``/teleop``. why: why it owes."""

    def __init__(self, name: str, standing: Standing, why: str) -> None:
        self.name = name
        self.standing = standing
        self.why = why
        self.refused = 0
        self.heard_at = -math.inf
        self.moved_at = -math.inf
        self.moving = False

    def __repr__(self) -> str:
        return f"<Publisher {self.name} {self.standing.name}>"


_NOTHING = Decision(Action.NOTHING)


class Driving:
    """The publishers of one robot's cmd_vel. robot: its name, for reasons."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self.publishers: dict[bytes, Publisher] = {}
        self.holder: bytes | None = None
        self._gone: OrderedDict[bytes, None] = OrderedDict()

    def __repr__(self) -> str:
        return f"<Driving {self._robot} {list(self.publishers.values())}>"

    def came(self, gid: bytes, name: str, now: float, *, early: bool) -> bool:
        """A publisher's token came; False where there is no place. early: the publisher was there before us."""
        known = self.publishers.get(gid)
        if known is not None:
            if early and known.standing is Standing.FREE:
                known.standing, known.why = Standing.OWES, _EARLY
            return True
        if len(self.publishers) >= PUBLISHERS:
            return False
        back = gid in self._gone
        why = "it was cut off, and is back" if back else _EARLY if early else ""
        self._gone.pop(gid, None)
        self.publishers[gid] = publisher = Publisher(name, Standing.OWES if why else Standing.FREE, why)
        publisher.heard_at = now  # it may have spoken until now: its silence begins here
        return True

    def gone(self, gid: bytes) -> Decision:
        """A publisher's token is gone."""
        publisher = self.publishers.pop(gid, None)
        if publisher is None:
            return _NOTHING
        self._gone[gid] = None
        if len(self._gone) > REMEMBERED:
            self._gone.popitem(last=False)
        return self._step(gid, publisher, Event.GONE, "it is gone")

    def heard(self, gid: bytes, moving: bool, now: float, wrong: str = "") -> Decision:
        """A publisher commands motion or zero; wrong: or what the robot cannot do, and why. Of an unknown one: refuse.

        SEND and ACQUIRE: the command that was heard is to be carried out.
        """
        publisher = self.publishers.get(gid)
        if publisher is None:
            return Decision(Action.REFUSE, "", "a publisher without a token")
        if now - publisher.heard_at >= QUIET_S and gid != self.holder:
            self._step(gid, publisher, Event.QUIET, "")
        publisher.heard_at = now
        publisher.moving = moving
        if wrong:
            return self._step(gid, publisher, Event.WRONG, wrong)
        if not moving:
            return self._step(gid, publisher, Event.NEUTRAL, "")
        publisher.moved_at = now
        if self.holder not in (None, gid):
            return self._step(gid, publisher, Event.TAKEN, f"{self._robot} is driven by {self.driver}")
        return self._step(gid, publisher, Event.MOTION, publisher.why)

    @property
    def driver(self) -> str | None:
        """The name of the publisher that drives."""
        publisher = self.publishers.get(self.holder) if self.holder is not None else None
        return publisher.name if publisher is not None else None

    def lost(self, why: str) -> Decision:
        """The lease was refused or lost."""
        if self.holder is None or self.holder not in self.publishers:
            self.holder = None
            return _NOTHING
        return self._step(self.holder, self.publishers[self.holder], Event.LOST, why)

    def stopped(self, why: str) -> Decision:
        """The robot was stopped: whoever commands motion now meant it before. Return what to do for the driver."""
        driven = self.holder
        for gid, publisher in self.publishers.items():
            self._step(gid, publisher, Event.LOST, why)
        return _NOTHING if driven is None else Decision(Action.RELEASE, "", why)

    def deadline(self) -> float | None:
        """Return when to call :meth:`expire`; None: not before something else happens."""
        publisher = self.publishers.get(self.holder) if self.holder is not None else None
        if publisher is None:
            return None
        return min(publisher.heard_at + DEADMAN_S if publisher.moving else math.inf, publisher.moved_at + QUIET_S)

    def expire(self, now: float) -> Decision:
        """Do what is due."""
        publisher = self.publishers.get(self.holder) if self.holder is not None else None
        if self.holder is None or publisher is None:
            return _NOTHING
        if publisher.moving and now - publisher.heard_at >= DEADMAN_S:
            return self._step(self.holder, publisher, Event.SILENT, f"silent for {DEADMAN_S:g} s while it drove")
        if not publisher.moving and now - publisher.moved_at >= QUIET_S:
            return self._step(self.holder, publisher, Event.IDLE, "it commands no motion")
        return _NOTHING

    def _step(self, gid: bytes, publisher: Publisher, event: Event, why: str) -> Decision:
        action, publisher.standing = TABLE[publisher.standing].get(event, (Action.NOTHING, publisher.standing))
        if publisher.standing is Standing.OWES:
            publisher.why = why or publisher.why
        else:
            publisher.why = ""
        if action is Action.REFUSE:
            publisher.refused += 1
        if publisher.standing is Standing.DRIVES and event is not Event.GONE:
            self.holder = gid
        elif self.holder == gid:
            self.holder = None
        return Decision(action, publisher.name, why)


TABLE: Mapping[Standing, Mapping[Event, tuple[Action, Standing]]] = {
    Standing.FREE: {
        Event.MOTION: (Action.ACQUIRE, Standing.DRIVES),
        Event.TAKEN: (Action.REFUSE, Standing.OWES),
        Event.WRONG: (Action.REFUSE, Standing.OWES),
        Event.LOST: (Action.NOTHING, Standing.OWES),
    },
    Standing.DRIVES: {
        Event.MOTION: (Action.SEND, Standing.DRIVES),
        Event.NEUTRAL: (Action.SEND, Standing.DRIVES),
        Event.WRONG: (Action.RELEASE, Standing.OWES),
        Event.SILENT: (Action.RELEASE, Standing.OWES),
        Event.IDLE: (Action.RELEASE, Standing.FREE),
        Event.LOST: (Action.NOTHING, Standing.OWES),
        Event.GONE: (Action.RELEASE, Standing.OWES),
    },
    Standing.OWES: {
        Event.MOTION: (Action.REFUSE, Standing.OWES),
        Event.TAKEN: (Action.REFUSE, Standing.OWES),
        Event.WRONG: (Action.REFUSE, Standing.OWES),
        Event.NEUTRAL: (Action.NOTHING, Standing.FREE),
        Event.QUIET: (Action.NOTHING, Standing.FREE),
    },
}
"""For each standing and event: what to do, and the next standing. An event that is not listed changes nothing."""
