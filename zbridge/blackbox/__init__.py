"""The black box: the last minutes of a robot on disk, and what is kept of them after an incident.

Theory of operation. The event loop puts what the robot sent and was sent into a queue (:mod:`~zbridge.blackbox.box`). A
thread of the process (:mod:`~zbridge.blackbox.disk_thread`) writes it once a second: the spool
(:mod:`~zbridge.blackbox.spool`) appends to a segment, and begins another every ten seconds. A segment
(:mod:`~zbridge.blackbox.segments`) stands for itself: it begins with the last value of every state. The oldest segments
of the ring are deleted. An incident (:mod:`~zbridge.blackbox.incidents`) takes the segments of the ring by renaming
them, and gets those of the minute after the cause.

The disk may fail, hang or be full: the loop never waits for it, what is not written is counted, and ``status`` says so.
Knows no bus, and nothing that decides over the robot.
"""

from zbridge.blackbox.box import BlackBox
from zbridge.blackbox.disk_thread import DISK, DiskThread
from zbridge.blackbox.incidents import BoxFolder, IncidentInfo
from zbridge.blackbox.settings import BlackBoxSettings

__all__ = ["DISK", "BlackBox", "BlackBoxSettings", "BoxFolder", "DiskThread", "IncidentInfo"]
