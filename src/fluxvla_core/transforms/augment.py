"""Random transforms of training: each draws from the sample's own generator and nothing else."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from fluxvla_core.errors import ConfigError
from fluxvla_core.transforms.images import split

Sample = dict[str, Any]


class RandomShiftImages:
    """Moves each camera's picture by up to ``pixels`` in both directions; borders are repeated.

    Source: Kostrikov et al., "Image augmentation is all you need", 2020.
    """

    needs_rng = True
    training_only = True

    def __init__(self, pixels: int) -> None:
        if pixels < 0:
            raise ConfigError(f"RandomShiftImages: pixels must be at least 0, got {pixels}")
        self.pixels = pixels

    def __call__(self, sample: Sample, rng: np.random.Generator) -> Sample:
        images = sample["images"]
        shifted = [self._shift(image, rng) for image in split(images)]
        whole = shifted if isinstance(images, list) else np.concatenate(shifted)
        return {**sample, "images": whole}

    def _shift(self, image: npt.NDArray[Any], rng: np.random.Generator) -> npt.NDArray[Any]:
        down, right = rng.integers(-self.pixels, self.pixels + 1, size=2)
        rows = np.clip(np.arange(image.shape[1]) + down, 0, image.shape[1] - 1)
        columns = np.clip(np.arange(image.shape[2]) + right, 0, image.shape[2] - 1)
        return image[:, rows[:, None], columns]


class StateNoise:
    """Adds normal noise to ``states`` ``(D,)``: a policy must not trust its own past blindly.

    Args:
        std: standard deviation, in the units that states have at this place of the list.
        state_key: multiply ``std`` by this entry's own standard deviations; for a place before
            the normalisation, where joints have different ranges.
    """

    needs_rng = True
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


class SampleFlowNoise:
    """Adds the noise and times of flow matching: ``noise`` ``(K, T, D)``, ``time`` ``(K,)``.

    Time runs from 0 (noise) to 1 (data) and stays below 1, where the velocity is singular. T and
    D are those of ``actions`` at this place, so it belongs after the padding.

    Args:
        repeats: K, draws for each sample.
        distribution: ``beta``: 1 - t = 0.001 + 0.999 u with u from Beta(alpha, beta), which with
            (1.5, 1) prefers noisy times (Black et al., "pi0", 2024); ``uniform``; or
            ``logit_normal``: sigmoid of a normal with ``mean`` and ``std`` (Esser et al., 2024).
    """

    needs_rng = True
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
                f"SampleFlowNoise: distribution {distribution!r} is none of {', '.join(_DRAWS)}"
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

    def _beta(self, rng: np.random.Generator) -> npt.NDArray[np.float64]:
        return 1 - rng.beta(self.alpha, self.beta, self.repeats)

    def _uniform(self, rng: np.random.Generator) -> npt.NDArray[np.float64]:
        return rng.random(self.repeats)

    def _logit_normal(self, rng: np.random.Generator) -> npt.NDArray[np.float64]:
        return 1 / (1 + np.exp(-rng.normal(self.mean, self.std, self.repeats)))


_DRAWS = {
    "beta": SampleFlowNoise._beta,
    "uniform": SampleFlowNoise._uniform,
    "logit_normal": SampleFlowNoise._logit_normal,
}
