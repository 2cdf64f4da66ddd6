"""One listener for external controllers: its clients, and what it shows them of any robot. Sans-IO.

It shows device registrations and sensor values, each encoded once for all clients. The session of a client and its
commands are in :mod:`.hq_client`, its devices in :mod:`.device_table`. Source: "Towards HQ programs" and
"Versions and dialects" of the protocol page.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, ClassVar

from gateways.wc2ec.device_table import DeviceTable, ShownDevice
from gateways.wc2ec.devices import DISTANCE
from gateways.wc2ec.hq_client import TRANSLATE, Wc2EcClient
from gateways.wc2ec.messages import SensorData, Wc2EcDialect, Wc2EcMessage, write
from gateways.wc2ec.options import Wc2EcHqOptions
from gateways.wc2ec.translate import NAME
from zbridge.fleet import topics
from zbridge.fleet.messages import Devices, FleetMessage, Reading, Scan, Scanner, Status
from zbridge.fleet.topics import Topic
from zbridge.fleet.view import RobotView
from zbridge.protocol import ATTEND_S, HqSide, Limits, Metrics, ProtocolError, RobotUser, Send, Telemetry

DEADMAN_S = 0.5
FAULT = -1.0
"""What a distance sensor shows when nothing is known: legacy controllers take it as a fault, while anything from
0 to 1000 would be a false distance ("What crashes a peer" in ``fragile-robots.md``)."""


class Wc2EcHq(HqSide):
    """One listener."""

    name = NAME
    hands_over = True
    kept: ClassVar[dict[str, Any]] = {"_table": DeviceTable}
    deadman_s = DEADMAN_S

    def __init__(self, options: Wc2EcHqOptions, view: RobotView, metrics: Metrics | None = None) -> None:
        self.options = options
        self.view = view
        self._dialect = Wc2EcDialect(options.dialect)
        self._draft = self._dialect is Wc2EcDialect.DRAFT
        self.follows = ("scan",) if self._draft else ("scan", "scanner", "devices", "sensor/*")
        self._sessions: list[Wc2EcClient] = []
        left_out = (metrics or Metrics()).count(
            "hq_devices_left_out", help="Devices that a WC2EC controller could not be shown."
        )
        self._table = DeviceTable(options, view, self._registered, left_out)
        self._frames: dict[int, tuple[float, bytes]] = {}
        """The value that was encoded last of each device."""
        self._readings_gone: dict[str, Reading] = {}
        self._scan_gone: Scan | None = None
        """The last readings and scan of a robot that was lost since: they are out of date now."""

    # Clients

    def session(self, number: int, bounds: Limits) -> Wc2EcClient:
        self._sessions = [session for session in self._sessions if not session.over]
        session = Wc2EcClient(self.options, self.view, bounds)
        self._sessions.append(session)
        return session

    def begin(self, session: Wc2EcClient, now: float) -> None:
        self._table.learn()
        self._register(session, now)

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

    def wanted(self) -> tuple[Topic, ...]:
        """List the sensors that some controller has enabled; controllers of the draft get no others."""
        if not self._draft:
            return ()
        enabled = set().union(*(session.enabled for session in self._sessions if not session.over))
        return tuple(topics.SENSOR(self._table.by_number[number].name) for number in sorted(enabled))

    # What is understood

    def take(self, session: Wc2EcClient, message: Wc2EcMessage) -> tuple[Telemetry, ...]:
        device = self._table.by_number.get(message.number)
        if device is None:
            raise ProtocolError(f"device {message.number} is not registered")
        return TRANSLATE[type(message)](session, device, message)

    def deadline(self, session: Wc2EcClient) -> float:
        return session.joined_at

    def expire(self, session: Wc2EcClient, now: float) -> tuple[Telemetry, ...]:
        return session.joined(now)

    # What is shown

    def show(self, topic: Topic, message: FleetMessage) -> Send | None:
        if isinstance(message, Reading):
            return self._reading(topics.unescape(topic.path.rpartition("/")[2]), message)
        if isinstance(message, Scan):
            return self._scan(message)
        if isinstance(message, Devices | Scanner | Status):
            before = len(self._table.by_name)
            self._table.learn()
            return self._register if len(self._table.by_name) > before else None
        return None

    def presence(self, there: bool) -> Send | None:
        """Show what is known of a robot that is there; faults for one that is lost."""
        devices = self._table.by_name.values()
        if there:
            return self._data((device, self._known(device)) for device in devices)
        self._readings_gone, self._scan_gone = dict(self.view.readings), self.view.scan
        return self._data((device, FAULT) for device in devices if device.kind == DISTANCE)

    def _register(self, session: Wc2EcClient, now: float) -> None:
        """Register the devices that the controller does not know yet; a value of each sensor follows at once."""
        table = self._table
        new = [device for device in table.by_number.values() if device.number not in session.registered]
        if new and not self._draft:
            session.outbox.put_exempt(b"".join(table.registrations[device.number] for device in new))
        session.registered.update(device.number for device in new)
        for device in new:
            value = self._first(device)
            if value is not None:
                self._queue(session, device, self._frame(device, value), now)

    def _first(self, device: ShownDevice) -> float | None:
        """Return the first value a controller gets of a sensor, which is ready only then; None for a motor."""
        if device.motor:
            return None
        known = self._known(device) if self.view.missing is None else None
        return known if known is not None else FAULT if device.kind == DISTANCE else 0.0

    def _known(self, device: ShownDevice) -> float | None:
        """Return the last value of a device since the robot is there; None if there is none."""
        reading, scan = self.view.readings.get(device.name), self.view.scan
        if reading is not None and reading is not self._readings_gone.get(device.name):
            return _shown(device, reading.value, fault=reading.fault)
        if scan is None or scan is self._scan_gone or self.view.protocol in (None, NAME):
            return None
        nearest = self._table.sectors.values(scan).get(device.name)
        return None if nearest is None else _shown(device, nearest)

    def _reading(self, name: str, message: Reading) -> Send | None:
        table = self._table
        if name not in table.by_name:
            table.learn()
        device = table.by_name.get(name)
        if device is None or self.view.missing is not None:
            return None
        return self._data(((device, _shown(device, message.value, fault=message.fault)),))

    def _scan(self, scan: Scan) -> Send | None:
        """Show a scan of a robot of another protocol as distance sensors, one for each sector."""
        if self.view.protocol in (None, NAME) or not len(scan.ranges):
            return None
        self._table.learn()
        if self.view.missing is not None:
            return None
        shown = [(self._table.by_name.get(name), value) for name, value in self._table.sectors.values(scan).items()]
        return self._data((device, _shown(device, value)) for device, value in shown if device is not None)

    def _data(self, values: Iterable[tuple[ShownDevice, float | None]]) -> Send | None:
        """Encode values once for all controllers; None if there is none."""
        frames = [(device, self._frame(device, value)) for device, value in values if value is not None]
        if not frames:
            return None

        def send(session: Wc2EcClient, now: float) -> None:
            for device, frame in frames:
                self._queue(session, device, frame, now)

        return send

    def _frame(self, device: ShownDevice, value: float) -> bytes:
        last = self._frames.get(device.number)
        if last is None or last[0] != value:
            last = (value, write(SensorData(device.type, device.number, value), self._dialect))
            self._frames[device.number] = last
        return last[1]

    def _queue(self, session: Wc2EcClient, device: ShownDevice, frame: bytes, now: float) -> None:
        """Queue a value as the newest of its device, if the controller wants it."""
        if device.number not in session.registered:
            self._register(session, now)
        if not self._draft or device.number in session.enabled:
            session.outbox.set(f"sensor {device.number}", (frame,), now)


def _shown(device: ShownDevice, value: float, *, fault: bool = False) -> float | None:
    """Return the value that a controller is shown: FAULT for a distance that is none, None for other non-numbers."""
    if device.kind == DISTANCE:
        return FAULT if fault or not math.isfinite(value) else value
    return value if math.isfinite(value) else None
