"""What ground stations ask for before they are content: parameters, streams, missions, files, clocks. Sans-IO.

Source: "The gateway as vehicle" of the protocol page.
"""

from __future__ import annotations

import struct

from gateways.mavlink.frames import MavlinkFrame
from gateways.mavlink.messages import control
from gateways.mavlink.station.session import Station

SPACING_S = 0.01
"""Between two parameters: radios lose bursts."""
_NAK, _NOT_FOUND = 129, 10
_FTP = struct.Struct("<HBBBBBBI")
_NS_PER_S = 1_000_000_000


def parameters(station: Station, message: control.ParamRequestList, asker: MavlinkFrame) -> None:
    """Send all parameters; asked for again meanwhile, from the beginning."""
    frames = tuple(station.encode(value) for value in station.parameters.all)
    station.outbox.clear("parameters")
    station.outbox.set("parameters", frames, station.now, spacing_s=SPACING_S)


def parameter(station: Station, message: control.ParamRequestRead | control.ParamSet, asker: MavlinkFrame) -> None:
    """Send one parameter; setting it changes nothing, and the old value tells so."""
    value = station.parameters.find(message)
    if value is not None:
        station.answer(value)


def streams(station: Station, message: control.RequestDataStream, asker: MavlinkFrame) -> None:
    """Change how often a group is sent."""
    station.streams.set_group(message.req_stream_id, message.req_message_rate, on=bool(message.start_stop))


def missions(station: Station, message: control.MissionRequestList, asker: MavlinkFrame) -> None:
    """Say that there is no mission of this type."""
    station.answer(control.MissionCount(0, asker.system, asker.component, message.mission_type))


def files(station: Station, message: control.FileTransferProtocol, asker: MavlinkFrame) -> None:
    """Say that there is no such file. The number of the transfer is copied, else MAVProxy does not take the answer."""
    seq, transfer, opcode, *_ = _FTP.unpack_from(message.payload)
    refusal = _FTP.pack(seq + 1 & 0xFFFF, transfer, _NAK, 1, opcode, 0, 0, 0) + bytes((_NOT_FOUND,))
    payload = refusal.ljust(len(message.payload), b"\0")
    station.answer(control.FileTransferProtocol(0, asker.system, asker.component, payload))


def ping(station: Station, message: control.Ping, asker: MavlinkFrame) -> None:
    """Answer a question, not an answer."""
    if not message.target_system:
        station.answer(control.Ping(message.time_usec, message.seq, asker.system, asker.component))


def timesync(station: Station, message: control.Timesync, asker: MavlinkFrame) -> None:
    """Answer a question with our clock."""
    if not message.tc1:
        station.answer(control.Timesync(int(station.now * _NS_PER_S), message.ts1))
