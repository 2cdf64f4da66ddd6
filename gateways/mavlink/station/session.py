"""One ground station at a listener: its session, with the mode and the arming that are its own. Sans-IO.

Source: "The gateway as vehicle" of the protocol page.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import Any, ClassVar

import msgspec

from gateways.mavlink.frames import MavlinkFrame, read_frame
from gateways.mavlink.messages import MavlinkMessage
from gateways.mavlink.messages.telemetry import MavlinkHeartbeat, Statustext
from gateways.mavlink.numbers import ARDUPILOT, ARMED, AUTOPILOT, BOAT, CUSTOM_MODE, ROVER, RoverMode, Severity
from gateways.mavlink.session import MavlinkSession
from gateways.mavlink.station.options import MavlinkHqOptions
from gateways.mavlink.station.parameters import Parameters
from gateways.mavlink.station.streams import TIMED, Streams
from gateways.mavlink.station.vehicle import ShownRover
from gateways.mavlink.texts import chunks_of, clip
from zbridge.fleet.messages import Drive
from zbridge.protocol import Limits, Refused, Role, State

HEARTBEAT_S = 1.0
SILENT_S = 5.0
"""Seconds without a frame after which a station is not armed any more: its address may be another program's then."""
CENTRE_US = 1500
WARN_S = 2.0
"""Seconds within which a warning that the client's stream causes is not repeated."""
_STICKS = 64
"""The bit of ``base_mode`` that an ArduRover always has: it can be driven by hand."""
_STANDBY, _ACTIVE = 3, 4
_MAVLINK = 3
_MOST_TEXT_ID = 65535


class StopNews(Enum):
    """What tells a station that its stop is over: ``control`` shows it, and the client's own lease has ended."""

    SHOWN = "shown"
    LEASE_ENDED = "lease ended"


class SaidMotion(msgspec.Struct):
    """What sticks and setpoints have said. axes: throttle and steering to the right, thousandths."""

    axes: tuple[int, int] = (0, 0)
    heard_at: float = -math.inf
    channels_us: list[int] = msgspec.field(default_factory=lambda: [CENTRE_US, CENTRE_US])
    """Throttle and steering of the RC override."""
    needs_neutral: bool = False
    """Whether the stick must be released first: it was away from zero, or not heard, when MANUAL was entered."""
    entered: bool = False
    """Whether GUIDED was entered, and no motion has counted since."""
    target_at: float = -math.inf
    live_from: float = math.inf
    """When setpoints count, unless there is a gap before."""
    last: Drive = Drive()
    changed_at: float = -math.inf


class Station(MavlinkSession[MavlinkFrame]):
    """A ground station. vehicle, parameters: what it is told of the robot."""

    role = Role.ROBOT
    kept: ClassVar[dict[str, Any]] = {
        "mode": int,
        "armed": bool,
        "there": bool,
        "streams": Streams,
        "now": float,
        "_texts": int,
    }

    def __init__(self, options: MavlinkHqOptions, vehicle: ShownRover, parameters: Parameters, bounds: Limits) -> None:
        super().__init__(options.system_id, AUTOPILOT, bounds)
        self.vehicle, self.parameters = vehicle, parameters
        self.options = options
        self.stick = SaidMotion()
        self.mode: int = RoverMode.HOLD
        self.armed = False
        self.there = False
        """Whether the robot is there; else the client hears nothing, and takes the vehicle for lost."""
        self.streams = Streams()
        self.now = -math.inf
        """When it was read last."""
        self.stop_asked_at = -math.inf
        """When it asked for a stop of which it awaits news."""
        self.awaits: set[StopNews] = set()
        self._kind = BOAT if options.kind == "boat" else ROVER
        self._beats_at = 0.0
        self._texts = 0
        self._warned: dict[str, float] = {}

    @property
    def who(self) -> str:
        """The client's name as the holder of a robot."""
        return f"hq.{self.name}"

    # What the core calls

    def opened(self, now: float) -> None:
        """Speak first: programs wait for it. A source of datagrams must show first that it speaks MAVLink."""
        if self.transport != "udp" or self.speaks_first:
            self.establish("", ())

    def receive(self, data: bytes, now: float) -> list[MavlinkFrame]:
        self.now = now
        return super().receive(data, now)

    def decode(self, frame: bytes) -> MavlinkFrame:
        return read_frame(frame)

    def accept(self, message: MavlinkFrame, now: float) -> bool:
        if message.message is None and self.state is not State.ESTABLISHED:
            return False
        self.establish("", ())
        return True

    def timers(self) -> float:
        return min(self._beats_at, self.streams.due) if self.there else math.inf

    def on_timer(self, now: float) -> None:
        if now >= self._beats_at:
            self.beat(now)
        for message_id in TIMED:
            if self.streams.take(message_id, now) and (message := self.vehicle.message(message_id)) is not None:
                self.outbox.set(str(message_id), (self.encode(message),), now)

    # What it is shown

    def beat(self, now: float) -> None:
        """Show mode and arming at once, and then every second; disarmed, if nothing is heard of the station."""
        if not self.there:
            return
        if now - self.now >= SILENT_S:
            self.armed, self.mode = False, RoverMode.HOLD
        base = CUSTOM_MODE | _STICKS | (ARMED if self.armed else 0)
        state = _ACTIVE if self.armed else _STANDBY
        heartbeat = MavlinkHeartbeat(self.mode, self._kind, ARDUPILOT, base, state, _MAVLINK)
        self.outbox.set("heartbeat", (self.encode(heartbeat),), now)
        self._beats_at = now + HEARTBEAT_S

    def appear(self, now: float, *, there: bool) -> None:
        """Show that the robot is there, or nothing any more."""
        self.there = there
        if there:
            self.beat(now)
        else:
            self.rest(now)

    def rest(self, now: float) -> None:
        """Show HOLD, disarmed: the client does not drive."""
        self.stick.channels_us = [CENTRE_US, CENTRE_US]
        if self.armed or self.mode != RoverMode.HOLD:
            self.armed, self.mode = False, RoverMode.HOLD
            self.beat(now)

    def answer(self, message: MavlinkMessage) -> None:
        """Send a message once; what finds no place is dropped and counted."""
        try:
            self.outbox.put(self.encode(message))
        except Refused:
            self.traffic.dropped += 1

    def text(self, text: str, severity: Severity = Severity.WARNING) -> None:
        """Show a text to the people at the station; a warning in one message, cut to 50 bytes."""
        if not self.there:
            return
        if severity is Severity.WARNING:
            self.answer(Statustext(severity, clip(text)))
            return
        self._texts = self._texts % _MOST_TEXT_ID + 1
        for chunk in chunks_of(text, severity, self._texts):
            self.answer(chunk)

    def warn(self, text: str) -> None:
        """Show a warning that the client's own stream causes, not for each of its messages."""
        if self.now - self._warned.get(text, -math.inf) >= WARN_S:
            self._warned = {old: at for old, at in self._warned.items() if self.now - at < WARN_S} | {text: self.now}
            self.text(text)
