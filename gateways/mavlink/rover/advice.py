"""What rovers are known to suffer from, for ``zbridge doctor``: the reasons that sessions give, and remedies.

Source: "The gateway as HQ" and "Links" of the protocol page.
"""

from __future__ import annotations

from zbridge.protocol import Advice

NO_BEAT, ONLY_OTHERS = "no HEARTBEAT within", "no HEARTBEAT but"
WITH_PX4, NO_ROVER = "has a PX4", "expected an ArduRover"
TWO_VEHICLES = "two vehicles have the id"
OTHER_STATION = "MAV_GCS_SYSID is"
NOT_HELD = "HOLD was not confirmed"
_NO_DATAGRAM = "no datagram within"
_LOST = "nothing came for 3 s"

ADVICE = (
    Advice(
        NO_BEAT,
        "no_heartbeat",
        "the connection is open, and nothing of MAVLink comes from a rover",
        "check that the rover is on, the baud rate, that its port speaks MAVLink 2 (SERIALn_PROTOCOL 2), and that no"
        " other program has the port",
    ),
    Advice(
        ONLY_OTHERS,
        "only_others",
        "radios, ground stations or other vehicles talk on the link, and the rover does not",
        "check that the rover is on and in range of the radio, and device.options.vehicle_id (MAV_SYSID of the rover)",
    ),
    Advice(
        _NO_DATAGRAM,
        "no_datagram",
        "no vehicle sends to this UDP port",
        "let the vehicle send to this machine and port, and look at the firewall; or udp://HOST:PORT: we speak first",
    ),
    Advice(
        WITH_PX4,
        "px4",
        "the vehicle runs PX4, whose modes and sticks are others: it is not driven",
        "only ArduPilot (ArduRover) is supported",
    ),
    Advice(
        NO_ROVER,
        "no_rover",
        "the vehicle is neither a rover nor a boat of ArduPilot: it is not driven",
        "check device.options.vehicle_id, and that this is the right port",
    ),
    Advice(
        TWO_VEHICLES,
        "two_vehicles",
        "two vehicles with one id are on the link: both would obey, so neither is driven",
        "give each its own MAV_SYSID (SYSID_THISMAV before ArduPilot 4.7)",
    ),
    Advice(
        _LOST,
        "heartbeat_lost",
        "the rover's HEARTBEAT stopped: it is switched off, out of range, or its link carries too much",
        "check power and range; with a slow radio lower position_hz and ranges_hz",
    ),
    Advice(
        OTHER_STATION,
        "other_station",
        "the rover takes sticks of another ground station only, and drops ours silently",
        'set device.options.system_id to that number, or the parameter to ours; or drive = "guided"',
    ),
    Advice(
        NOT_HELD,
        "not_held",
        "the rover did not take HOLD when it was stopped: its RC transmitter or another ground station has the mode",
        "look at its mode switch, and who else is connected; stop it again",
    ),
)
