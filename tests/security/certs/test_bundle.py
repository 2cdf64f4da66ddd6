"""Bundles: the files that another machine needs, and a ``[bus]`` table that a configuration takes as it is."""

from __future__ import annotations

import re
import shutil
import stat
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.security.certs.lab import Lab
from zbridge.app.config import plan
from zbridge.bus import Tls
from zbridge.errors import ConfigError
from zbridge.security.certs import authority
from zbridge.security.certs.bundle import Packing, bundle


@pytest.fixture
def output(tmp_path: Path) -> Path:
    return tmp_path / "to carry" / "r1"


def bus(folder: Path) -> Any:
    """Give the settings that a gateway reads of a bundle."""
    table = tomllib.loads((folder / "bus.toml").read_text())
    device = {"protocol": "tcpudp", "connect": ["tcp://127.0.0.1:1"]}
    return plan({"robot": {"name": "r1"}, "device": device, **table}).config.bus


def test_a_bundle_holds_the_files_of_the_name_and_a_table_that_a_configuration_takes(lab: Lab, output: Path) -> None:
    lab.issue("hub", "router", hosts=("localhost", "127.0.0.1", "hub.lab"))
    lab.issue("r1", "gateway", "r1")
    written = bundle(lab.folder, "r1", Packing(output), lab.now)
    assert sorted(path.name for path in written) == ["bus.toml", "ca.pem", "certificate.pem", "key.pem"]
    assert sorted(output.iterdir()) == sorted(written)
    files = lab.folder.of("r1")
    for name, original in (("ca.pem", lab.folder.ca), ("certificate.pem", files.certificate), ("key.pem", files.key)):
        assert (output / name).read_bytes() == original.read_bytes()
    assert stat.S_IMODE((output / "key.pem").stat().st_mode) == 0o600
    assert stat.S_IMODE(output.stat().st_mode) == 0o700
    settings = bus(output)
    assert (settings.effective_mode, settings.multicast) == ("client", False)
    assert settings.connect == ("tls/hub.lab:7447",)
    assert settings.tls == Tls(str(output / "ca.pem"), str(output / "certificate.pem"), str(output / "key.pem"))


def test_the_table_names_every_router_at_a_host_that_zenoh_reaches(lab: Lab, output: Path) -> None:
    lab.issue("hub", "router", hosts=("fe80::1", "127.0.0.1", "192.168.0.2"))
    lab.issue("hub2", "router", hosts=("localhost",))
    lab.issue("ann")
    bundle(lab.folder, "ann", Packing(output), lab.now)
    assert bus(output).connect == ("tls/192.168.0.2:7447", "tls/localhost:7447")


def test_the_table_takes_other_endpoints_and_another_place(lab: Lab, output: Path) -> None:
    lab.issue("ann")
    bundle(lab.folder, "ann", Packing(output, ("tls/hub.lab:7448",), Path('/etc/"x"\\y')), lab.now)
    settings = bus(output)
    assert settings.connect == ("tls/hub.lab:7448",)
    assert settings.tls.key == '/etc/"x"\\y/key.pem'


@pytest.mark.parametrize("endpoint", ["tcp/hub.lab:7447", "hub.lab:7447", "tls/hub.lab", "tls/[::1]:7447", ""])
def test_an_endpoint_that_zenoh_cannot_take_by_tls_is_refused(lab: Lab, output: Path, endpoint: str) -> None:
    lab.issue("ann")
    with pytest.raises(
        ConfigError, match=rf"--connect {re.escape(repr(endpoint))}: expected an endpoint like tls/router"
    ):
        bundle(lab.folder, "ann", Packing(output, (endpoint,)), lab.now)


def test_without_a_router_the_endpoint_is_asked_for(lab: Lab, output: Path) -> None:
    lab.issue("ann")
    with pytest.raises(ConfigError, match="--connect: missing: no router is issued yet"):
        bundle(lab.folder, "ann", Packing(output), lab.now)
    assert not output.exists()


def test_the_bundle_of_a_router_holds_the_roles(lab: Lab, output: Path) -> None:
    lab.issue("hub", "router", hosts=("hub.lab",))
    written = bundle(lab.folder, "hub", Packing(output), lab.now)
    assert sorted(path.name for path in written) == ["ca.pem", "certificate.pem", "key.pem", "roles.toml"]
    assert (output / "roles.toml").read_bytes() == lab.folder.roles.read_bytes()


@pytest.mark.parametrize("name", ["ca.pem", "certificate.pem", "key.pem", "bus.toml"])
def test_nothing_is_overwritten_without_force(lab: Lab, output: Path, name: str) -> None:
    lab.issue("ann")
    output.mkdir(parents=True)
    (output / name).write_text("mine")
    packing = Packing(output, ("tls/hub.lab:7447",))
    with pytest.raises(ConfigError, match=f"{name}: exists already; --force overwrites it"):
        bundle(lab.folder, "ann", packing, lab.now)
    assert [path.read_text() for path in output.iterdir()] == ["mine"]
    bundle(lab.folder, "ann", packing, lab.now, force=True)
    assert (output / name).read_text() != "mine"


REFUSED: dict[str, Callable[[Lab], object]] = {
    "'ann' is revoked": lambda lab: authority.revoke(lab.folder, "ann"),
    "issued by another authority; `zbridge certs renew ann`": lambda lab: authority.init(
        lab.folder, lab.now, force=True
    ),
    "others can read or write this key": lambda lab: lab.folder.of("ann").key.chmod(0o644),
    "No such file": lambda lab: shutil.rmtree(lab.folder.of("ann").folder),
}


@pytest.mark.parametrize("error", REFUSED)
def test_what_would_be_refused_on_the_bus_is_not_packed(lab: Lab, output: Path, error: str) -> None:
    lab.issue("ann")
    REFUSED[error](lab)
    with pytest.raises(ConfigError, match=error):
        bundle(lab.folder, "ann", Packing(output, ("tls/hub.lab:7447",)), lab.now)
    assert not output.exists()


def test_an_expired_certificate_is_not_packed(lab: Lab, output: Path) -> None:
    lab.issue("ann")
    with pytest.raises(ConfigError, match="expired on 2031-01-31; `zbridge certs renew ann`"):
        bundle(lab.folder, "ann", Packing(output, ("tls/hub.lab:7447",)), lab.later(400).now)
    assert not output.exists()
