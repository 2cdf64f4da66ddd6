"""Links to peers (tcp, tls, udp, serial), and conversations: one session over a link. Knows no protocol and no bus."""

from __future__ import annotations

from zbridge.transport.accepted import Accepted, ClientConversation
from zbridge.transport.by_address import attach, connect
from zbridge.transport.conversation import Conversation, ConversationHooks
from zbridge.transport.door import Door
from zbridge.transport.link import Link, Receiver
from zbridge.transport.sources import SourceDoor
from zbridge.transport.tcp import TcpLink, listen
from zbridge.transport.tls import TlsLink, server_context
from zbridge.transport.transferable import Parcel, Transferable

__all__ = [
    "Accepted",
    "ClientConversation",
    "Conversation",
    "ConversationHooks",
    "Door",
    "Link",
    "Parcel",
    "Receiver",
    "SourceDoor",
    "TcpLink",
    "TlsLink",
    "Transferable",
    "attach",
    "connect",
    "listen",
    "server_context",
]
