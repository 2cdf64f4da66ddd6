"""A fragile robot as a process of its own that tells each change of its commanded motion.

``python -m tests.e2e.moving_robot ROBOT HOST SEED``: prints its port, then a line ``AT SPEED`` (monotonic seconds,
fraction of full scale) for each change of what it last obeyed. A line on stdin, or its end, ends it; it then prints
what it noted as one JSON object. ROBOT is a name of :data:`ROBOTS`.
"""

import asyncio
import contextlib
import json
import math
import random
import socket
import struct
import sys
import time
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, NamedTuple

from gateways.alf.conformance import machine as alf_machine
from gateways.alf.conformance import parser as alf_wire
from gateways.alf.conformance.fragile_robot import FragileVehicle
from gateways.tcpudp.conformance import machine as tcpudp_machine
from gateways.tcpudp.conformance import parser as tcpudp_wire
from gateways.tcpudp.conformance.fragile_robot import FragileRobot
from gateways.wc2ec.conformance import machine as wc2ec_machine
from gateways.wc2ec.conformance import parser as wc2ec_wire
from gateways.wc2ec.conformance.fragile_robot import FragileController
from zbridge.simulation.judge import Judge

WHEEL_M, FULL_M_S = 0.05, 0.5
"""Radius of a Webots robot's wheels and its full speed; the gateway is configured with the same."""
SEND_S = 3600.0
"""A robot waits for its send as long as its kernel does: deployed ones block in it."""

HELD_UP_S = 0.1
"""Seconds of one send after which a robot's program counts as held up by it."""
GOES_ON = "on"
"""The word after the time at which such a program goes on."""

_TCPUDP = tcpudp_wire.Times(send_s=SEND_S)
_ALF = alf_wire.Times(send_s=SEND_S)
_WC2EC = wc2ec_wire.Times(send_s=SEND_S)

Tell = Callable[[float], None]
Serve = Callable[[str, int, Callable[[int], None]], Coroutine[Any, Any, None]]


class _Package(tcpudp_machine.Machine):
    """The machine of a TCP/UDP robot; tells the speed of 11, the turn of 12, and 0 for 13."""

    def __init__(self, tell: Tell, seed: int) -> None:
        super().__init__(random.Random(f"{seed} talk"))
        self._tell = tell

    def steer(self, body: bytes) -> None:
        super().steer(body)
        if len(body) == 12:
            x, y, speed = struct.unpack("<3f", body)
            self._tell(math.hypot(x, y) * speed)
        else:
            self._tell(struct.unpack("<f", body)[0] if body else 0.0)


class _Vehicle(alf_machine.Machine):
    """The machine of an ALF vehicle; tells the speed of 3, and 0 when its motor stops by itself."""

    def __init__(self, tell: Tell, seed: int) -> None:
        super().__init__(random.Random(f"{seed} machine"))
        self._tell = tell

    def obey(self, dialect: alf_wire.Dialect, fields: Sequence[int]) -> None:
        super().obey(dialect, fields)
        self._tell(fields[0] / alf_wire.FULL_PERCENT)

    def stop(self) -> None:
        super().stop()
        self._tell(0.0)


class _Wheels(wc2ec_machine.Robot):
    """The robot of a simulation; tells the speed of its fastest wheel."""

    def __init__(self, tell: Tell, seed: int) -> None:
        super().__init__(wc2ec_wire.DEFAULT["deployed"], random.Random(f"{seed} robot"), 3)
        self._tell = tell

    def set_motor(self, heard: wc2ec_wire.Heard) -> None:
        super().set_motor(heard)
        turning = [motor for motor in self.motors.values() if motor.device.kind is wc2ec_wire.Kind.ROTATIONAL]
        self._tell(max(abs(motor.velocity) for motor in turning) * WHEEL_M / FULL_M_S)


def _package(version: str, udp: bool) -> Callable[[Tell, int], tuple[Judge, Serve]]:
    def make(tell: Tell, seed: int) -> tuple[Judge, Serve]:
        robot = FragileRobot(version=version, udp=udp, seed=seed, times=_TCPUDP)
        robot.machine = _Package(tell, seed)
        return robot, robot.serve

    return make


def _vehicle(dialect: alf_wire.Dialect) -> Callable[[Tell, int], tuple[Judge, Serve]]:
    def make(tell: Tell, seed: int) -> tuple[Judge, Serve]:
        vehicle = FragileVehicle(dialect, laser=True, drive=True, seed=seed, times=_ALF, machine=_Vehicle(tell, seed))
        return vehicle, vehicle.serve

    return make


class _Controller(FragileController):
    """Tells when it goes on after its own send held it up: it sends and reads one after the other.

    Once its kernel's buffer is full it waits until that kernel tries again, which nobody else can hasten.
    """

    async def _send(self, conn: socket.socket, messages: list[bytes]) -> None:
        begun = time.monotonic()
        await super()._send(conn, messages)
        if time.monotonic() - begun > HELD_UP_S:
            print(f"{time.monotonic():.6f} {GOES_ON}", flush=True)


def _controller(tell: Tell, seed: int) -> tuple[Judge, Serve]:
    controller = _Controller("deployed", seed=seed, times=_WC2EC)
    controller.robot = _Wheels(tell, seed)
    return controller, controller.serve


class Kind(NamedTuple):
    """One kind of robot: how it is made, and what its gateway is told of it."""

    make: Callable[[Tell, int], tuple[Judge, Serve]]
    protocol: str
    version: str
    options: str = ""
    udp: bool = False


_DIFFERENTIAL = f"""dialect = "deployed"
[device.options.differential]
left = ["left wheel motor"]
right = ["right wheel motor"]
wheel_radius_m = {WHEEL_M}
track_m = 0.3
speed_full_m_s = {FULL_M_S}
turn_full_rad_s = 1.0
"""

ROBOTS = {
    **{
        f"tcpudp-{version}{'-udp' * udp}": Kind(_package(version, udp), "tcpudp", version + " UDP" * udp, udp=udp)
        for version in ("1.1", "1.2", "1.3", "1.4")
        for udp in (False, True)
    },
    "alf": Kind(_vehicle("text"), "alf", "text", 'dialect = "text"\n'),
    "alf-binary": Kind(_vehicle("binary"), "alf", "binary", 'dialect = "binary"\n'),
    "wc2ec": Kind(_controller, "wc2ec", "deployed", _DIFFERENTIAL),
}


async def main() -> None:
    name, host, seed = sys.argv[1], sys.argv[2], int(sys.argv[3])
    known = 0.0

    def tell(speed: float) -> None:
        nonlocal known
        if round(speed, 3) != known:
            known = round(speed, 3)
            print(f"{time.monotonic():.6f} {known:g}", flush=True)

    judge, serve = ROBOTS[name].make(tell, seed)
    serving = asyncio.create_task(serve(host, 0, lambda port: print(port, flush=True)))
    await asyncio.to_thread(sys.stdin.readline)
    serving.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await serving
    account: dict[str, object] = {"alive": judge.alive, "violations": judge.violations, "events": judge.events}
    account["piled"] = [kind for _, _, kind, _ in getattr(judge, "piled", ())]
    print(json.dumps(account))


if __name__ == "__main__":
    asyncio.run(main())
