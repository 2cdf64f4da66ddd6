"""The corpora, replayed: inputs that reach what no golden frame reaches, and all that was ever a finding."""

import random
import warnings

import pytest

from tests.fuzz.engine import HANG_S, mutated, run_blind, within
from tests.fuzz.registry import TARGETS
from tests.fuzz.target import CORPUS, Target, cut

each_target = pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
MOST_BYTES = 300_000


@each_target
def test_what_was_found_before_is_read_or_refused_as_documented(target: Target) -> None:
    with warnings.catch_warnings(), within(60.0):
        warnings.simplefilter("error")
        for data in [data for _, data in target.corpus()] + list(target.seeds()):
            target.run(data)


@each_target
def test_a_few_bent_inputs_are_read_or_refused_as_documented(target: Target) -> None:
    tally = run_blind(target, HANG_S, seed=1, most_bytes=1)
    assert (tally.inputs, tally.findings) == (64, 0)


def test_corpora_are_small_and_of_known_targets() -> None:
    folders = {path.name for path in CORPUS.iterdir()}
    assert folders <= set(TARGETS)
    assert sum(path.stat().st_size for path in CORPUS.rglob("*") if path.is_file()) < MOST_BYTES


def test_the_same_seed_bends_the_same_inputs() -> None:
    pool = [b"0123456789", b"abc"]
    runs = [[mutated(pool, random.Random(7), 100) for _ in range(5)] for _ in range(2)]
    assert runs[0] == runs[1]
    assert max(map(len, runs[0])) <= 100


def test_a_stream_is_cut_into_all_its_bytes() -> None:
    data = bytes(range(256)) * 9
    for seed in range(20):
        assert b"".join(cut(data, seed)) == data
