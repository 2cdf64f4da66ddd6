"""What listeners and their process are called on the bus."""

from __future__ import annotations

import pytest

from zbridge.app.config import plan
from zbridge.errors import ConfigError
from zbridge.hq.names import listener_names, process_name

ZID = "a1b2c3d4e5f6"
NAMES: list[tuple[str | None, tuple[str | None, ...], list[str]]] = [
    # the name in the certificate; the names in the configuration; the names on the bus
    (None, (None,), ["tcpudp-a1b2c3"]),
    (None, (None, None, None), ["tcpudp-a1b2c3", "tcpudp-a1b2c3-2", "tcpudp-a1b2c3-3"]),
    (None, ("desk", None), ["desk", "tcpudp-a1b2c3"]),
    ("h1", (None, None), ["h1.tcpudp-a1b2c3", "h1.tcpudp-a1b2c3-2"]),
    ("h1", ("desk", "h1", "h1.east", "h10", "h2.east"), ["h1.desk", "h1", "h1.east", "h1.h10", "h1.h2.east"]),
    ("h1", ("a" * 40,), ["h1." + "a" * 40]),
]


@pytest.mark.parametrize(("own", "configured", "names"), NAMES)
def test_a_listener_is_called_as_configured_below_the_name_in_the_certificate(
    own: str | None, configured: tuple[str | None, ...], names: list[str]
) -> None:
    assert listener_names(plans(*configured), own, ZID) == names


def test_a_name_that_leaves_no_room_for_numbers_is_named() -> None:
    name = f"{'h' * 48}.{'d' * 7}"
    with pytest.raises(ConfigError, match=rf"^hq\[1\]\.name: '{name}' has more than 55 characters: expected a shorter"):
        listener_names(plans("d", "d" * 7), "h" * 48, ZID)


def test_two_listeners_that_would_have_one_name_on_the_bus_are_named() -> None:
    with pytest.raises(ConfigError, match=r"^hq\[1\]\.name: 'h1\.desk' is another listener's name on the bus"):
        listener_names(plans("desk", "h1.desk"), "h1", ZID)


def test_a_process_is_called_by_its_certificate_or_else_by_its_first_listener() -> None:
    assert process_name(["h1.desk", "h1.east"], "h1", ZID) == f"hq.h1.{ZID}"
    assert process_name(["desk", "east"], None, ZID) == f"hq.desk.{ZID}"


def plans(*names: str | None) -> tuple:
    listeners = [
        {"protocol": "tcpudp", "listen": f"tcp://127.0.0.1:{number}"} | ({} if name is None else {"name": name})
        for number, name in enumerate(names, 1)
    ]
    return plan({"robot": {"name": "r1"}, "hq": listeners}).listeners
