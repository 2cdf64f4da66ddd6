"""The claim on a robot, as a part of a handover: the successor announces the same one before this one is withdrawn."""

from __future__ import annotations

from zbridge.protocol.kept import Exported
from zbridge.robot.ownership import Ownership
from zbridge.transport import Parcel


class ClaimPart:
    """The claim of a gateway that owns its robot."""

    def __init__(self, ownership: Ownership) -> None:
        self._ownership = ownership
        self._claim: Exported | None = None
        self._withdrawn = False

    def __repr__(self) -> str:
        return f"<ClaimPart {self._ownership!r}>"

    async def prepare(self, reason: str, within_s: float) -> None:
        """Report the successor's claim as no rival's."""
        self._ownership.hands_over = True

    async def shut(self) -> None:
        """Do nothing."""

    def hold(self) -> None:
        """Do nothing."""

    def hand_over(self, parcel: Parcel) -> Exported:
        """Describe the claim; ``{}`` where the robot is not owned. One that was withdrawn is the successor's."""
        if not self._withdrawn:
            self._claim = self._ownership.export()
        return self._claim or {}

    async def go_on(self) -> None:
        """Claim the robot again, where the claim was withdrawn."""
        self._ownership.hands_over = self._withdrawn = False
        if self._claim is not None and self._ownership.export() is None:
            self._ownership.inherit(self._claim)
            self._ownership.begin()

    def withdraw(self) -> None:
        """Leave the claim, and the liveliness token, to the successor's."""
        self._withdrawn = True
        self._ownership.release()

    async def release(self) -> None:
        """Do nothing: the claim is withdrawn."""
