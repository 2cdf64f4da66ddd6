"""Links to peers (tcp, udp, serial), and conversations: one session over one link. Knows no protocol and no bus."""

from __future__ import annotations

from zbridge.transport.accepted import Accepted
from zbridge.transport.by_address import connect, take_over
from zbridge.transport.conversation import Conversation
from zbridge.transport.door import Door
from zbridge.transport.link import Link, Receiver
from zbridge.transport.parcel import Parcel
from zbridge.transport.tcp import TcpLink, listen

__all__ = [
    "Accepted",
    "Conversation",
    "Door",
    "Link",
    "Parcel",
    "Receiver",
    "TcpLink",
    "connect",
    "listen",
    "take_over",
]
