"""Options of a ROS 2 robot: names of topics, and what cannot be."""

from typing import Any

import msgspec
import pytest

from gateways.ros2.options import RosOptions
from tests.gateways.rig import planned
from zbridge.app import config
from zbridge.errors import ConfigError
from zbridge.protocol.address import ZenohAddress


def test_topics_stand_in_the_namespace_unless_they_are_absolute() -> None:
    options = RosOptions(namespace="/robots/r1", odom="/odom", map="")
    assert (options.topic("scan"), options.topic("odom"), options.topic("map")) == ("/robots/r1/scan", "/odom", None)
    assert RosOptions().topic("image") == "/image/compressed"


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "namespace": ({"namespace": "/1"}, "namespace = '/1': expected a name like '/r1'"),
    "topic": ({"scan": "a b"}, "scan = 'a b': expected a name like 'scan'"),
    "twice": ({"scan": "odom"}, "expected a topic of its own for each"),
    "none": (dict.fromkeys(("scan", "odom", "map", "imu", "battery_state", "image"), ""), "at least one topic"),
    "distro": ({"distro": "foxy"}, "distro = 'foxy': expected one of humble"),
}


@pytest.mark.parametrize("case", WRONG)
def test_options_that_cannot_be_are_errors(case: str) -> None:
    options, expected = WRONG[case]
    with pytest.raises(ConfigError, match="device") as raised:
        planned("ros2", **options)
    assert expected in str(raised.value)


def test_a_robot_is_at_the_address_of_its_router() -> None:
    (address,) = planned("ros2").addresses
    assert address == ZenohAddress("127.0.0.1", 27015)
    assert (str(address), address.endpoint) == ("tcp://127.0.0.1:27015", "tcp/127.0.0.1:27015")


def test_a_serial_line_leads_to_no_router() -> None:
    raw = {"robot": {"name": "r1"}, "device": {"protocol": "ros2", "connect": ["serial:///dev/ttyUSB0?baud=9600"]}}
    with pytest.raises(ConfigError, match="expected tcp://host:port"):
        config.plan(raw)


def test_defaults_are_what_the_template_says() -> None:
    import tomllib

    from gateways import ros2

    lines = [line.removeprefix("# ") for line in ros2.TEMPLATE.splitlines()]
    written = tomllib.loads("\n".join(lines))["device"]["options"]
    assert msgspec.convert({**written, "namespace": ""}, RosOptions) == RosOptions()
