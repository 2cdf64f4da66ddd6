"""Twists as fractions of full scale."""

import pytest

from zbridge.errors import Malformed
from zbridge.fleet.messages import Drive
from zbridge.views.foxglove.requests import Scale, read_twist

FAST = Scale(speed_full_mps=2.0, turn_full_radps=4.0)

TWISTS = [
    ('{"linear":{"x":1.0,"y":0,"z":9},"angular":{"x":9,"y":9,"z":-1.0}}', (0.5, 0.0, -0.25)),
    ('{"linear":{"x":0,"y":0.5}}', (0.0, 0.25, 0.0)),
    ("{}", (0.0, 0.0, 0.0)),
    ('{"linear":{"x":4},"angular":{"z":2}}', (1.0, 0.0, 0.25)),
    ('{"linear":{"x":-8},"angular":{"z":4}}', (-1.0, 0.0, 0.25)),
]


@pytest.mark.parametrize(("text", "expected"), TWISTS)
def test_a_twist_is_scaled_to_full_speed_and_keeps_its_curve(text: str, expected: tuple[float, ...]) -> None:
    drive = read_twist(text.encode(), FAST)
    assert (drive.forward, drive.left, drive.turn) == expected


@pytest.mark.parametrize(
    "data",
    [b"", b"[]", b"\xff", b'{"linear":{"x":"1"}}', b'{"linear":{"x":1e999}}', b'{"linear":{"x":NaN}}', b"[" * 9999],
)
def test_a_spoiled_twist_is_malformed(data: bytes) -> None:
    with pytest.raises(Malformed):
        read_twist(data, FAST)


def test_a_huge_twist_is_full_speed() -> None:
    assert read_twist(b'{"linear":{"x":1e300}}', FAST) == Drive(forward=1.0)
