"""Between packets and fleet messages, both ways, for one robot. Sans-IO.

``robot`` turns commands into packets, ``telemetry`` packets into fleet messages, ``scans`` a scan into simulated lidar
data; ``options`` is what the configuration says.
"""

from gateways.tcpudp.translate.options import NAME, Angle, Length, Options, PacketId, Scale
from gateways.tcpudp.translate.robot import TcpUdpRobot
from gateways.tcpudp.translate.scans import polar_ranges
from gateways.tcpudp.translate.telemetry import OFF, ON

__all__ = ["NAME", "OFF", "ON", "Angle", "Length", "Options", "PacketId", "Scale", "TcpUdpRobot", "polar_ranges"]
