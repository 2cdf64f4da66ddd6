"""Listeners for HQ programs: each program sees the robot of the bus, and drives it as far as it may.

Knows the robot by its keys only, and no protocol: a protocol contributes an :class:`~zbridge.protocol.plugin.HqSide`.

============================== ==================================================================================
in (what a program says)       ``listener`` and ``admission`` accept it, ``client`` is one program, ``operator`` with
                               ``intent`` acquires the robot for it and commands it, ``robot_queries`` asks the robot
out (what the robot says)      ``robot_subscription`` decodes once for the process, ``broadcast`` encodes once for
                               all clients of a listener
besides                        ``context`` (what these share), ``refusals``, ``freeze``, ``listener_log``, ``tasks``,
                               ``settings``
============================== ==================================================================================
"""

from zbridge.hq.listener import Listener
from zbridge.hq.robot_subscription import RobotSubscription
from zbridge.hq.settings import HqSettings, ListenerPlan

__all__ = ["HqSettings", "Listener", "ListenerPlan", "RobotSubscription"]
