"""Proofs: they show that a command, or a question about the lease, comes unaltered from the holder. Sans-IO.

The token of a lease is sent once, in the answer that grants it. Each command and question of the holder carries the
lease's public id, a number that rises, and a proof: the first 16 bytes of HMAC-SHA256(token, key + 0x00 + number as 8
bytes big-endian + payload). If it is dated, the proof covers key + 0x01 + number + date as 8 bytes big-endian +
payload. Who overhears it can neither forge nor alter it, nor use it for another key, and the gateway accepts each
number once. Commands and questions are numbered separately; the proof of a question covers an empty payload.

:class:`Signer` is the holder's end. :class:`Verifier` and :class:`Holders` are the gateway's: the first checks proofs,
the second also numbers. The bus's thread verifies a command and leaves a note in the verifier; the event loop's thread
takes the note, so that each proof is computed once.
Source: the design's "Who may drive" and "Command age".
"""

from __future__ import annotations

import hashlib
import hmac
from collections import OrderedDict
from collections.abc import Callable

import msgspec
from msgspec import UNSET, UnsetType

from zbridge.control.command_age import CommandAge
from zbridge.errors import Code, Held, LeaseLost, Malformed, PayloadError
from zbridge.fleet.messages import Acquire, Authorization, Lease

LEASE_BYTES = 8
TOKEN_BYTES = 32
PROOF_BYTES = 16
NOTES = 1024
"""Verified commands that may wait for the event loop; the proofs of more are computed twice."""
ENDED = 16
"""Ended leases that are remembered: their holders are told why, and their ids are not given again."""
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


class Holder(msgspec.Struct):
    """A program that has the lease, or had it. asked_ms: its raw clock when it asked. ended: why its lease ended."""

    who: str
    priority: int
    verifier: Verifier
    lease_s: float
    alive: str | None
    expires_at: float
    age: CommandAge
    asked_ms: int | UnsetType = UNSET
    numbers: dict[str, int] = msgspec.field(default_factory=dict)
    """The highest number used, of commands and of questions."""
    ended: str | None = None

    def late_s(self, shown: Authorization, received_ms: float) -> float:
        """Return by how many seconds a command or question is late; raise Malformed where it should be dated."""
        try:
            return self.age.late_s(shown.t, received_ms)
        except Malformed as error:
            raise Malformed(str(error), who=self.who) from None

    def asks_again(self, request: Acquire) -> bool:
        """Return whether the holder repeats its own question because the grant did not reach it.

        That is a later question of the same name and liveliness token, while the lease was not used. A question that
        was held up on the way is an earlier one: it must not end the lease that was granted to a later one.
        """
        unused = not self.numbers and self.alive is not None and self.asked_ms is not UNSET
        same = (request.who, request.alive) == (self.who, self.alive)
        return unused and same and request.t is not UNSET and request.t > self.asked_ms  # type: ignore[operator]

    @property
    def described(self) -> str:
        return f"{self.who} (priority {self.priority})"


class Holders:
    """The holder of the lease and the last ones before it: finds out which one sent a command or a question.

    The proof is checked before the number, so that knowing a lease's id alone uses up and reveals no number.
    random: returns as many unguessable bytes as it is asked for.
    """

    def __init__(self, random: Callable[[int], bytes]) -> None:
        self.current: Holder | None = None
        self._random = random
        self._ended: OrderedDict[bytes, Holder] = OrderedDict()

    def __repr__(self) -> str:
        return f"<Holders {self.current.who if self.current else 'none'}, {len(self._ended)} before>"

    def new_lease(self) -> tuple[bytes, bytes]:
        """Return an id that no remembered lease has, and a token."""
        lease = self._random(LEASE_BYTES)
        while lease in self._ended:
            lease = ((int.from_bytes(lease, "big") + 1) % 256**LEASE_BYTES).to_bytes(LEASE_BYTES, "big")
        return lease, self._random(TOKEN_BYTES)

    def end(self, reason: str) -> Holder | None:
        """End the current lease and return its holder, if there is one."""
        holder, self.current = self.current, None
        if holder is not None:
            holder.ended = reason
            self._ended[holder.verifier.lease] = holder
            if len(self._ended) > ENDED:
                self._ended.popitem(last=False)
        return holder

    def of_command(self, attachment: bytes | None, key: str, payload: bytes) -> tuple[Holder, Authorization]:
        """Return the holder who sent a command, and its authorization, and use its number up.

        Raises Refused for other senders.
        """
        if attachment is None:
            raise LeaseLost("no lease: acquire first", Code.NO_LEASE)
        holder = self.current
        if holder is not None and (noted := holder.verifier.noted(attachment, key, payload)) is not None:
            return _use_up("commands", noted.seq, holder), noted
        shown = read(attachment)
        return self._sender("commands", shown, key, payload), shown

    def of_question(self, shown: Authorization, key: str) -> Holder:
        """Return the holder who asked to renew or release, use its number up; raise Refused for other senders."""
        return self._sender("questions", shown, key, b"")

    def _sender(self, kind: str, shown: Authorization, key: str, payload: bytes) -> Holder:
        holder = self._known(shown.lease)
        if not holder.verifier.proves(shown, key, payload):
            raise Malformed("wrong proof")
        return _use_up(kind, shown.seq, holder)

    def _known(self, lease: bytes) -> Holder:
        """Return the holder of a current or remembered lease; raise Refused for any other id."""
        holder = self.current
        if holder is not None and holder.verifier.lease == lease:
            return holder
        if lease in self._ended:
            return self._ended[lease]
        if holder is not None:
            raise Held(f"held by {holder.described}", holder=holder.who)
        raise LeaseLost("no lease: acquire first", Code.NO_LEASE)


def read(shown: bytes | None) -> Authorization:
    """Read an authorization; raise Malformed."""
    try:
        if shown is not None and len(shown) <= MOST_BYTES:
            return _decode(shown)
    except (msgspec.MsgspecError, RecursionError, ValueError) as error:
        raise Malformed(_EXPECTED) from error
    raise Malformed(_EXPECTED)


def _use_up(kind: str, seq: int, holder: Holder) -> Holder:
    """Use a proven number up and return its holder; raise Refused if it was used or passed, or the lease has ended."""
    fresh = seq > holder.numbers.get(kind, -1)
    if fresh:
        holder.numbers[kind] = seq
    if holder.ended is not None:  # who is None if repeated: anybody who overheard it may have sent it
        raise LeaseLost(f"the lease has ended ({holder.ended})", who=holder.who if fresh else None)
    if not fresh:
        raise Malformed("repeated or out of order", Code.OUT_OF_ORDER)
    return holder


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
