"""Proofs: they show that a command, or a question about the lease, comes unaltered from the holder. Sans-IO.

The token of a lease is sent once, in the answer that grants it. Each command and question of the holder carries the
lease's public id, a number that rises, and a proof: the first 16 bytes of HMAC-SHA256(token, key + 0x00 + number as 8
bytes big-endian + payload). If it is dated, the proof covers key + 0x01 + number + date as 8 bytes big-endian +
payload. Who overhears it can neither forge nor alter it, nor use it for another key, and the gateway accepts each
number once. Commands and questions are numbered separately; the proof of a question covers an empty payload.

:class:`Signer` is the holder's end. :class:`Verifier` is the gateway's: it checks proofs;
:class:`zbridge.control.holders.Holders` also checks numbers. The bus's thread verifies a command and leaves a note in
the verifier; the event loop's thread takes the note, so that each proof is computed once.
Source: "Proofs" and "Timestamps" in ``lease.md``.
"""

from __future__ import annotations

import hashlib
import hmac

import msgspec
from msgspec import UNSET, UnsetType

from zbridge.errors import Malformed, PayloadError
from zbridge.fleet.lease_messages import Authorization, Lease

PROOF_BYTES = 16
NOTES = 1024
"""Verified commands that may wait for the event loop; the proofs of more are computed twice."""
LEAST_BYTES, MOST_BYTES = 46, 128
"""Bytes of an authorization: the shortest MessagePack form, and room for longer forms."""

_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(Authorization).decode


class Signer:
    """Numbers and proves what the holder of one lease sends. Raises PayloadError if the lease was not granted."""

    def __init__(self, lease: Lease) -> None:
        if lease.lease is None or lease.token is None:
            raise PayloadError("Lease: granted without an id or a token")
        self.lease = lease.lease
        self.dates = lease.max_age_s is not UNSET
        """Whether commands and renewals must be dated."""
        self._prepared = _prepare(lease.token)
        self._commands = 0
        self._questions = 0

    def __repr__(self) -> str:
        return f"<Signer of {self.lease.hex()}>"

    def command(self, key: str, payload: bytes, given_ms: int) -> bytes:
        """Return the attachment of the next command.

        key: the key it is put on, without wildcards. given_ms: the raw clock when it was given.
        """
        self._commands += 1
        return self._sign(key, self._commands, payload, given_ms)

    def renewal(self, key: str, given_ms: int) -> bytes:
        """Return the payload of the next question, ``renew``."""
        self._questions += 1
        return self._sign(key, self._questions, b"", given_ms)

    def release(self, key: str) -> bytes:
        """Return the payload of the next question, ``release``: it is never too late."""
        self._questions += 1
        return self._sign(key, self._questions, b"", UNSET)

    def _sign(self, key: str, seq: int, payload: bytes, given_ms: int | UnsetType) -> bytes:
        date = given_ms if self.dates else UNSET
        proof = _proof(self._prepared, key, seq, payload, date)
        return _encode(Authorization(lease=self.lease, seq=seq, proof=proof, t=date))


class Verifier:
    """Verifies what the holder of one lease sends; keeps no numbers."""

    def __init__(self, lease: bytes, token: bytes) -> None:
        self.lease = lease
        self._prepared = _prepare(token)
        self._notes: dict[bytes, tuple[Authorization, str, bytes]] = {}

    def __repr__(self) -> str:
        return f"<Verifier of {self.lease.hex()}>"

    def plausible(self, shown: bytes | None) -> bool:
        """Return whether this can be an authorization of this lease, without decoding it."""
        return shown is not None and LEAST_BYTES <= len(shown) <= MOST_BYTES and self.lease in shown

    def proves(self, shown: Authorization, key: str, payload: bytes = b"") -> bool:
        """Return whether the proof is the holder's, for this key and payload. The caller must check the number."""
        return hmac.compare_digest(_proof(self._prepared, key, shown.seq, payload, shown.t), shown.proof)

    def note(self, attachment: bytes, shown: Authorization, key: str, payload: bytes) -> None:
        """Record that this command was verified, until :meth:`noted` is asked for it. One thread may call this."""
        if len(self._notes) >= NOTES:
            self._notes.clear()
        self._notes[attachment] = (shown, key, payload)

    def noted(self, attachment: bytes, key: str, payload: bytes) -> Authorization | None:
        """Return the authorization of a command that was verified with this key and payload, once; else None."""
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
    """Do what depends on the token alone: copying it is cheaper than making it anew."""
    return hmac.new(token, digestmod=hashlib.sha256)


def _proof(prepared: hmac.HMAC, key: str, seq: int, payload: bytes, date: int | UnsetType) -> bytes:
    code = prepared.copy()
    if date is UNSET:
        code.update(b"%b\0%b%b" % (key.encode(), seq.to_bytes(8, "big"), payload))
    else:
        code.update(b"%b\1%b%b%b" % (key.encode(), seq.to_bytes(8, "big"), date.to_bytes(8, "big"), payload))
    return code.digest()[:PROOF_BYTES]


_EXPECTED = "malformed authorization: expected {lease, seq, proof}"
