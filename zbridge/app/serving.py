"""Serves one robot for as long as this process owns it, and stands aside while another gateway serves it better.

Theory of operation. The ownership looks for other gateways, and calls :meth:`Serving.step_aside` and
:meth:`Serving.step_in`. Aside, everything that is the owner's on the bus is withdrawn: the robot's keys, the camera's,
the session table, the answer to restarts.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Awaitable, Callable, Coroutine, Iterable, Mapping
from typing import Any

from zbridge.bus import Handle
from zbridge.control.faults import FaultCode, OpenFaults
from zbridge.control.latch import LatchRecord
from zbridge.control.latch_store import LatchStore
from zbridge.errors import Held
from zbridge.log import Log
from zbridge.robot.claim import Claim, Standing
from zbridge.robot.device import RobotDevice
from zbridge.robot.ownership import Ownership

log = Log("zbridge.app.gateway")

LOG_S = 60.0
"""Seconds between two log lines about other gateways that serve the same robot."""
SERVED_ELSEWHERE = "served by another gateway"
SECOND_CONNECTION = "a second connection is open; ending that gateway makes the robot deaf"
_LISTED = 3
"""Other gateways that a log line names."""

Begin = Callable[[], Awaitable[None]]


class Serving:
    """One robot that is served; ``run`` does it.

    store: keeps what the owner says while this gateway is aside. show: declares what the owner of a robot answers
    besides the device. camera: publishes the camera's images until it is cancelled. clock: seconds.
    """

    def __init__(
        self,
        robot: str,
        device: RobotDevice,
        ownership: Ownership,
        store: LatchStore,
        open_faults: OpenFaults,
        show: Callable[[], Iterable[Handle]],
        camera: Callable[[], Coroutine[Any, Any, None]] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._robot = robot
        self._device = device
        self._ownership = ownership
        self._store = store
        self._open_faults = open_faults
        self._show = show
        self._camera = camera
        self._shown: list[Handle] = []
        self._filming: asyncio.Task[None] | None = None
        self._camera_failed: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._logged_at = -math.inf
        self._owners_record = LatchRecord()

    def __repr__(self) -> str:
        return f"<Serving {self._device!r}>"

    @property
    def state(self) -> str:
        """The state of the robot, as on ``status`` of the gateway that serves it."""
        return SERVED_ELSEWHERE if self._ownership.yielded else self._device.observed.state

    async def run(self, begin: Begin | None = None) -> None:
        """Serve until another gateway or a successor takes the robot over. begin: see :meth:`RobotDevice.run`."""
        if not self._ownership.yielded:
            self._open()
        work = (self._device.run(begin), self._ownership.watch(self), self._camera_failed)
        tasks = [asyncio.ensure_future(each) for each in work]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        finally:
            self._ownership.leave()
            for task in tasks:
                task.cancel()
            await asyncio.shield(asyncio.gather(*tasks, self._close(), return_exceptions=True))
            self._open_faults.set(FaultCode.SPLIT_CLAIMS, None)

    # What the ownership calls

    @property
    def standing(self) -> Standing:
        """How this gateway stands with the robot."""
        return self._device.standing

    @property
    def must_stay(self) -> bool:
        """Whether there is a connection to the robot that must not be closed."""
        return self._device.must_stay

    def heard(self, claims: Mapping[str, Claim]) -> None:
        """Take the latched stops of other gateways, and report them."""
        if self._ownership.yielded:
            owners = [claim.record for claim in claims.values() if not claim.yielded]
            self._owners_record = owners[0] if owners else self._owners_record
            self._store.mirror(self._owners_record)
            self._open_faults.set(FaultCode.SPLIT_CLAIMS, None)
            return
        for claim in claims.values():
            self._device.enforcer.merge(claim.record)
        self._report(claims)

    def merge(self, record: LatchRecord) -> None:
        """Take what a gateway knows that waits for this robot."""
        if not self._ownership.yielded:
            self._device.enforcer.merge(record)

    async def step_aside(self) -> None:
        """Stop the robot, and leave it to the gateway with the better claim."""
        await self._device.step_aside()
        await self._close()

    async def step_in(self) -> None:
        """Serve the robot again, with the latched stops of the gateway that served it meanwhile."""
        self._device.enforcer.merge(self._owners_record)
        await self._device.step_in()
        self._open()

    def _open(self) -> None:
        self._shown = list(self._show())
        if self._camera is not None:
            self._filming = asyncio.ensure_future(self._camera())
            self._filming.add_done_callback(self._on_camera)

    def _on_camera(self, task: asyncio.Task[None]) -> None:
        """End the whole gateway with what the camera's part raised."""
        if not task.cancelled() and (error := task.exception()) is not None and not self._camera_failed.done():
            self._camera_failed.set_exception(error)

    async def _close(self) -> None:
        while self._shown:
            self._shown.pop().close()
        filming, self._filming = self._filming, None
        if filming is not None:
            filming.cancel()
            await asyncio.gather(filming, return_exceptions=True)

    def _report(self, claims: Mapping[str, Claim]) -> None:
        """Show other gateways: on ``status`` always, on ``control`` and in the log every LOG_S."""
        zids = [zid for zid, claim in claims.items() if not claim.yielded]
        more = f" and {len(zids) - _LISTED} more" if len(zids) > _LISTED else ""
        text = f"another gateway serves this robot too: {', '.join(zids[:_LISTED])}{more}"
        if claims and not zids:
            text = SECOND_CONNECTION
        self._open_faults.set(FaultCode.SPLIT_CLAIMS, text if claims else None)
        if claims and self._clock() - self._logged_at >= LOG_S:
            self._logged_at = self._clock()
            log.error("robot_contested", "{robot}: {reason}", robot=self._robot, reason=text)
            for zid in zids[:_LISTED]:
                self._device.enforcer.authority.refuse("claim", Held("this gateway serves the robot"), zid)
                self._device.enforcer.settle()
