"""The order in which an epoch shows a dataset's samples: a function of (seed, epoch)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fluxvla_core.data.rng import order_rng
from fluxvla_core.errors import ConfigError

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class EpisodeShards:
    """Mix the samples of a few episodes at a time, so that few files are read from at once.

    A dataset of many large videos is then read from the page cache and from open decoders.
    Which episodes come together is drawn anew in every epoch.

    Args:
        ends: ``(E,)`` for each episode the index after its last sample, ascending; an episode
            begins where the one before it ends.
        together: how many episodes are mixed.

    Raises:
        ConfigError: ``together`` is below 2, which would be hardly mixed at all.
    """

    ends: Ints
    together: int

    def __post_init__(self) -> None:
        if self.together < 2:
            raise ConfigError(f"shuffle_episodes must be at least 2, got {self.together}")


def epoch_order(length: int, seed: int, epoch: int, shards: EpisodeShards | None = None) -> Ints:
    """``(length,)`` every index once; all samples mixed, or only those of a shard of episodes."""
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
