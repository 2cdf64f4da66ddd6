"""The receiver of an accepted link, until there is a conversation, and after it."""

from __future__ import annotations

import logging
from collections.abc import Callable

from zbridge.transport.conversation import Conversation
from zbridge.transport.link import Link, Receiver

log = logging.getLogger("zbridge.link")


class Accepted(Receiver):
    """The receiver of an accepted link; ``admit`` makes its conversation, or refuses the peer with None.

    ``level``: log level of the line about the end of the link.
    """

    def __init__(self, admit: Callable[[Link], Conversation | None], level: int = logging.INFO) -> None:
        self._admit = admit
        self._level = level
        self._conversation: Conversation | None = None

    def __repr__(self) -> str:
        return f"<Accepted {self._conversation!r}>"

    def attached(self, link: Link) -> None:
        """Begin the conversation, or close the link."""
        self._conversation = self._admit(link)
        if self._conversation is None:
            link.close()
        else:
            self._conversation.attached(link)

    def received(self, data: bytes) -> None:
        """Take bytes from the link."""
        if self._conversation is not None:
            self._conversation.received(data)

    def lost(self, reason: str) -> None:
        """End: the link is gone."""
        if self._conversation is not None:
            log.log(self._level, "%s: %s", self._conversation.session.peer, reason)
            self._conversation.lost(reason)

    def received_datagram(self, datagram: bytes) -> None:
        """Take a datagram from the link."""
        if self._conversation is not None:
            self._conversation.received_datagram(datagram)

    def claims(self, datagram: bytes, port: int) -> bool:
        """Ask the session whether this datagram is from its peer."""
        return self._conversation is not None and self._conversation.claims(datagram, port)

    def rivalled(self) -> None:
        """Tell the conversation of a second source, or conversation, with the same claim."""
        if self._conversation is not None:
            self._conversation.rivalled()

    def stray_datagram(self, datagram: bytes) -> None:
        """Show the session a datagram of the peer's host that nobody claimed."""
        if self._conversation is not None:
            self._conversation.stray_datagram(datagram)

    def foreign_datagram(self) -> None:
        """Count a datagram that came from elsewhere."""
        if self._conversation is not None:
            self._conversation.foreign_datagram()

    def writable(self) -> None:
        """Resume writing."""
        if self._conversation is not None:
            self._conversation.writable()
