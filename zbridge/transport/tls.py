"""TLS at a listener: a filter between an accepted TCP link and its receiver. Knows no socket, frame or session.

The receiver is attached before the handshake: a peer that may not connect costs no handshake, and one that never
completes it counts as a client. The link accepts writes once the handshake is complete (``ready``). All that TCP
reports (what the kernel accepted, how long the peer has been silent) is reported as without TLS, because only the TCP
link buffers. There are no datagrams.
"""

from __future__ import annotations

import asyncio
import contextlib
import ssl

from zbridge.errors import LinkError
from zbridge.transport.link import Link, Receiver

_READ_BYTES = 16_384
"""Most bytes of one TLS record."""


def server_context(certificate: str, key: str, ca: str | None = None) -> ssl.SSLContext:
    """Return the TLS context of a listener; raise LinkError, which names what cannot be used.

    ca: peers must present a certificate of this authority; None: they present none.
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


class TlsLink(Link, Receiver):
    """The server's end of TLS over a link. Is the link of ``receiver``, and the receiver of the TCP link.

    handshake_s: how long the peer may take for the handshake, seconds.
    """

    def __init__(self, receiver: Receiver, context: ssl.SSLContext, handshake_s: float) -> None:
        super().__init__(receiver)
        self._handshake_s = handshake_s
        self._incoming, self._outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
        self._tls = context.wrap_bio(self._incoming, self._outgoing, server_side=True)
        self._link: Link | None = None
        self._open = False
        self._why: str | None = None
        """Why we ended the connection."""
        self._timer: asyncio.TimerHandle | None = None

    def __repr__(self) -> str:
        return f"<TlsLink {self.peer or 'unconnected'}{'' if self._open else ', no handshake yet'}>"

    # What the receiver calls

    @property
    def ready(self) -> bool:
        """Whether the handshake is complete, and the kernel accepted all that was written."""
        return self._open and self._link is not None and self._link.ready

    @property
    def silent_s(self) -> float:
        return self._link.silent_s if self._link is not None else 0.0

    @property
    def unacknowledged_s(self) -> float:
        return self._link.unacknowledged_s if self._link is not None else 0.0

    def write(self, data: bytes) -> None:
        """Write ``data`` as one record; before the end of the handshake it is lost."""
        if self._open and self._link is not None and data:
            self._tls.write(data)
            self._flush()

    def pause_reading(self) -> None:
        if self._link is not None:
            self._link.pause_reading()

    def resume_reading(self) -> None:
        if self._link is not None:
            self._link.resume_reading()

    @property
    def descriptors(self) -> tuple[int, ...]:
        return self._link.descriptors if self._link is not None else ()

    @property
    def blocker(self) -> str | None:
        """Why this connection cannot be handed to another process: the keys of TLS stay in this one."""
        return "encrypted by this process"

    def close(self) -> None:
        if self._open and self._link is not None:
            with contextlib.suppress(ssl.SSLError):  # do not wait for the peer's close notification
                self._tls.unwrap()
        self._end()

    def abort(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.abort()

    # What the TCP link calls

    def attached(self, link: Link) -> None:
        """Begin: the connection is up, the handshake is not done."""
        self._link = link
        self.peer = link.peer.replace("tcp://", "tls://", 1)
        self._timer = asyncio.get_running_loop().call_later(self._handshake_s, self._on_late)
        self.receiver.attached(self)

    def received(self, data: bytes) -> None:
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
                    self.receiver.received(plain)
        except ssl.SSLWantReadError:
            self._flush()
        except ssl.SSLError as error:
            self._fail(f"TLS: {_said(error)}")

    def lost(self, reason: str) -> None:
        self._link = None
        self._stop_timer()
        self.receiver.lost(self._why or reason)

    def writable(self) -> None:
        if self._open:
            self.receiver.writable()

    def _shake_hands(self) -> None:
        self._tls.do_handshake()
        self._flush()
        self._open = True
        self._stop_timer()
        self.receiver.writable()

    def _flush(self) -> None:
        if self._link is not None and self._outgoing.pending:
            self._link.write(self._outgoing.read())

    def _fail(self, why: str) -> None:
        self._why = why
        self._end()

    def _end(self) -> None:
        """End the connection; the alert of TLS, if there is one, is sent."""
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
