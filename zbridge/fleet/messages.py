"""The fleet messages: what every protocol is translated to and from.

SI units and radians; axes after REP 103: x forward, y left, turns and angles counter-clockwise positive.
Speeds and drive commands are fractions of full scale, -1 to 1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import UNSET, UnsetType

Fraction = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
Finite = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
StopId = Annotated[bytes, msgspec.Meta(min_length=16, max_length=16)]
TOLD = 16
"""Most different refusals in one report of a listener."""
if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Floats = npt.NDArray[np.float32]
    Cells = npt.NDArray[np.uint8]
else:  # on the wire; numpy is loaded when the first array comes
    Floats = Cells = bytes


class FleetMessage(msgspec.Struct, frozen=True, gc=False, kw_only=True):
    """The fields that every fleet message may have; UNSET, and absent from the payload, where the device gives none.

    stamp_ns: best estimate of when the content was measured, Unix nanoseconds on the gateway's clock.
    seq: the device's own sequence number. device_ms: the device's own clock, milliseconds.
    """

    stamp_ns: int | UnsetType = UNSET
    seq: int | UnsetType = UNSET
    device_ms: int | UnsetType = UNSET


class Scan(FleetMessage, frozen=True, eq=False):
    """One sweep of a laser scanner, or of distance sensors.

    angle_min, angle_increment: radians. range_min, range_max: metres. ranges: float32[n], metres; NaN where nothing was
    measured.
    """

    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    ranges: Floats


class Scanner(FleetMessage, frozen=True):
    """The geometry of a laser scanner.

    angle_min, angle_max, angle_increment: radians. time_increment_s: from one point to the next. range_min, range_max:
    metres. points: in one sweep.
    """

    angle_min: float
    angle_max: float
    angle_increment: float
    time_increment_s: float
    range_min: float
    range_max: float
    points: int


class Motion(FleetMessage, frozen=True):
    """How the robot moves; None = unknown.

    speed: -1 to 1 of full scale. acceleration: [x, y, z], m/s2. gyro: [x, y, z], rad/s. temperature: degrees C.
    """

    speed: float | None = None
    acceleration: tuple[float, float, float] | None = None
    gyro: tuple[float, float, float] | None = None
    temperature: float | None = None


class Pose(FleetMessage, frozen=True):
    """Where the robot is in its own map frame.

    x, y: metres. heading: radians.
    """

    x: float
    y: float
    heading: float


class Map(FleetMessage, frozen=True, eq=False):
    """An occupancy map.

    rows, columns: number of them. cell: side of a cell in metres. origin: [x, y] of cell (0, 0) in metres. cells:
    uint8[rows, columns], row = y, 0 unknown, 1 free, 2 occupied.
    """

    rows: int
    columns: int
    cell: float
    origin: tuple[float, float]
    cells: Cells


class Image(FleetMessage, frozen=True):
    """One compressed picture of the robot's camera.

    format: ``jpeg`` or ``png``. data: the bytes of the file. width, height: pixels, None = unknown.
    """

    format: str
    data: bytes
    width: int | None = None
    height: int | None = None


class Battery(FleetMessage, frozen=True):
    """The robot's battery; None = unknown.

    level: 0 (empty) to 1. voltage: V. current: A, negative while it is being emptied. charging: whether it is being
    charged.
    """

    level: float | None = None
    voltage: float | None = None
    current: float | None = None
    charging: bool | None = None


class Reading(FleetMessage, frozen=True):
    """One value of a named sensor.

    value: in the sensor's unit. kind: what sort of sensor it is. device: its number in the device table. fault: the
    value is not plausible.
    """

    value: float
    kind: str | None = None
    device: int | None = None
    fault: bool = False


class Device(msgspec.Struct, frozen=True):
    """One entry of the device table.

    name: in keys, ``sensor/<name>``. number: the robot's own for it. kind: what it is, ``distance`` or ``rotational
    motor``.
    """

    name: str
    number: int
    kind: str


class Devices(FleetMessage, frozen=True):
    """The devices that the robot has registered.

    devices: in the order of their registration.
    """

    devices: tuple[Device, ...]


class Switch(FleetMessage, frozen=True):
    """A switch.

    on: whether it is on.
    """

    on: bool


class Text(FleetMessage, frozen=True):
    """A text for people.

    text: what it says. kind: ``request`` asks programs on the bus for something. sender: who wrote it, if that is
    known.
    """

    text: str
    kind: Literal["debug", "chat", "request"] = "debug"
    sender: str | None = None


class Raw(FleetMessage, frozen=True):
    """A legacy message that no fleet message holds.

    id: of the packet. body: its bytes.
    """

    id: int
    body: bytes = b""


class LinkStatus(msgspec.Struct, frozen=True):
    """One transport connection to the robot.

    name: of the link, ``robot``. state: of the link, with the values of ``Status.state``. peer: its address. reason:
    why it is not established. shared: gateways of other robots may connect to the same address; left out where they may
    not.
    """

    name: str
    state: str
    peer: str
    reason: str | None = None
    shared: bool | UnsetType = UNSET


class Fault(msgspec.Struct, frozen=True):
    """An open fault of a robot or of its gateway.

    code: what is wrong, for programs. text: for people. since_ns: when it opened, Unix time. count: how often it
    occurred since then.
    """

    code: str
    text: str
    since_ns: int
    count: int = 1


RobotState = Literal["offline", "connecting", "handshaking", "established", "closing"]


class Status(FleetMessage, frozen=True):
    """Whether the robot can be used, and what was negotiated with it.

    state: of the robot. reason: why it is not established, or what is wrong with it. protocol, dialect, version: of the
    robot. features: features that both sides use. links: links to the robot. host: the machine of its gateway. stalled:
    True while the robot's link acknowledges nothing: what it is sent waits. commands: what the robot accepts now:
    ``stop``, ``drive``, ``light``, ``motor``; whoever holds the robot or not. faults: what is wrong, oldest first; an
    event such as a deadman is shown for a minute.
    """

    state: RobotState
    reason: str | None = None
    protocol: str | None = None
    dialect: str | None = None
    version: str | None = None
    features: tuple[str, ...] = ()
    links: tuple[LinkStatus, ...] = ()
    host: str | None = None
    stalled: bool | UnsetType = UNSET
    commands: tuple[str, ...] = ()
    faults: tuple[Fault, ...] = ()


class Refusal(msgspec.Struct, frozen=True, kw_only=True):
    """A command that was not carried out, and how often.

    who: sent it, by its proof or the name in its key; None if neither shows it. command: what was refused. code: a
    :class:`zbridge.errors.Code`, for programs. reason: for people. count: how often. by: the listener that refused it,
    ``hq.<listener>``; None if the robot's gateway did.
    """

    who: str | None
    command: str
    code: str = ""
    reason: str
    count: int
    by: str | None = None


class Latch(msgspec.Struct, frozen=True):
    """A latched stop.

    id: releases it. who, reason: what its sender said. fleet: it was sent to all robots of the realm.
    """

    id: StopId
    who: str | None = None
    reason: str | None = None
    fleet: bool = False

    @property
    def described(self) -> str:
        """For people: ``latched by ann (wet floor)``."""
        by = f" by {self.who}" if self.who else ""
        return f"latched{by}" + (f" ({self.reason})" if self.reason else "")


class Control(FleetMessage, frozen=True):
    """Who drives, and what was refused lately.

    state: of the lease. holder: the name of who has it. lease: the public id of the current lease. priority: of the
    lease. expires_in_s: until the lease ends, unless it is renewed. refusals: the last different ones, newest last.
    latches: the latched stops in force. stops: the ids of the last stops that had one.
    """

    state: Literal["free", "held", "stopped", "latched"]
    holder: str | None = None
    lease: bytes | None = None
    priority: int | None = None
    expires_in_s: float | None = None
    refusals: tuple[Refusal, ...] = ()
    latches: tuple[Latch, ...] = ()
    stops: tuple[bytes, ...] = ()


class Refusals(FleetMessage, frozen=True):
    """A listener's report of what it refused its HQ programs; the robot's gateway shows it on ``control``.

    refusals: as ``control`` shows them.
    """

    refusals: Annotated[tuple[Refusal, ...], msgspec.Meta(max_length=TOLD)]


class Drive(FleetMessage, frozen=True):
    """Move, or stand still with the lease kept: all zero is neutral.

    forward: of full scale. left: sideways, of full scale. turn: counter-clockwise, of full scale. light: None leaves it
    unchanged.
    """

    forward: Fraction = 0.0
    left: Fraction = 0.0
    turn: Fraction = 0.0
    light: bool | None = None

    @property
    def moving(self) -> bool:
        """Return whether this is motion, not neutral."""
        return bool(self.forward or self.left or self.turn)


class Motor(FleetMessage, frozen=True):
    """One motor.

    value: rad/s, or metres for a linear motor.
    """

    value: Finite

    @property
    def moving(self) -> bool:
        """Return whether this is motion, not neutral. For a linear motor any value but 0 is."""
        return bool(self.value)


class Mode(FleetMessage, frozen=True):
    """Who moves the robot.

    mode: nobody (none), a person (manual) or the robot itself (autonomous).
    """

    mode: Literal["none", "manual", "autonomous"]


class Stop(FleetMessage, frozen=True):
    """Stop now. Anybody may send it. What cannot be read is a stop without any of these fields.

    latch: nobody drives until this id is released. id: ``control`` shows it once the stop was carried out. who, reason:
    for people.
    """

    latch: bool | UnsetType = UNSET
    id: StopId | UnsetType = UNSET
    who: str | UnsetType = UNSET
    reason: str | UnsetType = UNSET


class SensorSetting(FleetMessage, frozen=True):
    """Settings of one sensor: any of them.

    enable: whether it measures. index: of ``value``. value: one setting. values: all settings.
    """

    enable: bool | None = None
    index: int | None = None
    value: float | None = None
    values: tuple[float, ...] | None = None


class Query(FleetMessage, frozen=True):
    """A query without fields."""
