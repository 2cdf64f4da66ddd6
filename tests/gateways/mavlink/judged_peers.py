"""Small gateways in both roles, written by hand for the judges: right as they are, wrong where a test makes them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gateways.mavlink.conformance.machine import GatewayAsStation, StationRules
from gateways.mavlink.conformance.parser import MavlinkReader, ParsedMavlinkFrame, write_frame
from gateways.mavlink.conformance.programs import PROGRAMS, JudgedStation, Program
from gateways.mavlink.conformance.rover import JudgedRover, RoverQuirks
from gateways.mavlink.conformance.vehicle_rules import VehicleRules, VehicleTimes

STEP_S = 0.02
BEGIN_S = 100.0
ROVER, STATION = (1, 1), (255, 190)
FTP_SIZE = 251


def parsed(name: str, fields: dict[str, Any], source: tuple[int, int]) -> ParsedMavlinkFrame:
    """Write a message and read it again: its fields are as wide as on the wire."""
    (frame,) = MavlinkReader().take(write_frame(name, fields, source, 0))
    assert frame.problem == ""
    return frame


class Ground:
    """A gateway as ground station before a judged rover, in steps of 20 ms without a clock."""

    def __init__(self, expected: GatewayAsStation | None = None, quirks: RoverQuirks | None = None, **params: float):
        self.violations: list[str] = []
        self.expected = expected or GatewayAsStation()
        self.rules = StationRules(self.expected, self.violations.append)
        self.rover = JudgedRover(
            self.rules, quirks=quirks or RoverQuirks(), system_id=self.expected.vehicle_id, params=params
        )
        self.now = BEGIN_S
        self.source = self.expected.source
        self.heard: list[tuple[tuple[int, int], str, dict[str, Any]]] = []
        self.beats = True
        self._beat_due = self.now
        self.rover.connected(self.now)

    def send(self, name: str, **fields: Any) -> None:
        frame = parsed(name, fields, self.source)
        self.rules.receive(frame)
        self.rover.receive(frame)

    def command(self, number: int, *params: float, **fields: int) -> None:
        values = {f"param{at}": value for at, value in enumerate(params, 1)}
        self.send("COMMAND_LONG", **{"command": number, "target_system": 1, "target_component": 1, **values, **fields})

    def setpoint(self, forward: float, turn: float = 0.0, **fields: Any) -> None:
        right = {"coordinate_frame": 8, "type_mask": 0x5C7, "target_system": 1, "target_component": 1}
        self.send("SET_POSITION_TARGET_LOCAL_NED", vx=forward, yaw_rate=turn, **{**right, **fields})

    def stick(self, z: int, y: int = 0) -> None:
        self.send("MANUAL_CONTROL", z=z, y=y, target=1)

    def stop(self) -> None:
        self.setpoint(0.0)
        self.command(176, 1, 4)

    def shown(self, name: str) -> list[dict[str, Any]]:
        return [fields for source, each, fields in self.heard if each == name and source == ROVER]

    def wait(self, seconds: float, every: Callable[[], None] | None = None, period_s: float = 0.2) -> None:
        """Let time pass; ``every`` is called now and then each period."""
        end, due = self.now + seconds, self.now
        while self.now < end - STEP_S / 2:
            if every is not None and self.now >= due - STEP_S / 2:
                due += period_s
                every()
            self.now += STEP_S
            self.rules.step(self.now, STEP_S)
            self.rover.step(self.now)
            self.heard += [tuple(message) for message in self.rover.out]  # type: ignore[misc]
            self.rover.out.clear()
            if self.beats and len(self.shown("HEARTBEAT")) >= 2 and self.now >= self._beat_due:
                self._beat_due = self.now + 1.0
                self.send("HEARTBEAT", type=6, autopilot=8, mavlink_version=3, system_status=4)

    def drive(self, seconds: float, forward: float = 0.5, turn: float = 0.0) -> None:
        self.wait(seconds, lambda: self.setpoint(forward, turn))

    def guided(self) -> None:
        """Establish, be armed by the operator, and enter GUIDED."""
        self.wait(2.1)
        self.rover.arm()
        self.command(176, 1, 15)
        self.wait(0.1)


class Vehicle:
    """A gateway as vehicle before a judged station, in steps of 10 ms without a clock."""

    def __init__(self, program: Program = "mavsdk", **options: Any) -> None:
        self.violations: list[str] = []
        habits = PROGRAMS[program]
        self.peer = habits.source
        self.rules = VehicleRules(habits.source, VehicleTimes(), self.violations.append)
        self.station = JudgedStation(habits, self.rules, **options)
        self.now, self.mode, self.armed = BEGIN_S, 4, False
        self.source = ROVER
        self.held_by: str = ""
        """Who else holds the robot."""
        self.heard: list[tuple[float, str, dict[str, Any]]] = []
        self.beats = True
        self.deaf = False
        """Whether it answers nothing."""
        self.unasked_hz = 2.0
        self._beat_due = self._stream_due = self.now

    def send(self, name: str, **fields: Any) -> None:
        frame = parsed(name, fields, self.source)
        self.rules.receive(frame)
        self.station.receive(frame)

    def answer(self, name: str, **fields: Any) -> None:
        self.send(name, target_system=self.peer[0], target_component=self.peer[1], **fields)

    def beat(self) -> None:
        self._beat_due = self.now + 1.0
        mode = {"custom_mode": self.mode, "base_mode": 0x41 | 128 * self.armed}
        self.send("HEARTBEAT", type=10, autopilot=3, mavlink_version=3, system_status=4, **mode)

    def wait(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end - STEP_S / 4:
            self.now += STEP_S / 2
            self.rules.step(self.now, STEP_S / 2)
            self.station.step(self.now)
            for name, fields in [*self.station.out]:
                values = dict(parsed(name, dict(fields), self.peer).fields)
                self.heard.append((self.now - BEGIN_S, name, values))
                if not self.deaf:
                    self.obey(name, values)
            self.station.out.clear()
            if self.beats and self.now >= self._beat_due:
                self.beat()
            if self.beats and self.now >= self._stream_due:
                self._stream_due = self.now + 1 / self.unasked_hz
                self.send("SYS_STATUS", onboard_control_sensors_health=1 << 28)
                self.send("ATTITUDE", yaw=1.0)
                self.send("BATTERY_STATUS", battery_remaining=50)

    def obey(self, name: str, fields: dict[str, Any]) -> None:
        if name == "COMMAND_LONG":
            self.acknowledge(fields)
        elif name == "PARAM_REQUEST_LIST":
            for index in range(3):
                self.tell_parameter(index)
        elif name == "PARAM_REQUEST_READ":
            self.tell_parameter(fields["param_index"])
        elif name == "MISSION_REQUEST_LIST":
            self.answer("MISSION_COUNT", mission_type=fields["mission_type"])
        elif name == "FILE_TRANSFER_PROTOCOL":
            self.refuse_file(fields["payload"])

    def acknowledge(self, fields: dict[str, Any]) -> None:
        command, first = fields["command"], fields["param1"]
        result = self.result(command, first, fields["param2"])
        self.answer("COMMAND_ACK", command=command, result=result)
        if result == 1:
            self.send("STATUSTEXT", severity=4, text=f"{self.held_by} drives")
        elif command == 512 and not result:
            self.send({148: "AUTOPILOT_VERSION", 242: "HOME_POSITION"}[int(first)])
        elif command == 410:
            self.send("HOME_POSITION")

    def result(self, command: int, first: float, second: float) -> int:
        """Obey a command; return the result."""
        if command in (176, 400):
            stops = (command, first) == (400, 0) or (command, second) == (176, 4)
            if self.held_by and not stops:
                return 1
            if stops:
                self.armed, self.mode = False, 4
            elif command == 176:
                self.mode = int(second)
            else:
                self.armed = True
            self.beat()
            return 0
        if command == 512:
            return 0 if first in (148, 242) else 4
        return 0 if command in (410, 511) else 3

    def tell_parameter(self, index: int, **fields: Any) -> None:
        right = {"param_id": f"P{index}", "param_type": 9, "param_count": 3, "param_index": index}
        self.send("PARAM_VALUE", **{**right, **fields})

    def refuse_file(self, asked: tuple[int, ...]) -> None:
        head = [(asked[0] + 1) % 256, 0, asked[2], 129, 1, asked[3], 0, 0, 0, 0, 0, 0, 10]
        self.answer("FILE_TRANSFER_PROTOCOL", payload=tuple(head + [0] * (FTP_SIZE - len(head))))
