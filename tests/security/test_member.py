"""What a gateway's certificate is good for, and when it is warned of."""

from __future__ import annotations

import asyncio
import logging
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from tests.fake_bus import FakeBus
from zbridge.app.config import GatewayPlan, load
from zbridge.app.joining import ENDED_S, RARELY_S, RETRY_S, CertificateEnded, Pauses, watch_certificate
from zbridge.bus.tls.certificate import Certificate
from zbridge.control.faults import OpenFaults
from zbridge.errors import BusError, BusRefused, ConfigError
from zbridge.security.certs import authority
from zbridge.security.certs.authority import CertificateRequest
from zbridge.security.files import Folder
from zbridge.security.member import check_member
from zbridge.security.roles import Member

NOW = datetime.now(UTC)
DEVICE = '[device]\nprotocol = "tcpudp"\nconnect = ["tcp://127.0.0.1:1"]\n'
LISTENER = '[[hq]]\nprotocol = "tcpudp"\nlisten = "tcp://127.0.0.1:0"\n'
MEMBERS = {
    "g1": Member("gateway", ("r1",)),
    "h1": Member("hq", ("r1",)),
    "ann": Member("viewer"),
    "hub": Member("router"),
}


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    folder = Folder(tmp_path_factory.mktemp("lab") / "certs")
    authority.init(folder, NOW)
    for name, member in MEMBERS.items():
        authority.issue(folder, CertificateRequest(name, member, ("hub.lab",) if name == "hub" else ()), NOW)
    return folder


def planned(tmp_path: Path, lab: Folder, name: str, parts: str = DEVICE) -> GatewayPlan:
    file = tmp_path / "r1.toml"
    file.write_text(f'[robot]\nname = "r1"\n{parts}[bus]\nconnect = ["tls/hub.lab:7447"]\n')
    return load(file, {}, tls=lab.of(name).folder)


FITS = [
    ("g1", DEVICE, ""),
    ("g1", DEVICE + LISTENER, ""),
    ("g1", LISTENER, ""),
    ("h1", LISTENER, ""),
    ("h1", DEVICE, "the certificate of hq.h1: expected the role gateway for a file with [device]"),
    ("ann", DEVICE, "the certificate of viewer.ann: expected the role gateway for a file with [device]"),
    ("hub", DEVICE, "the certificate of router.hub: expected the role gateway for a file with [device]"),
    ("ann", LISTENER, "the certificate of viewer.ann: expected the role hq for a file with [[hq]] and no [device]"),
]


@pytest.mark.parametrize(("name", "parts", "told"), FITS)
def test_the_role_fits_what_the_file_does(tmp_path: Path, lab: Folder, name: str, parts: str, told: str) -> None:
    plan = planned(tmp_path, lab, name, parts)
    if not told:
        certificate = check_member(plan)
        assert certificate is not None
        assert certificate.name == name
        return
    with pytest.raises(ConfigError) as raised:
        check_member(plan)
    assert str(raised.value).endswith(told)


def test_a_key_that_others_can_read_or_another_authority_is_refused(tmp_path: Path, lab: Folder) -> None:
    plan, key = planned(tmp_path, lab, "g1"), lab.of("g1").key
    key.chmod(0o640)
    try:
        with pytest.raises(ConfigError, match="others can read or write this key"):
            check_member(plan)
    finally:
        key.chmod(0o600)
    other = Folder(tmp_path / "other")
    authority.init(other, NOW)
    ca, own = lab.of("g1").ca, lab.of("g1").ca.read_bytes()
    ca.write_bytes(other.ca.read_bytes())
    try:
        with pytest.raises(ConfigError, match=r"certificate\.pem: issued by another authority than .*ca\.pem"):
            check_member(plan)
    finally:
        ca.write_bytes(own)


def test_a_file_without_tls_needs_no_certificate_and_one_with_an_authority_alone_is_told(tmp_path: Path) -> None:
    file = tmp_path / "r1.toml"
    file.write_text(f'[robot]\nname = "r1"\n{DEVICE}')
    assert check_member(load(file, {})) is None
    file.write_text(f'[robot]\nname = "r1"\n{DEVICE}[bus]\nconnect = ["tls/a:1"]\ntls = {{ ca = "ca.pem" }}\n')
    with pytest.raises(ConfigError, match=r"bus\.tls: expected ca, certificate and key"):
        check_member(load(file, {}))


def test_after_refusals_a_gateway_tries_rarely_and_no_two_together() -> None:
    soonest, latest = Pauses(lambda: 0.0), Pauses(lambda: 1.0)
    refused, away = BusRefused("no"), BusError("nobody listens")
    assert [latest.after(refused) for _ in range(7)] == [4.0, 8.0, 16.0, 32.0, 60.0, 60.0, 60.0]
    assert [soonest.after(refused) for _ in range(7)] == [2.0, 4.0, 8.0, 16.0, 30.0, 30.0, 30.0]
    assert max(latest.after(refused) for _ in range(10_000)) == RARELY_S
    assert (soonest.after(away), latest.after(away)) == (0.5 * RETRY_S, 1.5 * RETRY_S)
    assert latest.after(refused) == 4.0


@pytest.mark.jumping
async def test_the_end_of_a_certificate_shows_on_status_and_once_a_day_in_the_log(
    caplog: pytest.LogCaptureFixture,
) -> None:
    loop, open_faults = asyncio.get_running_loop(), OpenFaults()
    start = loop.time()
    certificate, bus = Certificate("gateway.g1", NOW, NOW + timedelta(days=32)), FakeBus()
    caplog.set_level(logging.WARNING)
    watching = asyncio.create_task(
        watch_certificate(certificate, bus, open_faults, lambda: NOW + timedelta(seconds=loop.time() - start))
    )
    await asyncio.sleep(timedelta(days=1.9).total_seconds())
    assert (open_faults.texts, caplog.messages) == ((), [])
    await asyncio.sleep(timedelta(days=3).total_seconds())
    (text,) = open_faults.texts
    assert text.startswith("the certificate of gateway.g1 ends on ")
    assert caplog.messages == [text] * 3
    await asyncio.sleep(timedelta(days=28).total_seconds())
    assert "expired on" in open_faults.texts[0]
    assert not watching.done()  # nothing has closed the connection
    bus.connection(False)
    await asyncio.sleep(2 * ENDED_S)
    with pytest.raises(CertificateEnded, match=r"gateway\.g1 expired on .*; the bus is left"):
        await watching
