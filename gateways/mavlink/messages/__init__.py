"""The messages of MAVLink that the gateway reads or writes; all others are counted, and never passed on.

``base`` has the table and what a declaration is, ``telemetry`` and ``control`` the declarations.
"""

from gateways.mavlink.messages import control, telemetry
from gateways.mavlink.messages.base import MESSAGES, MavlinkMessage, MavlinkSpec

__all__ = ["MESSAGES", "MavlinkMessage", "MavlinkSpec", "control", "telemetry"]
