"""The gateway before its judge: fifty mixed commands for each version, by TCP and by UDP."""

from __future__ import annotations

import pytest

from tests.e2e.judge import VERSIONS, judge


@pytest.mark.parametrize("udp", [False, True], ids=["tcp", "udp"])
@pytest.mark.parametrize("version", VERSIONS)
def test_a_fragile_robot_survives_fifty_mixed_commands(version: str, udp: bool) -> None:
    judgement = judge(version, udp=udp, commands=50)
    assert judgement.alive
    assert len(judgement.excused) <= 2
    assert judgement.violations == []
    assert judgement.missing == []
    assert judgement.answered["no pose"] == judgement.answered["no map"] == 0
