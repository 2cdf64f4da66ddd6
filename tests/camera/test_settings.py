"""``[camera]``: which URLs, relays and networks are taken, and what is said of others."""

from __future__ import annotations

import pytest

from zbridge.camera.settings import CameraSettings, CameraSource, plan_camera
from zbridge.errors import ConfigError
from zbridge.protocol.address import Address

SOURCES = [
    ("http://robot", CameraSource("robot", 80, "/"), "robot:80"),
    ("http://10.0.0.7:8000/stream.mjpg?key=1", CameraSource("10.0.0.7", 8000, "/stream.mjpg?key=1"), "10.0.0.7:8000"),
    ("http://[::1]:81/a", CameraSource("::1", 81, "/a"), "[::1]:81"),
]


@pytest.mark.parametrize(("url", "source", "authority"), SOURCES)
def test_a_url_names_host_port_and_target(url: str, source: CameraSource, authority: str) -> None:
    plan = plan_camera(CameraSettings(url))
    assert (plan.source, plan.source.authority) == (source, authority)
    assert (plan.relay, plan.allow) == (None, ())
    assert "key" not in str(plan.source), "a query may hold a password"


BAD_URLS = [
    "robot:80/stream",
    "https://robot/",
    "http:///stream",
    "http://robot:0/",
    "http://robot:99999/",
    "http://ann:secret@robot/",
    "http://robot/#top",
    "http://robot/a b",
    f"http://{'x' * 70}/",
    "",
]


@pytest.mark.parametrize("url", BAD_URLS)
def test_a_url_that_is_not_of_plain_http_is_refused_by_name(url: str) -> None:
    with pytest.raises(ConfigError, match=r"^camera\.url = .*expected http://host:port/path$"):
        plan_camera(CameraSettings(url))


def test_a_relay_has_an_address_and_networks_and_networks_need_a_relay() -> None:
    plan = plan_camera(CameraSettings("http://robot", relay="0.0.0.0:8000", allow=("10.0.0.0/8",)))
    assert plan.relay == Address("0.0.0.0", 8000)
    assert [str(network) for network in plan.allow] == ["10.0.0.0/8"]
    with pytest.raises(ConfigError, match=r"camera\.relay = 'here': expected host:port"):
        plan_camera(CameraSettings("http://robot", relay="here"))
    with pytest.raises(ConfigError, match=r"camera\.allow = \['10\.0\.0\.0/8'\]: expected only with camera\.relay"):
        plan_camera(CameraSettings("http://robot", allow=("10.0.0.0/8",)))
