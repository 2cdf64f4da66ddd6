"""Sticks and setpoints of one ground station as drives. Sans-IO.

Source: "Translation" and "The gateway as vehicle" of the protocol page. Theory of operation. Motion counts while the
station is armed: sticks in MANUAL, setpoints in GUIDED. Programs begin to move in GUIDED without ever having sent zero,
as an ArduRover forgets its target there, so entering GUIDED is a neutral. What is read at once may have waited in the
network for a while, so motion counts only once setpoints have come for :data:`LIVE_S` without a gap.
"""

from __future__ import annotations

import math

from gateways.mavlink.frames import MavlinkFrame
from gateways.mavlink.messages.control import ManualControl, RcChannelsOverride, SetPositionTargetLocalNed
from gateways.mavlink.numbers import BODY_NED, BODY_OFFSET_NED, RoverMode
from gateways.mavlink.station.session import CENTRE_US, Station
from zbridge.fleet import topics
from zbridge.fleet.messages import Drive
from zbridge.protocol import Telemetry

LIVE_S = 0.35
GAP_S = 0.5
"""Seconds between two setpoints, or since a stick was heard, that are too many."""
OVERRIDE_S = 3.0
"""Seconds for which an RC override counts where a later one leaves a channel as it is."""
RELEASE = "release the stick (QGC: centre is zero throttle)"
TOO_SLOW = "send setpoints at 4 Hz or more"
VELOCITY_ONLY = "only velocity setpoints, frame 8 or 9"
_FULL = 1000
_GIVEN_BACK, _UNCHANGED = 32767, 65535
_US_TO_STICK = 2
_NOT_VELOCITY, _NO_YAW_RATE = 0x1C7, 0x800
_VELOCITY_ONLY = _NOT_VELOCITY | 0x008
"""Bits of ``type_mask``: positions and accelerations must be ignored, the velocity ahead must not."""
_NEUTRAL = Drive()


def manual_control(station: Station, message: ManualControl, sender: MavlinkFrame) -> tuple[Telemetry, ...]:
    """Take a stick: z ahead, y to the right, thousandths. It takes the place of an RC override."""
    station.stick.channels_us = [CENTRE_US, CENTRE_US]
    return _move_stick(station, *(0 if axis == _GIVEN_BACK else axis for axis in (message.z, message.y)))


def rc_override(station: Station, message: RcChannelsOverride, sender: MavlinkFrame) -> tuple[Telemetry, ...]:
    """Take a stick in the place of an RC receiver's: channels 1 and 3, us; 0 gives one back."""
    stick = station.stick
    if station.now - stick.heard_at > OVERRIDE_S:
        stick.channels_us = [CENTRE_US, CENTRE_US]
    channels = stick.channels_us
    for place, us in enumerate((message.chan3_raw, message.chan1_raw)):
        if us != _UNCHANGED:
            channels[place] = us or CENTRE_US
    return _move_stick(station, *((us - CENTRE_US) * _US_TO_STICK for us in channels))


def setpoint(station: Station, message: SetPositionTargetLocalNed, sender: MavlinkFrame) -> tuple[Telemetry, ...]:
    """Take a velocity ahead and a yaw rate; all else is ignored, and told."""
    if not (station.armed and station.mode == RoverMode.GUIDED):
        return ()
    if (
        message.coordinate_frame not in (BODY_NED, BODY_OFFSET_NED)
        or message.type_mask & _VELOCITY_ONLY != _NOT_VELOCITY
    ):
        station.warn(VELOCITY_ONLY)
        return ()
    options = station.options
    turn = 0.0 if message.type_mask & _NO_YAW_RATE else -message.yaw_rate / options.turn_full_rad_s
    drive = Drive(forward=_clip(message.vx / options.speed_full_m_s), turn=_clip(turn))
    return _drive(station, drive if _live(station) else _NEUTRAL)


def enter(station: Station, mode: RoverMode) -> tuple[Telemetry, ...]:
    """Take a new mode: motion of the one before ends, and GUIDED begins with a neutral, which is none of the stick."""
    stick = station.stick
    stick.channels_us = [CENTRE_US, CENTRE_US]
    stick.needs_neutral = stick.needs_neutral or mode is RoverMode.GUIDED
    moving, stick.last, stick.changed_at = stick.last.moving, _NEUTRAL, station.now
    stick.entered, stick.target_at, stick.live_from = mode is RoverMode.GUIDED, -math.inf, math.inf
    return _drive(station, _NEUTRAL) if moving or stick.entered else ()


def is_deflected(station: Station) -> bool:
    """Return whether the stick was away from zero when it was heard last, lately."""
    stick = station.stick
    return station.now - stick.heard_at < GAP_S and any(_zeroed(station, axis) for axis in stick.axes)


def _live(station: Station) -> bool:
    """Return whether setpoints have come long enough since GUIDED was entered."""
    stick, now = station.stick, station.now
    gap_s, stick.target_at = now - stick.target_at, now
    if not stick.entered:
        return True
    if gap_s > GAP_S:
        if gap_s < math.inf:
            station.warn(TOO_SLOW)
        stick.live_from = now + LIVE_S
    stick.entered = now < stick.live_from
    return not stick.entered


def _move_stick(station: Station, throttle: int, steering: int) -> tuple[Telemetry, ...]:
    stick, counts = station.stick, station.mode == RoverMode.MANUAL
    stick.axes, stick.heard_at = (throttle, steering), station.now
    forward, right = (_zeroed(station, axis) / _FULL for axis in stick.axes)
    deflected = bool(forward or right)
    stick.needs_neutral = deflected and (stick.needs_neutral or not counts)
    if not (station.armed and counts):
        return ()
    if stick.needs_neutral:
        station.rest(station.now)
        station.warn(RELEASE)
        return ()
    return _drive(station, Drive(forward=_clip(forward), turn=_clip(-right)))


def _drive(station: Station, drive: Drive) -> tuple[Telemetry, ...]:
    """Pass a drive on, unless it has not changed for so long that nobody may be there."""
    stick, now, stale_s = station.stick, station.now, station.options.stale_s
    if drive != stick.last:
        stick.last, stick.changed_at = drive, now
    elif stale_s and drive.moving and now - stick.changed_at > stale_s:
        station.text(f"not changed for {stale_s:g} s: stopped")
        station.rest(now)
        stick.last = drive = _NEUTRAL
    return ((topics.CMD_DRIVE, drive),)


def _zeroed(station: Station, axis: int) -> int:
    return axis if abs(axis) > station.options.dead else 0


def _clip(value: float) -> float:
    return max(-1.0, min(1.0, value)) + 0.0 if math.isfinite(value) else 0.0
