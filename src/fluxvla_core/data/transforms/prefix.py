"""``SamplePrefixLength``: how much of a chunk is known already, for real-time chunking."""

from __future__ import annotations

from typing import Any

import numpy as np

from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.training import RandomTransform
from fluxvla_core.errors import ConfigError

DISTRIBUTIONS = ("uniform", "exponential")


class SamplePrefixLength(RandomTransform):
    """Add ``prefix_len`` int64: as many actions as a robot executes while a policy computes.

    The shape is that of ``time`` of ``SampleFlowNoise``, ``(K,)``, behind which it belongs. Models
    that are conditioned on a prefix (Black et al. 2025, arXiv 2512.05964) hold so many actions of
    the chunk without noise.

    Args:
        max_delay: lengths are 0 to ``max_delay``, shorter than a chunk.
        distribution: ``uniform``, or ``exponential``: a length is ``exp(1)`` times as likely as
            the next longer one.

    Raises:
        ConfigError: there is no ``time`` yet, or chunks are not longer.
    """

    training_only = True
    keeps_images = True

    def __init__(self, max_delay: int, distribution: str = "uniform") -> None:
        if max_delay < 1:
            raise ConfigError(f"SamplePrefixLength: max_delay must be at least 1, got {max_delay}")
        if distribution not in DISTRIBUTIONS:
            raise ConfigError(
                f"SamplePrefixLength: distribution {distribution!r} is not one of "
                f"{', '.join(DISTRIBUTIONS)}"
            )
        self.max_delay = max_delay
        lengths = np.arange(max_delay + 1)
        weights = np.ones(max_delay + 1) if distribution == "uniform" else np.exp(-lengths)
        self._shares = weights / weights.sum()

    def __call__(self, sample: Sample, rng: np.random.Generator) -> Sample:
        time: Any = sample.get("time")
        if time is None:
            raise ConfigError(
                "SamplePrefixLength: the sample has no 'time'",
                next="put it behind SampleFlowNoise",
            )
        horizon = np.shape(sample["actions"])[0]
        if self.max_delay >= horizon:
            raise ConfigError(
                f"SamplePrefixLength: max_delay {self.max_delay} leaves nothing to predict of "
                f"chunks of {horizon} actions"
            )
        drawn = rng.choice(self.max_delay + 1, size=np.shape(time), p=self._shares)
        return {**sample, "prefix_len": drawn.astype(np.int64)}
