"""Open faults: what status tells people of a robot that is served all the same."""

from zbridge.control.faults import FaultCode, OpenFaults


def test_conditions_are_told_oldest_first_and_only_when_they_change() -> None:
    told: list[tuple[str, ...]] = []
    open_faults = OpenFaults(lambda: told.append(open_faults.texts))
    open_faults.set(FaultCode.LINK_STALLED, "is stalled")
    open_faults.set(FaultCode.AUDIT_LOG, "disk full")
    open_faults.set(FaultCode.LINK_STALLED, "is stalled")
    open_faults.set(FaultCode.LINK_STALLED, None)
    open_faults.set(FaultCode.LINK_STALLED, None)
    assert told == [("is stalled",), ("is stalled", "disk full"), ("disk full",)]
