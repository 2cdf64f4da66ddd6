"""Whether the router knows our name, as it answers or is silent."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from zbridge.bus import Answer
from zbridge.bus.tls.certificate import Certificate
from zbridge.bus.tls.membership import require_member, router_id
from zbridge.errors import BusError, BusRefused
from zbridge.fleet import payload as payloads
from zbridge.fleet.messages import Membership

NOW = datetime(2026, 11, 22, tzinfo=UTC)
KEY = "fleet/@bus/whoami/g1"
OURS = Membership(name="g1", role="gateway", robots=("r1", "r2"))
HQ = Membership(name="g1", role="hq", robots=("r1",))


def answer(message: Membership) -> Answer:
    return Answer(KEY, payloads.encode(message))


async def asked(answers: list[list[Answer]], robot: str | None, router: str, common_name: str = "gateway.g1") -> int:
    """Give how often the router was asked; it answers in turn."""
    keys: list[str] = []

    async def ask(key: str) -> list[Answer]:
        keys.append(key)
        return answers[len(keys) - 1] if len(keys) <= len(answers) else []

    await require_member(ask, [router], Certificate(common_name, NOW, NOW), "fleet", robot)
    assert set(keys) <= {KEY}
    return len(keys)


KNOWN = [[answer(OURS)]]
LATE = [[], [Answer(KEY, b"", BusError("timeout")), Answer(KEY, b"?")], *KNOWN]


@pytest.mark.jumping
async def test_a_member_that_is_known_may_go_on() -> None:
    assert await asked(KNOWN, "r1", router_id()) == 1
    assert await asked(KNOWN, None, router_id()) == 1
    assert await asked(LATE, "r2", router_id()) == 3
    everywhere = [[answer(Membership(name="g1", role="viewer"))]]
    assert await asked(everywhere, "r7", router_id(), "viewer.g1") == 1


async def test_a_router_that_answers_nobody_and_a_certificate_that_names_nobody_tell_nothing() -> None:
    assert await asked([], "r1", "5b84f6e9c574a220128d52750df2335d") == 0
    assert await asked([], "r1", router_id(), "somebody") == 0


UNKNOWN = [
    ([], "r1", "the router does not know gateway.g1 in realm fleet"),
    (KNOWN, "r3", "gateway.g1 is for r1, r2 and not for r3"),
    ([[answer(HQ)]], "r1", "names hq.g1, and the certificate is of gateway"),
]


@pytest.mark.jumping
@pytest.mark.parametrize(("answers", "robot", "told"), UNKNOWN)
async def test_who_is_not_known_is_told(answers: list[list[Answer]], robot: str, told: str) -> None:
    with pytest.raises(BusRefused, match=told):
        await asked(answers, robot, router_id())
