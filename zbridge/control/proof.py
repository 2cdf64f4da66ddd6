"""Proofs: what shows that a command, or a question about the lease, comes from the holder as it is. Sans-IO.

The token of a lease is told once, in the answer that grants it. What the holder sends afterwards carries the lease's
public id, a number that rises, and a proof: the first 16 bytes of HMAC-SHA256(token, key + 0x00 + number as 8 bytes
big-endian + payload). Whoever overhears it can neither forge nor alter it, nor use it for another key, and the
gateway takes each number once. Commands are numbered apart from questions, whose payload is empty in the proof.

:class:`Signer` is the holder's end. :class:`Verifier` is the gateway's. It keeps no numbers. The bus's thread proves a
command and leaves a note of it; the event loop's takes the note, so that each proof is reckoned once.
Source: the design's "Who may drive".
"""

from __future__ import annotations

import hashlib
import hmac

import msgspec

from zbridge.errors import Malformed, PayloadError
from zbridge.fleet.messages import Authorization, Lease

LEASE_BYTES = 8
TOKEN_BYTES = 32
PROOF_BYTES = 16
NOTES = 1024
"""Proven commands that may wait for the event loop; where there are more, their proofs are reckoned again."""
LEAST_BYTES, MOST_BYTES = 46, 128
"""Bytes of an authorization: as short as MessagePack can write it, and with room for those who write it longer."""

_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(Authorization).decode


class Signer:
    """Numbers and proves what the holder of one lease sends. Raises PayloadError where the lease was not granted."""

    def __init__(self, lease: Lease) -> None:
        if lease.lease is None or lease.token is None:
            raise PayloadError("Lease: granted without an id or a token")
        self.lease = lease.lease
        self._prepared = _prepare(lease.token)
        self._commands = 0
        self._questions = 0

    def __repr__(self) -> str:
        return f"<Signer of {self.lease.hex()}>"

    def command(self, key: str, payload: bytes) -> bytes:
        """Give the attachment of the next command. key: the one it is put on, without wildcards."""
        self._commands += 1
        return self._sign(key, self._commands, payload)

    def question(self, key: str) -> bytes:
        """Give the payload of the next question: ``renew`` or ``release``."""
        self._questions += 1
        return self._sign(key, self._questions, b"")

    def _sign(self, key: str, seq: int, payload: bytes) -> bytes:
        return _encode(Authorization(lease=self.lease, seq=seq, proof=_proof(self._prepared, key, seq, payload)))


class Verifier:
    """Tells what the holder of one lease sent from what anybody else did."""

    def __init__(self, lease: bytes, token: bytes) -> None:
        self.lease = lease
        self._prepared = _prepare(token)
        self._notes: dict[bytes, tuple[Authorization, str, bytes]] = {}

    def __repr__(self) -> str:
        return f"<Verifier of {self.lease.hex()}>"

    def plausible(self, shown: bytes | None) -> bool:
        """Tell by the cheapest look there is whether this can be an authorization of this lease."""
        return shown is not None and LEAST_BYTES <= len(shown) <= MOST_BYTES and self.lease in shown

    def proves(self, shown: Authorization, key: str, payload: bytes = b"") -> bool:
        """Tell whether the proof is the holder's, for this key and this payload; its number is looked at by others."""
        return hmac.compare_digest(_proof(self._prepared, key, shown.seq, payload), shown.proof)

    def note(self, attachment: bytes, shown: Authorization, key: str, payload: bytes) -> None:
        """Keep that this command was proven, until :meth:`noted` is asked for it; any one thread may call it."""
        if len(self._notes) >= NOTES:
            self._notes.clear()
        self._notes[attachment] = (shown, key, payload)

    def noted(self, attachment: bytes, key: str, payload: bytes) -> Authorization | None:
        """Give the authorization of a command that was proven as it is here; None once it was asked for."""
        note = self._notes.pop(attachment, None)
        return note[0] if note is not None and note[1:] == (key, payload) else None


def read(shown: bytes | None) -> Authorization:
    """Read an authorization; raise Malformed."""
    try:
        if shown is not None and len(shown) <= MOST_BYTES:
            return _decode(shown)
    except (msgspec.MsgspecError, RecursionError, ValueError) as error:
        raise Malformed(_EXPECTED) from error
    raise Malformed(_EXPECTED)


def _prepare(token: bytes) -> hmac.HMAC:
    """Do once what depends on the token alone: copying it is cheaper than making it."""
    return hmac.new(token, digestmod=hashlib.sha256)


def _proof(prepared: hmac.HMAC, key: str, seq: int, payload: bytes) -> bytes:
    code = prepared.copy()
    code.update(b"%b\0%b%b" % (key.encode(), seq.to_bytes(8, "big"), payload))
    return code.digest()[:PROOF_BYTES]


_EXPECTED = "malformed authorization: expected {lease, seq, proof}"
