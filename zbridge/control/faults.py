"""What is wrong with a robot, or with the gateway that serves it: faults with codes. Sans-IO.

Theory of operation. A *lasting* fault is set by the part that finds it, and cleared by the same part. An *event* is
over when it is noted; its fault heals by itself, :data:`EVENT_S` after the last occurrence. A fault that returns within
:data:`SETTLE_S` of its end is the same one: it is shown and counted once, with the number of its occurrences. Every
occurrence of a fault that is an incident is reported to :attr:`OpenFaults.occurred`, so that the minutes before are
kept. ``status`` shows the open faults; :meth:`OpenFaults.expire` must be called about once a second.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from enum import StrEnum

import msgspec

from zbridge.control.events import AuthorityEvent, EventKind, StopCause
from zbridge.errors import Code
from zbridge.fleet.messages import Fault, Latch
from zbridge.log import Log

log = Log("zbridge.control.faults")

EVENT_S = 60.0
"""Seconds after which the fault of an event heals."""
SETTLE_S = 5.0
"""A fault that returns within so many seconds is the same one."""
IN_A_ROW = 10
"""Refused motions of the driver, with no motion carried out between them, that are a fault."""
ROW_S = 2.0
"""Longest time between two of them, seconds."""


class FaultCode(StrEnum):
    """What is wrong, for programs; the text says more to people."""

    DEADMAN = "deadman"
    """Motion was not repeated in time, and the robot was stopped."""
    HOLDER_LOST = "holder_lost"
    """The driver's liveliness token disappeared while the robot moved, and the robot was stopped."""
    BUS_LOST = "bus_lost"
    """The gateway lost the bus while the robot moved, and the robot was stopped."""
    REFUSED_MOTION = "refused_motion"
    """Ten motions of the driver in a row were refused."""
    STALE_COMMANDS = "stale_commands"
    """Ten motions of the driver in a row came too late."""
    GATEWAY_DIED = "gateway_died"
    """The gateway's process before this one died: crashed, was killed, or lost power."""
    GATEWAY_HUNG = "gateway_hung"
    """The gateway's process before this one sent no heartbeat, and the supervisor killed it."""
    ROBOT_LOST = "robot_lost"
    """The connection to the robot ended."""
    LINK_STALLED = "link_stalled"
    """The robot's link acknowledges nothing: what it is sent waits."""
    LATCHED = "latched"
    """A latched stop is in force."""
    SPLIT_CLAIMS = "split_claims"
    """Another gateway serves the robot too."""
    CANNOT_STOP = "cannot_stop"
    """The robot cannot be sent its stop."""
    TOO_MANY_NAMES = "too_many_names"
    """The robot names more sensors or motors than are published."""
    CERTIFICATE = "certificate"
    """The certificate for the bus ends soon, or has ended."""
    AUDIT_LOG = "audit_log"
    """The audit log cannot be written."""
    LATCH_FILE = "latch_file"
    """Latched stops cannot be written down: they would not survive a restart."""
    BLACK_BOX = "black_box"
    """The black box cannot be written, or loses messages."""
    CAMERA = "camera"
    """The camera's stream failed."""
    CAMERA_RELAY = "camera_relay"
    """The relay of the camera cannot listen."""


EVENTS = frozenset(
    {
        FaultCode.DEADMAN,
        FaultCode.HOLDER_LOST,
        FaultCode.BUS_LOST,
        FaultCode.REFUSED_MOTION,
        FaultCode.STALE_COMMANDS,
        FaultCode.GATEWAY_DIED,
        FaultCode.GATEWAY_HUNG,
    }
)
"""Faults that heal by themselves. All others last until their cause is gone."""
INCIDENTS = EVENTS | {FaultCode.ROBOT_LOST, FaultCode.LINK_STALLED, FaultCode.LATCHED, FaultCode.SPLIT_CLAIMS}
"""Faults whose minutes before are kept."""
_TOLD_ELSEWHERE = EVENTS | {FaultCode.ROBOT_LOST, FaultCode.LATCHED}
"""Faults whose texts are not in ``status.reason``."""
_OF_CAUSES = {
    StopCause.DEADMAN: FaultCode.DEADMAN,
    StopCause.HOLDER_LOST: FaultCode.HOLDER_LOST,
    StopCause.BUS_LOST: FaultCode.BUS_LOST,
}
_REFUSALS = (Code.NEUTRAL_FIRST, Code.NOT_READY, Code.BUSY, Code.UNSUPPORTED, Code.STALE, Code.RATE)
"""Refusals of a driver that has the lease: those of strangers are no fault of the robot."""


class _OpenFault(msgspec.Struct):
    """heals_at: None while its cause lasts."""

    text: str
    since_ns: int
    count: int = 0
    heals_at: float | None = None


class OpenFaults:
    """The open faults of one robot.

    changed: called when a fault opens, heals or has another text. clock: seconds; clock_ns: Unix time.
    """

    def __init__(
        self,
        changed: Callable[[], object] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.changed = changed
        self.occurred: Callable[[str, str], object] = lambda code, text: None
        """Called with code and text of each occurrence that is an incident."""
        self.counts = Counter[FaultCode]()
        """How often each fault has opened."""
        self._clock = clock
        self._clock_ns = clock_ns
        self._open: dict[FaultCode, _OpenFault] = {}

    def __repr__(self) -> str:
        return f"<OpenFaults {[str(code) for code in self._open]}>"

    @property
    def texts(self) -> tuple[str, ...]:
        """The texts of lasting faults for ``status.reason``, oldest first."""
        return tuple(
            fault.text for code, fault in self._open.items() if fault.heals_at is None and code not in _TOLD_ELSEWHERE
        )

    @property
    def faults(self) -> tuple[Fault, ...]:
        """All open faults, oldest first."""
        return tuple(Fault(code, fault.text, fault.since_ns, fault.count) for code, fault in self._open.items())

    def set(self, code: FaultCode, text: str | None, *, anew: bool = True, quiet: bool = False) -> None:
        """Set a lasting fault; None: its cause is gone.

        anew: False for one that was there before this process. quiet: the caller shows the change.
        """
        fault = self._open.get(code)
        lasts = fault is not None and fault.heals_at is None
        if text is None:
            if fault is None or not lasts:
                return
            fault.heals_at = self._clock() + SETTLE_S
        elif fault is not None and lasts:
            if fault.text == text:
                return
            fault.text = text
        else:
            self._occur(code, text, None, anew=anew)
        if not quiet:
            self.changed()

    def happened(self, code: FaultCode, text: str) -> None:
        """Note an event. ``changed`` is called where it opens a fault, or gives it another text."""
        fault = self._open.get(code)
        shown = fault.text if fault is not None else None
        self._occur(code, text, self._clock() + EVENT_S)
        if text != shown:
            self.changed()

    def expire(self) -> None:
        """Close the faults that have healed."""
        now = self._clock()
        healed = [code for code, fault in self._open.items() if fault.heals_at is not None and now >= fault.heals_at]
        for code in healed:
            count = self._open.pop(code).count
            log.info("fault_healed", "fault {code} has healed, after {count}", code=code, count=count)
        if healed:
            self.changed()

    def _occur(self, code: FaultCode, text: str, heals_at: float | None, *, anew: bool = True) -> None:
        fault = self._open.get(code)
        if fault is None:
            fault = self._open[code] = _OpenFault(text, self._clock_ns())
            self.counts[code] += 1
            log.info("fault_opened", "fault {code}: {reason}", code=code, reason=text)
        fault.text, fault.heals_at = text, heals_at
        fault.count += 1
        if anew and code in INCIDENTS:
            self.occurred(code, text)


class EventFaults:
    """Finds faults in the events of one robot's authority. clock: seconds."""

    def __init__(self, open_faults: OpenFaults, clock: Callable[[], float]) -> None:
        self._open_faults = open_faults
        self._clock = clock
        self._refused = 0
        self._refused_at = 0.0

    def __repr__(self) -> str:
        return f"<EventFaults {self._refused} refused>"

    def note(self, event: AuthorityEvent) -> None:
        """Note one event."""
        if event.what is EventKind.REFUSED:
            self._note_refusal(event)
        elif event.cause in _OF_CAUSES:
            who = f" ({event.who})" if event.who else ""
            self._open_faults.happened(_OF_CAUSES[event.cause], f"{event.reason or event.cause}{who}")

    def moved(self) -> None:
        """Note that motion was carried out: no row of refusals goes on."""
        self._refused = 0

    def latched(self, latches: tuple[Latch, ...], *, anew: bool = True) -> None:
        """Note the latched stops in force."""
        text = ", ".join(latch.described for latch in latches)
        self._open_faults.set(FaultCode.LATCHED, text or None, anew=anew, quiet=not anew)

    def _note_refusal(self, event: AuthorityEvent) -> None:
        is_motion = event.command is not None and event.command.startswith(("drive", "motor"))
        if event.code not in _REFUSALS or event.who is None or not is_motion:
            return
        now = self._clock()
        self._refused = self._refused + 1 if now - self._refused_at <= ROW_S else 1
        self._refused_at = now
        if self._refused >= IN_A_ROW:
            self._refused = 0
            code = FaultCode.STALE_COMMANDS if event.code is Code.STALE else FaultCode.REFUSED_MOTION
            text = f"{IN_A_ROW} commands of {event.who} in a row were refused: {event.reason}"
            self._open_faults.happened(code, text)
