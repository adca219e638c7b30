"""Transforms that draw what models of this package need to be trained, with each sample."""

from __future__ import annotations

from typing import Any

import numpy as np

from fluxvla_core.errors import ConfigError
from fluxvla_core.training import RandomTransform

Sample = dict[str, Any]


class SampleLatentNoise(RandomTransform):
    """Add ``latent_noise`` ``(dim,)`` float32, standard normal: ACT's latent is made of it.

    Args:
        dim: the model's ``latent_dim``.
    """

    training_only = True
    keeps_images = True

    def __init__(self, dim: int = 32) -> None:
        if dim < 1:
            raise ConfigError(f"SampleLatentNoise: dim must be at least 1, got {dim}")
        self.dim = dim

    def __call__(self, sample: Sample, rng: np.random.Generator) -> Sample:
        return {**sample, "latent_noise": rng.standard_normal(self.dim, dtype=np.float32)}


class SampleDiffusionNoise(RandomTransform):
    """Add what Diffusion Policy is trained with.

    ``noise`` ``(K, T, D)`` float32 standard normal; ``timesteps`` ``(K,)`` int64; ``crops``
    ``(2,)`` float32 in 0..1, the place of a random crop, for models that crop. T and D are those
    of ``actions`` at this place, so it belongs behind the normalisation.

    Args:
        num_train_timesteps: the model's.
        repeats: K, draws for each sample.
    """

    training_only = True
    keeps_images = True

    def __init__(self, num_train_timesteps: int = 100, repeats: int = 1) -> None:
        if num_train_timesteps < 1 or repeats < 1:
            raise ConfigError(
                f"SampleDiffusionNoise: num_train_timesteps {num_train_timesteps} and repeats "
                f"{repeats} must be at least 1"
            )
        self.num_train_timesteps = num_train_timesteps
        self.repeats = repeats

    def __call__(self, sample: Sample, rng: np.random.Generator) -> Sample:
        shape = (self.repeats, *np.shape(sample["actions"]))
        return {
            **sample,
            "noise": rng.standard_normal(shape, dtype=np.float32),
            "timesteps": rng.integers(0, self.num_train_timesteps, self.repeats),
            "crops": rng.random(2, dtype=np.float32),
        }
