"""The options of the server: what is refused, and with which words."""

from pathlib import Path

import pytest

from zbridge.errors import ConfigError
from zbridge.views.foxglove.requests import Scale
from zbridge.views.foxglove.settings import FoxgloveOptions, plan

GOOD, SHORT, SPOILED = "a" * 32, "short", "with space and more letters"

REFUSED = [
    (FoxgloveOptions(listen="nowhere"), "--listen nowhere: expected host:port"),
    (FoxgloveOptions(metrics="nowhere"), "--metrics nowhere: expected host:port"),
    (FoxgloveOptions(listen="0.0.0.0:1"), "--listen 0.0.0.0:1: other machines need --tls-certificate"),
    (FoxgloveOptions(listen="0.0.0.0:1", insecure=True, drive=True), "--drive at 0.0.0.0:1: expected --token"),
    (FoxgloveOptions(tls_key=Path("key.pem")), "--tls-certificate and --tls-key: expected both"),
    (FoxgloveOptions(token=Path("nowhere")), "--token nowhere: No such file"),
    (FoxgloveOptions(token=Path("short")), "--token short: expected a line of at least 16 letters and digits"),
    (FoxgloveOptions(token=Path("spoiled")), "--token spoiled: expected a line"),
    (FoxgloveOptions(origins=["*"]), r"--origin \*: expected an Origin"),
    (FoxgloveOptions(origins=["https://example.org/"]), "--origin https://example.org/: expected an Origin"),
    (FoxgloveOptions(allow=["10.0.0.1/8"]), "--allow 10.0.0.1/8: expected a network"),
    (FoxgloveOptions(robots=["r/1"]), "'r/1': expected letters"),
    (FoxgloveOptions(who="a b"), "'a b': expected letters"),
    (FoxgloveOptions(speed_full_mps=["fast"]), "--speed-full-mps fast: expected a number above 0"),
    (FoxgloveOptions(turn_full_radps=["r1=0"]), "--turn-full-radps r1=0: expected a number above 0"),
    (FoxgloveOptions(turn_full_radps=["r/1=1"]), "--turn-full-radps r/1=1: expected a number above 0, or ROBOT=NUMBER"),
]


@pytest.fixture(autouse=True)
def _files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, text in (("good", GOOD + "\n"), ("short", SHORT), ("spoiled", SPOILED)):
        (tmp_path / name).write_text(text)


@pytest.mark.parametrize(("options", "expected"), REFUSED)
def test_options_that_do_not_go_are_refused(options: FoxgloveOptions, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        plan(options)


def test_by_default_loopback_is_served_to_foxglove_and_programs_that_may_look() -> None:
    planned = plan(FoxgloveOptions())
    assert str(planned.address) == "tcp://127.0.0.1:8765"
    assert planned.policy.origins == ("https://app.foxglove.dev",)
    assert not planned.policy.drive
    assert planned.policy.token is None


def test_a_token_is_read_from_its_file_and_makes_driving_elsewhere_possible() -> None:
    planned = plan(FoxgloveOptions(listen="0.0.0.0:1", insecure=True, drive=True, token=Path("good")))
    assert planned.policy.token == GOOD


def test_scales_are_given_for_all_robots_and_for_one() -> None:
    scales = plan(FoxgloveOptions(speed_full_mps=["0.5", "r2=2"], turn_full_radps=["r3=3"])).scales
    assert scales[""] == Scale(0.5, 1.0)
    assert scales["r2"] == Scale(2.0, 1.0)
    assert scales["r3"] == Scale(0.5, 3.0)
