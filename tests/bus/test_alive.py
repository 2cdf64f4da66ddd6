from __future__ import annotations

import asyncio

import pytest

from zbridge.bus.zenoh.alive import AliveWatches, Changed

TOKENS = "fleet/*/@alive/gateway"
R1, R2 = "fleet/r1/@alive/gateway", "fleet/r2/@alive/gateway"


class Declarations:
    def __init__(self) -> None:
        self.open: dict[str, Changed] = {}
        self.made = 0

    def declare(self, key_expr: str, changed: Changed) -> Declaration:
        self.made += 1
        self.open[key_expr] = changed
        return Declaration(self, key_expr)


class Declaration:
    def __init__(self, declarations: Declarations, key_expr: str) -> None:
        self._declarations, self._key_expr = declarations, key_expr

    def close(self) -> None:
        del self._declarations.open[self._key_expr]


@pytest.fixture
def declarations() -> Declarations:
    return Declarations()


@pytest.fixture
async def watches(declarations: Declarations) -> AliveWatches:
    return AliveWatches(asyncio.get_running_loop(), declarations.declare)


async def test_all_who_watch_the_same_tokens_share_a_declaration_until_the_last_one_goes(watches, declarations) -> None:
    seen: list[tuple[str, str, bool]] = []
    handles = [watches.add(TOKENS, lambda key, alive, who=who: seen.append((who, key, alive))) for who in "ab"]
    declarations.open[TOKENS](R1, True)
    assert seen == [("a", R1, True), ("b", R1, True)]
    handles[0].close()
    handles[0].close()
    declarations.open[TOKENS](R1, False)
    assert seen[2:] == [("b", R1, False)]
    handles[1].close()
    assert (declarations.made, declarations.open) == (1, {})
    watches.add(TOKENS, print)
    assert declarations.made == 2


async def test_a_late_watcher_is_told_what_is_there_and_of_each_change_once(watches, declarations) -> None:
    watches.add(TOKENS, lambda key, alive: None)
    changed = declarations.open[TOKENS]
    changed(R1, True)
    changed(R2, True)
    seen: list[tuple[str, bool]] = []
    watches.add(TOKENS, lambda key, alive: seen.append((key, alive)))
    changed(R2, False)
    changed(R1, True)
    await asyncio.sleep(0)
    assert seen == [(R2, False), (R1, True)]
    watches.add(TOKENS, lambda key, alive: seen.append((key, alive)))
    await asyncio.sleep(0)
    assert seen[2:] == [(R1, True)]


async def test_a_watcher_that_fails_costs_the_others_nothing(watches, declarations, caplog) -> None:
    seen: list[str] = []
    watches.add(TOKENS, lambda key, alive: 1 / 0)
    watches.add(TOKENS, lambda key, alive: seen.append(key))
    declarations.open[TOKENS](R1, True)
    assert seen == [R1]
    assert "a handler failed" in caplog.text
