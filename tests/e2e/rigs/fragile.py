"""Fragile robots, each a process of its own, so that nothing but the machine makes it late.

``python -m tests.e2e.rigs.fragile NAME HOST [OPTIONS]``: prints its port. The line ``cut`` on stdin breaks its
connection; any other ends it, and it prints what it received and what was violated as one JSON object, bytes as hex.
NAME is one of :data:`ROBOTS`. OPTIONS: more arguments of the robot's class, ``times``, ``port`` (default any), and
``tells``, as a JSON object.

A robot that ``tells`` prints a line ``AT SPEED`` (monotonic seconds, fraction of full scale) for each change of what it
last obeyed, and waits for its own sends as long as its kernel does: legacy ones block in them.
"""

import asyncio
import contextlib
import json
import math
import re
import struct
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import msgspec

from gateways.alf.conformance import parser as alf_wire
from gateways.alf.conformance.fragile_robot import FragileVehicle
from gateways.mavlink.conformance.fragile_robot import FragileRover
from gateways.mavlink.conformance.machine import GatewayAsStation
from gateways.mavlink.conformance.rover import RoverQuirks
from gateways.tcpudp.conformance import parser as tcpudp_wire
from gateways.tcpudp.conformance.fragile_robot import FragileRobot
from gateways.tcpudp.conformance.machine import Quirks
from gateways.wc2ec.conformance import parser as wc2ec_wire
from gateways.wc2ec.conformance.fragile_robot import FragileWebotsController
from tests.e2e.rigs.processes import Part, module

SEND_S = 3600.0
HELD_UP_S = 0.1
"""Seconds of one send after which a robot's program counts as held up by it."""
GOES_ON = "on"
"""The word after the time at which such a program continues."""
WHEEL_M, FULL_M_S = 0.05, 0.5
WHEELS = f"""
bounds_default = [0.0, 1000.0]
[device.options.differential]
left = ["left wheel motor"]
right = ["right wheel motor"]
wheel_radius_m = {WHEEL_M}
track_m = 0.3
speed_full_m_s = {FULL_M_S}
turn_full_rad_s = 1.0
"""
"""The options of the fragile Webots controller: 10 rad/s of both wheels are full scale."""
DRAFT = """
values = 3
pinned = ["light3"]
devices = [
  { name = "light0", number = 0 }, { name = "light1", number = 1 },
  { name = "light2", number = 2 }, { name = "light3", number = 3 },
]
"""

# The robots


class Kind(NamedTuple):
    """One kind of fragile robot; what its gateway is told of it, and the name that reports give it."""

    make: Callable[..., Any]
    protocol: str
    version: str
    options: str = ""
    udp: bool = False
    lost_s: float = math.inf
    """Seconds of silence after which the gateway may give its connection up: rovers show a HEARTBEAT each second."""
    hq: str = ""
    """Options of a listener of its protocol."""


def package(version: str, udp: bool) -> Kind:
    """Make a TCP/UDP robot; it tells the speed of 11, the turn of 12, and 0 for 13."""

    def make(tells: bool, times: dict[str, float], **options: Any) -> FragileRobot:
        times = {"send_s": SEND_S} if tells else {"part_s": 0.2, **times}
        quirks = Quirks(**{name: options.pop(name) for name in Quirks.__struct_fields__ if name in options})
        robot = FragileRobot(version=version, udp=udp, times=tcpudp_wire.RobotTimes(**times), quirks=quirks, **options)
        followed(robot.machine, "steer", told)
        return robot

    def told(body: bytes) -> float:
        values = struct.unpack(f"<{len(body) // 4}f", body)
        return math.hypot(*values[:2]) * values[2] if len(values) == 3 else sum(values)

    return Kind(make, "tcpudp", version + " UDP" * udp, udp=udp)


def vehicle(dialect: alf_wire.Dialect) -> Kind:
    """Make an ALF vehicle; it tells the speed of 3, and 0 when its motor stops by itself."""

    def make(tells: bool, times: dict[str, float], **options: Any) -> FragileVehicle:
        waits = alf_wire.AlfTimes(**{"send_s": SEND_S} if tells else {"info_s": 0.2, **times})
        robot = FragileVehicle(dialect, laser=True, drive=True, times=waits, **options)
        followed(robot.machine, "obey", lambda dialect, fields: fields[0] / alf_wire.FULL_PERCENT)
        followed(robot.machine, "stop", lambda: 0.0)
        return robot

    return Kind(make, "alf", dialect, f'dialect = "{dialect}"\n')


class _Controller(FragileWebotsController):
    """Tells when it continues after its own send held it up: it sends and reads one after the other.

    Once its kernel's buffer is full it waits until that kernel tries again, which nobody else can hasten.
    """

    async def _send(self, messages: list[bytes]) -> None:
        begun = time.monotonic()
        await super()._send(messages)
        if telling and time.monotonic() - begun > HELD_UP_S:
            print(f"{time.monotonic():.6f} {GOES_ON}", flush=True)


def controller(dialect: wc2ec_wire.Dialect, told: str) -> Kind:
    """Make a Webots controller; it tells the speed of its fastest wheel."""

    def make(tells: bool, times: dict[str, float], **options: Any) -> FragileWebotsController:
        waits = wc2ec_wire.Wc2EcTimes(**{"send_s": SEND_S} if tells else times)
        made = _Controller(dialect, times=waits, **options)

        def fastest(_: object) -> float:
            motors = [
                motor for motor in made.robot.motors.values() if motor.device.kind is wc2ec_wire.DeviceKind.ROTATIONAL
            ]
            return max(abs(motor.velocity) for motor in motors) * WHEEL_M / FULL_M_S

        followed(made.robot, "set_motor", fastest)
        return made

    return Kind(make, "wc2ec", dialect, f'dialect = "{dialect}"\n{told}')


def rover(tells: bool, times: dict[str, float], *, supervised: bool = False, **options: Any) -> FragileRover:
    """Make a rover that the first motion arms; it tells the speed that it is to reach, whatever ends it.

    supervised: its gateway may hang or die, and a supervisor stops it.
    """
    quirks = {name: options.pop(name) for name in RoverQuirks.__struct_fields__ if name in options}
    crashes = {"numbered": False, "heartbeat_s": 8.0, "motion_s": 1.5, "hold_s": 10.0}
    expected = msgspec.structs.replace(JUDGED, **crashes if supervised else {})
    made = FragileRover(expected=expected, quirks=RoverQuirks(**quirks), params={"GUID_TIMEOUT": 2.0}, **options)
    followed(made.machine, "step", lambda now: made.machine.commanded[0])
    return made


JUDGED = GatewayAsStation(arms=True, streams=frozenset({24, 74}))
"""A gateway with :data:`ARMS`, and the streams that it asks for besides those of the protocol page."""
ARMS = 'arm = "drive"\n'
ROBOTS = {
    **{
        f"tcpudp-{version}{'-udp' * udp}": package(version, udp)
        for version in ("1.1", "1.2", "1.3", "1.4")
        for udp in (False, True)
    },
    "alf": vehicle("text"),
    "alf-binary": vehicle("binary"),
    "mavlink": Kind(rover, "mavlink", "guided", ARMS, lost_s=2.0, hq="options = { system_id = 1 }"),
    "wc2ec": controller("deployed", WHEELS),
    "wc2ec-draft": controller("draft", DRAFT),
}

# What they tell

telling = False
_known = 0.0


def followed(machine: Any, name: str, speed: Callable[..., float]) -> None:
    """Tell the speed that a machine was commanded by one of its methods, each time that it is another one."""
    method = getattr(machine, name)

    def obeyed(*arguments: Any) -> None:
        global _known
        method(*arguments)
        commanded = round(speed(*arguments), 3)
        if telling and commanded != _known:
            _known = commanded
            print(f"{time.monotonic():.6f} {commanded:g}", flush=True)

    setattr(machine, name, obeyed)


async def main() -> None:
    global telling
    name, host, told = sys.argv[1:]
    options = {"tells": False, "times": {}, **json.loads(told)}
    telling, port = options["tells"], options.pop("port", 0)
    robot = ROBOTS[name].make(**options)
    serving = asyncio.create_task(robot.serve(host, port, lambda port: print(port, flush=True)))
    while await asyncio.to_thread(sys.stdin.readline) == "cut\n":
        robot.cut()
    left = serving.done()
    serving.cancel()
    await asyncio.wait([serving])
    report = {
        "violations": robot.violations,
        "events": robot.events,
        "alive": robot.alive and not getattr(robot, "stuck", False),
        "left": left,
        "moving": robot.machine.moving if hasattr(robot, "machine") else robot.robot.moving,
        **{name: [*map(shown, getattr(robot, name, ()))] for name in ("received", "misread", "piled", "ignored")},
    }
    print(json.dumps(report))


def shown(row: Any) -> list[Any]:
    return [value.hex() if isinstance(value, bytes) else value for value in row]


# For those who start them

DISTURBED = 5
"""Most runs against one robot that is disturbed each time."""
_HANDSHAKE = {3, 7}
_RARE, _RARE_S = re.compile(r"no drive command for |\d+ drive commands in "), 0.08
"""What a vehicle says of commands that are too rare, and for how long nobody may be late: 0.1 s less one period."""


def charges(violations: Iterable[str], late_s: float = 0.0) -> list[str]:
    """Give the violations that are not put down to the judge's own lateness.

    ``late_s``: the time that the machine withheld from the gateway, which excuses commands that are too rare.
    """
    mine = [text for text in violations if "(this process" not in text]
    return [text for text in mine if late_s < _RARE_S or not _RARE.search(text)]


def disturbed(report: dict[str, Any]) -> bool:
    """Tell whether a robot lost a packet of the handshake, being late itself: it understands nothing after that."""
    return any(packet_id in _HANDSHAKE for _, _, packet_id, _ in lost(report))


def lost(report: dict[str, Any]) -> list[Any]:
    """Give what the robot lost by reading late: what piled up, and what one of 1.1 or 1.2 ignored after that."""
    return [*report["piled"], *report["ignored"]]


class Fragile(Part):
    """A fragile robot that was started here."""

    def __init__(self, stack: contextlib.ExitStack, name: str, *, seed: int = 1, **options: Any) -> None:
        super().__init__(
            stack, *module("tests.e2e.rigs.fragile", name, "127.0.0.1", json.dumps({"seed": seed, **options}))
        )
        self.kind = ROBOTS[name]
        self.port = int(self.line())
        self._report: dict[str, Any] | None = None

    def ended(self) -> dict[str, Any]:
        """End it; give what it has to say. Idempotent."""
        if self._report is None:
            self.say("end")
            self._report = json.loads(self.rest()[-1])
        assert self._report is not None
        return self._report


@contextlib.contextmanager
def fragile_robot(name: str, **options: Any) -> Iterator[Fragile]:
    """Start a fragile robot for a while."""
    with contextlib.ExitStack() as stack:
        yield Fragile(stack, name, **options)


if __name__ == "__main__":
    asyncio.run(main())
