"""Why a router was not reached: handshakes on loopback with what is not the router that was expected."""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path

import msgspec
import pytest

from tests.certificates import Authority, openssl
from zbridge.bus import BusSettings, Tls
from zbridge.bus.tls import refusal
from zbridge.bus.tls.files import folder_tls
from zbridge.bus.tls.refusal import ConnectFault, ask_endpoint, why_not

HOST = "127.0.0.1"


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    authority = Authority(tmp_path_factory.mktemp("lab"))
    for name in ("router.hub", "gateway.g1"):
        authority.issue(name)
    return authority


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    authority = Authority(tmp_path_factory.mktemp("other"), "other")
    for name in ("router.hub", "gateway.g9"):
        authority.issue(name)
    return authority


@contextlib.contextmanager
def serving(answer: Callable[[socket.socket], None]) -> Iterator[int]:
    """Let a thread answer each connection; give the port."""
    held: list[socket.socket] = []

    def serve() -> None:
        with contextlib.suppress(OSError):
            while True:
                link = server.accept()[0]
                held.append(link)
                link.settimeout(5.0)
                with contextlib.suppress(OSError):
                    answer(link)

    with socket.create_server((HOST, 0)) as server:
        thread = threading.Thread(target=serve)
        thread.start()
        yield int(server.getsockname()[1])
        server.shutdown(socket.SHUT_RDWR)
        for link in held:
            with contextlib.suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
        thread.join(5.0)
    for link in held:
        link.close()


def member(authority: Authority, name: str) -> Tls:
    return folder_tls(authority.folder / name)


def router(tls: Tls) -> Callable[[socket.socket], None]:
    """Answer as a router with these files does: shake hands, wait for a first message, and end at one that is none."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(tls.ca)
    context.load_cert_chain(str(tls.certificate), tls.key)

    def answer(link: socket.socket) -> None:
        with context.wrap_socket(link, server_side=True) as secure:
            secure.settimeout(0.05)
            secure.recv(1)

    return answer


def ends(link: socket.socket) -> None:
    """End at the first bytes, as a router of plain TCP does."""
    link.recv(1)
    link.shutdown(socket.SHUT_RDWR)


def silent(link: socket.socket) -> None:
    """Take everything and say nothing."""


def told(finding: ConnectFault | None, port: int) -> tuple[str, bool] | None:
    return None if finding is None else (finding.text.replace(f"{HOST}:{port}", "HUB"), finding.refused)


def asked(answer: Callable[[socket.socket], None], tls: Tls | None, kind: str = "tls") -> tuple[str, bool] | None:
    """Say what is found out about a router that answers so."""
    with serving(answer) as port:
        return told(ask_endpoint(f"{kind}/{HOST}:{port}", tls), port)


def test_a_router_that_takes_our_certificate_is_there_but_silent(lab: Authority) -> None:
    found = asked(router(member(lab, "router.hub")), member(lab, "gateway.g1"))
    assert found == ("HUB takes our certificate, but answers nothing", False)


def test_an_authority_without_key_usage_is_trusted_by_every_python_as_zenoh_does(tmp_path: Path) -> None:
    lax = Authority(tmp_path, strict=False)
    for name in ("router.hub", "gateway.g1"):
        lax.issue(name)
    found = asked(router(member(lax, "router.hub")), member(lax, "gateway.g1"))
    assert found == ("HUB takes our certificate, but answers nothing", False)


def test_a_router_of_another_authority_is_not_trusted_and_does_not_trust_us(lab: Authority, other: Authority) -> None:
    ours = member(lab, "gateway.g1")
    expected = f"the certificate of the router at HUB is of another authority than {ours.ca}"
    assert asked(router(member(other, "router.hub")), ours) == (expected, True)
    theirs = msgspec.structs.replace(member(other, "gateway.g9"), ca=ours.ca)
    expected = "HUB refused gateway.g9: its certificate is of another authority"
    assert asked(router(member(lab, "router.hub")), theirs) == (expected, True)


def test_a_router_that_wants_a_certificate_is_told_where_none_was_shown(lab: Authority) -> None:
    expected = "HUB wants a certificate, and we showed none: give --tls FOLDER, or bus.tls with certificate and key"
    assert asked(router(member(lab, "router.hub")), Tls(str(lab.ca))) == (expected, True)


def test_a_router_whose_certificate_names_another_host_is_told(lab: Authority, tmp_path: Path) -> None:
    strange = Authority(tmp_path)
    files = tmp_path / "files"
    files.mkdir()
    openssl(
        *("req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "5"),
        *("-subj", "/CN=router.hub", "-addext", "subjectAltName=DNS:hub.lab", "-CA", str(strange.ca)),
        *("-addext", "basicConstraints=critical,CA:FALSE", "-CAkey", str(tmp_path / "ca.key")),
        *("-keyout", str(files / "key.pem"), "-out", str(files / "certificate.pem")),
    )
    ours = folder_tls(strange.issue("gateway.g1"))
    hub = Tls(str(strange.ca), str(files / "certificate.pem"), str(files / "key.pem"))
    found = asked(router(hub), ours)
    assert found is not None
    assert found[0].startswith("the certificate of the router at HUB does not name the host 127.0.0.1: issue it with")


@pytest.mark.parametrize("with_files", [True, False])
def test_tls_and_plain_tcp_are_told_apart(lab: Authority, with_files: bool) -> None:
    tls = member(lab, "gateway.g1") if with_files else None
    plain = ("HUB speaks no TLS: plain TCP (tcp/HUB), or no router at all", True)
    assert asked(ends, tls) == plain
    secure = ("HUB speaks TLS: connect to tls/HUB with certificates (--tls FOLDER, bus.tls)", True)
    assert asked(router(member(lab, "router.hub")), tls, "tcp") == secure
    assert asked(ends, tls, "tcp") is None, "a router of plain TCP, as expected"


def test_a_router_that_says_nothing_at_all_may_have_much_to_do(lab: Authority, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(refusal, "_PLAIN_S", 0.05)
    monkeypatch.setattr(refusal, "_HANDSHAKE_S", 0.05)
    busy = ("HUB does not answer in TLS: a router with much to do, or no router at all", False)
    assert asked(silent, member(lab, "gateway.g1")) == busy
    assert asked(silent, None, "tcp") is None


@pytest.mark.parametrize("endpoint", ["udp/127.0.0.1:1", "tcp/hub", "tls/hub:x", "quic/hub:1", ""])
def test_other_links_are_not_looked_at(endpoint: str) -> None:
    assert ask_endpoint(endpoint, None) is None


def fails_with(error: OSError) -> Callable[..., socket.socket]:
    def connect(*_: object) -> socket.socket:
        raise error

    return connect


UNREACHED = [
    (ConnectionRefusedError(111, "Connection refused"), "nobody listens at [::1]:7447"),
    (socket.gaierror(-2, "Name or service not known"), "no host has the name ::1"),
    (TimeoutError("timed out"), "[::1]:7447 does not answer"),
    (OSError(113, "No route to host"), "[::1]:7447 cannot be reached: No route to host"),
]


@pytest.mark.parametrize(("error", "text"), UNREACHED)
def test_a_router_that_is_not_reached_may_just_be_away(
    monkeypatch: pytest.MonkeyPatch, error: OSError, text: str
) -> None:
    monkeypatch.setattr(socket, "create_connection", fails_with(error))
    for endpoint in ("tls/[::1]:7447", "tcp/[::1]:7447?rel=0#iface=lo"):
        assert ask_endpoint(endpoint, None) == ConnectFault(text, refused=False)


async def test_our_own_files_are_looked_at_first_and_nobody_is_asked_then(lab: Authority, tmp_path: Path) -> None:
    asked_at: list[str] = []
    wrong = msgspec.structs.replace(member(lab, "gateway.g1"), key=str(lab.folder / "router.hub" / "key.pem"))
    settings = BusSettings(mode="client", connect=("tls/hub:1",), tls=wrong, multicast=False)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(refusal, "ask_endpoint", lambda at, tls: asked_at.append(at))
        found = await why_not(settings)
        assert found is not None
        assert found.refused
        assert "not the key of the certificate" in found.text
        right = msgspec.structs.replace(settings, tls=member(lab, "gateway.g1"))
        assert await why_not(right, ask=False) is None
        assert asked_at == []
        assert await why_not(right) is None
        assert asked_at == ["tls/hub:1"]


async def test_a_certificate_that_has_expired_is_told(lab: Authority, monkeypatch: pytest.MonkeyPatch) -> None:
    now = refusal.utc_now()
    monkeypatch.setattr(refusal, "utc_now", lambda: now + timedelta(days=40))
    settings = BusSettings(mode="client", connect=("tls/hub:1",), tls=member(lab, "gateway.g1"), multicast=False)
    found = await why_not(settings, ask=False)
    assert found is not None
    assert found.text.startswith("the certificate of gateway.g1 expired on ")


ANSWERS: list[tuple[list[ConnectFault | None], ConnectFault | None]] = [
    ([None, None], None),
    ([None, ConnectFault("nobody listens", refused=False)], ConnectFault("nobody listens", refused=False)),
    ([ConnectFault("a", refused=False), ConnectFault("b")], ConnectFault("a; b")),
    ([ConnectFault("a", refused=False)] * 2, ConnectFault("a", refused=False)),
    ([ConnectFault(str(number)) for number in range(9)], ConnectFault("0; 1; 2; 3")),
]


@pytest.mark.parametrize(("found", "said"), ANSWERS)
async def test_what_several_endpoints_tell_is_one_finding(
    monkeypatch: pytest.MonkeyPatch, found: list[ConnectFault | None], said: ConnectFault | None
) -> None:
    monkeypatch.setattr(refusal, "ask_endpoint", lambda at, tls: found[int(at.rpartition(":")[2]) - 1])
    endpoints = tuple(f"tcp/hub:{number}" for number in range(1, len(found) + 1))
    assert await why_not(BusSettings(mode="client", connect=endpoints, multicast=False)) == said


async def test_a_search_that_fails_itself_or_takes_too_long_finds_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    settings, release = BusSettings(mode="client", connect=("tcp/hub:1",), multicast=False), threading.Event()
    monkeypatch.setattr(refusal, "ask_endpoint", lambda at, tls: int("x"))
    assert await why_not(settings) is None
    monkeypatch.setattr(refusal, "LONGEST_S", -0.48)
    monkeypatch.setattr(refusal, "ask_endpoint", lambda at, tls: release.wait(5.0))
    assert await why_not(settings) is None
    release.set()
