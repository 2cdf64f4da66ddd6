"""Conversations of the TCP/UDP package protocol: framing, ``id`` bytes and channels, as both roles share them. Sans-IO.

``hq_role`` plays HQ towards a robot; ``robot_role`` plays the robot towards an
HQ program. Source: "Versions and dialects" of the protocol page.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from gateways.tcpudp.messages import (
    MAX_FRAME,
    PACKETS,
    DebugMessage,
    OpaquePacket,
    Packet,
    decoder,
    encode_packet,
    frame_end,
)
from gateways.tcpudp.settings import VERSIONS
from zbridge.protocol import Limits, ProtocolError, Role, Session

HANDSHAKE_S = 5.0
NO_COMMON_VERSION = "no common version"
_QUOTED = 80

Decode = Callable[[bytes, int], Packet]


def limits(gap_s: float) -> Limits:
    """Return the bounds of a session that leaves ``gap_s`` seconds between two packets."""
    return Limits(frame_bytes=MAX_FRAME, handshake_s=HANDSHAKE_S, gap_s=gap_s)


def decoders(role: Role) -> dict[int, Decode]:
    """Tabulate, by packet id, how to read what the peer of ``role`` may send."""
    return {
        number: decoder(number) for number in range(256) if number not in PACKETS or PACKETS[number].sender is not role
    }


def id_of(message: Packet) -> int:
    """Return the packet id of a packet, declared or not."""
    return message.id if isinstance(message, OpaquePacket) else message.spec.id


class PacketSession(Session[Packet]):
    """A session that speaks packets."""

    frame_end = staticmethod(frame_end)
    known_versions = frozenset(VERSIONS)
    sender_id: int
    """The ``id`` byte of what the session sends."""

    def encode(self, message: Packet) -> bytes:
        return encode_packet(message, self.sender_id, self.transport)

    def misplaced(self, frame: bytes) -> ProtocolError:
        """Make the error for a packet that the peer may not send."""
        sender_id, packet_id = frame[4], frame[5]
        spec = PACKETS.get(packet_id)
        if spec is not None and spec.sender is self.role:
            return ProtocolError(f"{spec.name} ({packet_id}) from the wrong side")
        return ProtocolError(f"packet {packet_id} with id {sender_id}, which is not the peer's")

    def refuse_versions(self, listed: str, ours: Iterable[str], now: float) -> None:
        """Close for lack of a common version, with a text to the peer ("Versions and dialects")."""
        reason = f"{NO_COMMON_VERSION}: the peer speaks {listed[:_QUOTED]!r}, this gateway {', '.join(ours)}"
        self.send(DebugMessage(reason))
        self.close(reason, now)
