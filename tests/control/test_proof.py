"""Proofs: as the design defines them, made by one end and checked by the other."""

import hashlib
import hmac

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.proofs import proof, shown
from zbridge.control.proof import LEAST_BYTES, MOST_BYTES, NOTES, Signer, Verifier, read
from zbridge.errors import Malformed, PayloadError
from zbridge.fleet.messages import Authorization, Lease

LEASE, TOKEN = bytes(range(8)), bytes(range(100, 132))
GRANTED = Lease(ok=True, lease=LEASE, token=TOKEN, expires_in_s=3.0, holder="ann")
DRIVE, RENEW = "fleet/r1/@cmd/drive", "fleet/r1/@rpc/control/renew"
PAYLOAD = msgpack.packb({"forward": 0.5})


def test_the_proof_of_a_command_is_what_the_design_says_byte_by_byte() -> None:
    signed = (
        b"fleet/r1/@cmd/drive\x00\x00\x00\x00\x00\x00\x00\x00\x01\x81\xa7forward\xcb\x3f\xe0\x00\x00\x00\x00\x00\x00"
    )
    assert PAYLOAD in signed
    expected = hmac.new(TOKEN, signed, hashlib.sha256).digest()[:16]
    assert msgpack.unpackb(Signer(GRANTED).command(DRIVE, PAYLOAD)) == {"lease": LEASE, "seq": 1, "proof": expected}


def test_the_proof_of_a_question_has_an_empty_payload() -> None:
    signed = b"fleet/r1/@rpc/control/renew\x00\x00\x00\x00\x00\x00\x00\x00\x01"
    expected = hmac.new(TOKEN, signed, hashlib.sha256).digest()[:16]
    assert msgpack.unpackb(Signer(GRANTED).question(RENEW)) == {"lease": LEASE, "seq": 1, "proof": expected}


def test_commands_and_questions_are_numbered_apart_and_rise() -> None:
    signer = Signer(GRANTED)
    commands = [msgpack.unpackb(signer.command(DRIVE, b""))["seq"] for _ in range(3)]
    questions = [msgpack.unpackb(signer.question(RENEW))["seq"] for _ in range(3)]
    assert commands == questions == [1, 2, 3]
    assert msgpack.unpackb(signer.command("fleet/r1/@cmd/mode", b""))["seq"] == 4, "whatever the key"


@given(st.binary(min_size=32, max_size=32), st.text(min_size=1), st.integers(0, 2**64 - 1), st.binary(max_size=300))
def test_a_verifier_takes_what_the_design_defines(token: bytes, key: str, seq: int, payload: bytes) -> None:
    key = key.encode("utf-8", "ignore").decode()
    verifier = Verifier(LEASE, token)
    said = shown(LEASE, token, key, seq, payload)
    assert verifier.plausible(said)
    assert verifier.proves(read(said), key, payload)
    assert not verifier.proves(read(said), key, payload + b"x")
    assert not verifier.proves(read(said), key + "x", payload)


def test_a_verifier_takes_what_a_signer_signs_again_and_again() -> None:
    signer, verifier = Signer(GRANTED), Verifier(LEASE, TOKEN)
    for _ in range(3):
        assert verifier.proves(read(signer.command(DRIVE, PAYLOAD)), DRIVE, PAYLOAD)
        assert verifier.proves(read(signer.question(RENEW)), RENEW)


@pytest.mark.parametrize("seq", [0, 1, 127, 128, 2**16, 2**32, 2**64 - 1])
def test_what_a_true_holder_sends_is_always_plausible(seq: int) -> None:
    said = shown(LEASE, TOKEN, DRIVE, seq, PAYLOAD)
    assert LEAST_BYTES <= len(said) <= MOST_BYTES
    assert Verifier(LEASE, TOKEN).plausible(said)


@pytest.mark.parametrize(
    "said",
    [
        None,
        b"",
        LEASE,
        shown(LEASE, TOKEN, DRIVE, 1)[:-12],
        shown(LEASE, TOKEN, DRIVE, 1) + bytes(100),
        shown(LEASE[::-1], TOKEN, DRIVE, 1),
        bytes(60),
    ],
)
def test_what_cannot_be_a_proof_is_told_by_a_look(said: bytes | None) -> None:
    assert not Verifier(LEASE, TOKEN).plausible(said)


@pytest.mark.parametrize("said", [None, b"", b"\xc1", b"\x90", msgpack.packb({"lease": LEASE, "seq": 1})])
def test_what_is_no_authorization_is_malformed(said: bytes | None) -> None:
    with pytest.raises(Malformed, match=r"expected \{lease, seq, proof\}"):
        read(said)


@pytest.mark.parametrize("missing", ["lease", "token"])
def test_a_lease_without_its_id_or_token_cannot_be_signed_for(missing: str) -> None:
    fields = {"lease": LEASE, "token": TOKEN, missing: None}
    with pytest.raises(PayloadError):
        Signer(Lease(ok=True, **fields))  # type: ignore[arg-type]


def test_nothing_that_prints_shows_the_token() -> None:
    printed = repr(Signer(GRANTED)) + repr(Verifier(LEASE, TOKEN))
    assert TOKEN.hex() not in printed
    assert "'" not in printed


def test_an_authorization_travels_with_three_fields() -> None:
    said = Authorization(lease=LEASE, seq=7, proof=proof(TOKEN, DRIVE, 7))
    assert read(shown(LEASE, TOKEN, DRIVE, 7)) == said


def test_what_was_proven_is_noted_once_and_only_as_it_was() -> None:
    verifier = Verifier(LEASE, TOKEN)
    attachment = Signer(GRANTED).command(DRIVE, PAYLOAD)
    said = read(attachment)
    for key, payload in (("fleet/r1/@cmd/motor/a", PAYLOAD), (DRIVE, PAYLOAD + b"\0")):
        verifier.note(attachment, said, DRIVE, PAYLOAD)
        assert verifier.noted(attachment, key, payload) is None
    verifier.note(attachment, said, DRIVE, PAYLOAD)
    assert verifier.noted(attachment, DRIVE, PAYLOAD) == said
    assert verifier.noted(attachment, DRIVE, PAYLOAD) is None


def test_notes_are_bounded() -> None:
    verifier = Verifier(LEASE, TOKEN)
    said = read(Signer(GRANTED).command(DRIVE, PAYLOAD))
    for number in range(3 * NOTES):
        verifier.note(number.to_bytes(4, "big"), said, DRIVE, PAYLOAD)
    assert len(verifier._notes) <= NOTES
