"""One listener for external controllers: its clients, and what it shows and understands. Sans-IO.

Source: "The gateway as Webots controller" and the dialects of the protocol page.
"""

from __future__ import annotations

from typing import Any, ClassVar

import msgspec

from gateways.wc2ec.hq.client import HqClient
from gateways.wc2ec.hq.commands import Commands
from gateways.wc2ec.hq.device_table import DeviceTable
from gateways.wc2ec.hq.display import Display
from gateways.wc2ec.hq.options import HqOptions
from gateways.wc2ec.hq.sectors import SectorSensors
from gateways.wc2ec.messages import MAX_FRAME, Dialect, Wc2EcMessage
from gateways.wc2ec.translate import NAME
from zbridge.fleet import topics
from zbridge.fleet.messages import FleetMessage
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.protocol import ATTEND_S, HqSide, Limits, Metrics, RobotUser, Send, Telemetry

DEADMAN_S = 0.5


class Wc2EcHq(HqSide):
    """One listener."""

    name = NAME
    hands_over = True
    kept: ClassVar[dict[str, Any]] = {"_table": DeviceTable}
    deadman_s = DEADMAN_S

    def __init__(self, options: HqOptions, view: RobotView, metrics: Metrics | None = None) -> None:
        self.options = options
        self.view = view
        self._dialect = Dialect(options.dialect)
        self._draft = self._dialect is Dialect.DRAFT
        self.follows = ("scan",) if self._draft else ("scan", "scanner", "devices", "sensor/*")
        self._sessions: list[HqClient] = []
        sectors = SectorSensors(options.sectors, options.sector_unit_m)
        left_out = (metrics or Metrics()).count("hq_devices_left_out")
        self._table = DeviceTable(options, view, sectors, self._registered, left_out)
        self._display = Display(self._dialect, view, self._table, sectors)
        self._commands = Commands(options, view, self._table)

    # Clients

    def session(self, number: int, bounds: Limits) -> HqClient:
        self._sessions = [session for session in self._sessions if not session.over]
        session = HqClient(
            self._dialect,
            values=self.options.values,
            bounds=msgspec.structs.replace(bounds, frame_bytes=MAX_FRAME),
        )
        self._sessions.append(session)
        return session

    def begin(self, session: HqClient, now: float) -> None:
        self._table.learn()
        self._display.register(session, now)

    def attend(self, client: RobotUser) -> None:
        """Repeat what a controller set, as it sets a velocity once, until its machine falls silent (``hold``)."""
        if self.options.hold:
            if client.silent_s > self.deadman_s - ATTEND_S:
                client.let_go("the connection is silent")
            else:
                client.repeat()

    def _registered(self) -> set[int]:
        """Return the numbers of the devices that some controller knows."""
        return set[int]().union(*(session.registered for session in self._sessions if not session.over))

    # What is shown

    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        return self._display.show(topic, message)

    def presence(self, there: bool) -> Send | None:
        return self._display.presence(there)

    def wanted(self) -> tuple[Topic, ...]:
        """List the sensors that some controller has enabled; controllers of the draft get no others."""
        if not self._draft:
            return ()
        enabled = set().union(*(session.enabled for session in self._sessions if not session.over))
        return tuple(topics.SENSOR(self._table.by_number[number].name) for number in sorted(enabled))

    # What is understood

    def take(self, session: HqClient, message: Wc2EcMessage) -> tuple[Telemetry, ...]:
        return self._commands.take(session, message)

    def deadline(self, session: HqClient) -> float:
        return session.joined_at

    def expire(self, session: HqClient, now: float) -> tuple[Telemetry, ...]:
        return self._commands.expire(session, now)
