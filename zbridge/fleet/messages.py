"""The fleet messages: what every protocol is translated to and from.

SI units and radians; axes after REP 103: x forward, y left, turns and angles counter-clockwise positive.
Speeds and drive commands are fractions of full scale, -1 to 1.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import UNSET, UnsetType

Fraction = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
Finite = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
LeaseId = Annotated[bytes, msgspec.Meta(min_length=8, max_length=8)]
Token = Annotated[bytes, msgspec.Meta(min_length=32, max_length=32)]
Proof = Annotated[bytes, msgspec.Meta(min_length=16, max_length=16)]
TOLD = 16
"""Different refusals that are told at a time."""
Floats = npt.NDArray[np.float32]
Cells = npt.NDArray[np.uint8]


class FleetMessage(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """What all fleet messages may carry; UNSET, and absent from the payload, where the device has none.

    stamp_ns: best estimate of when the content was measured, Unix nanoseconds on the gateway's clock.
    seq: the device's own sequence number. device_ms: the device's own clock, milliseconds.
    """

    stamp_ns: int | UnsetType = UNSET
    seq: int | UnsetType = UNSET
    device_ms: int | UnsetType = UNSET


class Scan(FleetMessage, frozen=True, eq=False):
    """One sweep of a laser scanner. ranges: float32[n], metres, invalid = NaN; angles in radians."""

    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    ranges: Floats


class Scanner(FleetMessage, frozen=True):
    """The geometry of a laser scanner: radians, seconds, metres."""

    angle_min: float
    angle_max: float
    angle_increment: float
    time_increment_s: float
    range_min: float
    range_max: float
    points: int


class Motion(FleetMessage, frozen=True):
    """How the robot moves: speed -1..1 of full scale, acceleration m/s2, gyro rad/s, temperature degrees C.

    acceleration and gyro are [x, y, z]; unknown = None.
    """

    speed: float | None = None
    acceleration: tuple[float, float, float] | None = None
    gyro: tuple[float, float, float] | None = None
    temperature: float | None = None


class Pose(FleetMessage, frozen=True):
    """Where the robot is in its own map frame: metres, heading in radians."""

    x: float
    y: float
    heading: float


class Map(FleetMessage, frozen=True, eq=False):
    """An occupancy map. cells: uint8[rows, columns], row = y, 0 unknown, 1 free, 2 occupied.

    cell: side of a cell in metres. origin: [x, y] of cell (0, 0) in metres.
    """

    rows: int
    columns: int
    cell: float
    origin: tuple[float, float]
    cells: Cells


class Reading(FleetMessage, frozen=True):
    """One value of a named sensor, in the sensor's unit; ``fault`` where the value is not plausible."""

    value: float
    kind: str | None = None
    device: int | None = None
    fault: bool = False


class Device(msgspec.Struct, frozen=True):
    """One entry of the device table."""

    name: str
    number: int
    kind: str


class Devices(FleetMessage, frozen=True):
    """What the robot has registered."""

    devices: tuple[Device, ...]


class Switch(FleetMessage, frozen=True):
    """Something that is on or off."""

    on: bool


class Text(FleetMessage, frozen=True):
    """A text for people; ``request`` asks programs on the bus for something."""

    text: str
    kind: Literal["debug", "chat", "request"] = "debug"
    sender: str | None = None


class Raw(FleetMessage, frozen=True):
    """A legacy message that no fleet message holds: its packet id and its body."""

    id: int
    body: bytes = b""


class LinkStatus(msgspec.Struct, frozen=True):
    """One transport connection to the robot."""

    name: str
    state: str
    peer: str
    reason: str | None = None


RobotState = Literal["offline", "connecting", "handshaking", "established", "closing"]


class Status(FleetMessage, frozen=True):
    """Whether the robot can be used, and what was agreed with it."""

    state: RobotState
    reason: str | None = None
    protocol: str | None = None
    dialect: str | None = None
    version: str | None = None
    features: tuple[str, ...] = ()
    links: tuple[LinkStatus, ...] = ()


class Refusal(msgspec.Struct, frozen=True, kw_only=True):
    """A command that was not carried out, and how often. code: one of :class:`zbridge.errors.Code`, for programs.

    by: the listener that refused it, ``hq.<listener>``; None where the robot's gateway did.
    """

    who: str | None
    command: str
    code: str = ""
    reason: str
    count: int
    by: str | None = None


class Control(FleetMessage, frozen=True):
    """Who drives, and what was refused lately. lease: the public id of the lease that is held."""

    state: Literal["free", "held", "stopped"]
    holder: str | None = None
    lease: bytes | None = None
    priority: int | None = None
    expires_in_s: float | None = None
    refusals: tuple[Refusal, ...] = ()


class Refusals(FleetMessage, frozen=True):
    """What a listener refused its HQ programs: for the robot's gateway, which shows it on ``control``."""

    refusals: Annotated[tuple[Refusal, ...], msgspec.Meta(max_length=TOLD)]


class Drive(FleetMessage, frozen=True):
    """Move: fractions of full scale, -1..1; ``light`` None leaves it as it is."""

    forward: Fraction = 0.0
    left: Fraction = 0.0
    turn: Fraction = 0.0
    light: bool | None = None

    @property
    def moving(self) -> bool:
        """Tell motion from neutral."""
        return bool(self.forward or self.left or self.turn)


class Motor(FleetMessage, frozen=True):
    """One motor: rad/s, or metres for a linear motor."""

    value: Finite

    @property
    def moving(self) -> bool:
        """Tell motion from neutral; of a linear motor nobody here knows where it stands, so it counts as motion."""
        return bool(self.value)


class Mode(FleetMessage, frozen=True):
    """Who moves the robot: nobody, a person, or the robot itself."""

    mode: Literal["none", "manual", "autonomous"]


class Stop(FleetMessage, frozen=True):
    """Stand still now."""


class SensorSetting(FleetMessage, frozen=True):
    """Settings of one sensor: any of enable, one value by index, or all values."""

    enable: bool | None = None
    index: int | None = None
    value: float | None = None
    values: tuple[float, ...] | None = None


class Query(FleetMessage, frozen=True):
    """A question without fields."""


class Acquire(FleetMessage, frozen=True):
    """Ask for the lease of a robot, or take it over.

    who: whom others are shown as the holder. priority: a higher one is given the robot of a lower one.
    lease_s, deadman_s: wishes in seconds, capped by the robot's configuration and its default where None.
    alive: the ``<who>`` of a liveliness token below the robot's ``@alive/``, whose loss ends the lease.
    """

    who: str
    priority: int = 0
    lease_s: float | None = None
    deadman_s: float | None = None
    alive: str | None = None


class Lease(FleetMessage, frozen=True):
    """The answer to every question about the lease.

    lease: its id, 8 bytes that everybody may know. token: 32 bytes for the holder alone, which are never sent again.
    Both only when granted. code: one of :class:`zbridge.errors.Code` where it is refused, for programs.
    """

    ok: bool
    lease: LeaseId | None = None
    token: Token | None = None
    expires_in_s: float | None = None
    holder: str | None = None
    reason: str | None = None
    code: str | None = None


class Authorization(FleetMessage, frozen=True):
    """What shows that a command, or a question about the lease, is the holder's: see :mod:`zbridge.control.proof`.

    The attachment of a command, and what is asked at ``renew`` and ``release``. seq: rises with each of the lease.
    """

    lease: LeaseId
    seq: Annotated[int, msgspec.Meta(ge=0)]
    proof: Proof


class Denied(FleetMessage, frozen=True):
    """The error reply to a query. code: one of :class:`zbridge.errors.Code`, for programs; reason: for people."""

    code: str
    reason: str


class SessionEntry(msgspec.Struct, frozen=True):
    """One session of the table: with a robot's link (role ``hq``) or with an HQ program (role ``robot``).

    counters: what it carried and lost. left_out: what the peer was not told, or could not be taken from it, by name.
    """

    name: str
    peer: str
    role: str
    state: str
    reason: str | None = None
    version: str | None = None
    features: tuple[str, ...] = ()
    transport: str = "tcp"
    counters: dict[str, int] = {}
    left_out: dict[str, int] = {}


class Sessions(FleetMessage, frozen=True):
    """The sessions of one process, the live ones first."""

    sessions: tuple[SessionEntry, ...]
