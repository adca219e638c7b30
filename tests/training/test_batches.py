"""Which samples a step uses, however many processes and batches it is split into."""

from __future__ import annotations

from itertools import islice

import pytest

from fluxvla_core.data.sampler import EpochSampler
from fluxvla_core.training.batches import Cursor, StepPlan, StepSampler


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


def test_the_order_is_the_samplers():
    mine = [[k.index for k in keys] for keys in islice(StepSampler(plan(), 0), 10)]
    theirs = [[k.index for k in keys] for keys in islice(EpochSampler(10, 2, seed=42), 10)]
    assert mine == theirs


@pytest.mark.parametrize(
    "split", [plan(8), plan(4, 2), plan(2, 4), plan(4, 1, 2), plan(2, 2, 2), plan(1, 2, 4)]
)
def test_a_step_has_the_same_samples_however_it_is_split(split):
    whole = steps(plan(8, length=21), 6)
    same = StepPlan(21, split.batch_size, split.accumulation, split.world, 42)
    assert steps(same, 6) == whole


def test_every_sample_is_used_in_every_epoch_and_epochs_differ():
    """D2 of the field notes: every epoch had the same order."""
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
    """T7 of the field notes: resuming began again at index 0."""
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
