"""The files of a member, read without the package that made them: what they say, and what is wrong with them."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest

from tests.certificates import Authority, openssl
from zbridge.bus import Tls
from zbridge.bus.tls.certificate import Certificate, read_certificate
from zbridge.bus.tls.files import (
    ends_soon,
    folder_settings,
    folder_tls,
    is_of_authority,
    not_strict,
    out_of_date,
    tls_beside,
    unusable,
)
from zbridge.errors import ConfigError
from zbridge.security.certs import authority, x509
from zbridge.security.certs.authority import CertificateRequest
from zbridge.security.files import Folder
from zbridge.security.roles import Member

NOW = datetime(2026, 11, 22, 12, 0, 0, tzinfo=UTC)
DAY = timedelta(days=1)


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    folder = Folder(tmp_path_factory.mktemp("lab") / "certs")
    authority.init(folder, NOW)
    authority.issue(folder, CertificateRequest("hub", Member("router"), ("hub.lab",)), NOW)
    authority.issue(folder, CertificateRequest("g1", Member("gateway", ("r1",)), days=90), NOW)
    return folder


@pytest.mark.parametrize("name", ["hub", "g1"])
def test_a_certificate_says_what_the_package_that_made_it_says(lab: Folder, name: str) -> None:
    file = lab.of(name).certificate
    read, expected = read_certificate(file), x509.read_certificate(file)
    assert read.common_name == x509.common_name_of(expected)
    assert (read.begins, read.ends) == (expected.not_valid_before_utc, expected.not_valid_after_utc)
    assert f"{read.role}.{read.name}" == read.common_name


def test_a_certificate_of_openssl_is_read_also_with_other_names_long_and_far_in_the_future(tmp_path: Path) -> None:
    subject = f"/C=CH/O={'x' * 60}/OU=lab/CN=gateway.g7"
    files = ("-keyout", str(tmp_path / "key.pem"), "-out", str(tmp_path / "c.pem"))
    openssl("req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "36500", "-subj", subject, *files)
    (tmp_path / "c.pem").write_text("a text before it\n" + (tmp_path / "c.pem").read_text())
    read = read_certificate(tmp_path / "c.pem")
    assert (read.common_name, read.ends - read.begins) == ("gateway.g7", 36500 * DAY)
    assert read.ends.year > 2050  # from then on dates have another form


BAD = [
    b"",
    b"hello",
    b"\xff\xfe",
    b"-----BEGIN CERTIFICATE-----\n",
    b"-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n",
    b"-----BEGIN CERTIFICATE-----\nMIIB\n-----END CERTIFICATE-----\n",
    b"-----BEGIN CERTIFICATE-----\n!\n-----END CERTIFICATE-----\n",
]


@pytest.mark.parametrize("content", BAD)
def test_what_is_no_certificate_is_told(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "c.pem"
    file.write_bytes(content)
    with pytest.raises(ConfigError, match=f"^{file}: not a certificate in PEM form$"):
        read_certificate(file)


def test_a_spoiled_certificate_never_does_more_than_be_told(lab: Folder, tmp_path: Path) -> None:
    whole, file = lab.of("g1").certificate.read_bytes(), tmp_path / "c.pem"
    for at in range(30, len(whole) - 30, 7):
        file.write_bytes(whole[:at] + b"A" + whole[at + 1 :])
        try:
            read_certificate(file)
        except ConfigError:
            continue


def changed(lab: Folder, **files: object) -> Tls:
    return msgspec.structs.replace(folder_tls(lab.of("g1").folder), **files)


def test_files_that_do_not_belong_together_are_told(lab: Folder, tmp_path: Path) -> None:
    other = Authority(tmp_path / "other")
    key, spoiled = str(lab.of("hub").key), tmp_path / "spoiled.pem"
    spoiled.write_text("hello")
    assert unusable(changed(lab)) is None
    assert unusable(changed(lab, certificate=None, key=None)) is None
    assert unusable(changed(lab, key=key)) == f"{key}: not the key of the certificate {lab.of('g1').certificate}"
    assert unusable(changed(lab, key=None)) == "certificate and key: expected both, or neither"
    for field, told in (
        ("ca", "not a certificate"),
        ("certificate", "not a certificate"),
        ("key", "not a private key"),
    ):
        assert (unusable(changed(lab, **{field: str(spoiled)})) or "").startswith(f"{spoiled}: {told} in PEM form")
        assert unusable(changed(lab, **{field: "no.pem"})) == "no.pem: No such file or directory"
    assert is_of_authority(changed(lab))
    assert not is_of_authority(changed(lab, ca=str(other.ca)))


def test_an_authority_that_python_3_13_refuses_is_told_and_used_all_the_same(lab: Folder, tmp_path: Path) -> None:
    lax = folder_tls(Authority(tmp_path / "lax", strict=False).issue("gateway.g1"))
    expected = (
        "Python 3.13 and other strict programs refuse certificates of this authority: CA cert does not include key"
        " usage extension"
    )
    assert (not_strict(lax), unusable(lax), is_of_authority(lax)) == (expected, None, True)
    assert not_strict(folder_tls(Authority(tmp_path / "strict").issue("gateway.g1"))) is None
    assert not_strict(changed(lab)) is None
    assert not_strict(changed(lab, ca=lax.ca)) is None, "of another authority, which is told elsewhere"


def test_a_key_with_a_password_is_told_and_nobody_is_asked_for_it(lab: Folder, tmp_path: Path) -> None:
    locked = tmp_path / "key.pem"
    openssl("ec", "-in", str(lab.of("g1").key), "-aes128", "-passout", "pass:secret", "-out", str(locked))
    assert unusable(changed(lab, key=str(locked))) == f"{locked}: not a private key in PEM form without a password"


DATES = [
    (timedelta(0), None, None),
    (59 * DAY, None, None),
    (60 * DAY, None, "the certificate of gateway.g1 ends on 2027-02-20: renew it (`zbridge certs renew g1`)"),
    (90 * DAY, "expired on 2027-02-20 12:00 UTC; `zbridge certs renew g1`", "expired on 2027-02-20"),
    (-2 * DAY, "is not valid before 2026-11-22 11:00 UTC: is the clock", None),
]


@pytest.mark.parametrize(("later", "out", "soon"), DATES)
def test_the_end_of_a_certificate_is_told_before_it_comes(
    lab: Folder, later: timedelta, out: str | None, soon: str | None
) -> None:
    certificate = read_certificate(lab.of("g1").certificate)
    for text, expected in ((out_of_date(certificate, NOW + later), out), (ends_soon(certificate, NOW + later), soon)):
        assert (expected is None) == (text is None)
        assert expected is None or expected in str(text)


def test_a_common_name_without_a_role_names_nobody() -> None:
    assert [Certificate(text, NOW, NOW).role for text in ("gateway.g1", "g1", "")] == ["gateway", "", ""]


# A folder, and the routers that it names


def test_a_folder_names_the_routers_unless_they_are_given(tmp_path: Path) -> None:
    (tmp_path / "bus.toml").write_text('[bus]\nconnect = ["tls/hub:7447", "tls/hub2:7447"]\n')
    settings = folder_settings(tmp_path)
    assert (settings.mode, settings.multicast) == ("client", False)
    assert settings.connect == ("tls/hub:7447", "tls/hub2:7447")
    names = ("ca.pem", "certificate.pem", "key.pem")
    assert settings.tls == Tls(*(str(tmp_path / name) for name in names)) == folder_tls(tmp_path)
    assert folder_settings(tmp_path, ["tls/other:1"]).connect == ("tls/other:1",)


def test_a_folder_that_is_not_there_or_names_no_router_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--tls .*gone: no such folder"):
        folder_settings(tmp_path / "gone")
    with pytest.raises(ConfigError, match=r"no bus\.toml there; give --connect tls/HOST:7447"):
        folder_settings(tmp_path)
    for content in ("", "[bus]\n", "bus = 1", "[bus]\nconnect = 1\n", "[bus]\nconnect = [1]\n", "["):
        (tmp_path / "bus.toml").write_text(content)
        with pytest.raises(ConfigError, match=r"bus\.toml: expected a \[bus\] table with connect"):
            folder_settings(tmp_path)
    (tmp_path / "bus.toml").unlink()
    (tmp_path / "bus.toml").mkdir()
    with pytest.raises(ConfigError, match=r"bus\.toml: Is a directory"):
        folder_settings(tmp_path)


def test_paths_of_a_configuration_are_relative_to_its_folder() -> None:
    here = Path("/etc/zbridge")
    assert tls_beside(Tls("ca.pem"), here) == Tls("/etc/zbridge/ca.pem")
    whole = Tls("tls/ca.pem", "/var/c.pem", "tls/k.pem")
    assert tls_beside(whole, here) == Tls("/etc/zbridge/tls/ca.pem", "/var/c.pem", "/etc/zbridge/tls/k.pem")
