"""The signs that a connection is not the robot's one usable connection. Sans-IO.

Source: "Signs of a poor connection" of the protocol page.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

from gateways.tcpudp.session import PacketSession
from zbridge.protocol import Kept, Limits, Traffic

FIRST_CLIENT = 2
"""The id that most robots give their first client; a legacy one gave 35."""
INSPECT_S = 5.0
"""Seconds after which a silent connection is a sign."""
INSPECT_AGAIN_S = 1.0
MALFORMED, MALFORMED_SHARE = 3, 0.05
"""Malformed packets are a sign from this number and from this share of all packets on."""
LATER_CLIENT = "another program is connected, or the one usable connection is used up"
GARBLED = "malformed packets"
UNANSWERED = f"no telemetry and no answer to the probe within {INSPECT_S:g} s"
MUTE = f"no telemetry within {INSPECT_S:g} s, unlike on the connection before"


class Signs(Kept):
    """The signs on one connection. ``before``: the signs on the connection before."""

    kept: ClassVar[dict[str, Any]] = {
        "talks": bool,
        "_expected": bool,
        "_talked": bool,
        "_inspected": bool,
        "_asked": int,
        "_silent": str | None,
    }

    def __init__(self, before: Signs | None = None) -> None:
        self.talks: bool = before is not None and before.talks
        """Whether the robot sent telemetry unasked within :data:`INSPECT_S`, on this connection or one before."""
        self._expected = self.talks
        self._talked = self._inspected = False
        self._asked = 0
        self._silent: str | None = None

    def __repr__(self) -> str:
        return f"<Signs talks={self.talks} {self._silent}>"

    def note_queries(self, received: int, questions: int = 1) -> None:
        """Count queries that were just sent: their answers are not telemetry."""
        self._note_telemetry(received)
        self._asked += questions

    def inspect(self, received: int, *, unanswered: bool) -> None:
        """Decide whether the robot's silence is a sign. Call at :data:`INSPECT_S` first, then repeatedly.

        received: packets that are telemetry or answers to queries. unanswered: the probe got no answer. Some robots
        send nothing until they are asked: silence is a sign only if the robot sent telemetry unasked on an earlier
        connection, or if it sent nothing at all on this one and did not answer the probe.
        """
        self._note_telemetry(received)
        if not self._inspected:
            self._inspected, self.talks = True, self.talks or self._talked
        if self._expected and not self._talked:
            self._silent = MUTE
        else:
            self._silent = UNANSWERED if unanswered and not received else None

    def listing(self, client_id: int, traffic: Traffic) -> tuple[str, ...]:
        """List the present signs, for people.

        A client id above :data:`FIRST_CLIENT` is listed only with another sign: a second HQ program gets such an id
        too, and some robots begin with any number.
        """
        few = traffic.malformed < max(MALFORMED, MALFORMED_SHARE * traffic.frames_in)
        signs = tuple(filter(None, (None if few else GARBLED, self._silent)))
        return (f"client id {client_id}: {LATER_CLIENT}", *signs) if signs and client_id > FIRST_CLIENT else signs

    def _note_telemetry(self, received: int) -> None:
        self._talked = self._talked or received > self._asked


class WatchedSession(PacketSession):
    """A session whose ``doubts`` are the signs of its connection. before: of the connection before."""

    kept: ClassVar[dict[str, Any]] = {"sender_id": int, "_signs": Signs, "_inspect_at": float, "_others": int}

    def __init__(self, limits: Limits, before: Signs | None) -> None:
        super().__init__(limits)
        self.sender_id = 0
        self._signs: Signs = Signs(before)
        self._inspect_at = math.inf
        self._others = 0
        """Packets received that are no telemetry."""

    def malformed(self, what: str) -> None:
        super().malformed(what)
        self._update_doubts()

    def _inspect(self, now: float, *, unanswered: bool) -> None:
        self._signs.inspect(self._telemetry_in, unanswered=unanswered)
        self._update_doubts()
        self._inspect_at = now + INSPECT_AGAIN_S

    @property
    def _telemetry_in(self) -> int:
        return self.traffic.frames_in - self.traffic.malformed - self._others

    def _update_doubts(self) -> None:
        self.doubts = self._signs.listing(self.sender_id, self.traffic)
