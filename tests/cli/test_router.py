"""``zbridge router``: options go before the file, and what is printed for Zenoh's own router is what is deployed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.access import LAB
from zbridge.bus import Tls
from zbridge.cli.router import run_router, settings_of
from zbridge.errors import ConfigError
from zbridge.security.roles import save_roles

DEPLOYED = Path(__file__).parents[2] / "deploy" / "zenoh"


def test_the_deployed_configuration_is_what_the_deployed_settings_make(capsys: pytest.CaptureFixture[str]) -> None:
    run_router(DEPLOYED / "router.toml", {}, print_config=True)
    assert capsys.readouterr().out == (DEPLOYED / "router.json5").read_text()


def test_rules_for_the_ports_of_the_deployed_router_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    run_router(DEPLOYED / "router.toml", {}, print_nftables=True)
    assert "tcp dport { 7447 } ct state new" in capsys.readouterr().out


def test_options_go_before_the_file(tmp_path: Path) -> None:
    file, tls = tmp_path / "router.toml", Tls("ca.pem", "c.pem", "k.pem")
    file.write_text("listen = ['tcp/127.0.0.1:1']\nrealm = 'lab'\n")
    assert settings_of(file, {"listen": [], "realm": ""}).listen == ("tcp/127.0.0.1:1",)
    settings = settings_of(file, {"listen": ["tls/127.0.0.1:2"], "tls": tls})
    assert (settings.listen, settings.realm, settings.tls) == (("tls/127.0.0.1:2",), "lab", tls)


def test_a_wrong_option_or_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^listen\[0\] = 'hello'"):
        settings_of(None, {"listen": ["hello"]})
    (tmp_path / "router.toml").write_text("roles = 'roles.toml'")
    save_roles(tmp_path / "roles.toml", LAB)
    with pytest.raises(ConfigError, match=r"router\.toml: roles = .*: expected tls too"):
        run_router(tmp_path / "router.toml", {}, print_config=True)
