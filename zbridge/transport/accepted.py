"""The receiver of an accepted link, before and after its conversation."""

from __future__ import annotations

from collections.abc import Callable

from zbridge.errors import Refused
from zbridge.log import Log
from zbridge.protocol.traffic import SourceClaims
from zbridge.transport.conversation import Conversation, then_pump
from zbridge.transport.link import Link, Receiver

log = Log("zbridge.link")


class Accepted(Receiver):
    """The receiver of an accepted link until ``admit`` has made its own, or refused the peer with None."""

    def __init__(self, admit: Callable[[Link], Receiver | None]) -> None:
        self._admit = admit

    def attached(self, link: Link) -> None:
        """Leave the link to the receiver that is made, or close it."""
        receiver = self._admit(link)
        if receiver is None:
            link.close()
        else:
            link.receiver = receiver
            receiver.attached(link)


class ClientConversation(Conversation):
    """A conversation with an accepted peer, whose session may have to say which datagrams come from that peer."""

    def claims(self, datagram: bytes, port: int) -> bool:
        session = self.session
        return isinstance(session, SourceClaims) and session.claims(datagram, port)

    @then_pump
    def rivalled(self) -> None:
        """Count a second source, or session, with the same claim, and tell the session."""
        session = self.session
        self._hooks.rivals.value += 1
        if isinstance(session, SourceClaims):
            session.rivalled(self._clock())
        if self._hooks.may_warn("with a rival source of datagrams"):
            template = "{session}: another source of datagrams claims to be {peer}"
            log.warning("rival_source", template, session=session.name, peer=session.peer)

    def stray_datagram(self, datagram: bytes) -> None:
        session = self.session
        try:
            if isinstance(session, SourceClaims):
                session.stray(datagram)
        except Refused as refusal:
            self._hooks.refused(refusal)

    def pump(self) -> None:
        """Write what may be written, without a source of datagrams that the session has dropped."""
        session = self.session
        if isinstance(session, SourceClaims) and session.drops_source and self.link is not None:
            session.drops_source = False
            self.link.drop_source()
        super().pump()
