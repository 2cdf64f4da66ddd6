"""MAVLink 2, message set ``common`` of ArduPilot: ground rovers and boats, and ground stations.

``frames``, ``messages`` and ``numbers`` are the wire, ``session`` what both roles share, ``texts`` STATUSTEXT. In
``rover`` the gateway is the ground station of an ArduRover, in ``station`` an ArduRover for ground stations.
``simulator`` is a simulated rover; ``conformance`` has peers as fragile as deployed ones, which share no code with the
rest.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, cast, get_args

from gateways.mavlink.frames import HEADER, MARKER, frame_end, frame_of, read_frame, write_frame
from gateways.mavlink.messages import MESSAGES, MavlinkMessage, control, telemetry
from gateways.mavlink.rover.advice import ADVICE
from gateways.mavlink.rover.options import RoverOptions
from gateways.mavlink.station.options import MavlinkHqOptions
from zbridge.fleet.messages import Drive
from zbridge.fleet.view import RobotView
from zbridge.protocol import (
    Codec,
    ConfigError,
    Example,
    HqSide,
    HqSimulation,
    Metrics,
    Protocol,
    ProtocolError,
    RobotSide,
    Simulation,
)

TEMPLATE = """\
[device]
protocol = "mavlink"
connect = ["tcp://127.0.0.1:5760"]      # or "serial:///dev/ttyUSB0?baud=57600"; "udp://HOST:14550": we speak first;
                                        # "udp-in://0.0.0.0:14550": the vehicle does

[device.options]
system_id = 255                         # ours; sticks count only from the rover's MAV_GCS_SYSID
# component_id = 190                    # ours
# vehicle_id = 1                        # the rover's; left out: the first rover or boat on the link
drive = "guided"                        # setpoints in mode GUIDED; "manual": sticks in mode MANUAL, without a GPS
arm = "operator"                        # who arms it; "drive": the first motion does
speed_full_m_s = 1.0                    # the speed of a drive of 1; WP_SPEED of the rover limits it
turn_full_rad_s = 1.0                   # the turn of a drive of 1
# position_hz = 5.0                     # how often position and attitude are asked for; 0: never
# ranges_hz = 5.0                       # distances; a radio of 57600 baud carries few
# status_hz = 1.0                       # battery and fix
"""
HQ_TEMPLATE = """\
protocol = "mavlink"
listen = "tcp://127.0.0.1:5762"         # or "udp://0.0.0.0:14550", with to = ["udp://HOST:14550"] for
                                        # stations that wait until a vehicle speaks
[hq.options]
system_id = 1                           # 1 to 250, of this robot alone: ground stations take two of one id for one
kind = "rover"                          # or "boat"
speed_full_m_s = 1.0                    # the speed of a drive of 1, for setpoints
turn_full_rad_s = 1.0                   # the turn of a drive of 1
# origin = { latitude = 48.2, longitude = 11.6, altitude = 0.0, compass = 90.0 }   # of the map; compass: of its +x
dead = 60                               # thousandths of a stick that are zero
stale_s = 0.0                           # ends motion that has not changed for so long; 0: never
"""


def _read(frame: bytes) -> MavlinkMessage:
    found = read_frame(frame)
    if found.message is None:
        raise ProtocolError(f"message {found.message_id} is not declared")
    return found.message


def _seal(frame: bytes) -> bytes:
    """Make a damaged frame whole: its marker, flags, length and checksum."""
    head = frame[:HEADER].ljust(HEADER, b"\0")
    message_id = int.from_bytes(head[7:10], "little")
    if message_id not in MESSAGES:
        return bytes((MARKER,)) + frame[1:]
    payload = frame[HEADER:-2][:255]
    return frame_of(message_id, payload, MESSAGES[message_id].crc_extra, head[4], head[5], head[6])


def _codec(name: str, system: int, component: int) -> Codec:
    messages = tuple(spec.message for spec in MESSAGES.values())
    write = partial(write_frame, seq=0, system=system, component=component)
    return Codec(name, write, _read, frame_end, messages, _seal)


def _robot(options: RoverOptions, links: int, metrics: Metrics) -> RobotSide:
    from gateways.mavlink.rover.translate import RoverRobot  # loads numpy

    return RoverRobot(options, links, metrics)


def _hq(options: MavlinkHqOptions, view: RobotView, metrics: Metrics) -> HqSide:
    from gateways.mavlink.station.hq import MavlinkHq  # loads numpy

    return MavlinkHq(options, view, metrics)


async def _simulate(simulation: Simulation) -> None:
    if simulation.fragile:
        from gateways.mavlink.conformance.fragile_robot import FragileRover

        await FragileRover(seed=simulation.seed).simulate(simulation.addresses, simulation.ready)
    else:
        from gateways.mavlink.simulator import simulate

        await simulate(simulation)


async def _simulate_hq(simulation: HqSimulation) -> None:
    from gateways.mavlink.conformance.fragile_hq import FragileStation
    from gateways.mavlink.conformance.programs import Program

    program, programs = simulation.dialect or "mavproxy", get_args(Program)
    if program not in programs:
        raise ConfigError(f"dialect {program!r}: expected one of {', '.join(programs)}")
    if simulation.version is not None or simulation.udp:
        raise ConfigError("ground stations have no versions, and no datagrams beside TCP")
    station = FragileStation(cast(Program, program))
    await station.simulate(simulation.address.host, simulation.address.port, simulation.drive)


def _example(codec: str, frame: str, message: MavlinkMessage, /, source: str = "pymavlink", **more: Any) -> Example:
    return Example(codec, bytes.fromhex(frame), message, source=source, **more)


_PAGE = "the protocol page"
_SETPOINT = control.SetPositionTargetLocalNed(
    vx=0.5, yaw_rate=-0.25, type_mask=0x5C7, target_system=1, target_component=1, coordinate_frame=8
)
_HOLD = control.CommandLong(1.0, 4.0, command=176, target_system=1, target_component=1)
_ATTITUDE = "fd1c00000001011e0000e803000000000000000000000000003f0000000000000000000080bef8b5"
_CELLS = telemetry.BatteryStatus(voltages=b"\xe0\x2e" + b"\xff" * 18, current_battery=150, battery_remaining=80)
EXAMPLES = (
    _example(
        "rover",
        "fd0900000001010000000f0000000a03c10403ac7c",
        telemetry.MavlinkHeartbeat(15, 10, 3, 0xC1, 4, 3),
        _PAGE,
        shown={"sensor/armed.value": 1.0},
    ),
    _example(
        "station",
        "fd0b000000ffbe450000000006fff401000000000146e7",
        control.ManualControl(y=-250, z=500, target=1),
        _PAGE,
    ),
    _example(
        "station",
        "fd20000000ffbe4c00000000803f000080400000000000000000000000000000000000000000b00001010e93",
        _HOLD,
        _PAGE,
    ),
    _example(
        "station",
        "fd35000000ffbe540000000000000000000000000000000000000000003f"
        "000000000000000000000000000000000000000000000000000080bec705010108a165",
        _SETPOINT,
        command=Drive(forward=0.5, turn=0.25),
    ),
    _example("rover", _ATTITUDE, telemetry.Attitude(1000, yaw=0.5, yawspeed=-0.25), shown={"motion.gyro": 0.25}),
    _example(
        "rover",
        "fd0c0000000101200000e803000000000040000040c06905",
        telemetry.LocalPositionNed(1000, 2.0, -3.0),
        shown={"pose.x": -3.0, "pose.y": 2.0, "pose.heading": math.pi / 2 - 0.5},
        before=(bytes.fromhex(_ATTITUDE),),
    ),
    _example(
        "rover",
        "fd24000000010193000000000000000000000000e02effffffffffffffffffffffffffffffffffff960000000050da9a",
        _CELLS,
        shown={"battery.voltage": 12.0, "battery.current": -1.5, "battery.level": 0.8},
    ),
    _example(
        "rover",
        "fd0d0000000101840000000000001400bc02fa000000027241",
        telemetry.DistanceSensor(0, 20, 700, 250, orientation=2),
        shown={"sensor/distance_right.value": 2.5},
    ),
)
PROTOCOL = Protocol(
    name="mavlink",
    summary="MAVLink: rovers and boats with ArduPilot",
    options=RoverOptions,
    links=1,
    datagrams=True,
    robot=_robot,
    simulate=_simulate,
    simulated={"arm": "drive"},
    hq=_hq,
    hq_options=MavlinkHqOptions,
    simulate_hq=_simulate_hq,
    template=TEMPLATE,
    hq_template=HQ_TEMPLATE,
    codecs=(_codec("rover", 1, 1), _codec("station", 255, 190)),
    advice=ADVICE,
    examples=EXAMPLES,
    plausible={"battery.voltage": (3.0, 100.0), "battery.current": (-200.0, 200.0)},
)
