"""TLS before a listener's sessions: the peer is Python's own client in memory, and no socket is opened."""

from __future__ import annotations

import asyncio
import ssl
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.certificates import Authority
from tests.clock import jumping
from tests.fake_link import FakeLink
from zbridge.errors import LinkError
from zbridge.transport import TlsLink, server_context
from zbridge.transport.link import Link, Receiver

HANDSHAKE_S = 5.0


class Heard(Receiver):
    """Keeps what it hears; ``on_attached`` does what a listener does with a new link."""

    def __init__(self, on_attached: Callable[[Link], object] = lambda link: None) -> None:
        self.calls: list[str] = []
        self.data = b""
        self.reason: str | None = None
        self._on_attached = on_attached

    def attached(self, link: Link) -> None:
        self.calls.append("attached")
        self._on_attached(link)

    def received(self, data: bytes) -> None:
        self.calls.append("received")
        self.data += data

    def writable(self) -> None:
        self.calls.append("writable")

    def lost(self, reason: str) -> None:
        self.calls.append("lost")
        self.reason = reason


class Pair:
    """A link of TLS, and the client at its other end."""

    def __init__(self, server: ssl.SSLContext, client: ssl.SSLContext, heard: Heard | None = None) -> None:
        self.heard = heard or Heard()
        self.tcp = FakeLink("tcp://10.0.0.7:5000")
        self.link = TlsLink(self.heard, server, HANDSHAKE_S)
        self.link.attached(self.tcp)
        self._in, self._out = ssl.MemoryBIO(), ssl.MemoryBIO()
        self.client = client.wrap_bio(self._in, self._out, server_hostname="localhost")
        self._taken = 0

    def carry(self, *, cut: int = 1 << 20) -> None:
        """Carry what both have written, until nobody writes."""
        moved = True
        while moved:
            sent = self._out.read()
            for at in range(0, len(sent), cut):
                self.link.received(sent[at : at + cut])
            come = b"".join(self.tcp.written[self._taken :])
            self._taken = len(self.tcp.written)
            self._in.write(come)
            moved = bool(sent or come)

    def shake(self, *, cut: int = 1 << 20) -> None:
        for _ in range(4):
            try:
                self.client.do_handshake()
            except ssl.SSLWantReadError:
                self.carry(cut=cut)
        self.carry(cut=cut)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    authority = Authority(tmp_path_factory.mktemp("lab"))
    for name in ("gateway.g1", "viewer.desk"):
        authority.issue(name)
    return authority


def serving(lab: Authority, *, mutual: bool = False) -> ssl.SSLContext:
    files = lab.folder / "gateway.g1"
    return server_context(str(files / "certificate.pem"), str(files / "key.pem"), str(lab.ca) if mutual else None)


def client_of(lab: Authority, name: str | None = None) -> ssl.SSLContext:
    context = ssl.create_default_context(cafile=str(lab.ca))
    if name is not None:
        context.load_cert_chain(str(lab.folder / name / "certificate.pem"), str(lab.folder / name / "key.pem"))
    return context


@jumping
@pytest.mark.parametrize("cut", [1, 7, 1 << 20])
async def test_bytes_go_both_ways_in_any_cut_once_hands_are_shaken(lab: Authority, cut: int) -> None:
    pair = Pair(serving(lab), client_of(lab))
    assert (pair.link.peer, pair.heard.calls, pair.link.ready) == ("tls://10.0.0.7:5000", ["attached"], False)
    pair.link.write(b"too early")
    assert pair.tcp.written == []
    pair.shake(cut=cut)
    assert (pair.link.ready, pair.heard.calls) == (True, ["attached", "writable"])
    pair.client.write(bytes(range(256)) * 200)
    pair.carry(cut=cut)
    assert pair.heard.data == bytes(range(256)) * 200
    pair.link.write(b"answer")
    assert b"answer" not in b"".join(pair.tcp.written), "nothing goes in the open"
    pair.carry()
    assert pair.client.read() == b"answer"
    await asyncio.sleep(2 * HANDSHAKE_S)
    assert not pair.tcp.closed


@jumping
async def test_what_the_tcp_link_tells_is_told_and_datagrams_are_lost(lab: Authority) -> None:
    pair = Pair(serving(lab), client_of(lab))
    pair.shake()
    pair.tcp.ready, pair.tcp.silent_s, pair.tcp.unacknowledged_s = False, 2.0, 0.4
    assert (pair.link.ready, pair.link.silent_s, pair.link.unacknowledged_s) == (False, 2.0, 0.4)
    pair.link.write_datagram(b"in the open")
    assert pair.tcp.datagrams == []
    for call, told in ((pair.link.pause_reading, True), (pair.link.resume_reading, None)):
        call()
        assert told is None or pair.tcp.paused


@jumping
@pytest.mark.parametrize("said", [b"GET / HTTP/1.1\r\n\r\n", bytes(64), b"\x16\x03\x01\xff\xff" + bytes(200)])
async def test_who_speaks_no_tls_is_ended_with_the_reason(lab: Authority, said: bytes) -> None:
    pair = Pair(serving(lab), client_of(lab))
    pair.link.received(said)
    assert pair.tcp.closed
    pair.link.received(said)
    pair.link.lost("closed by peer")
    assert pair.heard.calls == ["attached", "lost"]
    assert (pair.heard.reason or "").startswith("TLS: ")


@jumping
async def test_who_never_ends_the_handshake_is_cut(lab: Authority) -> None:
    pair = Pair(serving(lab), client_of(lab))
    with pytest.raises(ssl.SSLWantReadError):
        pair.client.do_handshake()
    pair.carry()
    await asyncio.sleep(HANDSHAKE_S - 0.1)
    assert not pair.tcp.closed
    await asyncio.sleep(0.2)
    assert pair.tcp.closed
    pair.link.lost("connection lost")
    assert pair.heard.reason == "no TLS handshake within 5 s"


@jumping
async def test_who_is_refused_costs_no_handshake(lab: Authority) -> None:
    pair = Pair(serving(lab), client_of(lab), Heard(lambda link: link.close()))
    assert pair.tcp.closed
    with pytest.raises(ssl.SSLWantReadError):
        pair.client.do_handshake()
    pair.carry()
    assert pair.tcp.written == []
    pair.link.lost("closed by peer")


@jumping
@pytest.mark.parametrize(("name", "welcome"), [("viewer.desk", True), (None, False)])
async def test_with_a_ca_clients_show_a_certificate_of_it(lab: Authority, name: str | None, welcome: bool) -> None:
    pair = Pair(serving(lab, mutual=True), client_of(lab, name))
    pair.shake()
    assert (pair.link.ready, pair.tcp.closed) == (welcome, not welcome)
    pair.link.lost("closed by peer")
    assert pair.heard.reason == ("closed by peer" if welcome else "TLS: peer did not return a certificate")


@jumping
async def test_both_ends_say_goodbye(lab: Authority) -> None:
    ours, theirs = (Pair(serving(lab), client_of(lab)) for _ in range(2))
    for pair in (ours, theirs):
        pair.shake()
    ours.link.close()
    ours.link.close()
    assert ours.tcp.closed
    ours.carry()
    assert ours.client.read() == b"", "an end, not a break"
    with pytest.raises(ssl.SSLWantReadError):
        theirs.client.unwrap()
    theirs.carry()
    assert theirs.tcp.closed
    theirs.link.lost("connection lost")
    assert theirs.heard.reason == "closed by peer"


def test_files_that_cannot_be_used_are_named(lab: Authority, tmp_path: Path) -> None:
    g1, desk = lab.folder / "gateway.g1", lab.folder / "viewer.desk"
    certificate, key = str(g1 / "certificate.pem"), str(g1 / "key.pem")
    garbage = tmp_path / "garbage.pem"
    garbage.write_text("none")
    for files, said in (
        ((str(tmp_path / "gone"), key, None), "gone' with key .*: No such file or directory"),
        ((certificate, str(desk / "key.pem"), None), "key values mismatch"),
        ((str(garbage), key, None), "garbage.pem' with key"),
        ((certificate, key, str(garbage)), "^ca '.*garbage.pem': "),
    ):
        with pytest.raises(LinkError, match=said):
            server_context(*files)
