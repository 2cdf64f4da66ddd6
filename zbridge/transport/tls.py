"""TLS at a listener: a filter between an accepted TCP link and its receiver. Knows no socket, frame or session.

The receiver is attached before the handshake: who may not connect costs none, and one that never ends its handshake
counts as a client. The link takes writes from the end of the handshake on (``ready``). All that TCP tells (what the
kernel took, how long the peer has been silent) is told as without TLS, for what waits is in the TCP link only. There
are no datagrams.
"""

from __future__ import annotations

import asyncio
import contextlib
import ssl
from collections.abc import Callable

from zbridge.errors import LinkError, NotReady
from zbridge.protocol.kept import Exported
from zbridge.transport.link import Link, Receiver
from zbridge.transport.transferable import Parcel

_READ_BYTES = 16_384
"""The most that one record of TLS holds."""


def server_context(certificate: str, key: str, ca: str | None = None) -> ssl.SSLContext:
    """Return what a listener shows its peers; raise LinkError, which says what cannot be used.

    ca: peers must show a certificate of this authority; None: they show none.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.num_tickets = 0
    try:
        context.load_cert_chain(certificate, key, password=lambda: "")  # never asks at the terminal
    except (OSError, ValueError) as error:
        raise LinkError(f"certificate {certificate!r} with key {key!r}: {_said(error)}") from error
    if ca is not None:
        try:
            context.load_verify_locations(ca)
        except (OSError, ValueError) as error:
            raise LinkError(f"ca {ca!r}: {_said(error)}") from error
        context.verify_mode = ssl.CERT_REQUIRED
    return context


class TlsLink(Receiver):
    """The server's end of TLS over a link. Is the link of ``receiver``, and the receiver of the TCP link.

    handshake_s: how long the peer may take for the handshake, seconds.
    """

    def __init__(self, receiver: Receiver, context: ssl.SSLContext, handshake_s: float) -> None:
        self.peer = ""
        self.reads: Callable[[], object] = lambda: None
        self._receiver = receiver
        self._handshake_s = handshake_s
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing, server_side=True)
        self._link: Link | None = None
        self._open = False
        self._why: str | None = None
        """Why we ended it."""
        self._timer: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<TlsLink {self.peer or 'unconnected'}{'' if self._open else ', no handshake yet'}>"

    # What the receiver calls

    @property
    def ready(self) -> bool:
        """Whether the handshake is done, and the kernel took all that was written."""
        return self._open and self._link is not None and self._link.ready

    @property
    def silent_s(self) -> float:
        """Seconds for which the peer's machine has not answered."""
        return self._link.silent_s if self._link is not None else 0.0

    @property
    def unacknowledged_s(self) -> float:
        """Seconds for which the oldest written byte has waited for its acknowledgement."""
        return self._link.unacknowledged_s if self._link is not None else 0.0

    def write(self, data: bytes) -> None:
        """Write ``data`` as one record; before the end of the handshake it is lost."""
        if self._open and self._link is not None and data:
            self._tls.write(data)
            self._flush()

    def write_datagram(self, data: bytes) -> None:
        """Lose the datagram: it would go in the open."""

    def drop_source(self) -> None:
        """Do nothing: there are no datagrams."""

    def pause_reading(self) -> None:
        """Read nothing until :meth:`resume_reading`."""
        if self._link is not None:
            self._link.pause_reading()

    def resume_reading(self) -> None:
        """Read again."""
        if self._link is not None:
            self._link.resume_reading()

    @property
    def descriptors(self) -> tuple[int, ...]:
        """The file descriptor of the stream; empty while there is no link."""
        return self._link.descriptors if self._link is not None else ()

    @property
    def blocker(self) -> str | None:
        """Why this connection cannot be handed to another process: the keys of TLS stay in this one."""
        return "encrypted by this process"

    def suspend(self) -> None:
        """Read nothing until :meth:`resume`."""
        if self._link is not None:
            self._link.suspend()

    def resume(self) -> None:
        """Read again, after :meth:`suspend`."""
        if self._link is not None:
            self._link.resume()

    def export(self, parcel: Parcel) -> Exported:
        """Raise NotReady: see :attr:`blocker`."""
        raise NotReady(f"the connection is {self.blocker}")

    def detach(self) -> None:
        """Close the connection: no other process can have it."""
        self.close()

    def close(self) -> None:
        """Close the connection after what was written; idempotent."""
        link, self._link = self._link, None
        if link is not None:
            if self._open:
                self._say_goodbye(link)
            link.close()

    def abort(self) -> None:
        """Close the connection now; what was written may be lost. Idempotent."""
        link, self._link = self._link, None
        if link is not None:
            link.abort()

    # What the TCP link calls

    async def ended(self) -> None:
        """Return at once: such a link has no threads."""

    def attached(self, link: Link) -> None:
        """Begin: the connection is up, the handshake is not done."""
        self._link = link
        self.peer = link.peer.replace("tcp://", "tls://", 1)
        self._timer = asyncio.get_running_loop().call_later(self._handshake_s, self._on_late)
        self._receiver.attached(self)

    def received(self, data: bytes) -> None:
        """Take encrypted bytes."""
        if self._link is None:
            return
        self._incoming.write(data)
        try:
            if not self._open:
                self._shake_hands()
            while self._link is not None:
                plain = self._tls.read(_READ_BYTES)
                if not plain:
                    self._fail("closed by peer")
                else:
                    self._receiver.received(plain)
        except ssl.SSLWantReadError:
            self._flush()
        except ssl.SSLError as error:
            self._fail(f"TLS: {_said(error)}")

    def lost(self, reason: str) -> None:
        """End: the connection is gone."""
        self._link = None
        self._stop_timer()
        self._receiver.lost(self._why or reason)

    def writable(self) -> None:
        """Resume writing."""
        if self._open:
            self._receiver.writable()

    def received_datagram(self, datagram: bytes) -> None:
        """Never called: there are no datagrams."""

    def claims(self, datagram: bytes, port: int) -> bool:
        """Never called: there are no datagrams."""
        return False

    def rivalled(self) -> None:
        """Never called: there are no datagrams."""

    def stray_datagram(self, datagram: bytes) -> None:
        """Never called: there are no datagrams."""

    def foreign_datagram(self) -> None:
        """Never called: there are no datagrams."""

    def _shake_hands(self) -> None:
        self._tls.do_handshake()
        self._flush()
        self._open = True
        self._stop_timer()
        self._receiver.writable()

    def _flush(self) -> None:
        if self._link is not None and self._outgoing.pending:
            self._link.write(self._outgoing.read())

    def _say_goodbye(self, link: Link) -> None:
        with contextlib.suppress(ssl.SSLError):  # the peer's own goodbye is not waited for
            self._tls.unwrap()
        if self._outgoing.pending:
            link.write(self._outgoing.read())

    def _fail(self, why: str) -> None:
        """End the connection; the alert of TLS, if there is one, is sent."""
        self._why = why
        self._flush()
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _on_late(self) -> None:
        self._why = f"no TLS handshake within {self._handshake_s:g} s"
        self.abort()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def _said(error: Exception) -> str:
    """Return what an error says, without the names and lines of OpenSSL's code."""
    reason = getattr(error, "reason", None)
    if isinstance(error, ssl.SSLError) and reason:
        return str(reason).replace("_", " ").lower()
    return str(getattr(error, "strerror", None) or error)
