"""The packets of the protocol page and of the recorded sessions; sections are the packets' numbers.

Every expected byte is written out by hand from the page or read off a capture, never computed by the code under test.
"""

import struct
from typing import Any

import numpy as np

from gateways.tcpudp import messages as m
from tests.conformance.side import Side, framed
from zbridge.protocol.session import Role


def block(*fields: Any) -> bytes:
    """A settings block by the page: bools of one byte, then int32 little endian."""
    return b"".join(struct.pack("<?" if isinstance(field, bool) else "<i", field) for field in fields)


def server_settings(client_id: int, versions: str, *fields: Any) -> m.ServerSettings:
    return m.ServerSettings(client_id, versions, block(*fields))


def client_settings(versions: str, *fields: Any) -> m.ClientSettings:
    return m.ClientSettings(versions, block(*fields))


def lidar(*ranges: float) -> m.ClientSimulatedLidarData:
    return m.ClientSimulatedLidarData(np.array(ranges, dtype=np.float32))


# (message, id byte of the header, the whole packet). Robots send id 1; HQ programs 0 until they were given one.
GOLDEN: list[tuple[Any, int, str]] = [
    # 1 debugMessage
    (m.DebugMessage("hi"), 1, "08000000 01 01 02000000 6869"),
    (m.DebugMessage(""), 1, "06000000 01 01 00000000"),
    # 2 serverSettings: 1.1, 1.2, 1.3
    (server_settings(2, "1.1", True, False, True, False, True), 1, "0f000000 01 02 02 03000000 312e31 0100010001"),
    (server_settings(3, "1.2", *[False, True] * 3), 1, "10000000 01 02 03 03000000 312e32 000100010001"),
    (
        server_settings(255, "1.1,1.2,1.3", True, True, False, False, True, False, True, 1000, 25),
        1,
        "21000000 01 02 ff 0b000000 312e312c312e322c312e33 01010000010001 e8030000 19000000",
    ),
    # 3 clientSettings: 1.1, 1.2, 1.3
    (client_settings("1.1", False, False, True, True, False), 0, "0e000000 00 03 03000000 312e31 0000010100"),
    (client_settings("1.2", True, False, False, True, True, False), 2, "0f000000 02 03 03000000 312e32 010000010100"),
    (
        client_settings("1.1,1.2,1.3", False, True, True, False, False, True, True),
        2,
        "18000000 02 03 0b000000 312e312c312e322c312e33 00010100000101",
    ),
    # 4-7 the UDP probe
    (m.ServerStartUDP(), 1, "02000000 01 04"),
    (m.ClientUDPConnection(), 2, "02000000 02 05"),
    (m.ServerUDPConnection(True), 1, "03000000 01 06 01"),
    (m.ServerUDPConnection(False), 1, "03000000 01 06 00"),
    (m.ClientUDPConnectionStatus(True), 2, "03000000 02 07 01"),
    # 10-13, 21 movement
    (m.ClientControllMode(2), 2, "06000000 02 0a 02000000"),
    (m.ClientJoystickMove(0.5, -0.25, 2.0), 2, "0e000000 02 0b 0000003f 000080be 00000040"),
    (m.ClientJoystickRotate(-0.75), 2, "06000000 02 0c 000040bf"),
    (m.ClientJoystickStop(), 2, "02000000 02 0d"),
    (m.ClientMoveAI(b"\xde\xad"), 2, "04000000 02 15 dead"),
    # 31 camera, 40 chat
    (m.ServerCamMode(1), 1, "06000000 01 1f 01000000"),
    (m.ChatMessage(b"\x00\xff"), 2, "04000000 02 28 00ff"),
    # 50-55 lidar, map, position; 56 has its own tests below
    (m.ClientLidarMode(1), 2, "06000000 02 32 01000000"),
    (m.ServerLidarStatus(1), 1, "06000000 01 33 01000000"),
    (m.ClientGetSLAMMap(), 2, "02000000 02 34"),
    (m.ServerSLAMMap(), 1, "06000000 01 35 00000000"),
    (m.ServerSLAMMap(b"\x00\x01\x02\x01\x00"), 1, "0b000000 01 35 05000000 0001020100"),
    (m.ClientGetPosition(), 2, "02000000 02 36"),
    (m.ServerPosition(1.0, -2.0, 180.0), 1, "0e000000 01 37 0000803f 000000c0 00003443"),
    # 60, 61 simulated lidar
    (m.ServerGetSimulatedLidarData(), 1, "02000000 01 3c"),
    (lidar(10.0, 0.0, 0.5), 2, "12000000 02 3d 03000000 00002041 00000000 0000003f"),
]

# id: (name, sender, carrier). Packet 6 goes by UDP when it says true and by TCP when it says false.
TABLE = {
    1: ("debugMessage", None, m.Carrier.TCP),
    2: ("serverSettings", Role.ROBOT, m.Carrier.TCP),
    3: ("clientSettings", Role.HQ, m.Carrier.TCP),
    4: ("serverStartUDP", Role.ROBOT, m.Carrier.TCP),
    5: ("clientUDPConnection", Role.HQ, m.Carrier.UDP),
    6: ("serverUDPConnection", Role.ROBOT, m.Carrier.UDP),
    7: ("clientUDPConnectionStatus", Role.HQ, m.Carrier.TCP),
    10: ("clientControllMode", Role.HQ, m.Carrier.TCP),
    11: ("clientJoystickMove", Role.HQ, m.Carrier.UDP_IF_AGREED),
    12: ("clientJoystickRotate", Role.HQ, m.Carrier.UDP_IF_AGREED),
    13: ("clientJoystickStop", Role.HQ, m.Carrier.TCP),
    21: ("clientMoveAI", Role.HQ, m.Carrier.TCP),
    31: ("serverCamMode", Role.ROBOT, m.Carrier.TCP),
    40: ("chatMessage", None, m.Carrier.TCP),
    50: ("clientLidarMode", Role.HQ, m.Carrier.TCP),
    51: ("serverLidarStatus", Role.ROBOT, m.Carrier.TCP),
    52: ("clientGetSLAMMap", Role.HQ, m.Carrier.TCP),
    53: ("servertSLAMMap", Role.ROBOT, m.Carrier.UDP_IF_AGREED),
    54: ("clientGetPosition", Role.HQ, m.Carrier.TCP),
    55: ("serverPosition", Role.ROBOT, m.Carrier.UDP_IF_AGREED),
    56: ("servertSLAMMapPart", Role.ROBOT, m.Carrier.UDP_IF_AGREED),
    60: ("serverGetSimulatedLidarData", Role.ROBOT, m.Carrier.TCP),
    61: ("clientSimulatedLidarData", Role.HQ, m.Carrier.UDP_IF_AGREED),
}

# What the captures say after the handshake, read off the hex: 9a99193f is the float32 next to 0.6, cdcc4c3f that next
# to 0.8.
HI_THERE = m.DebugMessage("hi there")
MOVE = m.ClientJoystickMove(0.6000000238418579, 0.800000011920929, 1.5)
POSE = m.ServerPosition(1.5, -2.25, 90.0)
MAP = m.ServerSLAMMap(bytes([0, 1, 2] * 133 + [0]))
UDP_SESSION_MESSAGES = [
    HI_THERE,
    m.ClientControllMode(2),
    MOVE,
    m.ClientJoystickRotate(-0.75),
    m.ClientJoystickStop(),
    m.ClientGetPosition(),
    POSE,
    m.ClientGetSLAMMap(),
    MAP,
    m.ServerGetSimulatedLidarData(),
    lidar(*(100.0 + 0.5 * degree for degree in range(360))),
    POSE,
    MAP,
    m.DebugMessage("bye"),
]
TCP_SESSION_MESSAGES = [
    HI_THERE,
    m.ClientControllMode(2),
    MOVE,
    m.ClientJoystickRotate(-0.75),
    m.ClientJoystickStop(),
    m.ClientGetPosition(),
    m.ClientGetSLAMMap(),
    POSE,
    m.ServerSLAMMap(),
    m.DebugMessage("bye"),
]


def _side(sender_id: int) -> Side:
    """The packets with one id byte in their header; robots send id 1, HQ programs 0 until they were given one."""
    golden = [(message, bytes.fromhex(text)) for message, by, text in GOLDEN if by == sender_id]
    return Side(
        f"tcpudp-{sender_id}",
        golden,
        m.decode_packet,
        lambda message: m.encode_packet(message, sender_id),
        framed(m.frame_end, m.MAX_FRAME, m.decode_packet),
        set(),
    )


SIDES = [_side(sender_id) for sender_id in (0, 1, 2)]
