"""Which samples each optimizer step uses on this rank, and where in the data a run stands.

A step uses ``per_device_batch_size * accumulation * world`` consecutive samples of the epoch's
order, whatever they are split into: a run of eight processes, a run of one with eight-fold
accumulation and one with a batch eight times as big see the same samples at the same step.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fluxvla_core.data.order import EpisodeShards
from fluxvla_core.data.sampler import EpochSampler, SampleKey


@dataclass(frozen=True)
class Cursor:
    """``samples`` of the order of ``epoch`` have been used; both count from 0."""

    epoch: int = 0
    samples: int = 0


@dataclass(frozen=True)
class StepPlan:
    """How an epoch of ``length`` samples is cut into steps.

    Args:
        length: samples in the dataset.
        batch_size: samples per rank and micro-batch.
        accumulation: micro-batches per step.
        world: number of ranks.
        seed: of the order.
        shards: mix a few episodes at a time instead of all samples.
    """

    length: int
    batch_size: int
    accumulation: int
    world: int
    seed: int
    shards: EpisodeShards | None = None

    @property
    def step_samples(self) -> int:
        """Samples that all ranks together use in one step."""
        return self.batch_size * self.accumulation * self.world

    @property
    def steps_per_epoch(self) -> int:
        return self.steps_left(Cursor())

    def steps_left(self, cursor: Cursor) -> int:
        """Steps from ``cursor`` to the end of its epoch; the last one is filled up."""
        return -(-(self.length - cursor.samples) // self.step_samples)

    def after_step(self, cursor: Cursor) -> Cursor:
        """Where one step leads; past the last sample the next epoch begins."""
        samples = cursor.samples + self.step_samples
        if samples >= self.length:
            return Cursor(cursor.epoch + 1, 0)
        return Cursor(cursor.epoch, samples)


class StepSampler:
    """Yields micro-batches of sample keys for one rank, without end, from ``start`` on.

    It is what ``data.loader.make_loader`` takes as sampler. An epoch's last step is filled up
    with the first samples of the same epoch's order: every sample is used, and no rank waits.
    """

    def __init__(self, plan: StepPlan, rank: int, start: Cursor | None = None) -> None:
        self.plan, self.rank = plan, rank
        self.start = start or Cursor()
        # One rank's view of the whole order; cutting it up is done here, by position in samples,
        # so that a run can go on with another number of ranks.
        self._order = EpochSampler(plan.length, 1, seed=plan.seed, shards=plan.shards)

    def __iter__(self) -> Iterator[list[SampleKey]]:
        epoch, skip = self.start.epoch, self.start.samples
        while True:
            yield from self._epoch(epoch, skip)
            epoch, skip = epoch + 1, 0

    def _epoch(self, epoch: int, skip: int) -> Iterator[list[SampleKey]]:
        plan = self.plan
        order = self._order.order(epoch)
        steps = plan.steps_left(Cursor(epoch, skip))
        filled = np.resize(order, skip + steps * plan.step_samples)[skip:]
        cut = filled.reshape(steps * plan.accumulation, plan.world, plan.batch_size)
        for indices in cut[:, self.rank].tolist():
            yield [SampleKey(epoch, index) for index in indices]
