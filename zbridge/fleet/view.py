"""The last values of what one robot published, as a process saw them on the bus. Sans-IO."""

from __future__ import annotations

from zbridge.fleet import topics
from zbridge.fleet.messages import (
    Control,
    Devices,
    FleetMessage,
    Map,
    Motion,
    Pose,
    Reading,
    Scan,
    Scanner,
    Status,
    Switch,
)
from zbridge.fleet.topics import Topic

READINGS = 256
"""Most sensors whose last reading is kept."""


class RobotView:
    """The robot as it was last seen; None for what was not seen yet.

    protocol, version, features: those of the last established connection, kept while the robot is away.
    """

    def __init__(self) -> None:
        self.alive = False
        """Whether a gateway serves the robot."""
        self.status: Status | None = None
        self.control: Control | None = None
        self.protocol: str | None = None
        self.version: str | None = None
        self.features: tuple[str, ...] | None = None
        self.pose: Pose | None = None
        self.map: Map | None = None
        self.scan: Scan | None = None
        self.motion: Motion | None = None
        self.scanner: Scanner | None = None
        self.lidar: Switch | None = None
        self.camera: Switch | None = None
        self.devices: Devices | None = None
        self.readings: dict[str, Reading] = {}

    def __repr__(self) -> str:
        return f"<RobotView {self.protocol} {self.missing or 'established'}>"

    @property
    def missing(self) -> str | None:
        """Why the robot cannot be used now; None if it can."""
        if not self.alive or self.status is None:
            return "no gateway serves the robot"
        if self.status.state != "established":
            return f"robot {self.status.state}" + (f": {self.status.reason}" if self.status.reason else "")
        return None

    def note(self, topic: Topic, message: FleetMessage) -> None:
        """Keep what was published."""
        if isinstance(message, Reading):
            name = topics.unescape(topic.path.rpartition("/")[2])
            if name in self.readings or len(self.readings) < READINGS:
                self.readings[name] = message
            return
        if isinstance(message, Status) and message.state != "established":
            self.readings.clear()  # the next connection may have other sensors
        if isinstance(message, Status) and message.state == "established":
            if self.protocol is not None and self.protocol != message.protocol:
                self.forget()
            self.protocol, self.version, self.features = message.protocol, message.version, message.features
        if topic.path in _KEPT:
            setattr(self, topic.path, message)

    def forget(self) -> None:
        """Forget what was seen: another robot has taken the name."""
        control, alive = self.control, self.alive
        self.__init__()  # type: ignore[misc]
        self.control, self.alive = control, alive


_KEPT = frozenset({"status", "control", "pose", "map", "scan", "motion", "scanner", "lidar", "camera", "devices"})
"""Paths that are attributes too."""
