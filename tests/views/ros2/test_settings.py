"""Options and the file together: what wins, and what is wrong is said."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from zbridge.errors import ConfigError
from zbridge.toml import convert
from zbridge.views.ros2.settings import RobotBody, Ros2Settings, plan

FILE = {
    "domain": 3,
    "distro": "humble",
    "robots": ["r1"],
    "drive": True,
    "ros": ["tcp/10.0.0.1:7447"],
    "others": {"speed_full_mps": 0.5},
    "robot": {"r1": {"wheelbase_m": 0.3, "laser": {"z": 0.1}}},
}


def test_defaults_are_those_of_ros() -> None:
    made = plan(Ros2Settings())
    assert (made.domain, made.distro, made.drive, made.robots) == (0, "jazzy", False, ())
    router = made.router
    assert (router.connect, router.effective_mode, router.multicast) == (("tcp/localhost:7447",), "client", False)
    assert made.body("r1") == RobotBody()


def test_options_win_over_the_file() -> None:
    made = plan(replace(convert(FILE, Ros2Settings), domain=0, distro="kilted", robots=("r2",), ros=("tcp/a:1",)))
    assert (made.domain, made.distro, made.robots, made.router.connect) == (0, "kilted", ("r2",), ("tcp/a:1",))
    assert made.drive


def test_each_robot_has_its_body() -> None:
    made = plan(convert(FILE, Ros2Settings))
    assert (made.domain, made.distro) == (3, "humble")
    assert made.body("r1").wheelbase_m == 0.3
    assert made.body("r1").laser.z == 0.1
    assert made.body("r2").speed_full_mps == 0.5


WRONG = {
    "domain = 233: expected 0 to 232": {"domain": 233},
    "distro = 'foxy': expected one of humble": {"distro": "foxy"},
    "robot 'a b': expected letters": {"robots": ("a b",)},
    "ros = .*localhost:7447.*: expected Zenoh endpoints": {"ros": ("localhost:7447",)},
    "others.wheelbase_m = 0: expected": {"others": {"wheelbase_m": 0}},
    "others.speed = 1: unknown key; expected one of speed_full_mps": {"others": {"speed": 1}},
}


@pytest.mark.parametrize("text", WRONG)
def test_what_is_wrong_is_said_in_one_line(text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        plan(convert(WRONG[text], Ros2Settings))
