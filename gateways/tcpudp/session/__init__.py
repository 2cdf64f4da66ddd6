"""Conversations of the TCP/UDP package protocol, with the gateway in either role. Sans-IO.

:class:`HqRole` plays HQ towards a robot: its handshake is the table of ``hq_handshake``; ``registered`` decides what
the robot may be sent. :class:`RobotRole` plays the robot towards an HQ program: its handshake is the table of
``robot_role``; ``source`` decides whose datagrams count. ``packets`` is what both share: framing and ``id`` bytes.
"""

from gateways.tcpudp.session.hq_role import HqRole
from gateways.tcpudp.session.packets import limits
from gateways.tcpudp.session.robot_role import RobotRole
from gateways.tcpudp.session.source import CLIENT_PORT

__all__ = ["CLIENT_PORT", "HqRole", "RobotRole", "limits"]
