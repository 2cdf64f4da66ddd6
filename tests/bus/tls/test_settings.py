"""What a session with certificates is for Zenoh: a client that is told where the router is, and finds nobody else."""

from __future__ import annotations

import json
import socket

import pytest

from zbridge.bus import BusSettings, Tls, open_bus
from zbridge.bus.zenoh import zenoh_config
from zbridge.client import bus_settings
from zbridge.errors import BusError, ConfigError
from zbridge.metrics import Metrics

WHERE, FILES = "tls/hub.lab:7447", Tls("/a.pem", "/c.pem", "/k.pem")
TLS = "transport/link/tls"
VALUES = {
    "mode": "client",
    "connect/endpoints": [WHERE],
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/link/protocols": ["tls", "quic"],
    f"{TLS}/root_ca_certificate": "/a.pem",
    f"{TLS}/enable_mtls": True,
    f"{TLS}/connect_certificate": "/c.pem",
    f"{TLS}/connect_private_key": "/k.pem",
    f"{TLS}/listen_certificate": None,
    f"{TLS}/verify_name_on_connect": True,
}
SETTINGS = [BusSettings(connect=(WHERE,), tls=FILES), bus_settings([WHERE], FILES)]


@pytest.mark.parametrize("settings", SETTINGS)
def test_with_certificates_a_session_is_a_client_that_finds_nobody_by_chance(settings: BusSettings) -> None:
    config = zenoh_config(settings)
    assert {key: json.loads(config.get_json(key)) for key in VALUES} == VALUES


@pytest.mark.parametrize("fields", [{"mode": "peer"}, {"mode": "router"}, {"listen": (WHERE,)}, {"connect": ()}])
def test_no_program_makes_settings_that_go_round_the_router(fields: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match="with tls every program is a client of a router"):
        BusSettings(**{"connect": (WHERE,), "tls": FILES, **fields})


def test_a_client_with_certificates_takes_no_endpoint_in_the_open_and_no_default() -> None:
    with pytest.raises(ConfigError, match=r"tcp/hub\.lab:1': expected tls/host:port"):
        bus_settings(["tcp/hub.lab:1"], FILES)
    with pytest.raises(ConfigError, match="missing, expected tls/host:port"):
        bus_settings([], FILES)


async def test_an_address_to_listen_at_that_is_taken_is_what_is_told() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken, socket.create_server(("127.0.0.1", 0)) as away:
        listen, connect = (f"tcp/127.0.0.1:{each.getsockname()[1]}" for each in (taken, away))
        away.close()
        settings = BusSettings(mode="router", listen=(listen,), connect=(connect,), multicast=False)
        with pytest.raises(BusError) as raised:
            await open_bus(settings, Metrics())
    assert "nobody listens" not in str(raised.value)
