"""Connects to a robot, whatever kind of link leads to it."""

from __future__ import annotations

from zbridge.protocol.address import DeviceAddress, SerialAddress
from zbridge.transport import serial, tcp
from zbridge.transport.link import Link, Receiver


async def connect(address: DeviceAddress, receiver: Receiver, buffer: bytearray | None = None) -> Link:
    """Connect ``receiver`` to the robot at ``address``; raise LinkError with the reason where that is not possible.

    buffer: where reads from sockets go, which links of one loop may share.
    """
    if isinstance(address, SerialAddress):
        return serial.connect(address, receiver)
    return await tcp.connect(address, receiver, buffer)
