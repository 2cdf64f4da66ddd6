"""What a vehicle tells of itself, in ids of the message set ``common``."""

from __future__ import annotations

from gateways.mavlink.messages.base import U64, Chunk, Floats4, MavlinkMessage, Shorts4, Shorts10, Shorts72, message
from zbridge.wire import F32, I8, I16, I32, U8, U16, U32


@message(0, 50)
class MavlinkHeartbeat(MavlinkMessage, frozen=True):
    """A system is there.

    kind: rover 10, boat 11, GCS 6. autopilot: ArduPilot 3, none 8. base_mode: bit 128 armed, 1 custom mode.
    """

    custom_mode: U32 = 0
    kind: U8 = 0
    autopilot: U8 = 0
    base_mode: U8 = 0
    system_status: U8 = 0
    mavlink_version: U8 = 0


@message(1, 124)
class SysStatus(MavlinkMessage, frozen=True):
    """Health, load and battery.

    voltage_battery: mV, 65535 unknown. current_battery: cA, -1 unknown. battery_remaining: %, -1 unknown.
    """

    onboard_control_sensors_present: U32 = 0
    onboard_control_sensors_enabled: U32 = 0
    onboard_control_sensors_health: U32 = 0
    load: U16 = 0
    voltage_battery: U16 = 0
    current_battery: I16 = 0
    drop_rate_comm: U16 = 0
    errors_comm: U16 = 0
    errors_count1: U16 = 0
    errors_count2: U16 = 0
    errors_count3: U16 = 0
    errors_count4: U16 = 0
    battery_remaining: I8 = 0
    onboard_control_sensors_present_extended: U32 = 0
    onboard_control_sensors_enabled_extended: U32 = 0
    onboard_control_sensors_health_extended: U32 = 0


@message(24, 24)
class GpsRawInt(MavlinkMessage, frozen=True):
    """A fix. lat, lon: 1e-7 degrees. alt: mm. eph, epv: 1e-2. vel: cm/s. cog: cdeg; 65535 unknown."""

    time_usec: U64 = 0
    lat: I32 = 0
    lon: I32 = 0
    alt: I32 = 0
    eph: U16 = 0
    epv: U16 = 0
    vel: U16 = 0
    cog: U16 = 0
    fix_type: U8 = 0
    satellites_visible: U8 = 0
    alt_ellipsoid: I32 = 0
    h_acc: U32 = 0
    v_acc: U32 = 0
    vel_acc: U32 = 0
    hdg_acc: U32 = 0
    yaw: U16 = 0


@message(30, 39)
class Attitude(MavlinkMessage, frozen=True):
    """Attitude in rad and rad/s: roll right, pitch up, yaw clockwise from north."""

    time_boot_ms: U32 = 0
    roll: F32 = 0.0
    pitch: F32 = 0.0
    yaw: F32 = 0.0
    rollspeed: F32 = 0.0
    pitchspeed: F32 = 0.0
    yawspeed: F32 = 0.0


@message(32, 185)
class LocalPositionNed(MavlinkMessage, frozen=True):
    """Position and velocity: north, east, down, m and m/s."""

    time_boot_ms: U32 = 0
    x: F32 = 0.0
    y: F32 = 0.0
    z: F32 = 0.0
    vx: F32 = 0.0
    vy: F32 = 0.0
    vz: F32 = 0.0


@message(33, 104)
class GlobalPositionInt(MavlinkMessage, frozen=True):
    """Position. lat, lon: 1e-7 degrees. alt: mm. vx, vy, vz: cm/s. hdg: cdeg, 65535 unknown."""

    time_boot_ms: U32 = 0
    lat: I32 = 0
    lon: I32 = 0
    alt: I32 = 0
    relative_alt: I32 = 0
    vx: I16 = 0
    vy: I16 = 0
    vz: I16 = 0
    hdg: U16 = 0


@message(65, 118)
class RcChannels(MavlinkMessage, frozen=True):
    """The channels of the RC receiver, us; 65535 unused."""

    time_boot_ms: U32 = 0
    chan1_raw: U16 = 0
    chan2_raw: U16 = 0
    chan3_raw: U16 = 0
    chan4_raw: U16 = 0
    chan5_raw: U16 = 0
    chan6_raw: U16 = 0
    chan7_raw: U16 = 0
    chan8_raw: U16 = 0
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
    chancount: U8 = 0
    rssi: U8 = 0


@message(74, 20)
class VfrHud(MavlinkMessage, frozen=True):
    """Speeds in m/s, heading in degrees, throttle in %."""

    airspeed: F32 = 0.0
    groundspeed: F32 = 0.0
    alt: F32 = 0.0
    climb: F32 = 0.0
    heading: I16 = 0
    throttle: U16 = 0


@message(132, 85)
class DistanceSensor(MavlinkMessage, frozen=True):
    """A distance, cm. orientation: forward 0, then by 45 degrees clockwise."""

    time_boot_ms: U32 = 0
    min_distance: U16 = 0
    max_distance: U16 = 0
    current_distance: U16 = 0
    kind: U8 = 0
    sensor_id: U8 = 0
    orientation: U8 = 0
    covariance: U8 = 0
    horizontal_fov: F32 = 0.0
    vertical_fov: F32 = 0.0
    quaternion: Floats4 = bytes(16)
    signal_quality: U8 = 0


@message(147, 154)
class BatteryStatus(MavlinkMessage, frozen=True):
    """A battery.

    voltages: u16[10], mV, 65535 unused. current_battery: cA, -1 unknown. battery_remaining: %, -1 unknown.
    """

    current_consumed: I32 = 0
    energy_consumed: I32 = 0
    temperature: I16 = 0
    voltages: Shorts10 = bytes(20)
    current_battery: I16 = 0
    battery_id: U8 = 0
    battery_function: U8 = 0
    kind: U8 = 0
    battery_remaining: I8 = 0
    time_remaining: I32 = 0
    charge_state: U8 = 0
    voltages_ext: Shorts4 = bytes(8)
    mode: U8 = 0
    fault_bitmask: U32 = 0


@message(242, 104)
class HomePosition(MavlinkMessage, frozen=True):
    """Where home is. latitude, longitude: 1e-7 degrees. altitude: mm."""

    latitude: I32 = 0
    longitude: I32 = 0
    altitude: I32 = 0
    x: F32 = 0.0
    y: F32 = 0.0
    z: F32 = 0.0
    q: Floats4 = bytes(16)
    approach_x: F32 = 0.0
    approach_y: F32 = 0.0
    approach_z: F32 = 0.0
    time_usec: U64 = 0


@message(245, 130)
class ExtendedSysState(MavlinkMessage, frozen=True):
    """Whether a vehicle has landed: 1 on the ground."""

    vtol_state: U8 = 0
    landed_state: U8 = 0


@message(253, 83)
class Statustext(MavlinkMessage, frozen=True):
    """A text, or a chunk of one with an id. severity: emergency 0 to debug 7."""

    severity: U8 = 0
    text: Chunk = bytes(50)
    text_id: U16 = 0
    chunk_seq: U8 = 0


@message(330, 23)
class ObstacleDistance(MavlinkMessage, frozen=True):
    """Distances around. distances: u16[72], cm, clockwise from angle_offset; 65535 unknown. frame: body 12."""

    time_usec: U64 = 0
    distances: Shorts72 = bytes(144)
    min_distance: U16 = 0
    max_distance: U16 = 0
    sensor_type: U8 = 0
    increment: U8 = 0
    increment_f: F32 = 0.0
    angle_offset: F32 = 0.0
    frame: U8 = 0
