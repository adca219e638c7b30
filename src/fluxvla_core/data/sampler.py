"""Which samples make up which batch: a function of (seed, epoch), whoever asks.

One permutation per epoch is cut into global batches of ``batch_size * world`` samples, and rank
``r`` takes the ``r``-th part of each. The stream of samples is therefore the same for every world
size, and a run resumes at a position instead of replaying what it has seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.order import EpisodeShards, epoch_order
from fluxvla_core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class SampleKey:
    """What a data worker is asked for."""

    epoch: int
    index: int


class Position(NamedTuple):
    """The next batch of this rank: ``batch`` batches of ``epoch`` have been used already."""

    epoch: int
    batch: int


class EpochSampler:
    """Yields batches of :class:`SampleKey` for one rank, epoch after epoch, without end.

    Args:
        length: number of samples in the dataset.
        batch_size: samples per rank and batch.
        seed: with the epoch, all that the order depends on.
        rank, world: this process and how many there are.
        shuffle: False keeps the dataset's own order in every epoch.
        drop_last: drop an epoch's incomplete last global batch. By default it is filled up with
            the first samples of the same epoch's order, so that every sample is seen, every rank
            has equally many full batches, and no rank waits for another.
        start: the first position that is yielded; the beginning of epoch 0 by default.
        shards: mix a few episodes at a time instead of all samples.

    Raises:
        ConfigError: the dataset is empty, or too small for one batch under ``drop_last``.
    """

    def __init__(
        self,
        length: int,
        batch_size: int,
        seed: int = 42,
        rank: int = 0,
        world: int = 1,
        shuffle: bool = True,
        drop_last: bool = False,
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
        self.drop_last = drop_last
        self.start = start or Position(0, 0)
        self.shards = shards
        if self.batches_per_epoch == 0:
            raise ConfigError(
                f"{length} samples do not fill one global batch of {self.global_batch}",
                next="lower per_device_batch_size, use fewer processes, or set drop_last=False",
            )

    @property
    def global_batch(self) -> int:
        """Samples in one batch of all ranks together."""
        return self.batch_size * self.world

    @property
    def batches_per_epoch(self) -> int:
        full, rest = divmod(self.length, self.global_batch)
        return full if self.drop_last or rest == 0 else full + 1

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

    def advance(self, position: Position, batches: int) -> Position:
        """The position ``batches`` batches after ``position``."""
        done = position.epoch * self.batches_per_epoch + position.batch + batches
        return Position(*divmod(done, self.batches_per_epoch))

    def seek(self, position: Position) -> None:
        """Let the next iteration begin at ``position``."""
        self.start = self.advance(position, 0)

    def __iter__(self) -> Iterator[list[SampleKey]]:
        epoch, batch = self.start
        while True:
            yield from self.batches(epoch, batch)
            epoch, batch = epoch + 1, 0
