"""What one session on ROS's side declares: nodes, and their publishers, each with its token, numbers and gid."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from zbridge.bus import Bus, Handle
from zbridge.errors import EncodeError
from zbridge.metrics import Metrics
from zbridge.ros2.rmw_zenoh import Attachment, Endpoint, Kind, Node, RosQoS
from zbridge.ros2.types import Types


class RosSide:
    """The session on ROS's side, and what all nodes share there. domain: of ROS."""

    def __init__(self, bus: Bus, domain: int, types: Types, metrics: Metrics) -> None:
        self.bus = bus
        self.domain = domain
        self.types = types
        self.metrics = metrics
        self._numbers = itertools.count()
        self.sent = metrics.count("ros2_sent")
        self.not_encoded = metrics.count("ros2_not_encoded")

    def node(self, namespace: str, name: str) -> Node:
        return Node(self.domain, self.bus.zid, next(self._numbers), namespace, name)

    def endpoint(self, node: Node, kind: Kind, name: str, type_name: str, qos: RosQoS) -> Endpoint:
        """Name an endpoint of a node. name: ``/r1/scan``."""
        return Endpoint(node, next(self._numbers), kind, name, type_name, self.types.hash(type_name), qos)


class Outlet:
    """One publisher. listened: called with it when the first subscriber comes (True) and the last one goes (False)."""

    def __init__(
        self, side: RosSide, endpoint: Endpoint, listened: Callable[[Outlet, bool], None], *, kept: int
    ) -> None:
        self._side = side
        self._gid = endpoint.gid()
        self._numbers = itertools.count(1)
        on_listened, best_effort = partial(listened, self), endpoint.qos.best_effort
        self._publisher = side.bus.frames(endpoint.key, on_listened, best_effort=best_effort, kept=kept)
        self._handles: tuple[Handle, ...] = (side.bus.announce(endpoint.token()), self._publisher)

    def put(self, message: Any) -> None:
        """Publish a message, or one that is CDR already; what ROS's types cannot hold is counted and left out."""
        try:
            payload = message if isinstance(message, bytes) else self._side.types.encode(message)
        except EncodeError:
            self._side.not_encoded.value += 1
            return
        attachment = Attachment(next(self._numbers), time.time_ns(), self._gid).encode()
        self._publisher.put(payload, attachment)
        self._side.sent.value += 1

    def close(self) -> None:
        """Take the publisher back; idempotent."""
        for handle in self._handles:
            handle.close()
