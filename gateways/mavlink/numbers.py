"""The numbers of MAVLink that the gateway knows by name, as the message set ``common`` and ArduRover define them."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

ROVER, BOAT, STATION = 10, 11, 6
"""Kinds of systems in HEARTBEAT."""
ARDUPILOT, PX4, NO_AUTOPILOT = 3, 12, 8
AUTOPILOT: Final = 1
"""The component of an autopilot."""
ARMED, CUSTOM_MODE = 128, 1
"""Bits of ``base_mode``."""
BODY_NED, BODY_OFFSET_NED, BODY_FRD = 8, 9, 12
"""Coordinate frames whose x is ahead of the vehicle and whose y is to its right."""
VELOCITY_AND_YAW_RATE = 0x5C7
"""``type_mask`` that ignores all but velocity and yaw rate."""
FORCE_ARM, FORCE_DISARM = 2989.0, 21196.0
"""``param2`` of ARM: without checks; in motion."""


M_PER_E7: Final = 0.011131884502145034
"""Metres of 1e-7 degrees of latitude, as ArduPilot has it."""


class RoverMode(IntEnum):
    """Modes of ArduRover, ``custom_mode``."""

    MANUAL = 0
    ACRO = 1
    STEERING = 3
    HOLD = 4
    LOITER = 5
    FOLLOW = 6
    SIMPLE = 7
    DOCK = 8
    CIRCLE = 9
    AUTO = 10
    RTL = 11
    SMART_RTL = 12
    GUIDED = 15
    INITIALISING = 16


class Command(IntEnum):
    """Commands of COMMAND_LONG and COMMAND_INT."""

    DO_SET_MODE = 176
    FLIGHT_TERMINATION = 185
    ARM = 400
    GET_HOME_POSITION = 410
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512
    REQUEST_AUTOPILOT_CAPABILITIES = 520


class Result(IntEnum):
    """The results of COMMAND_ACK."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5


class Severity(IntEnum):
    """The severities of STATUSTEXT that are sent."""

    WARNING = 4
    INFO = 6
