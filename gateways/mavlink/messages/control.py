"""Commands, parameters, sticks, and what is only answered or refused."""

from __future__ import annotations

from gateways.mavlink.messages.base import I64, U64, Bytes8, Bytes18, Bytes251, Floats4, MavlinkMessage, Name, message
from zbridge.wire import F32, I16, I32, U8, U16, U32


@message(4, 237)
class Ping(MavlinkMessage, frozen=True):
    """A question for an answer with the same number; to target 0: a question."""

    time_usec: U64 = 0
    seq: U32 = 0
    target_system: U8 = 0
    target_component: U8 = 0


@message(11, 89)
class MavlinkSetMode(MavlinkMessage, frozen=True):
    """Set the mode of a system; older than the command 176."""

    custom_mode: U32 = 0
    target_system: U8 = 0
    base_mode: U8 = 0


@message(20, 214)
class ParamRequestRead(MavlinkMessage, frozen=True):
    """Ask for one parameter, by index, or by name where the index is -1."""

    param_index: I16 = 0
    target_system: U8 = 0
    target_component: U8 = 0
    param_id: Name = bytes(16)


@message(21, 159)
class ParamRequestList(MavlinkMessage, frozen=True):
    """Ask for all parameters."""

    target_system: U8 = 0
    target_component: U8 = 0


@message(22, 220)
class ParamValue(MavlinkMessage, frozen=True):
    """A parameter; its value is a float whatever its type."""

    param_value: F32 = 0.0
    param_count: U16 = 0
    param_index: U16 = 0
    param_id: Name = bytes(16)
    param_type: U8 = 0


@message(23, 168)
class ParamSet(MavlinkMessage, frozen=True):
    """Set a parameter."""

    param_value: F32 = 0.0
    target_system: U8 = 0
    target_component: U8 = 0
    param_id: Name = bytes(16)
    param_type: U8 = 0


@message(43, 132)
class MissionRequestList(MavlinkMessage, frozen=True):
    """Ask for the mission."""

    target_system: U8 = 0
    target_component: U8 = 0
    mission_type: U8 = 0


@message(44, 221)
class MissionCount(MavlinkMessage, frozen=True):
    """How many items a mission has."""

    count: U16 = 0
    target_system: U8 = 0
    target_component: U8 = 0
    mission_type: U8 = 0


@message(66, 148)
class RequestDataStream(MavlinkMessage, frozen=True):
    """Ask for a group of messages at a rate, Hz; stream 0 is all."""

    req_message_rate: U16 = 0
    target_system: U8 = 0
    target_component: U8 = 0
    req_stream_id: U8 = 0
    start_stop: U8 = 0


@message(69, 243)
class ManualControl(MavlinkMessage, frozen=True):
    """A stick, -1000 to 1000. y: right. z: throttle of a rover, 0 neutral."""

    x: I16 = 0
    y: I16 = 0
    z: I16 = 0
    r: I16 = 0
    buttons: U16 = 0
    target: U8 = 0
    buttons2: U16 = 0
    enabled_extensions: U8 = 0
    s: I16 = 0
    t: I16 = 0
    aux1: I16 = 0
    aux2: I16 = 0
    aux3: I16 = 0
    aux4: I16 = 0
    aux5: I16 = 0
    aux6: I16 = 0


@message(70, 124)
class RcChannelsOverride(MavlinkMessage, frozen=True):
    """RC channels in place of the receiver's, us; 0 gives one back, 65535 leaves it."""

    chan1_raw: U16 = 0
    chan2_raw: U16 = 0
    chan3_raw: U16 = 0
    chan4_raw: U16 = 0
    chan5_raw: U16 = 0
    chan6_raw: U16 = 0
    chan7_raw: U16 = 0
    chan8_raw: U16 = 0
    target_system: U8 = 0
    target_component: U8 = 0
    chan9_raw: U16 = 0
    chan10_raw: U16 = 0
    chan11_raw: U16 = 0
    chan12_raw: U16 = 0
    chan13_raw: U16 = 0
    chan14_raw: U16 = 0
    chan15_raw: U16 = 0
    chan16_raw: U16 = 0
    chan17_raw: U16 = 0
    chan18_raw: U16 = 0


@message(75, 158)
class CommandInt(MavlinkMessage, frozen=True):
    """A command with a position. x, y: 1e-7 degrees, or 1e-4 m."""

    param1: F32 = 0.0
    param2: F32 = 0.0
    param3: F32 = 0.0
    param4: F32 = 0.0
    x: I32 = 0
    y: I32 = 0
    z: F32 = 0.0
    command: U16 = 0
    target_system: U8 = 0
    target_component: U8 = 0
    frame: U8 = 0
    current: U8 = 0
    autocontinue: U8 = 0


@message(76, 152)
class CommandLong(MavlinkMessage, frozen=True):
    """A command with seven numbers."""

    param1: F32 = 0.0
    param2: F32 = 0.0
    param3: F32 = 0.0
    param4: F32 = 0.0
    param5: F32 = 0.0
    param6: F32 = 0.0
    param7: F32 = 0.0
    command: U16 = 0
    target_system: U8 = 0
    target_component: U8 = 0
    confirmation: U8 = 0


@message(77, 143)
class CommandAck(MavlinkMessage, frozen=True):
    """The answer to a command: accepted 0, temporarily rejected 1, denied 2, unsupported 3, failed 4."""

    command: U16 = 0
    result: U8 = 0
    progress: U8 = 0
    result_param2: I32 = 0
    target_system: U8 = 0
    target_component: U8 = 0


@message(82, 49)
class SetAttitudeTarget(MavlinkMessage, frozen=True):
    """A wanted attitude; refused."""

    time_boot_ms: U32 = 0
    q: Floats4 = bytes(16)
    body_roll_rate: F32 = 0.0
    body_pitch_rate: F32 = 0.0
    body_yaw_rate: F32 = 0.0
    thrust: F32 = 0.0
    target_system: U8 = 0
    target_component: U8 = 0
    type_mask: U8 = 0


@message(84, 143)
class SetPositionTargetLocalNed(MavlinkMessage, frozen=True):
    """A wanted velocity, or position. type_mask: a set bit ignores what it stands for. yaw_rate: clockwise."""

    time_boot_ms: U32 = 0
    x: F32 = 0.0
    y: F32 = 0.0
    z: F32 = 0.0
    vx: F32 = 0.0
    vy: F32 = 0.0
    vz: F32 = 0.0
    afx: F32 = 0.0
    afy: F32 = 0.0
    afz: F32 = 0.0
    yaw: F32 = 0.0
    yaw_rate: F32 = 0.0
    type_mask: U16 = 0
    target_system: U8 = 0
    target_component: U8 = 0
    coordinate_frame: U8 = 0


@message(110, 84)
class FileTransferProtocol(MavlinkMessage, frozen=True):
    """A step of a file transfer; refused."""

    target_network: U8 = 0
    target_system: U8 = 0
    target_component: U8 = 0
    payload: Bytes251 = bytes(251)


@message(111, 34)
class Timesync(MavlinkMessage, frozen=True):
    """Two clocks, ns. tc1 0: a question, whose time is ts1."""

    tc1: I64 = 0
    ts1: I64 = 0


@message(148, 178)
class AutopilotVersion(MavlinkMessage, frozen=True):
    """Capabilities and ids of an autopilot."""

    capabilities: U64 = 0
    uid: U64 = 0
    flight_sw_version: U32 = 0
    middleware_sw_version: U32 = 0
    os_sw_version: U32 = 0
    board_version: U32 = 0
    vendor_id: U16 = 0
    product_id: U16 = 0
    flight_custom_version: Bytes8 = bytes(8)
    middleware_custom_version: Bytes8 = bytes(8)
    os_custom_version: Bytes8 = bytes(8)
    uid2: Bytes18 = bytes(18)


@message(244, 95)
class MessageInterval(MavlinkMessage, frozen=True):
    """How often a message is sent. interval_us: 0 unavailable, -1 not sent."""

    interval_us: I32 = 0
    message_id: U16 = 0
