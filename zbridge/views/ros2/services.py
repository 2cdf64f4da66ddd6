"""The services of one robot: stop and latch; where driving is allowed unlatch, set_light, set_lidar and set_camera."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from zbridge.bus import Handle, IncomingQuery
from zbridge.client import Robot
from zbridge.errors import BusError, Malformed, NotReady, ProtocolError, Refused, describe
from zbridge.ros2.rmw_zenoh import SERVICES, Attachment, Kind, Node, read_attachment
from zbridge.tasks import Tasks
from zbridge.views.ros2.outlets import RosSide

TRIGGER, SET_BOOL = "std_srvs/srv/Trigger", "std_srvs/srv/SetBool"
AT_ONCE = 16
"""Calls of one robot that are carried out at the same time."""
MOST_BYTES = 64
"""Bound of a request."""
Work = Callable[[Any], Awaitable[object]]
_WITHOUT_FIELDS = (b"\x00\x01\x00\x00", b"\x00\x00\x00\x00")
"""CDR of no fields at all, in both byte orders."""


class Services:
    """Declares and answers the services of a robot. on_stop: called before the robot is stopped by a call."""

    def __init__(self, side: RosSide, node: Node, robot: Robot, *, drive: bool, on_stop: Callable[[], None]) -> None:
        self._side = side
        self._robot = robot
        self._on_stop = on_stop
        self._tasks = Tasks()
        self._handles: list[Handle] = []
        self._called = side.metrics.count("ros2_calls")
        self._refused = side.metrics.count("ros2_calls_refused")
        for name, stop in (("stop", robot.stop), ("latch", robot.latch)):
            self._serve(node, name, TRIGGER, partial(self._stop, stop))
        if drive:
            self._serve(node, "unlatch", TRIGGER, lambda _: robot.unlatch())
            switches = {"set_light": robot.set_light, "set_lidar": robot.set_lidar, "set_camera": robot.set_camera}
            for name, switch in switches.items():
                self._serve(node, name, SET_BOOL, partial(_switched, switch))

    def __repr__(self) -> str:
        return f"<Services of {self._robot.name}, {len(self._tasks)} calls>"

    def close(self) -> None:
        """Take the services back; idempotent. Calls that are on their way end unanswered."""
        while self._handles:
            self._handles.pop().close()
        self._tasks.cancel()

    def _serve(self, node: Node, name: str, type_name: str, work: Work) -> None:
        endpoint = self._side.endpoint(node, Kind.SERVER, f"{node.namespace}/{name}", type_name, SERVICES)
        handler = partial(self._call, type_name, work)
        self._handles.append(self._side.bus.answer(endpoint.key, handler, complete=True))
        self._handles.append(self._side.bus.announce(endpoint.token()))

    def _call(self, type_name: str, work: Work, query: IncomingQuery) -> None:
        self._called.value += 1
        try:
            attachment = read_attachment(query.attachment)
            if len(query.payload) > MOST_BYTES:
                raise ProtocolError(f"request of {len(query.payload)} bytes exceeds {MOST_BYTES}")
            request = self._read(type_name, query.payload)
            if len(self._tasks) >= AT_ONCE:
                raise NotReady(f"more than {AT_ONCE} calls at the same time")
        except (ProtocolError, NotReady) as error:
            self._refused.value += 1
            query.refuse(error if isinstance(error, NotReady) else Malformed(str(error)))
            return
        self._tasks.start(self._carry_out(type_name, work, request, attachment, query))

    def _read(self, type_name: str, payload: bytes) -> Any:
        """Read a request; ``None`` of one without fields, for which ROS writes a byte and dora-rs nothing."""
        if type_name == TRIGGER and payload in _WITHOUT_FIELDS:
            return None
        return self._side.types.decode(f"{type_name}_Request", payload)

    async def _carry_out(
        self, type_name: str, work: Work, request: Any, attachment: Attachment, query: IncomingQuery
    ) -> None:
        why = ""
        try:
            await work(request)
        except (Refused, BusError) as error:
            why = str(error)
        except Exception as error:  # nobody awaits this task
            why = describe(error)
        types = self._side.types
        response = types.message(f"{type_name}_Response", success=not why, message=why)
        back = Attachment(attachment.number, time.time_ns(), attachment.gid)
        query.answer(types.encode(response), back.encode())

    async def _stop(self, stop: Callable[[], Awaitable[object]], request: Any) -> None:
        self._on_stop()
        await stop()


async def _switched(switch: Callable[[bool], Awaitable[None]], request: Any) -> None:
    await switch(bool(request.data))
