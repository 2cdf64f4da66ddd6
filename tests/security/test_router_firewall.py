"""nftables rules of a router's ports, checked by ``nft`` itself where it is there."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from zbridge.errors import ConfigError
from zbridge.security.router_firewall import AT_A_TIME, BURST, NEW_HZ, nftables
from zbridge.security.router_settings import RouterSettings

LISTEN: list[tuple[tuple[str, ...], dict[str, str]]] = [
    (("tls/0.0.0.0:7447",), {"tcp": "7447"}),
    (("tls/192.168.0.2:7448", "tls/[::]:7447", "tcp/localhost:7447#iface=eth0"), {"tcp": "7447, 7448"}),
    (("quic/0.0.0.0:7447",), {"udp": "7447"}),
    (("tls/0.0.0.0:7447", "quic/0.0.0.0:7500", "unixsock-stream//tmp/a:1"), {"tcp": "7447", "udp": "7500"}),
]


@pytest.mark.parametrize(("listen", "ports"), LISTEN)
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
@pytest.mark.parametrize(("listen", "ports"), LISTEN)
def test_nft_takes_the_rules(listen: tuple[str, ...], ports: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "router.nft").write_text(nftables(RouterSettings(listen=listen)))
    checked = subprocess.run(["nft", "-c", "-f", str(tmp_path / "router.nft")], capture_output=True, text=True)
    if "not permitted" in checked.stderr:
        pytest.skip("nft needs the right to see the kernel's tables")
    assert checked.returncode == 0, checked.stderr
