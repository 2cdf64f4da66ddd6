"""Settings of robots and listeners at UDP ports, where their protocol allows datagrams alone."""

from __future__ import annotations

import re
from typing import Any

import msgspec
import pytest

from zbridge.app import config, plan
from zbridge.errors import ConfigError
from zbridge.protocol.address import DatagramAddress
from zbridge.protocol.plugin import Protocol, find_protocol


@pytest.fixture(autouse=True)
def _datagrams(monkeypatch: pytest.MonkeyPatch) -> None:
    def find(name: str) -> Protocol:
        return msgspec.structs.replace(find_protocol(name), datagrams=True)

    monkeypatch.setattr(config, "find_protocol", find)


def serving(*listeners: dict[str, Any]) -> dict[str, Any]:
    return {"robot": {"name": "r1"}, "hq": [{"protocol": "tcpudp", **each} for each in listeners]}


def test_a_robot_and_a_listener_may_be_at_udp_ports_and_tcp_may_have_the_same_number() -> None:
    device = {"protocol": "alf", "connect": ["udp-in://0.0.0.0:14540"]}
    listeners = ({"listen": "udp://0.0.0.0:14550", "to": ["udp://desk:14550"]}, {"listen": "tcp://0.0.0.0:14550"})
    found = plan({**serving(*listeners), "device": device})
    assert found.device is not None
    assert found.device.addresses == (DatagramAddress("0.0.0.0", 14540, waits=True),)
    assert (found.listeners[0].to, found.listeners[1].to) == ((DatagramAddress("desk", 14550),), ())
    assert "alf at udp-in://0.0.0.0:14540, tcpudp HQ programs at udp://0.0.0.0:14550" in found.described


@pytest.mark.parametrize(
    ("listeners", "error"),
    [
        (({"listen": "udp://h:1"}, {"listen": "udp://h:1"}), "hq[0].listen = 'udp://h:1': expected an address of its"),
        (({"listen": "udp-in://h:1"},), "hq[0].listen = 'udp-in://h:1': expected tcp://host:port or udp://host:port"),
        (({"listen": "tcp://h:1", "to": ["udp://d:1"]},), "hq[0].to = ['udp://d:1']: expected only with listen = 'udp"),
        (({"listen": "udp://h:1", "to": ["d:1"]},), "hq[0].to = 'd:1': expected udp://host:port"),
        (({"listen": "udp://h:1", "tls": {"certificate": "c", "key": "k"}},), "expected tls://host:port, because"),
    ],
)
def test_a_faulty_setting_is_an_error_that_says_what_was_expected(listeners: Any, error: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(error)):
        plan(serving(*listeners))
