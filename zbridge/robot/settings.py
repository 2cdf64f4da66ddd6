"""The settings of the robot that a gateway serves (``[device]``), and the plan made of them."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec

from zbridge.errors import FAULT, ConfigError, describe
from zbridge.metrics import Metrics
from zbridge.protocol.address import DeviceAddress
from zbridge.protocol.plugin import Protocol, RobotSide


class DeviceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """``[device]``: the robot itself.

    protocol: the robot's protocol. connect: one address for each of its links, ``tcp://host:port`` or
    ``serial:///dev/ttyUSB0?baud=57600``; if the protocol allows datagrams alone (MAVLink) also ``udp://host:port`` (the
    gateway speaks first) or ``udp-in://host:port`` (our own port: the first that sends to it is the robot).
    allow_shared_address: gateways of other robot names may connect to the same address; both must say so.
    """

    protocol: str
    connect: Annotated[tuple[str, ...], msgspec.Meta(min_length=1)]
    options: dict[str, Any] = {}
    allow_shared_address: bool = False


class DevicePlan(msgspec.Struct, frozen=True):
    """How to reach one robot: its protocol, the protocol's options, an address for each link.

    shares: whether gateways of other robot names may connect to the same addresses.
    """

    protocol: Protocol
    options: Any
    addresses: tuple[DeviceAddress, ...]
    shares: bool = False

    def make_robot(self, metrics: Metrics) -> RobotSide:
        """Make the device side; raise ConfigError if the protocol's own code cannot."""
        try:
            return self.protocol.robot(self.options, len(self.addresses), metrics)
        except Exception as error:
            raise ConfigError(f"device.protocol = {self.protocol.name!r}: {FAULT}{describe(error)}") from error
