"""The restarts of one gateway: who may request one, what is handed over (also the claim), and how it is answered."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import Callable, Sequence

import msgspec

from zbridge.app.config import GatewayPlan
from zbridge.app.handover.channel import VERSION, HandoverState
from zbridge.app.handover.processes import PROCESSES, Processes, Successor
from zbridge.app.handover.sequence import Incoming, Outgoing
from zbridge.bus import Bus, Handle, IncomingQuery
from zbridge.control.admission import NameFilter
from zbridge.control.latch_store import LatchStore
from zbridge.errors import BusError, NotReady, Refused, Unsupported
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.messages import Query
from zbridge.fleet.topics import KeySpace
from zbridge.log import Log
from zbridge.protocol.kept import Budget, Exported
from zbridge.robot.device import RobotDevice
from zbridge.robot.ownership import Ownership
from zbridge.transport import Parcel, Transferable
from zbridge.transport.kernel import KERNEL, Kernel

log = Log("zbridge.app.handover")


class ClaimPart(Transferable):
    """The claim of a gateway that owns its robot, and the file of its latched stops, which the successor reads."""

    def __init__(self, ownership: Ownership, latches: LatchStore) -> None:
        self._ownership = ownership
        self._latches = latches
        self._claim: Exported | None = None
        self._withdrawn = False

    def __repr__(self) -> str:
        return f"<ClaimPart {self._ownership!r}>"

    async def prepare(self, reason: str, within_s: float) -> None:
        """Treat the successor's claim as our own, not as a rival's."""
        self._ownership.hands_over = True

    def export(self, parcel: Parcel) -> Exported:
        """Export the claim; ``{}`` if the robot is not owned. A withdrawn claim is the successor's."""
        if not self._withdrawn:
            self._claim = self._ownership.export()
        return self._claim or {}

    async def restore(self, state: Exported, parcel: Parcel) -> None:
        """Own the robot as the predecessor does, with a weak claim until :meth:`resume`."""
        self._ownership.restore(state)

    async def resume(self) -> None:
        """Own the robot: again, after the claim was withdrawn, or in place of the predecessor."""
        if self._withdrawn and self._claim is not None:
            self._ownership.restore(self._claim)
        self._ownership.hands_over = self._withdrawn = False
        self._ownership.begin()

    async def withdraw(self) -> None:
        """Leave claim and liveliness token to the successor; wait until it can read the latched stops."""
        self._withdrawn = True
        self._ownership.release()
        await self._latches.flush()
        await self._ownership.drain()


class Restarts:
    """The restarts of one gateway, which registers its parts as it makes them.

    incoming: what this gateway itself was handed. successor: starts one; None: a restart is refused. clock:
    seconds. processes, kernel: of this machine, or simulated ones.
    """

    def __init__(
        self,
        plan: GatewayPlan,
        keys: KeySpace,
        incoming: Incoming,
        successor: Successor | None,
        clock: Callable[[], float] = time.monotonic,
        processes: Processes = PROCESSES,
        kernel: Kernel = KERNEL,
    ) -> None:
        self._clock = clock
        self._processes = processes
        self._kernel = kernel
        self.listeners: Sequence[Transferable] = ()
        self.device: RobotDevice | None = None
        self.claim: ClaimPart | None = None
        self.metrics_sockets: list[socket.socket] = []
        self.gone = asyncio.Event()
        """Set when a successor serves everything: the gateway ends."""
        self._plan = plan
        self._keys = keys
        self._incoming = incoming
        self._successor = successor
        self._lock = asyncio.Lock()
        self._outgoing: Outgoing | None = None
        self._ends = False
        """Whether the gateway ends."""
        self._tasks: set[asyncio.Task[None]] = set()

    def __repr__(self) -> str:
        return f"<Restarts of {self._keys.robot}>"

    async def restart(self) -> None:
        """Hand everything to a successor and end; log the reason if that is refused."""
        with contextlib.suppress(Refused):
            await self._restart()
            self.gone.set()

    async def settle(self) -> None:
        """Start no further restart, and abort one in progress; wait until everything is taken back, or handed over.

        Await this before the parts of the gateway end: two processes must not write to one socket.
        """
        self._ends = True
        if self._outgoing is not None:
            self._outgoing.give_up()
        async with self._lock:
            return

    def deposit(self, parcel: Parcel, budget: Budget) -> HandoverState | None:
        """Return the robot's part for the successor of a gateway that dies; None if no successor could continue."""
        device = self.device.deposit(parcel, budget) if self.device is not None else None
        claim = self.claim.export(parcel) if self.claim is not None else None
        if device is None or not claim:
            return None
        return HandoverState(VERSION, self._plan.setup, len(parcel), claim=claim, device=device)

    def answer(self, bus: Bus) -> Handle:
        """Restart on request of whoever the access rules permit, and answer when done."""

        def take(question: IncomingQuery) -> None:
            task = asyncio.ensure_future(self._restart_for(question, bus))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

        return bus.answer(self._keys.key("@rpc/restart/*"), take, priority=NameFilter(self._clock))

    async def _restart_for(self, question: IncomingQuery, bus: Bus) -> None:
        try:
            if not topics.is_concrete(question.asked):
                raise Unsupported("a restart needs one robot and one name in its key")
            await self._restart()
        except Refused as refusal:
            question.refuse(refusal)
            return
        question.answer(payloads.encode(Query()))
        with contextlib.suppress(BusError):
            await bus.flush()
        self.gone.set()

    async def _restart(self) -> None:
        """Hand everything over; raise Refused with the reason, after undoing everything."""
        if self._successor is None:
            raise Unsupported("nothing starts a successor of this process")
        if self._plan.config.bus.listen:
            raise Unsupported("[bus] listen: two processes cannot listen at one endpoint; stop this one and start it")
        if self._lock.locked() or self.gone.is_set() or not self._incoming.begun.is_set():
            raise NotReady("a restart is in progress")
        if self._ends:
            raise NotReady("the gateway ends")
        async with self._lock:
            began = self._clock()
            machine = (self._processes, self._kernel)
            self._outgoing = Outgoing(self._successor, self._parts, self._describe, *machine)
            pid = await self._outgoing.run()
            took_ms = (self._clock() - began) * 1000
            log.info("handed_over", "handed over to process {pid} in {took_ms:.0f} ms", pid=pid, took_ms=took_ms)

    def _parts(self) -> list[Transferable]:
        return [part for part in (*self.listeners, self.device, self.claim) if part is not None]

    def _describe(self, parcel: Parcel) -> HandoverState:
        state = HandoverState(
            VERSION,
            self._plan.setup,
            0,
            claim=self.claim.export(parcel) if self.claim is not None else None,
            device=self.device.export(parcel) if self.device is not None else None,
            listeners=tuple(part.export(parcel) for part in self.listeners),
            metrics=tuple(parcel.put(sock.fileno()) for sock in self.metrics_sockets),
        )
        return msgspec.structs.replace(state, descriptors=len(parcel))
