"""The TCP/UDP protocol towards HQ programs: what they are shown of any robot, and what they command. Sans-IO.

``options`` of a listener, ``client`` is the session of one program, ``display`` shows the robot, ``commands``
understands the programs, ``side`` puts them together. Source: "The gateway as robot", "Translation" and "Settings and
version negotiation" of the protocol page.
"""

from gateways.tcpudp.hq.client import HqClient
from gateways.tcpudp.hq.options import HqOptions
from gateways.tcpudp.hq.side import TcpUdpHq

__all__ = ["HqClient", "HqOptions", "TcpUdpHq"]
