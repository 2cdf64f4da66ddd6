"""A router's settings: what is wrong is told with its key, and what is right becomes Zenoh's configuration."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import pytest
import zenoh

from tests.access import LAB
from zbridge.bus.tls.files import folder_tls
from zbridge.errors import ConfigError
from zbridge.security.roles import save_roles
from zbridge.security.router_settings import (
    AT_A_TIME,
    BURST,
    LISTEN,
    LISTEN_TLS,
    NEW_HZ,
    RouterSettings,
    load_router,
    nested,
    nftables,
    plan_router,
    zenoh_values,
)

WITH_TLS = "tls = { ca = 'ca.pem', certificate = 'certificate.pem', key = 'key.pem' }\n"
WRONG = [
    ("listen = ['tcp/0.0.0.0:7447']", "listen = 'tcp/0.0.0.0:7447': without tls whoever reaches this address"),
    ("listen = ['tcp/[::]:7447']", "without tls whoever reaches this address"),
    ("listen = ['tcp/lab:7447']", "without tls whoever reaches this address"),
    ("listen = ['7447']", "listen[0] = '7447': expected `str` matching regex"),
    ("roles = 'roles.toml'", "expected tls too: a role is known by its certificate"),
    ("realm = 'a/b'", "realm = 'a/b': expected letters"),
    ("relm = 'a'", "relm = 'a': unknown key; expected one of listen, connect, realm"),
    ("[limits]\nstops_hz = 1.0", "limits.stops_hz = 1.0"),
    (WITH_TLS, "roles: missing, it is required with tls"),
    (WITH_TLS + "roles = 'no.toml'", "no.toml: No such file or directory"),
    (WITH_TLS + "roles = 'roles.toml'\nlisten = ['tcp/127.0.0.1:1']", "listen = 'tcp/127.0.0.1:1': expected tls/"),
    (WITH_TLS + "roles = 'roles.toml'\nconnect = ['tcp/lab:1']", "connect = 'tcp/lab:1': expected tls/host:port"),
    (WITH_TLS + "roles = 'roles.toml'\ninsecure = true", "insecure = true: expected no tls beside it"),
    ("tls = { ca = 'ca.pem' }\nroles = 'roles.toml'", "tls.certificate: missing, it is required in a router"),
    ("tls = { ca = 'no.pem', certificate = 'c', key = 'k' }\nroles = 'roles.toml'", "no.pem': no such file"),
]
PORTS: list[tuple[tuple[str, ...], dict[str, str]]] = [
    (("tls/0.0.0.0:7447",), {"tcp": "7447"}),
    (("tls/192.168.0.2:7448", "tls/[::]:7447", "tcp/localhost:7447#iface=eth0"), {"tcp": "7447, 7448"}),
    (("quic/0.0.0.0:7447",), {"udp": "7447"}),
    (("tls/0.0.0.0:7447", "quic/0.0.0.0:7500", "unixsock-stream//tmp/a:1"), {"tcp": "7447", "udp": "7500"}),
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_roles(tmp_path / "roles.toml", LAB)
    for name in ("ca", "certificate", "key"):
        (tmp_path / f"{name}.pem").write_text("")
    return tmp_path


def written(folder: Path, text: str) -> Path:
    file = folder / "router.toml"
    file.write_text(text)
    return file


@pytest.mark.parametrize(("text", "told"), WRONG)
def test_what_is_wrong_is_told(folder: Path, text: str, told: str) -> None:
    with pytest.raises(ConfigError) as raised:
        plan_router(load_router(written(folder, text)))
    assert told in str(raised.value)
    assert "\n" not in str(raised.value)


LOOPBACK = ("tcp/127.0.0.1:7447", "tcp/[::1]:7447", "tcp/localhost:1", "unixsock-stream//run/z")


@pytest.mark.parametrize("address", LOOPBACK)
def test_without_tls_this_machine_is_served(address: str) -> None:
    values = zenoh_values(plan_router(RouterSettings(listen=(address,))))
    assert values["listen/endpoints"] == [address]
    assert "access_control" not in values


def test_insecure_serves_everybody() -> None:
    plan = plan_router(RouterSettings(listen=("tcp/0.0.0.0:7447",), insecure=True))
    assert plan.settings.listen == ("tcp/0.0.0.0:7447",)


def test_without_listen_there_is_a_default(folder: Path) -> None:
    assert plan_router(RouterSettings()).settings.listen == (LISTEN,)
    secure = RouterSettings(tls=folder_tls(folder), roles=str(folder / "roles.toml"))
    assert plan_router(secure).settings.listen == (LISTEN_TLS,)


def test_with_tls_members_show_certificates_and_rules_hold(folder: Path) -> None:
    plan = plan_router(
        load_router(written(folder, WITH_TLS + "roles = 'roles.toml'\n[limits]\nsessions = 7\npending = 3"))
    )
    values = zenoh_values(plan)
    assert plan.roles == LAB
    for key in ("enable_mtls", "verify_name_on_connect", "close_link_on_expiration"):
        assert values[f"transport/link/tls/{key}"] is True
    assert values["transport/link/tls/listen_private_key"] == str(folder / "key.pem")
    assert values["transport/link/protocols"] == ["tls", "quic"]
    assert values["scouting/gossip/enabled"] is values["scouting/multicast/enabled"] is False
    assert values["adminspace"]["permissions"] == {"read": True, "write": False}
    assert values["access_control"]["default_permission"] == "deny"
    assert (values["transport/unicast/max_sessions"], values["transport/unicast/accept_pending"]) == (7, 3)


def test_zenoh_takes_the_configuration_by_paths_and_as_a_file(folder: Path) -> None:
    values = zenoh_values(plan_router(load_router(written(folder, WITH_TLS + "roles = 'roles.toml'"))))
    by_paths = zenoh.Config()
    for path, value in values.items():
        by_paths.insert_json5(path, json.dumps(value))
    (folder / "router.json5").write_text("// a comment\n" + json.dumps(nested(values)))
    assert str(zenoh.Config.from_file(str(folder / "router.json5"))) == str(by_paths)


@pytest.mark.parametrize(("listen", "ports"), PORTS)
def test_each_port_has_limits_for_each_address_of_both_families(listen: tuple[str, ...], ports: dict[str, str]) -> None:
    text = nftables(RouterSettings(listen=listen))
    for transport in ("tcp", "udp"):
        rules = [line.strip() for line in text.splitlines() if line.strip().startswith(f"{transport} dport")]
        assert len(rules) == (4 if transport in ports else 0)
        for family, address in (("4", "ip saddr"), ("6", "ip6 saddr")) if rules else ():
            new = f"{transport} dport {{ {ports[transport]} }} ct state new"
            at_a_time = f"{new} add @{transport}_open{family} {{ {address} ct count over {AT_A_TIME} }} counter drop"
            rate = f"{address} limit rate over {NEW_HZ}/second burst {BURST} packets"
            assert [at_a_time, f"{new} update @{transport}_new{family} {{ {rate} }} counter drop"] == [
                rule for rule in rules if f"{family} {{ ip" in rule
            ]


def test_a_router_without_ports_has_no_rules() -> None:
    with pytest.raises(ConfigError, match=r"^listen = \['unixsock-stream//tmp/a'\]: expected an address with a port"):
        nftables(RouterSettings(listen=("unixsock-stream//tmp/a",)))


@pytest.mark.skipif(shutil.which("nft") is None, reason="nft is not installed")
@pytest.mark.parametrize(("listen", "ports"), PORTS)
def test_nft_takes_the_rules(listen: tuple[str, ...], ports: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "router.nft").write_text(nftables(RouterSettings(listen=listen)))
    checked = subprocess.run(
        ["nft", "-c", "-f", str(tmp_path / "router.nft")], capture_output=True, text=True, check=False
    )
    if "not permitted" in checked.stderr:
        pytest.skip("nft needs the right to see the kernel's tables")
    assert checked.returncode == 0, checked.stderr
