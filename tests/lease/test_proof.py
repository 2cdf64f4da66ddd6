"""Proofs: as the design defines them, made by one end and checked by the other."""

import hashlib
import hmac

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.bounds import most_kept
from tests.proofs import packed, proof, shown
from zbridge.errors import Malformed, PayloadError
from zbridge.fleet.lease_messages import Authorization, Lease
from zbridge.lease.proof import LEAST_BYTES, MOST_BYTES, NOTES, Signer, Verifier, read

LEASE, TOKEN = bytes(range(8)), bytes(range(100, 132))
GRANTED = Lease(ok=True, lease=LEASE, token=TOKEN, expires_in_s=3.0, holder="ann")
DRIVE, RENEW = "fleet/r1/@cmd/drive", "fleet/r1/@rpc/control/renew"
RELEASE = "fleet/r1/@rpc/control/release"
PAYLOAD = packed({"forward": 0.5})
PROOF = proof(TOKEN, DRIVE, 9, PAYLOAD)
WHOLE = {"lease": LEASE, "seq": 9, "proof": PROOF}
ATTACHMENT = packed(WHOLE)


T = 0x0102030405
DATED = Lease(ok=True, lease=LEASE, token=TOKEN, expires_in_s=3.0, holder="ann", max_age_s=0.4)
THREE = b"\0\0\0\0\0\0\0\x03"
DATE = b"\0\0\0\x01\x02\x03\x04\x05"
SIGNED = {
    "command": (GRANTED, DRIVE, PAYLOAD, b"fleet/r1/@cmd/drive\0" + THREE + PAYLOAD, {}),
    "renew": (GRANTED, RENEW, None, b"fleet/r1/@rpc/control/renew\0" + THREE, {}),
    "dated command": (DATED, DRIVE, PAYLOAD, b"fleet/r1/@cmd/drive\1" + THREE + DATE + PAYLOAD, {"t": T}),
    "dated renew": (DATED, RENEW, None, b"fleet/r1/@rpc/control/renew\1" + THREE + DATE, {"t": T}),
    "release": (DATED, RELEASE, None, b"fleet/r1/@rpc/control/release\0" + THREE, {}),
}


@pytest.mark.parametrize(("lease", "key", "payload", "signed", "dated"), SIGNED.values(), ids=SIGNED)
def test_a_proof_is_what_the_design_says_byte_by_byte_and_commands_are_numbered_apart(
    lease: Lease, key: str, payload: bytes | None, signed: bytes, dated: dict[str, int]
) -> None:
    assert PAYLOAD == b"\x81\xa7forward\xcb\x3f\xe0\0\0\0\0\0\0"
    signer = Signer(lease)
    for _ in range(2):
        signer.command("fleet/r1/@cmd/mode", b"", T)
        signer.renewal(RENEW, T)
    if payload is not None:
        said = signer.command(key, payload, T)
    else:
        said = signer.release(key) if key == RELEASE else signer.renewal(key, T)
    expected = hmac.new(TOKEN, signed, hashlib.sha256).digest()[:16]
    assert msgpack.unpackb(said) == {"lease": LEASE, "seq": 3, "proof": expected, **dated}
    assert Verifier(LEASE, TOKEN).proves(read(said), key, payload or b"")


@given(
    st.binary(min_size=32, max_size=32),
    st.text(min_size=1),
    st.integers(0, 2**64 - 1),
    st.binary(max_size=300),
    st.none() | st.integers(0, 2**53 - 1),
)
def test_a_verifier_takes_what_the_design_defines_and_nothing_near_it(token, key, seq, payload, t) -> None:
    key = key.encode("utf-8", "ignore").decode()
    verifier = Verifier(LEASE, token)
    said = shown(LEASE, token, key, seq, payload, t)
    assert LEAST_BYTES <= len(said) <= MOST_BYTES
    assert verifier.plausible(said)
    assert verifier.proves(read(said), key, payload)
    assert not verifier.proves(read(said), key, payload + b"x")
    assert not verifier.proves(read(said), key + "x", payload)
    undated = {name: value for name, value in msgpack.unpackb(said).items() if name != "t"}
    if t is not None:
        assert not verifier.proves(read(packed(undated)), key, payload), "a date cannot be taken off"
    later = packed({**undated, "t": (t or 0) + 1})
    assert t == 2**53 - 1 or not verifier.proves(read(later), key, payload), "nor altered, nor put on"


def test_a_proof_or_a_token_with_one_bit_changed_proves_nothing() -> None:
    for bit in range(8 * 16):
        near = (int.from_bytes(PROOF, "big") ^ 1 << bit).to_bytes(16, "big")
        assert not Verifier(LEASE, TOKEN).proves(Authorization(lease=LEASE, seq=9, proof=near), DRIVE, PAYLOAD)
    for bit in range(8 * 32):
        near = (int.from_bytes(TOKEN, "big") ^ 1 << bit).to_bytes(32, "big")
        assert not Verifier(LEASE, near).proves(Authorization(lease=LEASE, seq=9, proof=PROOF), DRIVE, PAYLOAD)


@pytest.mark.parametrize(
    "said",
    [None, b"", ATTACHMENT[:-12], ATTACHMENT + bytes(100), shown(LEASE[::-1], TOKEN, DRIVE, 1), bytes(60)],
)
def test_what_cannot_be_a_proof_is_told_by_a_look(said: bytes | None) -> None:
    assert not Verifier(LEASE, TOKEN).plausible(said)


MALFORMED = {
    "nothing": None,
    "no map": msgpack.packb([*WHOLE.values()]),
    "nil": msgpack.packb(None),
    "the bare token": TOKEN,
    "no MessagePack": b"\xc1",
    **{f"{name} is nil": packed({**WHOLE, name: None}) for name in WHOLE},
    **{f"{name} is not there": packed({key: WHOLE[key] for key in WHOLE if key != name}) for name in WHOLE},
    "a lease as text": packed({**WHOLE, "lease": LEASE.decode()}),
    "a short lease": packed({**WHOLE, "lease": LEASE[1:]}),
    "a long lease": packed({**WHOLE, "lease": LEASE + b"\x01"}),
    "a short proof": packed({**WHOLE, "proof": PROOF[:15]}),
    "no proof at all": packed({**WHOLE, "proof": b""}),
    "a longer proof": packed({**WHOLE, "proof": PROOF + b"\x00"}),
    "a proof as text": packed({**WHOLE, "proof": "0123456789abcdef"}),
    "a negative number": packed({**WHOLE, "seq": -1}),
    "a fraction": packed({**WHOLE, "seq": 9.5}),
    "a truth": packed({**WHOLE, "seq": True}),
    "a date of 2**53": packed({**WHOLE, "t": 2**53}),
    "a date before zero": packed({**WHOLE, "t": -1}),
    "a date that is a fraction": packed({**WHOLE, "t": 1.5}),
    "a date that is nil": packed({**WHOLE, "t": None}),
    "more behind it": ATTACHMENT + b"\x00",
    "much beside it": packed({**WHOLE, "x": bytes(200)}),
    "deeply nested": b"\x91" * 100_000 + b"\xc0",
    "deeply nested but short": ATTACHMENT.replace(b"\x83", b"\x84", 1) + b"\xa1x" + b"\x91" * 60,
    **{f"cut at {size}": ATTACHMENT[:size] for size in range(len(ATTACHMENT))},
}


@pytest.mark.parametrize("said", MALFORMED.values(), ids=MALFORMED)
def test_what_is_no_authorization_is_malformed(said: bytes | None) -> None:
    with pytest.raises(Malformed, match=r"^malformed authorization: expected \{lease, seq, proof\}$"):
        read(said)


def test_whatever_order_its_fields_have_and_however_long_they_are_written_it_is_read() -> None:
    lease, proven = (bytes([0xC6, 0, 0, 0, len(value)]) + value for value in (LEASE, PROOF))
    number = b"\xcf" + bytes(7) + b"\x09"
    long = b"\xdf\0\0\0\x03" + b"\xda\0\5lease" + lease + b"\xda\0\3seq" + number + b"\xda\0\5proof" + proven
    for said in (ATTACHMENT, packed(dict(reversed(WHOLE.items()))), long, packed({**WHOLE, "more": "to come"})):
        assert read(said) == Authorization(lease=LEASE, seq=9, proof=PROOF)


@pytest.mark.parametrize("missing", ["lease", "token"])
def test_a_lease_without_its_id_or_token_cannot_be_signed_for(missing: str) -> None:
    fields = {"lease": LEASE, "token": TOKEN, missing: None}
    with pytest.raises(PayloadError):
        Signer(Lease(ok=True, **fields))  # type: ignore[arg-type]


def test_nothing_that_prints_shows_the_token() -> None:
    printed = repr(Signer(GRANTED)) + repr(Verifier(LEASE, TOKEN))
    assert TOKEN.hex() not in printed
    assert "'" not in printed


def test_what_was_proven_is_noted_once_and_only_as_it_was_and_notes_are_bounded() -> None:
    verifier, said = Verifier(LEASE, TOKEN), read(ATTACHMENT)
    for key, payload in (("fleet/r1/@cmd/motor/a", PAYLOAD), (DRIVE, PAYLOAD + b"\0")):
        verifier.note(ATTACHMENT, said, DRIVE, PAYLOAD)
        assert verifier.noted(ATTACHMENT, key, payload) is None
    verifier.note(ATTACHMENT, said, DRIVE, PAYLOAD)
    assert verifier.noted(ATTACHMENT, DRIVE, PAYLOAD) == said
    assert verifier.noted(ATTACHMENT, DRIVE, PAYLOAD) is None
    for number in range(3 * NOTES):
        verifier.note(number.to_bytes(4, "big"), said, DRIVE, PAYLOAD)
    assert most_kept(verifier) <= NOTES
