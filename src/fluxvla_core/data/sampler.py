"""The order of samples, and random number generators: functions of (seed, epoch, index).

An optimizer step uses ``batch_size * accumulation * world`` consecutive samples of the epoch's
order, whatever they are split into: a run of eight processes, a run of one with eight-fold
accumulation and one with a batch eight times as big see the same samples at the same step. A run
resumes at a position in samples instead of replaying what it has seen.

A sample's noise follows from (seed, epoch, index) and an epoch's order from (seed, epoch), so
neither the number of ranks, nor the number of workers, nor a restart changes either. Philox is a
counter-based generator: the counter's high words say what the numbers are for, which keeps the
streams of two samples apart for 2^64 draws each.
Source: Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
"""

from __future__ import annotations

import hashlib
import random
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.random.mtrand import get_bit_generator, set_bit_generator

from fluxvla_core.contracts.training import Dataset
from fluxvla_core.errors import ConfigError

Ints = npt.NDArray[np.int64]
DEFAULT_SEED = 42
"""The seed of datasets that set none, where no run gives them its own."""
_SPARE = np.random.MT19937()
"""The bit generator of ``numpy.random`` while a batch is made."""
_SAMPLE, _ORDER, _MIXTURE, _BATCH = 1, 2, 3, 4


@dataclass(frozen=True, slots=True)
class SampleKey:
    """One sample of one epoch, as a data worker is given it."""

    epoch: int
    index: int


@dataclass(frozen=True, eq=False)
class EpisodeShards:
    """Shuffle within a few episodes at a time, so that few files are read from at once.

    A dataset of many large videos is then read from the page cache and from open decoders.
    Which episodes come together is drawn again in every epoch.

    Args:
        ends: ``(E,)`` for each episode the index after its last sample, ascending; an episode
            begins where the one before it ends.
        together: how many episodes are shuffled together.

    Raises:
        ConfigError: ``together`` is below 2, which would hardly shuffle.
    """

    ends: Ints
    together: int

    def __post_init__(self) -> None:
        if self.together < 2:
            raise ConfigError(f"shuffle_episodes must be at least 2, got {self.together}")


def epoch_order(length: int, seed: int, epoch: int, shards: EpisodeShards | None = None) -> Ints:
    """Shuffle an epoch: ``(length,)`` every index once, over all samples or within shards."""
    rng = order_rng(seed, epoch)
    if shards is None:
        return rng.permutation(length)
    starts = np.concatenate([[0], shards.ends[:-1]])
    episodes = rng.permutation(len(shards.ends))
    parts: list[Ints] = []
    for first in range(0, len(episodes), shards.together):
        chosen = episodes[first : first + shards.together]
        samples = np.concatenate([np.arange(starts[e], shards.ends[e]) for e in chosen])
        parts.append(rng.permutation(samples))
    return np.concatenate(parts)


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
        seed: with the epoch, all that the order depends on.
        shards: mix a few episodes at a time instead of all samples.
        shuffle: False keeps the dataset's own order in every epoch.
    """

    length: int
    batch_size: int
    accumulation: int = 1
    world: int = 1
    seed: int = DEFAULT_SEED
    shards: EpisodeShards | None = None
    shuffle: bool = True

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

    def order(self, epoch: int) -> Ints:
        """``(length,)`` indices of all samples, in the order of ``epoch``."""
        if not self.shuffle:
            return np.arange(self.length)
        return epoch_order(self.length, self.seed, epoch, self.shards)

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
    """Yields micro-batches of sample keys for one rank, epoch after epoch, from ``start`` on.

    An epoch's last step is filled up with the first samples of the same epoch's order: every sample
    is used, every rank has equally many full batches, and none waits for another.

    Raises:
        ConfigError: the dataset is empty.
    """

    def __init__(self, plan: StepPlan, rank: int = 0, start: Cursor | None = None) -> None:
        if plan.length < 1:
            raise ConfigError("the dataset holds no samples")
        self.plan, self.rank, self.start = plan, rank, start or Cursor()

    def __iter__(self) -> Iterator[list[SampleKey]]:
        epoch, skip = self.start.epoch, self.start.samples
        while True:
            yield from self.epoch(epoch, skip)
            epoch, skip = epoch + 1, 0

    def epoch(self, epoch: int, skip: int = 0) -> Iterator[list[SampleKey]]:
        """The micro-batches of one epoch, without its first ``skip`` samples over all ranks."""
        plan = self.plan
        steps = plan.steps_left(Cursor(epoch, skip))
        filled = np.resize(plan.order(epoch), skip + steps * plan.step_samples)[skip:]
        cut = filled.reshape(steps * plan.accumulation, plan.world, plan.batch_size)
        for indices in cut[:, self.rank].tolist():
            yield [SampleKey(epoch, index) for index in indices]


def sample_rng(seed: int, epoch: int, index: int) -> np.random.Generator:
    """The generator of sample ``index`` in ``epoch``."""
    return _generator(seed, _SAMPLE, epoch, index)


def order_rng(seed: int, epoch: int) -> np.random.Generator:
    """The generator that shuffles ``epoch``."""
    return _generator(seed, _ORDER, epoch, 0)


def mixture_rng(seed: int, dataset: int, turn: int) -> np.random.Generator:
    """The generator that orders the ``turn``-th round through a mixture's ``dataset``."""
    return _generator(seed, _MIXTURE, turn, dataset)


@contextmanager
def global_generators(seed: int, epoch: int, index: int) -> Iterator[None]:
    """Seed Python's, numpy's and torch's global generators for the batch that starts at ``index``.

    Afterwards they have their old state, without the second of a pair of normal numbers that numpy
    may have kept: see :func:`drop_kept_normal`. GPUs' are left alone: batches are made on CPUs.
    """
    import torch

    # A Philox of its own would take longer than seeding all three.
    key = struct.pack("<4Q", seed, _BATCH, epoch, index)
    word = int.from_bytes(hashlib.blake2b(key, digest_size=8).digest(), "little")
    before = random.getstate(), get_bit_generator(), torch.get_rng_state()
    random.seed(word)
    # Exchanged, because numpy takes four times as long as all the rest to read and set a state.
    set_bit_generator(_SPARE)
    np.random.seed(word % 2**32)
    torch.default_generator.manual_seed(word)
    try:
        yield
    finally:
        random.setstate(before[0])
        set_bit_generator(before[1])
        torch.set_rng_state(before[2])


def drop_kept_normal() -> None:
    """Let numpy's global generator drop the second of a pair of normal numbers that it keeps.

    Making a batch does so, too. The training process calls this for each batch that a worker made:
    what a model draws then does not depend on the number of workers.
    """
    set_bit_generator(get_bit_generator())


def _generator(seed: int, purpose: int, epoch: int, index: int) -> np.random.Generator:
    key = np.array([seed, purpose], dtype=np.uint64)
    counter = np.array([0, 0, index, epoch], dtype=np.uint64)
    return np.random.Generator(np.random.Philox(key=key, counter=counter))
