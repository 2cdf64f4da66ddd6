"""The claim on a robot while it is handed over, and taken back."""

from __future__ import annotations

from zbridge.app.handover.claim import ClaimPart
from zbridge.bus.fake import FakeBus
from zbridge.fleet.topics import KeySpace
from zbridge.robot.ownership import Ownership
from zbridge.transport import Parcel


async def test_a_claim_that_is_withdrawn_for_the_successor_is_still_deposited_and_comes_back() -> None:
    ownership = Ownership(FakeBus("1"), KeySpace("fleet", "r1"), clock=lambda: 5.0)
    part = ClaimPart(ownership)
    assert part.hand_over(Parcel()) == {}
    claim = {"since": 2.0, "yielded": False, "close_until": 4.0}
    ownership.inherit(claim)
    assert part.hand_over(Parcel()) == claim
    part.withdraw()
    assert ownership.export() is None
    assert part.hand_over(Parcel()) == claim, "the successor may die before it has deposited any"
    await part.go_on()
    assert ownership.export() == claim
    ownership.release()
    assert part.hand_over(Parcel()) == {}
