"""One probe: waited for, answered, or given up; never twice."""

import math

import pytest

from zbridge.protocol.udp_probe import Probe, Verdict


def test_a_probe_that_has_not_begun_waits_for_nothing() -> None:
    probe = Probe(2.0)
    assert (probe.verdict, probe.deadline) == (Verdict.UNKNOWN, math.inf)
    assert not probe.settle(works=True)
    assert not probe.expire(1e9)
    assert probe.verdict is Verdict.UNKNOWN


@pytest.mark.parametrize(("works", "verdict"), [(True, Verdict.WORKS), (False, Verdict.FAILED)])
def test_the_first_answer_counts_and_ends_the_waiting(works: bool, verdict: Verdict) -> None:
    probe = Probe(2.0)
    probe.begin(10.0)
    assert (probe.verdict, probe.deadline) == (Verdict.WAITING, 12.0)
    assert probe.settle(works=works)
    assert (probe.verdict, probe.deadline) == (verdict, math.inf)
    assert not probe.settle(works=not works)
    assert not probe.expire(12.0)
    assert probe.verdict is verdict


def test_a_probe_fails_once_when_its_time_is_used_up() -> None:
    probe = Probe(2.0)
    probe.begin(10.0)
    assert not probe.expire(11.999)
    assert probe.verdict is Verdict.WAITING
    assert probe.expire(12.0)
    assert (probe.verdict, probe.deadline) == (Verdict.FAILED, math.inf)
    assert not probe.expire(13.0)
    assert not probe.settle(works=True)
    assert probe.verdict is Verdict.FAILED


def test_a_probe_prints_what_is_known() -> None:
    probe = Probe(2.0)
    assert repr(probe) == "<Probe unknown>"
    probe.begin(0.0)
    assert repr(probe) == "<Probe waiting>"


@pytest.mark.parametrize("works", [True, None])
def test_a_probe_may_fail_whatever_was_found_out(works: bool | None) -> None:
    probe = Probe(2.0)
    probe.begin(10.0)
    if works:
        probe.settle(works=True)
    probe.fail()
    assert (probe.verdict, probe.deadline) == (Verdict.FAILED, math.inf)
    assert not probe.settle(works=True)
