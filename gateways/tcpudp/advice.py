"""What TCP/UDP robots are known to suffer from, for ``zbridge doctor``: the reasons that sessions give, and remedies.

Source: "Signs of a poor connection" and "Versions and dialects" of the protocol page.
"""

from __future__ import annotations

from gateways.tcpudp.session import NO_COMMON_VERSION
from gateways.tcpudp.session.hq_role import UNREADABLE, USED_UP
from gateways.tcpudp.session.signs import GARBLED, LATER_CLIENT, MUTE, UNANSWERED
from zbridge.protocol import Advice

BROKEN = "broken stream: frame of"
"""The first four bytes of a packet are its length: another protocol's are far too large."""
RESTART = "end whatever else is connected to the robot, and restart the robot's program"

ADVICE = (
    Advice(
        USED_UP,
        "used_up",
        "the robot accepts the connection and sends no settings: its one usable connection is used up, or no TCP/UDP"
        " robot answers there",
        f"{RESTART}; the gateway connects again by itself. If that does not help, check the address",
    ),
    Advice(
        LATER_CLIENT,
        "used_up",
        "this is not the robot's first connection: another program is connected, or the usable one is used up",
        RESTART,
    ),
    Advice(MUTE, "mute", "the robot has fallen silent, unlike on the connection before", RESTART),
    Advice(UNANSWERED, "mute", "the robot sends no telemetry and does not answer", RESTART),
    Advice(
        GARBLED,
        "garbled",
        "packets of the robot are damaged: two programs share its connection, or the version is another one",
        RESTART,
    ),
    Advice(
        NO_COMMON_VERSION,
        "wrong_version",
        "the robot and the gateway have no version in common",
        "update the gateway, or the robot's program",
    ),
    Advice(
        BROKEN,
        "wrong_protocol",
        "what the robot sends is not the TCP/UDP package protocol",
        "check device.protocol and device.connect",
    ),
    Advice(
        UNREADABLE,
        "wrong_protocol",
        "what answers at the robot's address does not speak this protocol",
        "check device.protocol and device.connect",
    ),
)
