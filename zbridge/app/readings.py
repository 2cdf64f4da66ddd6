"""What ``/metrics`` shows of a gateway that nothing counts: its robot's state, sessions, the lease, its event loop.

Everything here is read when somebody reads the metrics, but for the lateness of the event loop, which a timer measures.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, get_args

from zbridge.control.faults import FaultCode, OpenFaults
from zbridge.fleet.messages import RobotState
from zbridge.metrics import OTHER, Histogram, Metrics, Reading
from zbridge.protocol.session import Role, Session
from zbridge.protocol.session_table import SessionTable
from zbridge.robot.device import RobotDevice

LATENESS_S = 0.5
"""Seconds between two measurements of the event loop."""
_STATES: tuple[str, ...] = get_args(RobotState)


def session_readings(sessions: SessionTable) -> Iterator[Reading]:
    """Read the sessions that there are, what all have carried, and what waits for their peers."""
    present = Counter((each.role, each.state.value, _version(each)) for each in sessions)
    for (role, state, version), number in present.items():
        yield "sessions", {"role": role.value, "state": state, "version": version}, number
    for role, queue in ((Role.HQ, "robot_out"), (Role.ROBOT, "hq_out")):
        carried = sessions.carried(role)
        for direction in ("in", "out"):
            labels = {"role": role.value, "direction": direction}
            yield "link_bytes", labels, getattr(carried, f"bytes_{direction}")
            yield "link_frames", labels, getattr(carried, f"frames_{direction}")
        yield "queue_length", {"queue": queue}, sum(len(each.outbox) for each in sessions if each.role is role)


def _version(session: Session[Any]) -> str:
    version = session.version or ""
    return version if not version or version in session.known_versions else OTHER


def robot_readings(device: RobotDevice | None, protocol: str) -> Iterator[Reading]:
    """Read the state of a robot. device: None while another gateway serves it, or nobody does yet."""
    yield "robot_info", {"protocol": protocol}, 1
    if device is None or device.observed.aside:
        return
    for state in _STATES:
        yield "robot_state", {"state": state}, int(device.observed.state == state)
    authority = device.enforcer.authority
    yield "link_stalled", {}, int(device.observed.stalled)
    yield "lease_held", {}, int(authority.holders.current is not None)
    yield "robot_driven", {}, int(device.observed.driven)
    yield "latches", {}, len(authority.latches.in_force)


def fault_readings(open_faults: OpenFaults) -> Iterator[Reading]:
    """Read which faults are open, and how often each has opened."""
    opened = {fault.code for fault in open_faults.faults}
    for code in FaultCode:
        yield "fault_open", {"code": code}, int(code in opened)
        yield "faults", {"code": code}, open_faults.counts[code]


class LoopLateness:
    """Measures how late timers of the event loop are, from :meth:`begin` to :meth:`close`."""

    def __init__(self, metrics: Metrics) -> None:
        self._late: Histogram = metrics.histogram("event_loop_lateness_seconds")
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<LoopLateness {self._late!r}>"

    def begin(self) -> Callable[[], None]:
        """Start measuring; return what ends it."""
        self._wait()
        return self.close

    def close(self) -> None:
        """Measure no more; idempotent."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _wait(self) -> None:
        due = self._loop.time() + LATENESS_S
        self._timer = self._loop.call_at(due, self._on_time, due)

    def _on_time(self, due: float) -> None:
        self._late.observe(max(0.0, self._loop.time() - due))
        self._wait()
