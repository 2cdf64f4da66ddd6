"""What travels on the bus: fleet messages, the keys they travel on, and how each is delivered. Sans-IO.

Knows no bus, no robot and no protocol. ``messages`` declares what is said, ``topics`` every key, ``payload`` the bytes,
``view`` what a process knows of one robot.
"""

from __future__ import annotations

from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Delivery, KeySpace, Topic
from zbridge.fleet.view import RobotView

__all__ = ["Delivery", "FleetMessage", "KeySpace", "RobotView", "Topic"]
