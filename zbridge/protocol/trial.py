"""What a protocol contributes so that it can be tried: simulated peers, and what the conformance kit checks. Sans-IO.

A package names these in its :class:`Protocol`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import msgspec

from zbridge.fleet.messages import Drive
from zbridge.protocol.address import Address
from zbridge.wire.frames import FrameEnd


class HqSimulation(msgspec.Struct, frozen=True):
    """The start options of a simulated HQ program. It is as fragile as legacy ones. ``address``: where it connects.

    ``drive``: forward and turn that it drives once it has sent neutral, fractions of full scale; None: none.
    """

    address: Address
    version: str | None = None
    dialect: str | None = None
    udp: bool = False
    drive: tuple[float, float] | None = None


class Truth(msgspec.Struct, frozen=True):
    """Ground truth of a simulated robot: the conformance kit compares what is shown with it.

    x, y, heading: metres and radians in the room, counter-clockwise (REP 103). wheels_m_s: the speed of each side over
    ground, left first; empty: it has no such sides. neutral: whether its motors are told to stand still.
    wraps: how often one of its counters has wrapped around. watchdog: whether its watchdog has stopped it, because a
    keep-alive or a request was missing. lived_s: seconds that the robot itself has lived, which are fewer than the
    kit's after a pause of the process, and pass faster while it catches up; None: it lives by the kit's clock.
    ``zbridge.simulation`` sets it.
    """

    x: float
    y: float
    heading: float
    wheels_m_s: tuple[float, ...] = ()
    neutral: bool = False
    wraps: int = 0
    watchdog: bool = False
    lived_s: float | None = None


class Simulation(msgspec.Struct, frozen=True):
    """The start options of a simulated robot. ``addresses``: where it listens, one for each link, in the links' order.

    ``ready`` is called with the bound addresses. A protocol raises ConfigError for what it does not support
    (versions, dialects, datagrams, a second link). For the conformance kit: ``place`` is where the robot begins (x,
    y, heading; None: a place of its choice), ``at_wrap`` lets its counters begin just below the value at which they
    wrap around, and ``report`` is called with the truth after each step.
    """

    addresses: tuple[Address, ...]
    seed: int = 1
    version: str | None = None
    dialect: str | None = None
    udp: bool = False
    fragile: bool = False
    ready: Callable[[tuple[Address, ...]], None] = lambda addresses: None
    place: tuple[float, float, float] | None = None
    at_wrap: bool = False
    report: Callable[[Truth], None] = lambda truth: None


class Codec(msgspec.Struct, frozen=True):
    """The messages that one side sends in one dialect, and how they are written, read and framed; for the kit.

    write: returns one frame, raises EncodeError. read: decodes one frame, raises ProtocolError and nothing else.
    messages: examples. A class stands for one example whose fields the kit fills in. seal: makes a damaged frame whole,
    with the count and checksum that it needs, so that the kit can damage what is behind them; None: as
    :meth:`zbridge.wire.Packets.seal` does it where ``frame_end`` is that of packets.
    """

    name: str
    write: Callable[[Any], bytes]
    read: Callable[[bytes], Any]
    frame_end: FrameEnd
    messages: tuple[Any, ...]
    seal: Callable[[bytes], bytes] | None = None


class Example(msgspec.Struct, frozen=True):
    """Bytes from the maker's manual, or recorded from a real robot, and what they mean: the kit checks both ways.

    Without examples, a fault that session and simulated robot share cannot be found. codec: the name of the
    :class:`Codec`. message: what the frame is read as, and what is written as this frame. shown: the numbers that the
    bus must show of it, by path and field (``{"battery.voltage": 12.5, "sensor/front.value": 0.3}``), in the bus's
    units. before: frames that came before this one, as counters need. command: a drive for which the robot must be sent
    this frame. source: where the bytes stand.
    """

    codec: str
    frame: bytes
    message: Any
    shown: dict[str, float] = {}
    command: Drive | None = None
    source: str = ""
    before: tuple[bytes, ...] = ()
