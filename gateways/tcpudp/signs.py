"""Signs that a connection is not the robot's one usable connection, and may lose half of all packets. Sans-IO.

Source: "One usable connection per start" of the protocol page. The session passes ``heard``, the number of packets that
it received, without texts: every client of a robot gets texts, also on a poor connection.
"""

from __future__ import annotations

from typing import Any, ClassVar

from zbridge.protocol import Kept, Traffic

FIRST_CLIENT = 2
"""The id that most robots give their first client; a deployed one gave 35."""
LOOK_S = 5.0
"""Seconds after which a silent connection is a sign."""
LOOK_AGAIN_S = 1.0
MALFORMED, MALFORMED_SHARE = 3, 0.05
"""Malformed packets are a sign from this number and from this share of all packets on."""
LATER_CLIENT = "another program is connected, or the one usable connection is used up"
GARBLED = "malformed packets"
UNANSWERED = f"no telemetry and no answer to the probe within {LOOK_S:g} s"
MUTE = f"no telemetry within {LOOK_S:g} s, unlike on the connection before"


class Signs(Kept):
    """The signs on one connection. ``before``: the signs on the connection before."""

    kept: ClassVar[dict[str, Any]] = {
        "talks": bool,
        "_expected": bool,
        "_talked": bool,
        "_looked": bool,
        "_asked": int,
        "_silent": str | None,
    }

    def __init__(self, before: Signs | None = None) -> None:
        self.talks: bool = before is not None and before.talks
        """Whether the robot sent telemetry unasked within :data:`LOOK_S`, on this connection or one before."""
        self._expected = self.talks
        self._talked = self._looked = False
        self._asked = 0
        self._silent: str | None = None

    def __repr__(self) -> str:
        return f"<Signs talks={self.talks} {self._silent}>"

    def asked(self, heard: int, questions: int = 1) -> None:
        """Count queries that were just sent: their answers are no telemetry."""
        self._listen(heard)
        self._asked += questions

    def look(self, heard: int, *, unanswered: bool) -> None:
        """Judge whether the robot is silent. Call first at :data:`LOOK_S`; ``unanswered``: a probe got no answer.

        Some robots send nothing until they are asked: silence is a sign only if the robot sent telemetry on the
        connection before, or did not answer the probe.
        """
        self._listen(heard)
        if not self._looked:
            self._looked, self.talks = True, self.talks or self._talked
        if self._expected and not self._talked:
            self._silent = MUTE
        else:
            self._silent = UNANSWERED if unanswered and not heard else None

    def gather(self, client_id: int, traffic: Traffic) -> tuple[str, ...]:
        """List the present signs, for people.

        A client id above :data:`FIRST_CLIENT` is listed only with another sign: a second HQ program gets such an id
        too, and some robots begin with any number.
        """
        few = traffic.malformed < max(MALFORMED, MALFORMED_SHARE * traffic.frames_in)
        signs = tuple(filter(None, (None if few else GARBLED, self._silent)))
        return (f"client id {client_id}: {LATER_CLIENT}", *signs) if signs and client_id > FIRST_CLIENT else signs

    def _listen(self, heard: int) -> None:
        self._talked = self._talked or heard > self._asked
