"""A router's own words: who it says a member is, whom it logs, and what it makes of Zenoh's log."""

from __future__ import annotations

import logging

import pytest

from tests.access import LAB
from zbridge.bus import Neighbour, Tls
from zbridge.errors import Refused
from zbridge.fleet import payload as payloads
from zbridge.fleet.processes import Membership
from zbridge.security.router import Router, log_zenoh_line, translate_log_line
from zbridge.security.router_settings import RouterPlan, RouterSettings

HINT = ". Hint: increase the system open file limit."
HEAD = "2026-11-22T03:30:33.272777Z  WARN acc-0 ThreadId(05) zenoh_link_tls::unicast: "
LINES = [
    ("invalid peer certificate: certificate expired: verification time 1 (UNIX), but" + HINT, "has expired"),
    ("invalid peer certificate: certificate not valid yet: verification time 1" + HINT, "is not valid yet"),
    ("Closing TLS link 127.0.0.1:1 => 127.0.0.1:2 : remote certificate chain expired", "closed a connection: its"),
    ("peer sent no certificates" + HINT, "showed no certificate"),
    ("invalid peer certificate: UnknownIssuer" + HINT, "is of another authority"),
    ("invalid peer certificate: Other" + HINT, "its certificate is not valid"),
    ("received corrupt message of type InvalidContentType" + HINT, "spoke no TLS"),
    ("received fatal alert: UnknownCA" + HINT, "does not know the authority of this router's certificate"),
    ("received fatal alert: BadCertificate" + HINT, "did not accept this router's certificate"),
    ("tls handshake eof" + HINT, "ended before it had said who it was"),
    ("Unknown token id=2", "took back a token, subscription or queryable that its rules had not let through"),
    ("Too many open files (os error 24)" + HINT, "may open no more files"),
]


class Question:
    key = payload = attachment = None

    def __init__(self, asked: str) -> None:
        self.asked = asked
        self.answers: list[Membership] = []

    def answer(self, payload: bytes) -> None:
        self.answers.append(payloads.decode(Membership, payload))

    def refuse(self, refusal: Refused) -> None:
        raise AssertionError(refusal)


@pytest.fixture
def router() -> Router:
    return Router(RouterPlan(RouterSettings(tls=Tls("ca.pem")), LAB), lambda: 12345)


@pytest.mark.parametrize(
    ("name", "answers"),
    [
        ("h1", [Membership(name="h1", role="hq", robots=("r1",), stamp_ns=12345)]),
        ("v1", [Membership(name="v1", role="viewer", stamp_ns=12345)]),
        ("nobody", []),
        ("*", []),
    ],
)
def test_a_member_is_told_who_it_is(router: Router, name: str, answers: list[Membership]) -> None:
    question = Question(f"fleet/@bus/whoami/{name}")
    router.answer(question)  # type: ignore[arg-type]
    assert question.answers == answers


def test_who_comes_and_goes_is_logged_and_an_unknown_name_is_a_warning(
    router: Router, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    for name in ("viewer.v1", "viewer.op1", None):
        router.note(Neighbour(name, "tls/10.0.0.7:50000", "a1"), True)
    router.note(Neighbour("viewer.v1", "tls/10.0.0.7:50000", "a1"), False)
    assert [record.levelno for record in caplog.records] == [logging.INFO, *2 * [logging.WARNING], logging.INFO]
    assert "viewer.op1 connected from tls/10.0.0.7:50000: its certificate is of this authority" in caplog.text


@pytest.mark.parametrize(("said", "words"), LINES)
def test_zenohs_warnings_are_said_in_words(said: str, words: str) -> None:
    level, text = translate_log_line(HEAD + said)
    assert words in text
    assert level == logging.WARNING
    assert "Hint" not in text


def test_any_other_line_keeps_its_level_and_loses_its_place_in_zenohs_source() -> None:
    line = "2026-11-22T03:48:39.7Z ERROR ThreadId(10) zenoh::net: Broken. at /root/zenoh/src/net/x.rs:388."
    assert translate_log_line(line) == (logging.ERROR, "Zenoh: zenoh::net: Broken.")
    assert translate_log_line("a line of something else")[0] == logging.DEBUG
    assert translate_log_line(HEAD + "Unable to open listener tcp/1: in use")[0] == logging.DEBUG


def test_a_line_of_zenoh_is_an_event_whose_text_tells_repeated_ones_apart(caplog: pytest.LogCaptureFixture) -> None:
    log_zenoh_line(HEAD + LINES[0][0])
    (record,) = caplog.records
    assert (record.__dict__["event"], record.__dict__["fields"]) == ("zenoh", {"warning": record.getMessage()})
