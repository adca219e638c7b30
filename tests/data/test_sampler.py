from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluxvla_core.data.sampler import EpochSampler, Position, SampleKey, order_rng, sample_rng
from fluxvla_core.errors import ConfigError

sizes = st.integers(1, 60)


def flat(batches):
    return [key for batch in batches for key in batch]


@given(length=sizes, batch=st.integers(1, 7), seed=st.integers(0, 2**40), epoch=st.integers(0, 9))
def test_every_sample_of_an_epoch_is_seen_and_only_the_filling_is_seen_twice(
    length, batch, seed, epoch
):
    sampler = EpochSampler(length, batch, seed=seed)
    seen = [key.index for key in flat(sampler.batches(epoch))]
    assert set(seen) == set(range(length))
    assert sorted(seen[:length]) == list(range(length))
    assert len(seen) == sampler.batches_per_epoch * batch


@given(length=sizes, batch=st.integers(1, 4), world=st.integers(1, 4), epoch=st.integers(0, 3))
def test_all_ranks_together_walk_the_order_of_one_process(length, batch, world, epoch):
    ranks = [
        [
            [k.index for k in b]
            for b in EpochSampler(length, batch, rank=r, world=world).batches(epoch)
        ]
        for r in range(world)
    ]
    together = [i for parts in zip(*ranks, strict=True) for part in parts for i in part]
    alone = [k.index for k in flat(EpochSampler(length, batch).batches(epoch))]
    assert together[:length] == alone[:length]


@given(length=sizes, batch=st.integers(1, 5), skip=st.integers(0, 40))
def test_a_position_resumes_at_the_very_next_batch(length, batch, skip):
    sampler = EpochSampler(length, batch)
    whole = list(islice(sampler, skip + 5))
    start = Position(*divmod(skip, sampler.batches_per_epoch))
    assert list(islice(EpochSampler(length, batch, start=start), 5)) == whole[skip:]


def test_position_at_the_end_of_an_epoch_is_the_beginning_of_the_next():
    sampler = EpochSampler(10, 4, start=Position(0, 3))
    assert sampler.batches_per_epoch == 3
    assert next(iter(sampler)) == next(sampler.batches(1))


def test_epochs_and_seeds_differ_and_repeat():
    sampler = EpochSampler(50, 50, seed=1)
    first, second = (list(sampler.order(e)) for e in (0, 1))
    assert first != second
    assert first != list(EpochSampler(50, 50, seed=2).order(0))
    assert first == list(EpochSampler(50, 50, seed=1).order(0))


def test_without_shuffling_the_order_is_the_datasets():
    sampler = EpochSampler(5, 2, shuffle=False)
    assert flat(sampler.batches(3)) == [SampleKey(3, i) for i in (0, 1, 2, 3, 4, 0)]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"length": 0, "batch_size": 2}, "the dataset holds no samples"),
        ({"length": 4, "batch_size": 0}, "batch size must be at least 1, got 0"),
        ({"length": 4, "batch_size": 2, "rank": 2, "world": 2}, "rank 2 is not among 2 processes"),
    ],
)
def test_impossible_samplers_are_refused(arguments, message):
    with pytest.raises(ConfigError, match=message):
        EpochSampler(**arguments)


def test_random_streams_are_apart_and_repeatable():
    draws = {
        (seed, epoch, index): tuple(sample_rng(seed, epoch, index).random(3))
        for seed in (0, 1)
        for epoch in (0, 1)
        for index in (0, 1)
    }
    assert len(set(draws.values())) == 8
    assert tuple(sample_rng(1, 0, 1).random(3)) == draws[1, 0, 1]
    assert not np.array_equal(order_rng(0, 0).random(3), sample_rng(0, 0, 0).random(3))


def test_the_order_is_pinned():
    # A changed order would silently break resuming from older checkpoints.
    assert EpochSampler(8, 8, seed=42).order(0).tolist() == [4, 7, 2, 1, 6, 3, 5, 0]
    assert sample_rng(42, 1, 7).integers(0, 1000, 3).tolist() == [680, 572, 135]
