"""Shuffling, batches per rank, and random number generators: functions of (seed, epoch, index).

One permutation per epoch is cut into global batches of ``batch_size * world`` samples, and rank
``r`` takes the ``r``-th part of each. The stream of samples is therefore the same for every world
size, and a run resumes at a position instead of replaying what it has seen.

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
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.random.mtrand import get_bit_generator, set_bit_generator

from fluxvla_core.errors import ConfigError

Ints = npt.NDArray[np.int64]
DEFAULT_SEED = 42
"""The seed of datasets that set none, where no run gives them its own."""
_SPARE = np.random.MT19937()
"""The bit generator of ``numpy.random`` while a batch is made."""
_SAMPLE, _ORDER, _MIXTURE, _BATCH = 1, 2, 3, 4


@dataclass(frozen=True, slots=True)
class SampleKey:
    """One sample of one epoch: what a data worker is asked for."""

    epoch: int
    index: int


class Position(NamedTuple):
    """Where this rank continues: ``batch`` batches of ``epoch`` have been used already."""

    epoch: int
    batch: int


class EpochSampler:
    """Yields batches of :class:`SampleKey` for one rank, epoch after epoch, without end.

    An epoch's incomplete last global batch is filled up with the first samples of the same epoch's
    order, so that every sample is seen, every rank has equally many full batches, and no rank waits
    for another.

    Args:
        length: number of samples in the dataset.
        batch_size: samples per rank and batch.
        seed: with the epoch, all that the order depends on.
        rank, world: this process and how many there are.
        shuffle: False keeps the dataset's own order in every epoch.
        start: the first position that is yielded; the beginning of epoch 0 by default.
        shards: mix a few episodes at a time instead of all samples.

    Raises:
        ConfigError: the dataset or a batch is empty.
    """

    def __init__(
        self,
        length: int,
        batch_size: int,
        seed: int = DEFAULT_SEED,
        rank: int = 0,
        world: int = 1,
        shuffle: bool = True,
        start: Position | None = None,
        shards: EpisodeShards | None = None,
    ) -> None:
        if length < 1:
            raise ConfigError("the dataset holds no samples")
        if batch_size < 1:
            raise ConfigError(f"batch size must be at least 1, got {batch_size}")
        if not 0 <= rank < world:
            raise ConfigError(f"rank {rank} is not among {world} processes")
        self.length = length
        self.batch_size = batch_size
        self.seed = seed
        self.rank = rank
        self.world = world
        self.shuffle = shuffle
        self.start = start or Position(0, 0)
        self.shards = shards

    @property
    def global_batch(self) -> int:
        """Samples in one batch of all ranks together."""
        return self.batch_size * self.world

    @property
    def batches_per_epoch(self) -> int:
        return -(-self.length // self.global_batch)

    def order(self, epoch: int) -> npt.NDArray[np.int64]:
        """Indices of the whole epoch over all ranks: ``(batches_per_epoch * global_batch,)``."""
        if self.shuffle:
            order = epoch_order(self.length, self.seed, epoch, self.shards)
        else:
            order = np.arange(self.length)
        return np.resize(order, self.batches_per_epoch * self.global_batch).astype(np.int64)

    def batches(self, epoch: int, start: int = 0) -> Iterator[list[SampleKey]]:
        """This rank's batches of one epoch, from the ``start``-th on."""
        cut = self.order(epoch).reshape(self.batches_per_epoch, self.world, self.batch_size)
        for indices in cut[start:, self.rank].tolist():
            yield [SampleKey(epoch, index) for index in indices]

    def __iter__(self) -> Iterator[list[SampleKey]]:
        epoch, batch = self.start
        while True:
            yield from self.batches(epoch, batch)
            epoch, batch = epoch + 1, 0


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
