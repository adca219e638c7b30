"""Noise schedules of diffusion models and the steps back from noise to data.

``x_t = sqrt(a_t) x_0 + sqrt(1 - a_t) noise``, with ``a_t`` the product of ``1 - beta`` up to step
``t`` (Ho et al. 2020, equation 4). Steps back by the posterior's mean and variance (DDPM, equations
6 and 7 there) or without noise (DDIM, Song et al. 2021, equation 12 with sigma 0).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from fluxvla_core.errors import ConfigError

BETAS = ("linear", "scaled_linear", "squaredcos_cap_v2")
KINDS = ("DDPM", "DDIM")
PREDICTIONS = ("epsilon", "sample")


@dataclass(frozen=True)
class DiffusionSchedule:
    """How much noise there is at each step, and what a network predicts.

    Args:
        kind: ``DDPM`` or ``DDIM``.
        steps: of training, N.
        inference_steps: steps from noise to data; N by default. They are evenly spaced.
        beta_schedule: ``linear`` or ``scaled_linear`` (of the square root) from ``beta_start`` to
            ``beta_end``, or ``squaredcos_cap_v2`` (Nichol and Dhariwal 2021, equation 17).
        prediction: ``epsilon``, the noise, or ``sample``, the data.
        clip: estimates of the data are clipped to -clip..clip on the way; None: they are not.

    Raises:
        ConfigError: a name that is unknown, or more steps at inference than in training.
    """

    kind: str = "DDPM"
    steps: int = 100
    inference_steps: int | None = None
    beta_schedule: str = "squaredcos_cap_v2"
    beta_start: float = 0.0001
    beta_end: float = 0.02
    prediction: str = "epsilon"
    clip: float | None = 1.0

    def __post_init__(self) -> None:
        for what, value, known in (
            ("noise_scheduler_type", self.kind, KINDS),
            ("beta_schedule", self.beta_schedule, BETAS),
            ("prediction_type", self.prediction, PREDICTIONS),
        ):
            if value not in known:
                raise ConfigError(f"{what} {value!r} is not one of {', '.join(known)}")
        if not 1 <= self.count <= self.steps:
            raise ConfigError(
                f"num_inference_steps {self.count} is not between 1 and "
                f"num_train_timesteps {self.steps}"
            )

    @property
    def count(self) -> int:
        """Steps from noise to data."""
        return self.steps if self.inference_steps is None else self.inference_steps

    @property
    def timesteps(self) -> list[int]:
        """The steps that inference takes, from noise to data."""
        return [place * self._stride for place in reversed(range(self.count))]

    def shares(self) -> Tensor:
        """``a_t`` for each step of training, ``(N,)`` float32."""
        return torch.cumprod(1.0 - self._betas(), dim=0)

    def add_noise(self, clean: Tensor, noise: Tensor, timesteps: Tensor) -> Tensor:
        """``x_t`` of ``(B, ...)`` at ``timesteps`` ``(B,)`` int64."""
        share = self.shares().to(clean.device, clean.dtype)[timesteps]
        share = share.reshape(-1, *[1] * (clean.ndim - 1))
        return share.sqrt() * clean + (1 - share).sqrt() * noise

    def coefficients(self) -> Tensor:
        """What :meth:`step` needs of each step in :attr:`timesteps`, ``(count, 5)`` float32.

        ``sqrt(a_t)`` and ``sqrt(1 - a_t)``; what the estimate of the data is multiplied by, and
        what the rest is: the noise in ``x`` (DDIM) or ``x`` itself (DDPM); the deviation of the
        noise that DDPM adds.
        """
        steps = torch.tensor(self.timesteps)
        shares = self.shares()
        now, before = shares[steps], steps - self._stride
        earlier = torch.where(before >= 0, shares[before.clamp(min=0)], 1.0)
        if self.kind == "DDIM":
            clean, rest, added = earlier.sqrt(), (1 - earlier).sqrt(), torch.zeros_like(now)
        else:
            beta = 1 - now / earlier
            clean = earlier.sqrt() * beta / (1 - now)
            rest = (now / earlier).sqrt() * (1 - earlier) / (1 - now)
            added = ((1 - earlier) / (1 - now) * beta).clamp(min=1e-20).sqrt()
        return torch.stack([now.sqrt(), (1 - now).sqrt(), clean, rest, added], dim=1)

    def step(self, output: Tensor, x: Tensor, coefficients: Tensor, noise: Tensor | None) -> Tensor:
        """From ``x`` one step back, by the network's ``output`` there.

        Args:
            coefficients: ``(5,)``, the step's row of :meth:`coefficients`.
            noise: standard normal like ``x``, for DDPM; None in its last step.
        """
        signal, spread, clean_share, rest_share, deviation = coefficients.unbind()
        if self.prediction == "epsilon":
            clean, predicted = (x - spread * output) / signal, output
        else:
            clean, predicted = output, (x - signal * output) / spread
        if self.clip is not None:
            clean = clean.clamp(-self.clip, self.clip)
        rest = predicted if self.kind == "DDIM" else x
        found = clean_share * clean + rest_share * rest
        return found if noise is None else found + deviation * noise

    @property
    def _stride(self) -> int:
        return self.steps // self.count

    def _betas(self) -> Tensor:
        if self.beta_schedule == "linear":
            return torch.linspace(self.beta_start, self.beta_end, self.steps)
        if self.beta_schedule == "scaled_linear":
            return torch.linspace(self.beta_start**0.5, self.beta_end**0.5, self.steps) ** 2

        def share(time: float) -> float:
            return math.cos((time + 0.008) / 1.008 * math.pi / 2) ** 2

        pairs = [(i / self.steps, (i + 1) / self.steps) for i in range(self.steps)]
        return torch.tensor([min(1 - share(late) / share(early), 0.999) for early, late in pairs])
