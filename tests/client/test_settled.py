from __future__ import annotations

import asyncio

import pytest

from zbridge.client.settled import QUERY_AFTER_S, SETTLE_S, settled

pytestmark = pytest.mark.jumping


class Looks:
    """What is found look by look; the last stays."""

    def __init__(self, *found: set[str]) -> None:
        self.found, self.looked_at = list(found), list[float]()

    async def __call__(self) -> set[str]:
        self.looked_at.append(asyncio.get_running_loop().time())
        return self.found.pop(0) if len(self.found) > 1 else self.found[0]


async def test_what_is_the_same_twice_is_believed_after_the_second_look() -> None:
    looks = Looks({"r1"})
    assert await settled(looks, lambda seen: seen) == {"r1"}
    assert looks.looked_at[1] - looks.looked_at[0] == pytest.approx(QUERY_AFTER_S[0])
    assert len(looks.looked_at) == 2


async def test_while_it_grows_it_is_looked_at_again() -> None:
    growing = [{f"r{number}" for number in range(count)} for count in (0, 1, 5, 9)]
    looks = Looks(*growing)
    assert await settled(looks, lambda seen: seen) == growing[-1]
    assert len(looks.looked_at) == 5


async def test_a_look_that_is_known_to_be_partial_is_not_believed_though_it_repeats() -> None:
    looks = Looks({"r1"}, {"r1"}, {"r1"}, {"r1", "r2"})
    assert await settled(looks, lambda seen: seen if len(seen) > 1 else None) == {"r1", "r2"}


async def test_what_never_settles_ends_with_what_was_seen_last() -> None:
    looks = Looks(*({f"r{number}"} for number in range(100)))
    before = asyncio.get_running_loop().time()
    await settled(looks, lambda seen: seen)
    assert SETTLE_S - QUERY_AFTER_S[-1] <= asyncio.get_running_loop().time() - before <= SETTLE_S
