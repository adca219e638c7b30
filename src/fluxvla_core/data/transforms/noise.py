"""Random draws for training: noise on states, flow matching, and prefixes of chunks."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.contracts.frame import Sample
from fluxvla_core.contracts.training import RandomTransform
from fluxvla_core.errors import ConfigError

Floats = npt.NDArray[np.float64]


class StateNoise(RandomTransform):
    """Add normal noise to ``states`` ``(D,)``, so that a policy does not rely on its past alone.

    Args:
        std: standard deviation, in the units that states have at this place of the list.
        state_key: multiply ``std`` by this entry's own standard deviations; for a place before
            the normalisation, where joints have different ranges.
    """

    training_only = True
    keeps_images = True

    def __init__(self, std: float, state_key: str | None = None) -> None:
        if std < 0:
            raise ConfigError(f"StateNoise: std must be at least 0, got {std}")
        self.std = std
        self.state_key = state_key

    def __call__(self, sample: Sample, rng: np.random.Generator) -> Sample:
        states = np.asarray(sample["states"])
        noise = self.std * rng.standard_normal(states.shape)
        if self.state_key is not None:
            noise *= np.asarray(sample["stats"][self.state_key]["std"])
        return {**sample, "states": (states + noise).astype(states.dtype)}


class SampleFlowNoise(RandomTransform):
    """Add the noise and times of flow matching: ``noise`` ``(K, T, D)``, ``time`` ``(K,)``.

    Time runs from 0 (noise) to 1 (data) and stays below 1, where the velocity is singular. T and
    D are those of ``actions`` at this place, so it belongs after the padding.

    Args:
        repeats: K, draws for each sample.
        distribution: ``beta``: 1 - t = 0.001 + 0.999 u with u from Beta(alpha, beta), which with
            (1.5, 1) prefers noisy times (Black et al., "pi0", 2024); ``uniform``; or
            ``logit_normal``: sigmoid of a normal with ``mean`` and ``std`` (Esser et al., 2024).
    """

    training_only = True
    keeps_images = True

    def __init__(
        self,
        repeats: int = 1,
        distribution: str = "beta",
        alpha: float = 1.5,
        beta: float = 1.0,
        mean: float = 0.0,
        std: float = 1.0,
    ) -> None:
        if repeats < 1:
            raise ConfigError(f"SampleFlowNoise: repeats must be at least 1, got {repeats}")
        if distribution not in _DRAWS:
            raise ConfigError(
                f"SampleFlowNoise: distribution {distribution!r} is not one of {', '.join(_DRAWS)}"
            )
        if min(alpha, beta, std) <= 0:
            raise ConfigError("SampleFlowNoise: alpha, beta and std must be positive")
        self.repeats = repeats
        self.distribution = distribution
        self.alpha = alpha
        self.beta = beta
        self.mean = mean
        self.std = std

    def __call__(self, sample: Sample, rng: np.random.Generator) -> Sample:
        shape = (self.repeats, *np.shape(sample["actions"]))
        noise = rng.standard_normal(shape, dtype=np.float32)
        unit = _DRAWS[self.distribution](self, rng)
        return {**sample, "noise": noise, "time": (0.999 * unit).astype(np.float32)}

    def _beta(self, rng: np.random.Generator) -> Floats:
        return 1 - rng.beta(self.alpha, self.beta, self.repeats)

    def _uniform(self, rng: np.random.Generator) -> Floats:
        return rng.random(self.repeats)

    def _logit_normal(self, rng: np.random.Generator) -> Floats:
        return 1 / (1 + np.exp(-rng.normal(self.mean, self.std, self.repeats)))


_DRAWS = {
    "beta": SampleFlowNoise._beta,
    "uniform": SampleFlowNoise._uniform,
    "logit_normal": SampleFlowNoise._logit_normal,
}


PREFIX_DISTRIBUTIONS = ("uniform", "exponential")


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
        if distribution not in PREFIX_DISTRIBUTIONS:
            raise ConfigError(
                f"SamplePrefixLength: distribution {distribution!r} is not one of "
                f"{', '.join(PREFIX_DISTRIBUTIONS)}"
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
