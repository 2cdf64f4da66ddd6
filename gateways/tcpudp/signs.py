"""Signs of a connection to a robot that is not its first, and may carry half of what is said on it. Sans-IO.

Source: "One usable connection per start" of the protocol page. The session tells what it heard, as a count of packets:
texts are left out, as they reach every client of a robot.
"""

from __future__ import annotations

from zbridge.protocol import Traffic

FIRST_CLIENT = 2
"""The id that a robot gives the first client after its start."""
LOOK_S = 5.0
"""Seconds in which a connection is expected to show that it works."""
LOOK_AGAIN_S = 1.0
MALFORMED, MALFORMED_SHARE = 3, 0.05
"""Malformed packets that are a sign: so many, and such a share of all that came."""
LATER_CLIENT = "another program is connected, or the one usable connection is used up"
GARBLED = "malformed packets"
UNANSWERED = f"no telemetry and no answer to the probe within {LOOK_S:g} s"
MUTE = f"no telemetry within {LOOK_S:g} s, unlike on the connection before"


class Signs:
    """The signs on one connection. before: those on the connection before."""

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
        """Take note of questions that were just sent: their answers are no telemetry."""
        self._listen(heard)
        self._asked += questions

    def look(self, heard: int, *, unanswered: bool) -> None:
        """Judge after :data:`LOOK_S` whether the robot is silent, and again later; unanswered: so was the probe.

        A robot may be waiting to be asked: without telemetry before, or a probe, silence is no sign.
        """
        self._listen(heard)
        if not self._looked:
            self._looked, self.talks = True, self.talks or self._talked
        if self._expected and not self._talked:
            self._silent = MUTE
        else:
            self._silent = UNANSWERED if unanswered and not heard else None

    def gather(self, client_id: int, traffic: Traffic) -> tuple[str, ...]:
        """List the signs there are now, for people."""
        later = f"client id {client_id}: {LATER_CLIENT}" if client_id > FIRST_CLIENT else None
        few = traffic.malformed < max(MALFORMED, MALFORMED_SHARE * traffic.frames_in)
        return tuple(filter(None, (later, None if few else GARBLED, self._silent)))

    def _listen(self, heard: int) -> None:
        self._talked = self._talked or heard > self._asked
