"""What processes tell of themselves: a router's members, sessions with peers, what each process does and uses."""

from __future__ import annotations

import msgspec
from msgspec import UNSET, UnsetType

from zbridge.fleet.messages import FleetMessage


class Membership(FleetMessage, frozen=True):
    """What a router knows of the member that asks.

    name, role: in ``roles.toml``. robots: that it is for; empty: as its role says.
    """

    name: str
    role: str
    robots: tuple[str, ...] = ()


class SessionEntry(msgspec.Struct, frozen=True):
    """One session of the table, with a robot's link or with an HQ program.

    name: of the session. peer: its address. role: of the gateway or listener, ``hq`` towards a robot, ``robot`` towards
    an HQ program. state: of the session. reason: why it ended, or is not established. version: of the protocol.
    features: features that both sides use. transport: of its frames. counters: frames and bytes carried, lost and
    refused. left_out: counts of what has no form on the other side.
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


class ProcessStats(msgspec.Struct, frozen=True):
    """One process, and what it uses of its machine.

    host: its machine. pid: its process id. version: of zbridge. robots: how many it serves. uptime_s: since it started.
    cpu: processors in use, 0.02 is two hundredths of one, over the last seconds. resident_bytes: with all shared pages.
    proportional_bytes: each shared page divided among those that share it; None where the platform does not say. files:
    open descriptors. most_files: how many it may have. late_s: by how much the event loop was late in the last second.
    """

    host: str
    pid: int
    version: str
    robots: int = 1
    uptime_s: float = 0.0
    cpu: float = 0.0
    resident_bytes: int = 0
    proportional_bytes: int | None = None
    files: int = 0
    most_files: int = 0
    late_s: float = 0.0


class ListenerStats(msgspec.Struct, frozen=True):
    """One listener for HQ programs.

    name: on the bus, without ``hq.``. protocol: of its programs. address: where they connect. clients: connected now.
    listening: whether it accepts connections.
    """

    name: str
    protocol: str
    address: str
    clients: int = 0
    listening: bool = True


class DiskSpace(msgspec.Struct, frozen=True):
    """The disk that a file is written to.

    use: ``audit``, ``blackbox``, ``latches`` or ``recording``. path: of the file. free_bytes: left for this user.
    """

    use: str
    path: str
    free_bytes: int


class Stats(FleetMessage, frozen=True):
    """What the gateway of a robot does and uses; once a second.

    process: that it runs in. rates: messages that it published in the last second, by the first part of the key:
    ``{"pose": 20.0}``. gaps: messages of the robot that were lost before they reached the gateway, where a sequence
    shows it, since the process started. refused: commands refused since then. dropped: messages dropped since then.
    listeners: of the process. disks: that it writes to.
    """

    process: ProcessStats
    rates: dict[str, float] = msgspec.field(default_factory=dict)
    gaps: int = 0
    refused: int = 0
    dropped: int = 0
    listeners: tuple[ListenerStats, ...] = ()
    disks: tuple[DiskSpace, ...] = ()


class Sessions(FleetMessage, frozen=True):
    """The sessions of one process.

    sessions: the live ones first. process, listeners: of a process that serves HQ programs only, which has no
    :class:`Stats` of its own.
    """

    sessions: tuple[SessionEntry, ...]
    process: ProcessStats | UnsetType = UNSET
    listeners: tuple[ListenerStats, ...] = ()
