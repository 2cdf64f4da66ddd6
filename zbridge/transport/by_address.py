"""Connects to a robot, whatever kind of link leads to it."""

from __future__ import annotations

from zbridge.errors import ProtocolError
from zbridge.protocol.address import DatagramAddress, DeviceAddress, SerialAddress, ZenohAddress
from zbridge.protocol.kept import Exported
from zbridge.transport import datagram_link, serial, tcp
from zbridge.transport.kernel import KERNEL, Kernel
from zbridge.transport.link import Link, Receiver
from zbridge.transport.transferable import Parcel


async def connect(
    address: DeviceAddress, receiver: Receiver, buffer: bytearray | None = None, kernel: Kernel = KERNEL
) -> Link:
    """Connect ``receiver`` to the robot at ``address``; raise LinkError with the reason if that fails.

    buffer: receives what is read from sockets; links of one loop may share it. kernel: of this machine, or a simulated
    one.
    """
    if isinstance(address, SerialAddress):
        return serial.connect(address, receiver)
    if isinstance(address, ZenohAddress):
        from zbridge.transport import zenoh_link  # loads what only these links need

        return await zenoh_link.connect(address, receiver)
    if isinstance(address, DatagramAddress):
        return await datagram_link.connect(address, receiver, kernel)
    return await tcp.connect(address, receiver, buffer, kernel)


async def attach(
    address: DeviceAddress, state: Exported, parcel: Parcel, receiver: Receiver, kernel: Kernel = KERNEL
) -> Link:
    """Attach ``receiver`` to the connection that another process handed over; raise ProtocolError, OSError.

    Call it only after the other process has detached: reading begins at once.
    """
    if isinstance(address, SerialAddress):
        return serial.attach(address, parcel.take(state.get("serial")), receiver)
    if isinstance(address, ZenohAddress):
        raise ProtocolError("a Zenoh session stays in its process")
    if isinstance(address, DatagramAddress):
        return datagram_link.attach(state, parcel, receiver, kernel)
    return await tcp.attach(state, parcel, receiver, kernel)
