"""Which hosts are among the networks that settings name, and which are this machine."""

import pytest

from zbridge.errors import ConfigError
from zbridge.protocol.networks import is_among, is_loopback, parse_network, parse_networks


@pytest.mark.parametrize(
    ("host", "among"),
    [
        ("10.1.2.3", True),
        ("11.1.2.3", False),
        ("::ffff:10.1.2.3", True),
        ("::ffff:11.1.2.3", False),
        ("fe80::1%eth0", True),
        ("2001:db8::1", False),
    ],
)
def test_a_host_is_among_networks_by_its_own_address(host: str, among: bool) -> None:
    assert is_among(host, parse_networks("allow", ["10.0.0.0/8", "fe80::/10"])) is among


@pytest.mark.parametrize(
    ("host", "loopback"),
    [("127.0.0.7", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("robot-hq", False), ("", False)],
)
def test_only_what_is_this_machine_for_certain_is_loopback(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback


def test_a_wrong_network_is_named_with_its_place_in_the_list() -> None:
    with pytest.raises(ConfigError, match=r"^allow\[1\] = '10.0.0.1/8': expected a network like '192.168.1.0/24': "):
        parse_networks("allow", ["10.0.0.0/8", "10.0.0.1/8"])
    with pytest.raises(ConfigError, match=r"^--allow home: expected a network like"):
        parse_network("--allow home", "home")
