"""A person's program on MAVSDK, unmodified, in a process of its own that a scene commands by lines.

    python -m tests.e2e.rigs.mavsdk_operator URL [SYSTEM]    # tcpout://HOST:PORT, udpout://..., udpin://...

Each line on stdin is a command of :class:`Operator` with its numbers; each line on stdout a JSON object. A command is
answered by ``{"did": COMMAND, "result": WORD, ...}``, one after the other. In between come ``{"connected": SECONDS}``
since the connection was asked for, and, as they change or arrive, ``armed``, ``mode``, ``healthy``, ``link``, ``text``
and ``refused`` (the raw result of a command's COMMAND_ACK that is not ACCEPTED). The end of stdin is an orderly end.
SYSTEM says which vehicle, where several speak to one port.

MAVSDK repeats a setpoint 20 times a second by itself. It does not repeat a stick: ``stick`` does, until ``release``.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from mavsdk import log_subscribe
from mavsdk.asyncio import ComponentType, Configuration, Mavsdk, System
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.manual_control import ManualControlAsync
from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.exceptions import MavsdkError
from mavsdk.plugins.mavlink_direct import MavlinkMessage
from mavsdk.plugins.offboard import VelocityBodyYawspeed

CONNECT_S = 30.0
STICK_S = 0.05
"""Seconds between two sticks: a good minimum rate is 10 Hz, says MAVSDK."""
DO_SET_MODE, MANUAL = 176, 0


def say(**fields: Any) -> None:
    print(json.dumps(fields), flush=True)


class Operator:
    """The commands: coroutines whose arguments are numbers; what they return is said beside their result."""

    def __init__(self, system: System) -> None:
        self._system = system
        self._action, self._offboard = ActionAsync(system), OffboardAsync(system)
        self._manual, self._params = ManualControlAsync(system), ParamAsync(system)
        self._telemetry, self._direct = TelemetryAsync(system), MavlinkDirectAsync(system)
        self._seen: dict[str, Any] = {}
        self._stick: asyncio.Task[None] | None = None
        self.commands: dict[str, Callable[..., Awaitable[Any]]] = {
            "arm": self._action.arm,
            "disarm": self._action.disarm,
            "hold": self._action.hold,
            "kill": self._action.kill,
            "goto": self._action.goto_location,
            "home": self._action.return_to_launch,
            "terminate": self._action.terminate,
            "setpoint": self._setpoint,
            "start": self._offboard.start,
            "stop": self._offboard.stop,
            "manual": self._enter_manual,
            "stick": self._push,
            "release": self._release,
            "params": self._all_params,
            "rate": self._telemetry.set_rate_attitude_euler,
            "seen": self._say_seen,
        }

    def watched(self) -> tuple[Awaitable[None], ...]:
        """Give what watches the vehicle, for as long as it runs."""
        telemetry = self._telemetry
        return (
            _each(telemetry.subscribe_armed(), _changes("armed")),
            _each(telemetry.subscribe_flight_mode(), _changes("mode")),
            _each(telemetry.subscribe_health_all_ok(), _changes("healthy")),
            _each(self._system.is_connected_state(), _changes("link")),
            _each(telemetry.subscribe_status_text(), lambda one: say(text=one.text, severity=one.type.name)),
            _each(self._direct.subscribe_message("COMMAND_ACK"), _refusal),
            _each(self._direct.subscribe_message("LOCAL_POSITION_NED"), self._see("local")),
            _each(telemetry.subscribe_position(), self._see("position")),
            _each(telemetry.subscribe_attitude_euler(), self._see("attitude")),
            _each(telemetry.subscribe_velocity_ned(), self._see("velocity")),
            _each(telemetry.subscribe_battery(), self._see("battery")),
        )

    def _see(self, name: str) -> Callable[[Any], None]:
        def see(value: Any) -> None:
            fields = json.loads(value.fields_json) if isinstance(value, MavlinkMessage) else vars(value)
            numbers = {field: each for field, each in fields.items() if isinstance(each, int | float)}
            count = self._seen.get(name, {}).get("count", 0)
            self._seen[name] = {**numbers, "count": count + 1}

        return see

    async def _say_seen(self) -> dict[str, Any]:
        return {"seen": self._seen}

    async def _setpoint(self, forward_m_s: float, yaw_deg_s: float) -> None:
        """Set the velocity; yaw clockwise."""
        await self._offboard.set_velocity_body(VelocityBodyYawspeed(forward_m_s, 0.0, 0.0, yaw_deg_s))

    async def _enter_manual(self) -> dict[str, Any]:
        """Ask for the mode MANUAL: MAVSDK itself has a word for PX4's only."""
        fields = {"command": DO_SET_MODE, "param1": 1, "param2": MANUAL, "target_component": 1}
        fields["target_system"] = await self._system.get_system_id()
        message = MavlinkMessage("COMMAND_LONG", 0, 0, fields["target_system"], 1, json.dumps(fields))
        ack = await self._direct.send_command(message)
        return {"ack": json.loads(ack.fields_json)["result"]}

    async def _push(self, forward: float, right: float) -> None:
        """Push the stick, and keep it there. MAVSDK's throttle is 0 to 1, 0 at rest; its y steers to the right."""
        await self._let_go()
        self._stick = asyncio.create_task(self._hold_stick(forward, right))

    async def _hold_stick(self, forward: float, right: float) -> None:
        while True:
            await self._manual.set_manual_control_input(0.0, right, forward, 0.0)
            await asyncio.sleep(STICK_S)

    async def _let_go(self) -> None:
        if self._stick is not None:
            self._stick.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._stick
            self._stick = None

    async def _release(self) -> None:
        """Let the stick go back to the centre."""
        await self._push(0.0, 0.0)

    async def _all_params(self) -> dict[str, Any]:
        found = await self._params.get_all_params()
        return {"params": {each.name: each.value for each in (*found.int_params, *found.float_params)}}


async def _each(stream: AsyncIterator[Any], take: Callable[[Any], None]) -> None:
    async for value in stream:
        take(value)


def _changes(name: str) -> Callable[[Any], None]:
    """Say a value when it is another one."""
    last: Any = None

    def take(value: Any) -> None:
        nonlocal last
        if value != last:
            last = value
            say(**{name: getattr(value, "name", value)})

    return take


def _refusal(message: MavlinkMessage) -> None:
    fields = json.loads(message.fields_json)
    if fields["result"]:
        say(refused=fields["result"], command=fields["command"])


async def _carry_out(operator: Operator, line: str) -> None:
    name, *numbers = line.split()
    try:
        more = await operator.commands[name](*map(float, numbers))
        say(did=name, result="SUCCESS", **(more if isinstance(more, dict) else {}))
    except MavsdkError as error:
        result = getattr(error, "result", None)
        say(did=name, result=getattr(result, "name", repr(error)))


async def _lines() -> AsyncIterator[str]:
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    async for line in reader:
        yield line.decode()


async def main(url: str, number: str = "") -> None:
    """Connect, and carry out commands until stdin ends."""
    log_subscribe(lambda *_: True)  # it would be printed on stdout
    async with Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION)) as mavsdk:
        began = time.monotonic()
        await mavsdk.add_any_connection(url)
        system = await mavsdk.first_autopilot(CONNECT_S)
        while number and system is not None and await system.get_system_id() != int(number):
            await asyncio.sleep(0.05)
            system = (await mavsdk.get_systems())[-1]
        if system is None:
            sys.exit(f"no vehicle at {url}")
        say(connected=time.monotonic() - began, system=await system.get_system_id())
        operator = Operator(system)
        tasks = [asyncio.ensure_future(each) for each in operator.watched()]
        async for line in _lines():
            await _carry_out(operator, line)
        for task in tasks:
            task.cancel()


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
