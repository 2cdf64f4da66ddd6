"""Whether the router knows our name, as it answers or is silent."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime

import pytest

from zbridge.bus import Answer
from zbridge.bus.tls.certificate import Certificate
from zbridge.bus.tls.membership import WHOAMI_S, Right, no_answer, require_member, require_right, router_id
from zbridge.errors import BusError, BusRefused
from zbridge.fleet import payload as payloads
from zbridge.fleet.processes import Membership
from zbridge.security.access import GRANTS, Keys, MessageKind

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


V1, OP1 = Membership(name="v1", role="viewer"), Membership(name="op1", role="operator")
SUP1, H1 = Membership(name="sup1", role="supervisor"), Membership(name="h1", role="hq", robots=("r1",))
ROLES = "in roles.toml of the router"
RIGHTS: list[tuple[Membership | None, Right, str | None]] = [
    (V1, Right.DRIVE, f"viewer.v1 may not drive it: that takes the role operator or supervisor or hq {ROLES}"),
    (V1, Right.TAKE_OVER, f"viewer.v1 may not take it over: that takes the role supervisor {ROLES}"),
    (OP1, Right.DRIVE, None),
    (OP1, Right.TAKE_OVER, f"operator.op1 may not take it over: that takes the role supervisor {ROLES}"),
    (OP1, Right.RESTART, f"operator.op1 may not restart its gateway: that takes the role supervisor {ROLES}"),
    (SUP1, Right.RESTART, None),
    (H1, Right.DRIVE, "hq.h1 is for r1 only: roles.toml of the router says so"),
    (OURS, Right.DRIVE, None),  # its process may have listeners
    (None, Right.DRIVE, None),
]


@pytest.mark.parametrize(("member", "right", "said"), RIGHTS)
async def test_the_role_that_a_program_lacks_is_named_as_the_router_knows_it(
    member: Membership | None, right: Right, said: str | None
) -> None:
    keys: list[str] = []

    async def ask(key: str) -> list[Answer]:
        keys.append(key)
        return [answer(member)] if member is not None else []

    name = member.name if member is not None else "ann"
    if said is None:
        await require_right(ask, "lab", name, right, "r2")
    else:
        with pytest.raises(BusRefused, match=f"^r2: {said}$"):
            await require_right(ask, "lab", name, right, "r2")
    assert keys == [f"lab/@bus/whoami/{name}"]


async def silent(key: str) -> list[Answer]:
    await asyncio.sleep(60.0)
    raise AssertionError(key)


@pytest.mark.jumping
async def test_a_router_that_is_silent_is_waited_for_briefly_and_then_the_certificate_counts() -> None:
    began = asyncio.get_running_loop().time()
    await require_right(silent, "lab", "v1", Right.MARK)
    with pytest.raises(BusRefused, match=r"^viewer\.v1 may not write a mark: that takes the role operator or"):
        await require_right(silent, "lab", "v1", Right.MARK, role="viewer")
    await require_right(silent, "lab", "op1", Right.MARK, role="operator")
    assert asyncio.get_running_loop().time() - began == pytest.approx(3 * WHOAMI_S, abs=0.01)


async def test_nobody_is_asked_about_a_name_that_no_certificate_has() -> None:
    await require_right(silent, "lab", "ann@here", Right.DRIVE, "r2", role="viewer")


def test_who_had_no_answer_is_told_of_rules_only_if_they_may_concern_it() -> None:
    assert no_answer("ann@here", 5.0) == "no gateway answered within 5 s"
    assert no_answer("ann", 5.0) == "no answer within 5 s: no gateway, or the router's rules forbid it"
    assert no_answer("ann") == "no answer: no gateway, or the router's rules forbid it"


@pytest.mark.parametrize(
    ("right", "keys"),
    [
        (Right.DRIVE, Keys.ACQUIRE),
        (Right.TAKE_OVER, Keys.TAKEOVER),
        (Right.RESTART, Keys.RESTART),
        (Right.MARK, Keys.MARK),
        (Right.UNLATCH, Keys.UNLATCH),
        (Right.UNLATCH_FLEET, Keys.UNLATCH_FLEET),
    ],
)
def test_the_rights_are_those_of_the_access_rules(right: Right, keys: Keys) -> None:
    """A gateway with listeners holds leases for its HQ programs; its role does not tell whether it has some."""
    granted = {
        column
        for column, grants in GRANTS.items()
        if any(grant.keys is keys and {MessageKind.QUERY, MessageKind.PUT} & {*grant.kinds} for grant in grants)
    }
    assert set(right.value[1]) == granted - {"gateway with listeners"}


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
