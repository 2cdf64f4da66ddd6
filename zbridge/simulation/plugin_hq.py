"""Runs the robot side of a protocol against a robot, without a gateway and a bus: for authors who debug a session.

A :class:`PluginHq` connects, prints what happens, and drives the robot on request. None of a gateway's rules apply: no
lease, no latched stop, no limit of motion. Three duties remain: neutral comes before motion; a session that becomes
busy or doubtful stops the robot, until the program is started again; and the program stops the robot before it ends.
Knows no protocol.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import msgspec

from zbridge.errors import ProtocolError, Refused
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive, FleetMessage, Reading, Scan
from zbridge.fleet.printable import shown
from zbridge.metrics import Metrics
from zbridge.protocol.address import DeviceAddress
from zbridge.protocol.plugin import Protocol, Telemetry
from zbridge.protocol.session import State
from zbridge.simulation.fragile import print_line
from zbridge.tasks import occurs
from zbridge.transport import Conversation, ConversationHooks, Link, connect

DRIVE_S = 0.1
"""Seconds between two drive commands."""
NEUTRAL_S = 0.5
"""Seconds of neutral before motion."""
STOP_S = 0.5
"""Seconds for which a stop is repeated."""
REPORT_S = 1.0
"""Seconds between two lines of the same kind."""
CLOSE_S = 1.0
"""Seconds for a closing session to write its last frames."""
LINE = 300
"""Most characters of a line."""
KINDS = 1000
"""Most kinds of lines; any more are not printed."""
_COMMON = frozenset(FleetMessage.__struct_fields__)


def described(path: str, message: FleetMessage) -> str:
    """Return one telemetry message as one line: its path, and its fields that have a value."""
    if isinstance(message, Scan):
        measured = [float(range_m) for range_m in message.ranges if not math.isnan(range_m)]
        nearest = f", nearest {min(measured):.2f} m" if measured else ""
        return f"{path} {len(message.ranges)} points, {len(measured)} measured{nearest}"
    if isinstance(message, Reading):
        return f"{path} {message.value:g}{' (fault)' if message.fault else ''}"
    values = ((name, getattr(message, name)) for name in message.__struct_fields__ if name not in _COMMON)
    fields = [f"{name}={_value(value)}" for name, value in values if value is not None and value is not msgspec.UNSET]
    return " ".join((path, *fields))


def _value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:z.2f}"
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, tuple):
        numbers = all(isinstance(item, int | float) for item in value)
        return f"({', '.join(map(_value, value))})" if numbers else f"{len(value)} items"
    if hasattr(value, "shape"):
        return f"{value.dtype}{list(value.shape)}"
    return repr(value)


class LineReport:
    """Prints lines by kind: the first of a kind at once, then the newest of each kind on every :meth:`flush`."""

    def __init__(self, show: Callable[[str], None] = print_line) -> None:
        self._show = show
        self._kinds: set[str] = set()
        self._newest: dict[str, Callable[[], str]] = {}

    def event(self, line: str) -> None:
        """Print a line now."""
        self._show(shown(line, LINE))

    def note(self, kind: str, line: Callable[[], str]) -> None:
        """Replace the line of a kind; ``line`` is called only if it is printed."""
        if kind in self._kinds:
            self._newest[kind] = line
        elif len(self._kinds) < KINDS:
            self._kinds.add(kind)
            self.event(line())

    def flush(self) -> None:
        """Print the lines that are new since the last call, sorted by kind."""
        newest, self._newest = self._newest, {}
        for kind in sorted(newest):
            self.event(newest[kind]())


class PluginHq:
    """One session of a protocol's robot side with the robot at ``address``, for one connection.

    drive: forward and turn that it drives once the robot is ready, fractions of full scale; None: it only watches, and
    sends what the session sends by itself. Needs a running event loop.
    """

    def __init__(
        self,
        protocol: Protocol,
        address: DeviceAddress,
        drive: tuple[float, float] | None = None,
        show: Callable[[str], None] = print_line,
    ) -> None:
        self.robot = protocol.robot(msgspec.convert(protocol.simulated, protocol.options), 1, Metrics())
        self.session = self.robot.session(self.robot.link_names[0], str(address))
        self._address = address
        self._drive = None if drive is None else Drive(forward=drive[0], turn=drive[1])
        self._report = LineReport(show)
        self._clock = asyncio.get_running_loop().time
        hooks = ConversationHooks(
            deliver=self._deliver, changed=self._changed, linked=self._linked, may_warn=lambda kind: False
        )
        self._conversation = Conversation(self.session, asyncio.get_running_loop(), hooks)
        self._unlinked = asyncio.Event()
        self._begun = False
        self._trouble: str | None = None
        self._neutral_until: float | None = None
        """When motion may begin; None: the robot was sent no command."""
        self._moving = False
        self._halted = False
        self._malformed = self._untranslatable = 0

    def __repr__(self) -> str:
        return f"<PluginHq {self.session!r}>"

    async def run(self) -> None:
        """Run until the session ends. If cancelled, first stop the robot that was driven, and close the session.

        Raises LinkError if there is no connection, and what the protocol's own code raises for a command.
        """
        ended = self._conversation.ended
        await connect(self._address, self._conversation)
        try:
            flush_at = self._clock() + REPORT_S
            while not ended.done():
                await asyncio.wait((ended,), timeout=DRIVE_S)
                self._step()
                if self._clock() >= flush_at:
                    self._report.flush()
                    flush_at += REPORT_S
        finally:
            await self._leave()

    # What the conversation calls

    def _linked(self, link: Link, up: bool) -> None:
        if up:
            self._report.event(f"connected to {link.peer}")
        else:
            self._unlinked.set()

    def _changed(self) -> None:
        session = self.session
        if session.state is not State.ESTABLISHED:
            return
        if not self._begun:
            self._begun = True
            self._begin()
        trouble = session.busy or session.doubtful
        if trouble != self._trouble:
            self._trouble = trouble
            self._report.event(f"busy: {trouble}" if trouble else "no longer busy")
            if trouble and self._neutral_until is not None:
                self._halt("start again to drive")

    def _begin(self) -> None:
        """Begin with the session that was just established."""
        session, dialect = self.session, self.robot.dialect
        features = f", features {', '.join(session.features)}" if session.features else ""
        version = f", version {session.version}" if session.version else ""
        self._report.event(f"established{f', dialect {dialect}' if dialect else ''}{version}{features}")
        self._note(self.robot.begun(time.time_ns()))
        if self._drive is not None:
            self._attempt("lease", lambda: self.robot.leased(True, self._clock()))

    def _deliver(self, messages: list[Any]) -> None:
        stamp_ns = time.time_ns()
        for message in messages:
            try:
                self._note(self.robot.telemetry(message, stamp_ns))
            except ProtocolError as error:
                self._untranslatable += 1
                text = f"no meaning {self._untranslatable}, last: {error}"
                self._report.note("no meaning", partial(str, text))

    def _note(self, telemetry: Iterable[Telemetry]) -> None:
        for topic, message in telemetry:
            self._report.note(topic.path, partial(described, topic.path, message))

    # What it does by itself

    def _step(self) -> None:
        """Count what is malformed, and send the next command; called every :data:`DRIVE_S`."""
        session, malformed = self.session, self.session.traffic.malformed
        if malformed != self._malformed:
            self._malformed = malformed
            self._report.note("malformed", lambda: f"malformed {malformed}, last: {session.last_malformed}")
        if self._drive is None or self._halted or self._trouble or not self.robot.ready:
            return
        now, drive = self._clock(), self._drive
        if self._neutral_until is None:
            self._neutral_until = now + NEUTRAL_S
            self._report.event("sends neutral")
        if now >= self._neutral_until and not self._moving:
            self._moving = True
            self._report.event(f"drives: forward {drive.forward:g}, turn {drive.turn:g}")
        self._attempt("drive", lambda: self._command(drive if self._moving else Drive(), now))
        self._conversation.pump()

    def _command(self, drive: Drive, now: float) -> None:
        left_out = self.robot.command(topics.CMD_DRIVE, drive, now).left_out
        if left_out is not None:
            self._report.note("left out", lambda: f"left out of the drive: {left_out}")

    def _attempt(self, what: str, act: Callable[[], None]) -> None:
        """Send the robot a command; print that it refuses it."""
        try:
            act()
        except Refused as refusal:
            text = f"refused {what}: {refusal} ({refusal.code})"
            self._report.note(f"refused {what}", lambda: text)

    def _halt(self, remark: str) -> None:
        """Stop the robot, and drive it no more. The caller pumps."""
        self._halted = True
        self._report.event(f"stops the robot; {remark}" if remark else "stops the robot")
        now = self._clock()
        self._attempt("stop", lambda: self.robot.stop(now, now + STOP_S))

    async def _leave(self) -> None:
        """Stop the robot that was driven, close the session and wait until the link has ended."""
        conversation, ended, session = self._conversation, self._conversation.ended, self.session
        try:
            if self._drive is not None and session.state is State.ESTABLISHED:
                self._halt("")
                conversation.pump()
                await asyncio.wait((ended,), timeout=STOP_S)
                self._attempt("release", lambda: self.robot.leased(False, self._clock()))
            conversation.close("this program ends")
            await asyncio.wait((ended,), timeout=CLOSE_S)
        finally:
            conversation.abandon()
            await occurs(self._unlinked, CLOSE_S)
            self._report.flush()
            traffic = session.traffic
            counts = f"{traffic.frames_in} frames in, {traffic.frames_out} out, {traffic.malformed} malformed"
            self._report.event(f"session ended: {session.reason}; {counts}")
