"""Connects to a robot, whatever kind of link leads to it."""

from __future__ import annotations

from zbridge.protocol.address import DeviceAddress, SerialAddress, ZenohAddress
from zbridge.transport import serial, tcp
from zbridge.transport.link import Link, Receiver


async def connect(address: DeviceAddress, receiver: Receiver) -> Link:
    """Connect ``receiver`` to the robot at ``address``; raise LinkError with the reason where that is not possible."""
    if isinstance(address, SerialAddress):
        return serial.connect(address, receiver)
    if isinstance(address, ZenohAddress):
        from zbridge.transport import samples  # loads what only such links need

        return await samples.connect(address, receiver)
    return await tcp.connect(address, receiver)
