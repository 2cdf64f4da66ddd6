"""Conditions: what status tells people of a robot that is served all the same."""

from zbridge.control.faults import Conditions, FaultCode


def test_conditions_are_told_oldest_first_and_only_when_they_change() -> None:
    told: list[tuple[str, ...]] = []
    conditions = Conditions(lambda: told.append(conditions.texts))
    conditions.set(FaultCode.LINK_STALLED, "takes nothing")
    conditions.set(FaultCode.AUDIT_LOG, "disk full")
    conditions.set(FaultCode.LINK_STALLED, "takes nothing")
    conditions.set(FaultCode.LINK_STALLED, None)
    conditions.set(FaultCode.LINK_STALLED, None)
    assert told == [("takes nothing",), ("takes nothing", "disk full"), ("disk full",)]
