"""What gateways of one robot claim, and whose claim is better. Sans-IO.

A claim is the answer to a query. The bus tells whose claim an answer is (the replier), never a payload.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable

import msgspec

from zbridge.bus import Answer
from zbridge.control.latch import LatchRecord
from zbridge.fleet.messages import Latch, StopId
from zbridge.log import Log

log = Log("zbridge.app.gateway")

CLAIM = "@rpc/claim/gateway"
"""The path at which a gateway answers with its claim."""
RIVALS = 16
"""Claims of others that are considered at a time: the best."""
MOST_S = 10 * 365 * 86_400.0
"""The longest time for which a robot can have been served, seconds: ten years. Longer claims are ignored."""
LOOKS = 3
"""Looks in a row that must find no gateway after one was seen or the bus was gone, or no claim behind a token."""
YOUNG_S = 60.0
"""Seconds for which a gateway that found nobody at its start looks closely: it may have started beside a cut."""


class Standing(msgspec.Struct, frozen=True):
    """How a gateway stands with its robot.

    healthy: the robot is established, not in doubt, and sent something a moment ago. connected_s: the connection's age,
    0 where there is none. record: the robot's latched stops, and what else survives a restart.
    """

    healthy: bool = False
    connected_s: float = 0.0
    record: LatchRecord = LatchRecord()


class Claim(msgspec.Struct, frozen=True):
    """What a gateway claims. held_s: seconds since the robot is served, 0 while it is not.

    healthy, connected_s: its :class:`Standing`; the fields after ``leaving`` are its record. yielded: to a better
    claim. leaving: it ends in good order.
    """

    held_s: float = 0.0
    healthy: bool = False
    connected_s: float = 0.0
    yielded: bool = False
    leaving: bool = False
    latches: tuple[Latch, ...] = ()
    released: tuple[StopId, ...] = ()
    released_fleet: tuple[StopId, ...] = ()
    autonomous: bool = False

    @property
    def record(self) -> LatchRecord:
        """What other gateways of the robot write down."""
        return LatchRecord(self.latches, self.released, self.released_fleet, self.autonomous)

    @property
    def plausible(self) -> bool:
        """Whether a gateway can claim this."""
        return all(math.isfinite(age_s) and 0 <= age_s <= MOST_S for age_s in (self.held_s, self.connected_s)) and (
            self.held_s > 0 or self == Claim()
        )

    def better_than(self, other: Claim, zid: str, other_zid: str) -> bool:
        """Return whether this claim, of the session ``zid``, is better than another one's."""
        first, second = (each.rank for each in (self, other))
        if first != second:
            return first > second
        if self.yielded:
            return zid < other_zid
        return (self.connected_s, self.held_s, other_zid) > (other.connected_s, other.held_s, zid)

    @property
    def rank(self) -> tuple[bool, ...]:
        """What counts before any age; higher is better."""
        return (self.held_s > 0, not self.leaving, self.healthy, not self.yielded)


class ClaimQuestion(msgspec.Struct, frozen=True):
    """A question for claims. zid: who asks, so that a gateway knows its own question; serves: whether it owns too.

    latches, autonomous: the latched stops that the sender knows, and whether the robot was ordered to move by itself.
    Released ids are not here: whoever asks has not proved that it may release anything.
    """

    zid: str = ""
    serves: bool = False
    latches: tuple[Latch, ...] = ()
    autonomous: bool = False


_read = msgspec.msgpack.Decoder(Claim).decode
_read_question = msgspec.msgpack.Decoder(ClaimQuestion).decode
write = msgspec.msgpack.Encoder().encode
_UNREADABLE = (msgspec.MsgspecError, UnicodeError, RecursionError)


def read_question(payload: bytes) -> ClaimQuestion | None:
    """Read who asks for claims; None if that cannot be read."""
    with contextlib.suppress(*_UNREADABLE):
        return _read_question(payload)
    return None


def best_claims(answers: Iterable[Answer], own_zid: str) -> dict[str, Claim]:
    """Return the claims of others by session id, the best first: one of each. Implausible ones are ignored."""
    claims: list[tuple[Claim, str]] = []
    heard = {own_zid}
    for answer in answers:
        if answer.replier is None or answer.replier in heard:
            continue
        heard.add(answer.replier)
        with contextlib.suppress(*_UNREADABLE):
            claim = _read(answer.payload)
            if answer.error is None and claim.plausible:
                claims.append((claim, answer.replier))
    claims.sort(key=lambda each: (*(not good for good in each[0].rank), -each[0].connected_s, -each[0].held_s, each[1]))
    return {zid: claim for claim, zid in claims[:RIVALS]}


class OtherGateways:
    """What was seen of other gateways while the robot is waited for; each finding is logged once."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._without_claim = 0
        self._logged: set[str] = set()
        self._close_until: float | None = None

    def seen(self, token: bool, claim: bool, *, leaving: bool) -> bool:
        """Return whether there is another gateway. A token without a claim, :data:`LOOKS` times in a row, is none."""
        if claim:
            self._without_claim = 0
            self._close_until = -math.inf if leaving else math.inf
            if self._is_new("serves"):
                log.warning("robot_served", "another gateway serves {robot}: waiting until it goes", robot=self._robot)
            return True
        self._without_claim = self._without_claim + 1 if token else 0
        if self._without_claim == LOOKS and self._is_new("silent"):
            text = "a gateway of {robot} has a token but does not answer: ignoring it"
            log.warning("gateway_silent", text, robot=self._robot)
        return 0 < self._without_claim < LOOKS

    def close_until(self, now: float) -> float:
        """Return until when others must be looked for closely: one that went without a goodbye may come back."""
        return now + YOUNG_S if self._close_until is None else self._close_until

    def _is_new(self, finding: str) -> bool:
        new = finding not in self._logged
        self._logged.add(finding)
        return new
