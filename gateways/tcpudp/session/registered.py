"""Which packets a robot has registered: any other one crashes it. Sans-IO.

Source: "The gateway as HQ" of the protocol page, unregistered packet ids.
"""

from __future__ import annotations

from collections.abc import Iterable

from gateways.tcpudp.messages import OpaquePacket, Packet
from gateways.tcpudp.settings import Feature, Settings
from zbridge.protocol import Unsupported


class Registered:
    """The packets that one robot knows. ``force``: features and packet ids that it knows without announcing them."""

    def __init__(self, force: Iterable[Feature | int]) -> None:
        self._force = frozenset(force)
        self._known: set[type[Packet]] = set()
        """Classes of packets that the robot's settings were found to allow."""

    def __repr__(self) -> str:
        return f"<Registered force={sorted(map(str, self._force))}>"

    def check(self, message: Packet, settings: Settings | None, version: str) -> None:
        """Raise Unsupported for a packet that the robot may not know, by its settings and the agreed version."""
        if type(message) in self._known:
            return
        if isinstance(message, OpaquePacket):
            if message.id not in self._force:
                raise Unsupported(f"packet {message.id} may crash the robot; list it in options.force if it knows it")
            return
        spec = message.spec
        if spec.id in self._force or not spec.features or not self._force.isdisjoint(spec.features):
            return
        # Of several features the first one that the robot's version has a flag for decides.
        feature = next((feature for feature in spec.features if hasattr(settings, feature.value)), None)
        if feature is None:
            names = " or ".join(feature.value for feature in spec.features)
            raise Unsupported(f"{spec.name}: version {version} has no {names}")
        if not getattr(settings, feature.value):
            raise Unsupported(f"{spec.name}: the robot does not announce {feature.value}")
        self._known.add(type(message))
