"""The order of samples over epochs, steps and ranks, and their random streams."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fluxvla_core.data.sampler import (
    Cursor,
    SampleKey,
    StepPlan,
    StepSampler,
    order_rng,
    sample_rng,
)
from fluxvla_core.errors import ConfigError

sizes = st.integers(1, 60)


def flat(batches):
    return [key for batch in batches for key in batch]


@given(length=sizes, batch=st.integers(1, 7), seed=st.integers(0, 2**40), epoch=st.integers(0, 9))
def test_every_sample_of_an_epoch_is_seen_and_only_the_filling_is_seen_twice(
    length, batch, seed, epoch
):
    plan = StepPlan(length, batch, seed=seed)
    seen = [key.index for key in flat(StepSampler(plan).epoch(epoch))]
    assert set(seen) == set(range(length))
    assert sorted(seen[:length]) == list(range(length))
    assert len(seen) == plan.steps_per_epoch * batch


@given(length=sizes, batch=st.integers(1, 4), world=st.integers(1, 4), epoch=st.integers(0, 3))
def test_all_ranks_together_walk_the_order_of_one_process(length, batch, world, epoch):
    plan = StepPlan(length, batch, world=world)
    ranks = [
        [[k.index for k in b] for b in StepSampler(plan, rank).epoch(epoch)]
        for rank in range(world)
    ]
    together = [i for parts in zip(*ranks, strict=True) for part in parts for i in part]
    alone = [k.index for k in flat(StepSampler(StepPlan(length, batch)).epoch(epoch))]
    assert together[:length] == alone[:length]


@given(length=sizes, batch=st.integers(1, 5), skip=st.integers(0, 40))
def test_a_position_resumes_at_the_very_next_batch(length, batch, skip):
    plan = StepPlan(length, batch)
    whole = list(islice(StepSampler(plan), skip + 5))
    epoch, done = divmod(skip, plan.steps_per_epoch)
    start = Cursor(epoch, done * batch)
    assert list(islice(StepSampler(plan, 0, start), 5)) == whole[skip:]


def test_epochs_and_seeds_differ_and_repeat():
    first, second = (StepPlan(50, 50, seed=1).order(e).tolist() for e in (0, 1))
    assert first != second
    assert first != StepPlan(50, 50, seed=2).order(0).tolist()
    assert first == StepPlan(50, 50, seed=1).order(0).tolist()


def test_without_shuffling_the_order_is_the_datasets():
    plan = StepPlan(5, 2, shuffle=False)
    assert flat(StepSampler(plan).epoch(3)) == [SampleKey(3, i) for i in (0, 1, 2, 3, 4, 0)]


def test_an_empty_dataset_is_refused():
    with pytest.raises(ConfigError, match="the dataset holds no samples"):
        StepSampler(StepPlan(0, 2))


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
    assert StepPlan(8, 8, seed=42).order(0).tolist() == [4, 7, 2, 1, 6, 3, 5, 0]
    assert sample_rng(42, 1, 7).integers(0, 1000, 3).tolist() == [680, 572, 135]


def plan(batch=2, accumulation=1, world=1, length=10):
    return StepPlan(length, batch, accumulation, world, seed=42)


def steps(plan, count, start=None):
    """The samples of each step, joined over batches and ranks."""
    ranks = [iter(StepSampler(plan, rank, start)) for rank in range(plan.world)]
    found = []
    for _ in range(count):
        rows = [next(rank) for _ in range(plan.accumulation) for rank in ranks]
        found.append([(key.epoch, key.index) for row in rows for key in row])
    return found


@pytest.mark.parametrize(
    "split", [plan(8), plan(4, 2), plan(2, 4), plan(4, 1, 2), plan(2, 2, 2), plan(1, 2, 4)]
)
def test_a_step_has_the_same_samples_however_it_is_split(split):
    whole = steps(plan(8, length=21), 6)
    same = StepPlan(21, split.batch_size, split.accumulation, split.world, 42)
    assert steps(same, 6) == whole


def test_every_sample_is_used_in_every_epoch_and_epochs_differ():
    """D2 of upstream's bugs: every epoch had the same order."""
    first, second = steps(plan(5), 4)[:2], steps(plan(5), 4)[2:]
    for epoch in (first, second):
        assert sorted(index for step in epoch for _, index in step) == list(range(10))
    assert [i for s in first for _, i in s] != [i for s in second for _, i in s]


def test_the_last_step_of_an_epoch_is_filled_up_from_its_own_order():
    (a, b, c) = steps(plan(4), 3)
    assert c[2:] == a[:2]
    assert {epoch for epoch, _ in a + b + c} == {0}


def test_a_dataset_smaller_than_a_step():
    small = plan(8, length=3)
    assert small.steps_per_epoch == 1
    assert [len(step) for step in steps(small, 2)] == [8, 8]
    assert [{epoch for epoch, _ in step} for step in steps(small, 2)] == [{0}, {1}]


@pytest.mark.parametrize("done", range(9))
def test_going_on_gives_what_would_have_come(done):
    """T7 of upstream's bugs: resuming began again at index 0."""
    whole = plan(4)
    cursor = Cursor()
    for _ in range(done):
        cursor = whole.after_step(cursor)
    assert steps(whole, 3, cursor) == steps(whole, done + 3)[done:]


def test_another_number_of_processes_goes_on_at_the_same_sample():
    two = plan(2, world=2, length=20)
    cursor = two.after_step(two.after_step(Cursor()))
    assert cursor == Cursor(0, 8)
    three = plan(2, world=3, length=20)
    flat = [s for step in steps(plan(1, length=20), 20) for s in step]
    assert three.steps_left(cursor) == 2
    after = [s for step in steps(three, 2, cursor) for s in step]
    assert after == flat[8:]


def test_cursor_at_the_end_of_an_epoch():
    assert plan(4).after_step(Cursor(1, 8)) == Cursor(2, 0)
    assert plan(5).after_step(Cursor(0, 5)) == Cursor(1, 0)
    assert plan(4).steps_per_epoch == 3
    assert plan(4).step_samples == 4
