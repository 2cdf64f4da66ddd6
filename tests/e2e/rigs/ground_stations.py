"""A simulated robot that tells how it really moves, its gateway with listeners for ground stations, and their programs.

The robot lives on a thread of the test; MAVSDK is a process of its own (:mod:`tests.e2e.rigs.mavsdk_operator`).
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import socket
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

from tests.e2e.conftest import HOST, WAIT_S, Bench, device, until
from tests.e2e.rigs.processes import Part, module
from tests.machine import Withheld
from tests.ports import free_port
from zbridge.protocol.address import Address
from zbridge.protocol.plugin import Simulation, Truth, find_protocol

SYSTEM = 7
FULL_M_S, FULL_RAD_S = 0.5, 1.0
"""The speed and the yaw rate that the listeners take for full scale."""
WHEELS = f"""
[device.options.differential]
left = ["left wheel"]
right = ["right wheel"]
wheel_radius_m = 0.05
track_m = 0.3
speed_full_m_s = {FULL_M_S}
turn_full_rad_s = {FULL_RAD_S}
"""
DEVICES = {
    "alf": "",
    "mavlink": f'arm = "drive"\nspeed_full_m_s = {FULL_M_S}\nturn_full_rad_s = {FULL_RAD_S}',
    "ros2": f"speed_full_mps = {FULL_M_S}\nturn_full_radps = {FULL_RAD_S}",
    "tcpudp": "",
    "wc2ec": WHEELS,
}
FASTEST_M_S = {"alf": 1.0, "mavlink": FULL_M_S, "ros2": FULL_M_S, "tcpudp": 0.5, "wc2ec": FULL_M_S}
"""What each robot really does at full scale; nobody can tell the gateway of an ALF vehicle, or a TCP/UDP robot."""
ATTEMPTS, HELD_UP_S = 3, 3.0
"""Attempts to move a robot, and seconds of each."""
REST_S = 0.3
"""Seconds that a robot must be told to stand still."""


class Moment(NamedTuple):
    """How the robot was at one moment of the monotonic clock."""

    at: float
    truth: Truth


class Motion(NamedTuple):
    """What a robot did over a while: m/s along its heading, rad/s counter-clockwise."""

    forward: float
    turn: float


class SimulatedRobot:
    """A simulated robot in the middle of its room, on a thread with a loop of its own, until it is closed."""

    def __init__(self, protocol: str) -> None:
        self.port = free_port()
        self.moments: list[Moment] = []
        self._protocol = protocol
        self.begin()

    def begin(self) -> None:
        """Begin to live, again at the same port."""
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._task: asyncio.Task[None] | None = None
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()
        assert self._ready.wait(10.0), "the simulated robot does not listen"

    def _live(self) -> None:
        async def live() -> None:
            self._task = asyncio.current_task()
            await find_protocol(self._protocol).simulate(
                Simulation(
                    (Address(HOST, self.port),),
                    ready=lambda _: self._ready.set(),
                    place=(0.0, 0.0, 0.0),
                    report=lambda truth: self.moments.append(Moment(time.monotonic(), truth)),
                )
            )

        with contextlib.suppress(asyncio.CancelledError), asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(live())

    def close(self) -> None:
        """End it; idempotent."""
        if self._thread.is_alive():
            assert self._task is not None
            self._loop.call_soon_threadsafe(self._task.cancel)
            self._thread.join()

    def motion(self, over_s: float = 0.2) -> Motion:
        """Give how it has moved since a while ago."""
        now = self.moments[-1]
        then = next(one for one in reversed(self.moments) if one.at <= now.at - over_s)
        took_s, heading = now.at - then.at, (now.truth.heading + then.truth.heading) / 2
        along = (now.truth.x - then.truth.x) * math.cos(heading) + (now.truth.y - then.truth.y) * math.sin(heading)
        turned = math.remainder(now.truth.heading - then.truth.heading, 2 * math.pi)
        return Motion(along / took_s, turned / took_s)

    def moves(self, forward: float, turn: float | None = None, *, within: float = 0.15) -> Motion | None:
        """Give its motion if it is this one (``within``: the part that may be missing, or too much); else None."""
        motion = self.motion()
        wrong = abs(motion.forward - forward) > abs(forward) * within + 0.01
        if turn is not None:
            wrong |= abs(motion.turn - turn) > abs(turn) * within + 0.02
        return None if wrong else motion

    def still(self, since: float = 0.0) -> bool:
        """Tell whether it was told to stand still for as long as REST_S, or since a moment."""
        since = since or time.monotonic() - REST_S
        return all(one.truth.neutral for one in self.moments if one.at >= since)

    def stopped(self, after: float, within_s: float) -> float:
        """Wait until it is told to stand still, and stays so; give how long after a moment it was."""
        until(self.still, within_s + REST_S + 5.0, "the robot is told to stand still")
        moved = max((number for number, one in enumerate(self.moments) if not one.truth.neutral), default=-1)
        return max(0.0, self.moments[moved + 1].at - after)


class Mavsdk:
    """One program on MAVSDK: what it has said, and the commands that it is given."""

    def __init__(self, stack: contextlib.ExitStack, url: str, *system: int) -> None:
        self.said: list[dict[str, Any]] = []
        self.part = Part(stack, *module("tests.e2e.rigs.mavsdk_operator", url, *system), heard=self._hear)

    def _hear(self, line: str) -> None:
        self.said.append(json.loads(line))

    def values(self, name: str) -> list[Any]:
        """Give everything that it has said of one name."""
        return [one[name] for one in tuple(self.said) if name in one]

    def last(self, name: str) -> Any:
        """Give what it has said last of one name, or None."""
        return (self.values(name) or [None])[-1]

    def tell(self, command: str, *numbers: float) -> None:
        """Give it a command, and do not wait."""
        self.part.say(" ".join(map(str, (command, *numbers))))

    def ask(self, command: str, *numbers: float, within_s: float = 10.0) -> dict[str, Any]:
        """Give it a command, and wait for the answer."""
        done = len(self.values("did"))
        self.tell(command, *numbers)
        until(lambda: len(self.values("did")) > done, within_s, f"{command} is answered")
        return next(one for one in reversed(self.said) if one.get("did") == command)

    def do(self, command: str, *numbers: float) -> dict[str, Any]:
        """Give it a command that must succeed; give the answer."""
        answer = self.ask(command, *numbers)
        assert answer["result"] == "SUCCESS", (answer, self.said[-10:])
        return answer

    def connected(self) -> float:
        """Wait until it is connected; give the seconds that it took."""
        until(lambda: self.values("connected"), 15.0, "MAVSDK is connected")
        seconds: float = self.last("connected")
        return seconds

    def saw(self) -> dict[str, Any]:
        """Give the last telemetry of each kind, and how many there were."""
        seen: dict[str, Any] = self.do("seen")["seen"]
        return seen

    def arm(self) -> None:
        """Arm; again while a stop is not over yet."""
        until(lambda: self.ask("arm")["result"] == "SUCCESS", what="MAVSDK arms")

    def offboard(self, forward_m_s: float, yaw_deg_s: float = 0.0) -> None:
        """Arm, and drive by setpoints; yaw clockwise."""
        self.arm()
        self.do("setpoint", forward_m_s, yaw_deg_s)
        self.do("start")


class GroundStationScene:
    """A simulated robot of a protocol, its gateway with listeners on TCP and UDP, and programs that connect to them."""

    def __init__(self, folder: Path, stack: contextlib.ExitStack, protocol: str, *more: str, options: str = "") -> None:
        self.stack, self.protocol = stack, protocol
        self.robot = SimulatedRobot(protocol)
        stack.callback(self.robot.close)
        self.bench = Bench(folder, stack)
        self.tcp, self.udp, self.spoken, self.desk = (free_port() for _ in range(4))
        to = f'to = ["udp://{HOST}:{self.desk}"]'
        parts = [
            station("tcp", f"tcp://{HOST}:{self.tcp}", options=options),
            station("udp", f"udp://{HOST}:{self.udp}", options=options),
            station("spoken", f"udp://{HOST}:{self.spoken}", to, options=options),
        ]
        self.gateway = self.bench.gateway(device(self.robot.port, protocol, DEVICES[protocol]), *parts, *more)
        self._withheld, self._pids = Withheld(), [self.gateway.process.pid]
        self.urls = {
            "tcp": f"tcpout://{HOST}:{self.tcp}",
            "udp": f"udpout://{HOST}:{self.udp}",
            "spoken": f"udpin://{HOST}:{self.desk}",
        }
        fleet = self.bench.fleet
        until(lambda: self.gateway.listens(sum(part.count("[[hq]]") for part in (*parts, *more))), 30, "listeners")
        until(lambda: fleet.state() == "established" and fleet.last("r1/control"), 30, "established")

    def mavsdk(self, link: str = "tcp", *system: int) -> Mavsdk:
        """Start a program on MAVSDK that connects by ``tcp``, ``udp``, or ``spoken``: by UDP, and we speak first."""
        program = Mavsdk(self.stack, self.urls[link], *system)
        self._pids.append(program.part.pid)
        return program

    def another(self) -> SimulatedRobot:
        """Begin another robot, r2, whose gateway speaks to the same port of the desk; its system is one more."""
        robot = SimulatedRobot(self.protocol)
        self.stack.callback(robot.close)
        said = station("two", f"udp://{HOST}:{free_port()}", f'to = ["udp://{HOST}:{self.desk}"]', system=SYSTEM + 1)
        self.bench.gateway(device(robot.port, self.protocol, DEVICES[self.protocol]), said, robot="r2")
        until(lambda: self.bench.fleet.state("r2") == "established", 30, "established")
        return robot

    @property
    def control(self) -> dict[str, Any]:
        """What the gateway shows of the lease."""
        return self.bench.fleet.last("r1/control")

    @property
    def withheld_s(self) -> float:
        """The processor time that was withheld so far from the robot, its gateway and the programs on MAVSDK."""
        return self._withheld.seconds(self._pids)

    def free(self) -> None:
        """Wait until nobody holds the robot."""
        until(lambda: self.control.get("state") in ("free", "stopped"), what="nobody holds the robot")

    def drives(self, forward: float, turn: float | None = None, *, within_s: float = WAIT_S) -> Motion:
        """Wait until the robot moves: m/s, and rad/s to the left."""
        motion = until(lambda: self.robot.moves(forward, turn), within_s, f"{forward} m/s, {turn} rad/s")
        assert motion is not None
        return motion

    def driven(self, program: Mavsdk, forward_m_s: float) -> Motion:
        """Have a program drive; begin again, as people do, where a busy machine was late and motion was held back."""
        for _ in range(ATTEMPTS):
            program.offboard(forward_m_s)
            with contextlib.suppress(AssertionError):
                return self.drives(forward_m_s, within_s=HELD_UP_S)
            if program.last("armed"):
                break
        raise AssertionError(f"the robot does not move: {program.said[-10:]}")

    def stops(self, after: float, within_s: float) -> float:
        """Wait until the robot is told to stand still, and give when; too late, but for a busy machine, is an error."""
        withheld_s = self.withheld_s
        took_s = self.robot.stopped(after, within_s)
        late_s = self.withheld_s - withheld_s
        assert took_s <= within_s + late_s, f"told to stand still after {took_s:.3f} s, not {within_s} s"
        return took_s


def station(name: str, listen: str, *lines: str, options: str = "", system: int = SYSTEM) -> str:
    """Write a listener for ground stations: more lines of it, and of its options."""
    full = (f"system_id = {system}", f"speed_full_m_s = {FULL_M_S}", f"turn_full_rad_s = {FULL_RAD_S}", options, "")
    head = ("[[hq]]", f'name = "{name}"', 'protocol = "mavlink"', f'listen = "{listen}"', *lines, "[hq.options]")
    return "\n".join((*head, *full))


class RawStation:
    """A ground station of a few lines on pymavlink, by TCP: what it was sent, and what it says, as others would not."""

    def __init__(self, stack: contextlib.ExitStack, port: int, system: int = 255, component: int = 190) -> None:
        from pymavlink.dialects.v20 import ardupilotmega as dialect

        self.received: list[Any] = []
        self._socket = stack.enter_context(socket.create_connection((HOST, port)))
        self.mav = dialect.MAVLink(self._socket.makefile("wb", buffering=0), system, component)
        self.mav.robust_parsing = True
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while data := self._socket.recv(65536):
                self.received += self.mav.parse_buffer(data) or ()

    def of(self, kind: str) -> list[Any]:
        """Give the messages of one type that it was sent."""
        return [one for one in tuple(self.received) if one.get_type() == kind]

    def command(self, number: int, *params: float) -> int:
        """Send a COMMAND_LONG; wait for its ACK, and give the result."""
        acks = len(self.of("COMMAND_ACK"))
        self.mav.command_long_send(SYSTEM, 1, number, 0, *params, *(7 - len(params)) * (0.0,))
        until(lambda: len(self.of("COMMAND_ACK")) > acks, what=f"command {number} is answered")
        result: int = self.of("COMMAND_ACK")[-1].result
        return result

    def stick(self, forward: int, right: int = 0) -> None:
        """Send one MANUAL_CONTROL, thousandths."""
        self.mav.manual_control_send(SYSTEM, 0, right, forward, 0, 0)

    @property
    def texts(self) -> list[str]:
        return [one.text for one in self.of("STATUSTEXT")]
