"""The batches of a run: which samples each optimizer step uses on this rank, and moving them to
the device.

A step uses ``per_device_batch_size * accumulation * world`` consecutive samples of the epoch's
order, whatever they are split into: a run of eight processes, a run of one with eight-fold
accumulation and one with a batch eight times as big see the same samples at the same step.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from fluxvla_core.contracts.training import Dataset
from fluxvla_core.data.loader import DictCollator
from fluxvla_core.data.sampler import EpisodeShards, EpochSampler, SampleKey
from fluxvla_core.data.transforms.images import normalized
from fluxvla_core.data.transforms.pipeline import deferring
from fluxvla_core.errors import ConfigError

IDS = "sample_ids"


@dataclass(frozen=True)
class Cursor:
    """``samples`` of the order of ``epoch`` have been used; both count from 0."""

    epoch: int = 0
    samples: int = 0


@dataclass(frozen=True)
class StepPlan:
    """Cuts an epoch of ``length`` samples into steps.

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
    def shuffle_episodes(self) -> int | None:
        """Episodes that are mixed at a time; None where all samples are."""
        return self.shards.together if self.shards is not None else None

    def to_dict(self) -> dict[str, Any]:
        """Its part of ``trainer.json``, as JSON values."""
        return {
            "seed": self.seed,
            "n_train_examples": self.length,
            "step_samples": self.step_samples,
            "world_size": self.world,
            "shuffle_episodes": self.shuffle_episodes,
        }

    @property
    def steps_per_epoch(self) -> int:
        return self.steps_left(Cursor())

    def steps_left(self, cursor: Cursor) -> int:
        """Steps from ``cursor`` to the end of its epoch; the last one is filled up."""
        return -(-(self.length - cursor.samples) // self.step_samples)

    def total_steps(self, max_steps: int | None, max_epochs: int | None) -> int:
        """Steps of a whole run, which ends by either number."""
        return max_steps or self.steps_per_epoch * (max_epochs or 0)

    def run_steps_left(
        self, step: int, cursor: Cursor, max_steps: int | None, max_epochs: int | None
    ) -> int:
        """Steps to the end of a run that has done ``step`` of them and stands at ``cursor``."""
        if max_steps is not None:
            return max(0, max_steps - step)
        epochs = (max_epochs or 0) - cursor.epoch
        after = (epochs - 1) * self.steps_per_epoch
        return self.steps_left(cursor) + after if epochs > 0 else 0

    def after_step(self, cursor: Cursor) -> Cursor:
        """Where one step leads; past the last sample the next epoch begins."""
        samples = cursor.samples + self.step_samples
        if samples >= self.length:
            return Cursor(cursor.epoch + 1, 0)
        return Cursor(cursor.epoch, samples)


def episode_shards(dataset: Any, together: int | None, where: str | None) -> EpisodeShards | None:
    """Shards of ``dataset`` by ``shuffle_episodes``: ``together`` episodes at a time, or None.

    Raises:
        ConfigError: the dataset does not say where its episodes end.
    """
    if together is None:
        return None
    ends = Dataset.adapt(dataset).episode_ends
    if ends is None:
        raise ConfigError(
            f"{type(dataset).__name__} does not say where its episodes end, so "
            "shuffle_episodes cannot be used with it",
            where=where,
            next="--set train_dataloader.shuffle_episodes=None: all samples are then mixed",
        )
    return EpisodeShards(ends, together)


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


def on_device(device: torch.device) -> bool:
    """Whether images are normalised there: it saves three quarters of what is copied to a GPU."""
    return device.type == "cuda"


def loader_source(dataset: Any, collator: Any, device: torch.device) -> Any:
    """``dataset`` as the loader reads it: on a GPU, images are normalised there by ``to_device``.

    With a collator that is not ours everything is normalised in the workers: it may look at images.
    """
    stacks = type(collator).__call__ is DictCollator.__call__ and "images" in collator.keys
    found = deferring(dataset) if on_device(device) and stacks else None
    return dataset if found is None else found


def to_device(batch: Mapping[str, Any], device: torch.device) -> dict[str, Any]:
    """Tensors of a batch on ``device``; from pinned memory the copy overlaps with computing.

    Images are normalised there if :func:`loader_source` has left that to the device.
    """
    return normalized(
        {
            key: value.to(device, non_blocking=True) if isinstance(value, Tensor) else value
            for key, value in batch.items()
        }
    )
