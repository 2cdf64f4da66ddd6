"""The packets of the protocol page and of the recorded sessions; sections are the packets' numbers.

Every expected byte is written out by hand from the page or read off a capture, never computed by the code under test.
"""

import struct
from typing import Any

import numpy as np

from gateways.tcpudp.messages import (
    MAX_FRAME,
    Carrier,
    ChatMessage,
    ClientControllMode,
    ClientGetPosition,
    ClientGetSLAMMap,
    ClientJoystickMove,
    ClientJoystickRotate,
    ClientJoystickStop,
    ClientLidarMode,
    ClientMoveAI,
    ClientSettings,
    ClientSimulatedLidarData,
    ClientUDPConnection,
    ClientUDPConnectionStatus,
    DebugMessage,
    Sender,
    ServerCamMode,
    ServerGetSimulatedLidarData,
    ServerLidarStatus,
    ServerPosition,
    ServerSettings,
    ServerSLAMMap,
    ServerStartUDP,
    ServerUDPConnection,
    decode_packet,
    encode_packet,
    frame_end,
)
from tests.conformance.side import Side, framed


def block(*fields: Any) -> bytes:
    """A settings block by the page: bools of one byte, then int32 little endian."""
    return b"".join(struct.pack("<?" if isinstance(field, bool) else "<i", field) for field in fields)


def server_settings(client_id: int, versions: str, *fields: Any) -> ServerSettings:
    return ServerSettings(client_id, versions, block(*fields))


def client_settings(versions: str, *fields: Any) -> ClientSettings:
    return ClientSettings(versions, block(*fields))


def lidar(*ranges: float) -> ClientSimulatedLidarData:
    return ClientSimulatedLidarData(np.array(ranges, dtype=np.float32))


# (message, id byte of the header, the whole packet). Robots send id 1; HQ programs 0 until they were given one.
GOLDEN: list[tuple[Any, int, str]] = [
    # 1 debugMessage
    (DebugMessage("hi"), 1, "08000000 01 01 02000000 6869"),
    (DebugMessage("hi"), 7, "08000000 07 01 02000000 6869"),
    (DebugMessage(""), 1, "06000000 01 01 00000000"),
    # 2 serverSettings: 1.1, 1.2, 1.3
    (server_settings(2, "1.1", True, False, True, False, True), 1, "0f000000 01 02 02 03000000 312e31 0100010001"),
    (
        server_settings(3, "1.2", False, True, False, True, False, True),
        1,
        "10000000 01 02 03 03000000 312e32 000100010001",
    ),
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
    (ServerStartUDP(), 1, "02000000 01 04"),
    (ClientUDPConnection(), 2, "02000000 02 05"),
    (ServerUDPConnection(True), 1, "03000000 01 06 01"),
    (ServerUDPConnection(False), 1, "03000000 01 06 00"),
    (ClientUDPConnectionStatus(True), 2, "03000000 02 07 01"),
    (ClientUDPConnectionStatus(False), 2, "03000000 02 07 00"),
    # 10-13, 21 movement
    (ClientControllMode(1), 2, "06000000 02 0a 01000000"),
    (ClientControllMode(2), 2, "06000000 02 0a 02000000"),
    (ClientControllMode(3), 2, "06000000 02 0a 03000000"),
    (ClientJoystickMove(0.5, -0.25, 2.0), 2, "0e000000 02 0b 0000003f 000080be 00000040"),
    (ClientJoystickRotate(-0.75), 2, "06000000 02 0c 000040bf"),
    (ClientJoystickStop(), 2, "02000000 02 0d"),
    (ClientMoveAI(b""), 2, "02000000 02 15"),
    (ClientMoveAI(b"\xde\xad"), 2, "04000000 02 15 dead"),
    # 31 camera, 40 chat
    (ServerCamMode(1), 1, "06000000 01 1f 01000000"),
    (ServerCamMode(2), 1, "06000000 01 1f 02000000"),
    (ChatMessage(b""), 1, "02000000 01 28"),
    (ChatMessage(b"\x00\xff"), 2, "04000000 02 28 00ff"),
    # 50-55 lidar, map, position; 56 has its own tests below
    (ClientLidarMode(1), 2, "06000000 02 32 01000000"),
    (ClientLidarMode(2), 2, "06000000 02 32 02000000"),
    (ServerLidarStatus(1), 1, "06000000 01 33 01000000"),
    (ServerLidarStatus(2), 1, "06000000 01 33 02000000"),
    (ClientGetSLAMMap(), 2, "02000000 02 34"),
    (ServerSLAMMap(), 1, "06000000 01 35 00000000"),
    (ServerSLAMMap(b"\x00\x01\x02\x01\x00"), 1, "0b000000 01 35 05000000 0001020100"),
    (ClientGetPosition(), 2, "02000000 02 36"),
    (ServerPosition(1.0, -2.0, 180.0), 1, "0e000000 01 37 0000803f 000000c0 00003443"),
    # 60, 61 simulated lidar
    (ServerGetSimulatedLidarData(), 1, "02000000 01 3c"),
    (lidar(10.0, 0.0, 0.5), 2, "12000000 02 3d 03000000 00002041 00000000 0000003f"),
    (lidar(), 2, "06000000 02 3d 00000000"),
]

# id: (name, sender, carrier). Packet 6 goes by UDP when it says true and by TCP when it says false.
TABLE = {
    1: ("debugMessage", Sender.BOTH, Carrier.TCP),
    2: ("serverSettings", Sender.ROBOT, Carrier.TCP),
    3: ("clientSettings", Sender.HQ, Carrier.TCP),
    4: ("serverStartUDP", Sender.ROBOT, Carrier.TCP),
    5: ("clientUDPConnection", Sender.HQ, Carrier.UDP),
    6: ("serverUDPConnection", Sender.ROBOT, Carrier.UDP),
    7: ("clientUDPConnectionStatus", Sender.HQ, Carrier.TCP),
    10: ("clientControllMode", Sender.HQ, Carrier.TCP),
    11: ("clientJoystickMove", Sender.HQ, Carrier.UDP_IF_AGREED),
    12: ("clientJoystickRotate", Sender.HQ, Carrier.UDP_IF_AGREED),
    13: ("clientJoystickStop", Sender.HQ, Carrier.TCP),
    21: ("clientMoveAI", Sender.HQ, Carrier.TCP),
    31: ("serverCamMode", Sender.ROBOT, Carrier.TCP),
    40: ("chatMessage", Sender.BOTH, Carrier.TCP),
    50: ("clientLidarMode", Sender.HQ, Carrier.TCP),
    51: ("serverLidarStatus", Sender.ROBOT, Carrier.TCP),
    52: ("clientGetSLAMMap", Sender.HQ, Carrier.TCP),
    53: ("servertSLAMMap", Sender.ROBOT, Carrier.UDP_IF_AGREED),
    54: ("clientGetPosition", Sender.HQ, Carrier.TCP),
    55: ("serverPosition", Sender.ROBOT, Carrier.UDP_IF_AGREED),
    56: ("servertSLAMMapPart", Sender.ROBOT, Carrier.UDP_IF_AGREED),
    60: ("serverGetSimulatedLidarData", Sender.ROBOT, Carrier.TCP),
    61: ("clientSimulatedLidarData", Sender.HQ, Carrier.UDP_IF_AGREED),
}

# What the captures say, read off the hex: 9a99193f is the float32 next to 0.6, cdcc4c3f the one next to 0.8.
HI_THERE = DebugMessage("hi there")
MOVE = ClientJoystickMove(0.6000000238418579, 0.800000011920929, 1.5)
POSE = ServerPosition(1.5, -2.25, 90.0)
MAP = ServerSLAMMap(bytes([0, 1, 2] * 133 + [0]))
UDP_SESSION_MESSAGES = [
    server_settings(1, "1.1,1.2,1.3", True, False, False, False, False, True, True, 2048, 1),
    client_settings("1.1,1.2,1.3", True, False, False, False, False, True, False),
    ServerStartUDP(),
    ClientUDPConnection(),
    ServerUDPConnection(True),
    ClientUDPConnectionStatus(True),
    HI_THERE,
    ClientControllMode(2),
    MOVE,
    ClientJoystickRotate(-0.75),
    ClientJoystickStop(),
    ClientGetPosition(),
    POSE,
    ClientGetSLAMMap(),
    MAP,
    ServerGetSimulatedLidarData(),
    lidar(*(100.0 + 0.5 * degree for degree in range(360))),
    POSE,
    MAP,
    DebugMessage("bye"),
]
TCP_SESSION_MESSAGES = [
    server_settings(1, "1.1", False, False, False, False, False),
    client_settings("1.1", True, False, False, False, False),
    HI_THERE,
    ClientControllMode(2),
    MOVE,
    ClientJoystickRotate(-0.75),
    ClientJoystickStop(),
    ClientGetPosition(),
    ClientGetSLAMMap(),
    POSE,
    ServerSLAMMap(),
    DebugMessage("bye"),
]


def _side(sender_id: int) -> Side:
    """The packets with one id byte in their header; robots send id 1, HQ programs 0 until they were given one."""
    golden = [(message, bytes.fromhex(text)) for message, by, text in GOLDEN if by == sender_id]
    return Side(
        f"tcpudp-{sender_id}",
        golden,
        decode_packet,
        lambda message: encode_packet(message, sender_id),
        framed(frame_end, MAX_FRAME, decode_packet),
        set(),
    )


SIDES = [_side(sender_id) for sender_id in (0, 1, 2, 7)]
