"""Every state of small worlds around the lease: nobody moves a robot who may not, and who wants the lease gets it."""

import contextlib
from collections import Counter

import pytest

from tests.search.bounds import QUICK
from tests.search.intent import search_intent
from tests.search.moves import Bounds
from tests.search.mutants import MUTANTS, Broken, caught_by
from tests.search.search import STEPS, search
from zbridge.hq.intent import Intent


@pytest.mark.parametrize("bounds", QUICK, ids=lambda bounds: bounds.name)
def test_every_state_of_a_bounded_world_keeps_the_rules_and_leads_to_a_lease(bounds: Bounds) -> None:
    found = search(bounds)
    assert found.complete
    assert found.states > 1000
    assert 0 < found.longest <= STEPS


def test_every_state_of_the_intent_of_a_program_keeps_the_rules_and_each_cell_is_reached() -> None:
    found = search_intent()
    every = {("Intent", state.value, said.value) for state, row in Intent.TABLE.items() for said in row}
    assert every == set(Counter(found.cells))


@pytest.mark.parametrize("broken", MUTANTS, ids=lambda broken: broken[0])
def test_a_broken_variant_is_caught(broken: Broken) -> None:
    assert caught_by(broken[1]) is not None


def test_the_same_search_finds_nothing_in_the_real_machines() -> None:
    assert caught_by(contextlib.nullcontext) is None
