"""Proofs as the design defines them, made without the code under test.

``proof = HMAC-SHA256(token, concrete key + 0x00 + seq as 8 bytes big-endian + payload)[:16]``, and of what is dated
``HMAC-SHA256(token, concrete key + 0x01 + seq as 8 bytes big-endian + t as 8 bytes big-endian + payload)[:16]``.
"""

from __future__ import annotations

import hashlib
import hmac
import itertools
import struct
from collections.abc import Callable
from typing import Any

import msgpack


def proof(token: bytes, key: str, seq: int, payload: bytes = b"", t: int | None = None) -> bytes:
    """Prove one command; a question about the lease has no payload here."""
    numbers = b"\x00" + struct.pack(">Q", seq) if t is None else b"\x01" + struct.pack(">QQ", seq, t)
    return hmac.new(token, key.encode() + numbers + payload, hashlib.sha256).digest()[:16]


def shown(lease: bytes, token: bytes, key: str, seq: int, payload: bytes = b"", t: int | None = None) -> bytes:
    """Write the attachment of a command, or the payload of a question."""
    fields = {"lease": lease, "seq": seq, "proof": proof(token, key, seq, payload, t)}
    return packed(fields if t is None else {**fields, "t": t})


def packed(fields: dict[str, Any]) -> bytes:
    payload: bytes = msgpack.packb(fields)
    return payload


class Holder:
    """One lease that was granted: numbers and proves what is sent by it."""

    def __init__(self, lease: bytes, token: bytes, robot: str = "r1", *, first: int = 1) -> None:
        self.lease = lease
        self.token = token
        self.seq = first - 1
        self.asked = first - 1
        self._keys = f"fleet/{robot}/"

    @classmethod
    def of(cls, answer: dict[str, Any], robot: str = "r1", *, first: int = 1) -> Holder:
        """Make one of the answer that granted the lease."""
        return cls(answer["lease"], answer["token"], robot, first=first)

    def attachment(self, command: str, payload: bytes, t: int | None = None) -> bytes:
        """Give what goes with the next command: ``drive``, ``motor/left``; t: its date, in ms."""
        self.seq += 1
        return shown(self.lease, self.token, f"{self._keys}@cmd/{command}", self.seq, payload, t)

    def question(self, name: str, t: int | None = None) -> bytes:
        """Give what is asked next: ``renew`` or ``release``."""
        self.asked += 1
        return shown(self.lease, self.token, f"{self._keys}@rpc/control/{name}", self.asked, t=t)


def numbered() -> Callable[[int], bytes]:
    """Give an authority its random bytes: the id and the token of lease n are nothing but bytes n."""
    calls = itertools.count(2)
    return lambda size: bytes([next(calls) // 2 % 256]) * size


def lease(number: int, robot: str = "r1") -> Holder:
    """Give the lease of this number, as :func:`numbered` makes them."""
    return Holder(bytes([number]) * 8, bytes([number]) * 32, robot)
