"""Links to peers (tcp, tls, udp, serial), and conversations: one session over a link. Knows no protocol and no bus."""

from __future__ import annotations

from zbridge.transport.accepted import Accepted
from zbridge.transport.by_address import connect, take_over
from zbridge.transport.conversation import Conversation
from zbridge.transport.door import Door
from zbridge.transport.link import Link, Receiver
from zbridge.transport.parcel import Parcel
from zbridge.transport.tcp import TcpLink, listen
from zbridge.transport.tls import TlsLink, server_context

__all__ = [
    "Accepted",
    "Conversation",
    "Door",
    "Link",
    "Parcel",
    "Receiver",
    "TcpLink",
    "TlsLink",
    "connect",
    "listen",
    "server_context",
    "take_over",
]
