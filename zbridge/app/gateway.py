"""One gateway process, from its plan to its end. Knows no protocol.

Theory of operation. The gateway tries to open the bus until that succeeds. Then it runs its listeners. The device side
runs only while this process owns the robot (:class:`Ownership`), and waits while another gateway does. An exception of
one part ends all others; each part takes leave of its peers before the bus is closed.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
from collections.abc import Coroutine, Iterator
from functools import partial
from typing import Any

import msgspec

from zbridge.app.black_box import BoxServer, open_black_box
from zbridge.app.config import GatewayPlan
from zbridge.app.endpoint import serve_metrics
from zbridge.app.handover import ClaimPart, ColdStart, Incoming, Restarts, Successor
from zbridge.app.joining import SessionUseless, watch_certificate, watch_session
from zbridge.app.readings import LoopLateness, fault_readings, robot_readings, session_readings
from zbridge.app.runtime import RUNTIME, Runtime, open_audit
from zbridge.app.serving import SERVED_ELSEWHERE, Begin, Serving
from zbridge.app.stats import GatewayStats, StatsPublisher, disks_of
from zbridge.blackbox import BlackBox
from zbridge.bus import Bus, Handle, IncomingQuery
from zbridge.bus.tls.files import own_certificate, own_name
from zbridge.control.audit_log import Audit
from zbridge.control.authority import Authority
from zbridge.control.context import ProtocolFaults, RobotContext
from zbridge.control.faults import FaultCode, OpenFaults
from zbridge.control.latch_store import LatchStore
from zbridge.control.motion_limits import MotionLimits
from zbridge.errors import ZbridgeError, describe
from zbridge.fleet import payload as payloads
from zbridge.fleet import topics
from zbridge.fleet.processes import Sessions
from zbridge.fleet.topics import KeySpace
from zbridge.hq import Listener, RobotSubscription
from zbridge.hq.names import listener_names, process_name
from zbridge.log import Log
from zbridge.metrics import Metrics, Reading
from zbridge.protocol.address import Address
from zbridge.protocol.kept import Exported
from zbridge.protocol.session_table import SessionTable
from zbridge.robot.connection import LinkSettings
from zbridge.robot.device import ControlParts, RobotDevice
from zbridge.robot.observer import Observer
from zbridge.robot.ownership import Ownership
from zbridge.robot.settings import DevicePlan
from zbridge.robot.wire_tap import recording
from zbridge.tasks import together, until
from zbridge.transport import Parcel, attach, connect
from zbridge.transport.reading import FairShare

log = Log("zbridge.app.gateway")

LINGER_S = 0.2
"""Seconds between a handover and the end of the bus session: closing it drops what Zenoh has not yet sent."""


def robot_metrics(plan: GatewayPlan, metrics: Metrics) -> Metrics:
    """Return the part of a process's metrics that a robot's gateway has: all have its realm and name as labels."""
    return metrics.labelled(realm=plan.config.robot.realm, robot=plan.config.robot.name)


class Neighbourhood(msgspec.Struct, frozen=True):
    """What a gateway shares with others of its process.

    part: the part of the processor that its robot may use in the long run. buffer: all links of the loop read into it.
    """

    part: float
    buffer: bytearray


class Gateway:
    """A gateway of one robot: its device side, its listeners, or both, as the plan says.

    metrics, sessions, open_faults: of this gateway, shared by all parts. observer: a supervisor, notified of the
    robot's links. predecessor: the channel to the gateway that hands over to this one. successor: starts the process
    that this one hands over to. runtime: clocks, processes and sockets of the machine. died: how the process before
    this one ended, if it did not end in order.
    """

    def __init__(
        self,
        plan: GatewayPlan,
        metrics: Metrics | None = None,
        *,
        observer: Observer | None = None,
        predecessor: socket.socket | None = None,
        successor: Successor | None = None,
        runtime: Runtime = RUNTIME,
        died: tuple[FaultCode, str] | None = None,
    ) -> None:
        self._plan = plan
        self._died = died
        self._box: BlackBox | None = None
        self._runtime = runtime
        self._observer = observer
        self._keys = KeySpace(plan.config.robot.realm, plan.config.robot.name)
        self._incoming = (
            Incoming(predecessor, plan.setup, supervised=observer is not None, processes=runtime.processes)
            if predecessor is not None
            else ColdStart()
        )
        self.restarts = Restarts(
            plan, self._keys, self._incoming, successor, runtime.clock, runtime.processes, runtime.kernel
        )
        """What is handed to a successor, and how."""
        self.left = True
        """Whether the bus was closed in order; if not, one of its threads may hang."""
        self.metrics = metrics or robot_metrics(plan, Metrics())
        self.sessions = SessionTable()
        self.open_faults = OpenFaults(clock=runtime.clock, clock_ns=runtime.clock_ns)
        self._own = own_name(plan.config.bus.tls)
        """The name in our certificate."""
        self._process = "gateway"
        """The name of this process on the bus, while it does not serve the robot."""
        self._neighbourhood: Neighbourhood | None = None
        self._on_the_bus = False
        self._serving: Serving | None = None
        self._stats: GatewayStats

    def __repr__(self) -> str:
        return f"<Gateway {self._plan.config.robot.name}>"

    async def run(self) -> None:
        """Serve the robot and its HQ programs until cancelled; then stop the robot and close the bus.

        Returns if everything was handed to a successor. Raises HandoverError if the predecessor hands over nothing.
        """
        with self._open_files(alone=True) as audit:
            while True:
                bus = await self._runtime.join(self._plan, self.metrics)
                try:
                    await self._run(bus, audit)
                    return
                except SessionUseless as error:
                    self._incoming = ColdStart()
                    log.error("session_useless", "{reason}", reason=error)
                except Exception as error:
                    if not self._incoming.begun.is_set():
                        self._incoming.fail(str(error) if isinstance(error, ZbridgeError) else describe(error))
                    raise
                finally:
                    if self.restarts.gone.is_set():  # what was published last is still on its way
                        await asyncio.sleep(LINGER_S)
                    self.left = await bus.close()

    async def run_on(self, bus: Bus, neighbourhood: Neighbourhood | None = None) -> None:
        """Do the same on a bus and with metrics that the caller opens and closes.

        neighbourhood: None if the process serves this robot only.
        """
        self._neighbourhood = neighbourhood
        with self._open_files(alone=neighbourhood is None) as audit:
            await self._run(bus, audit, alone=False)

    @contextlib.contextmanager
    def _open_files(self, *, alone: bool) -> Iterator[Audit]:
        """Open what the gateway writes: the audit log, and the black box. alone: the process serves this robot only."""
        folder = self._runtime.folder
        with (
            open_audit(self._plan, self.metrics, self.open_faults) as audit,
            open_black_box(self._plan, self._keys, self.open_faults, folder, alone=alone) as self._box,
        ):
            yield audit

    async def _run(self, bus: Bus, audit: Audit, *, alone: bool = True) -> None:
        """Run all parts. alone: the bus and the metrics are this gateway's own."""
        await self._incoming.receive()
        async with contextlib.AsyncExitStack() as stack:
            stack.callback(bus.watch_connected(self._on_bus).close)
            stack.callback(self.metrics.add_source(self._readings))
            if alone:
                stack.callback(self.metrics.add_source(self._runtime.usage.readings))
                stack.callback(LoopLateness(self.metrics).begin())
            robot = RobotSubscription(bus, self._keys, self.metrics)
            listeners = self._listeners(bus, robot)
            self._stats = self._read_stats(listeners)
            work: list[Coroutine[Any, Any, None]] = [each.run(self._incoming.part_restored) for each in listeners]
            self.restarts.listeners = [listener.handover for listener in listeners]
            certificate = own_certificate(self._plan.config.bus.tls)
            if work:
                robot.open()
                stack.callback(robot.close)
            if certificate is not None:
                work.append(watch_certificate(certificate, bus, self.open_faults))
            if self._plan.device is not None:
                work.append(self._robot(bus, audit, self._plan.device))
            else:
                stack.callback(self._show_sessions(bus, self._process).close)
            if alone and self._plan.metrics is not None:
                work.append(self._serve_metrics(self._plan.metrics))
            if alone and self._plan.config.bus.effective_mode == "client":
                work.append(watch_session(self._plan, bus, self._runtime.can_connect))
            await until(self.restarts.gone, together(*work, first=self.restarts.settle))

    async def _serve_metrics(self, address: Address) -> None:
        """Serve the counters, once the predecessor has released them."""
        await self._incoming.begun.wait()
        sockets = [self._runtime.kernel.adopt(self._incoming.parcel.take(n)) for n in self._incoming.state.metrics]
        async with serve_metrics(address, self.metrics, self.missing, sockets) as self.restarts.metrics_sockets:
            await asyncio.Event().wait()

    def _listeners(self, bus: Bus, robot: RobotSubscription) -> list[Listener]:
        plans, incoming = self._plan.listeners, self._incoming
        names = listener_names(plans, self._own, bus.zid)
        self._process = process_name(names, self._own, bus.zid) if names else "gateway"
        exported: list[tuple[Exported, Parcel] | None] = [None] * len(plans)
        if incoming.state.listeners:  # a gateway that died hands over none: bind them again
            exported = [(each, incoming.parcel) for each in incoming.state.listeners]
        return [
            Listener(
                plan,
                each[0]["name"] if each and plan.settings.name is None else name,
                robot,
                self.sessions,
                self.metrics,
                self._runtime,
                each,
                self._runtime.kernel,
            )
            for plan, name, each in zip(plans, names, exported, strict=True)
        ]

    def _read_stats(self, listeners: list[Listener]) -> GatewayStats:
        runtime, robot = self._runtime, self._keys.robot
        usage = runtime.usage
        usage.disks[robot] = disks_of(self._plan, runtime.folder)
        return GatewayStats(robot, self.metrics, usage, listeners, runtime.clock, runtime.clock_ns)

    def _readings(self) -> Iterator[Reading]:
        yield "bus_connected", {}, int(self._on_the_bus or self._plan.config.bus.alone_is_normal)
        yield from session_readings(self.sessions)
        if self._plan.device is not None:
            yield from robot_readings(self.restarts.device, self._plan.device.protocol.name)
            yield from fault_readings(self.open_faults)
            yield from self._box.readings() if self._box is not None else ()

    def missing(self) -> tuple[str, ...]:
        """Return why this gateway cannot serve its robot now: no bus, or the robot is not established."""
        reasons = [] if self._on_the_bus or self._plan.config.bus.alone_is_normal else ["no bus"]
        if self._plan.device is not None:
            state = self._serving.state if self._serving is not None else SERVED_ELSEWHERE
            reasons += [f"robot {state}"] * (state != "established")
        return tuple(reasons)

    def _on_bus(self, connected: bool) -> None:
        self._on_the_bus = connected

    async def _robot(self, bus: Bus, audit: Audit, plan: DevicePlan) -> None:
        """Serve the robot whenever no other gateway does."""
        store = LatchStore(self._keys, self.open_faults, self._runtime.folder)
        store.load()  # the gateway that serves the robot is sent its contents
        clock, chance = self._runtime.clock, self._runtime.chance
        ownership = Ownership(
            bus, self._keys, clock, mirror=store.mirror, record=lambda: store.known.record, chance=chance
        )
        incoming, state = self._incoming, self._incoming.state
        self.restarts.claim = claim = ClaimPart(ownership, store)
        try:
            bus.gather(self._keys.key("@rpc/**"))
            if state.device is not None and state.claim:
                await claim.restore(state.claim, incoming.parcel)
                device = self._make_device(bus, audit, plan, store)
                await device.restore(state.device, incoming.parcel, state.partials)

                async def begin() -> None:
                    await incoming.part_restored()
                    await claim.resume()
                    device.enforcer.restore(store.load())  # one that came last is only in the file
                    self._begin_recording(device)

                await self._serve(bus, ownership, device, store, begin)
            elif not state.listeners:
                await incoming.finish()
            await incoming.begun.wait()
            while True:
                shown = self._show_sessions(bus, self._process) if self._plan.listeners else None
                await ownership.take()
                if shown is not None:
                    shown.close()
                await self._serve(bus, ownership, self._make_device(bus, audit, plan, store), store)
        finally:
            ownership.release()
            await asyncio.shield(store.flush())

    def _show_sessions(self, bus: Bus, who: str) -> Handle:
        """Answer queries for the session table of this process; ``who`` names the process."""

        def answer(question: IncomingQuery) -> None:
            question.answer(self._session_table(of_listeners=who != "gateway"))

        return bus.answer(self._keys.key(topics.RPC_SESSIONS(who).path), answer)

    def _session_table(self, *, of_listeners: bool = False) -> bytes:
        table = Sessions(self.sessions.snapshots(), stamp_ns=self._runtime.clock_ns())
        if of_listeners:
            process, listeners = self._stats.process(), self._stats.listeners()
            table = msgspec.structs.replace(table, process=process, listeners=listeners)
        return payloads.encode(table)

    async def _serve(
        self, bus: Bus, ownership: Ownership, device: RobotDevice, store: LatchStore, begin: Begin | None = None
    ) -> None:
        """Serve the robot, and its camera, until another gateway takes it over."""
        self.restarts.device, camera = device, None
        if self._plan.camera is not None:
            from zbridge.camera.camera import Camera

            camera = Camera(self._plan.camera, self._keys, bus, self.metrics, self.open_faults).run

        def show() -> tuple[Handle, ...]:
            stats = StatsPublisher(bus, self._keys, self._stats)
            box = () if self._box is None else (BoxServer(bus, self._keys, self._box, self._runtime.clock),)
            return (self._show_sessions(bus, "gateway"), self.restarts.answer(bus), stats, *box)

        self._serving = Serving(
            self._keys.robot, device, ownership, store, self.open_faults, show, camera, self._runtime.clock
        )

        if begin is None:  # else this process may still be given up for the one before it
            self._begin_recording(device)
        try:
            await self._serving.run(begin)
        finally:
            self.restarts.device = self._serving = None
            if self._box is not None:
                self._box.snapshot = tuple

    def _begin_recording(self, device: RobotDevice) -> None:
        """Begin the black box, and note how the process before this one ended."""
        if self._box is not None:
            sessions = self._keys.key(topics.RPC_SESSIONS("gateway").path)
            self._box.snapshot = lambda: [*device.publishers.states(), (sessions, self._session_table())]
            self._box.begin()
        died, self._died = self._died, None
        if died is not None:
            self.open_faults.happened(*died)

    def _authority(self, store: LatchStore) -> Authority:
        control, bus = self._plan.config.control, self._plan.config.bus
        return Authority(
            control.lease_s,
            control.deadman_s,
            self._runtime.secret,
            control.max_age_s,
            store.load(),
            alone_is_normal=bus.alone_is_normal,
        )

    def _make_device(self, bus: Bus, audit: Audit, plan: DevicePlan, store: LatchStore) -> RobotDevice:
        near, runtime = self._neighbourhood, self._runtime
        control = self._plan.config.control
        limited = control.rate_hz is not None or control.slew_per_s is not None
        limits = MotionLimits(control.rate_hz or math.inf, control.slew_per_s or math.inf) if limited else None
        return RobotDevice(
            RobotContext(
                plan.make_robot(self.metrics),
                self._keys,
                bus,
                self.metrics,
                self.open_faults,
                ProtocolFaults(self._keys.robot),
                clock=runtime.clock,
                clock_ns=runtime.clock_ns,
                raw_ms=runtime.raw_ms,
                suspended_s=runtime.suspended_s,
                box=self._box,
            ),
            plan.protocol.name,
            LinkSettings(
                addresses=plan.addresses,
                sessions=self.sessions,
                connect=partial(connect, buffer=near.buffer if near is not None else None, kernel=runtime.kernel),
                attach=partial(attach, kernel=runtime.kernel),
                chance=runtime.chance,
                share=FairShare(near.part) if near is not None else None,
                shared=plan.shares,
                tap=partial(recording, self._box, self._keys),
            ),
            ControlParts(
                authority=self._authority(store),
                audit=audit,
                limits=limits,
                idle_stop_s=control.idle_stop_s,
                save=store.save,
            ),
            self._observer,
        )
